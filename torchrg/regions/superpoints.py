"""Hierarchical superpoint partition by greedy region merging in a neighbor graph."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torchrg import kernels
from torchrg._checks import eager_only
from torchrg._parallel import ROWS_AT_ONCE, map_chunks, nonzero_rows, split_rows
from torchrg.config import SuperpointsConfig, is_terraced
from torchrg.linalg.angles import sq_chords
from torchrg.linalg.moments import Segments, eigh3_lapack, reduce_runs
from torchrg.neighbors import distinct_points, measure_sampling, search_knn
from torchrg.neighbors.knn import prepare_search
from torchrg.neighbors.order import DistinctPoints, finite_rows
from torchrg.regions.adjacency import NUM_CONTACTS, KnnAdjacency
from torchrg.regions.edges import neighborhood_radii
from torchrg.regions.fit import fit_planes, mean_normals
from torchrg.regions.growth import rank_by_count
from torchrg.regions.repair import value_of_points
from torchrg.regions.splits import connected_points
from torchrg.robust.lanes import sum_products, sum_squares
from torchrg.structures import UNLABELED, Neighbors, Sampling, Superpoints

_NUM_MEASURED = 50
"""Number of neighbors by which the sampling is measured, the default of ``normals.k``."""
_MAX_RMS = 0.3
"""Maximum RMS distance of the points of terraces to their plane, as a fraction of the RMS distance
along it. It is 0.05 for a table seen by a Kinect; a slab a third as thick as long has 0.33."""
_PLANE_REACH = 3.0
"""Maximum distance of a point of a terrace to the plane, in thicknesses, as for absorbed points;
others may be on another surface."""
_RADIUS_SPACINGS = 1.6
"""Radius, in spacings, of a circle around 8 points that are one spacing apart."""
_COLOR_WEIGHT = 3.0
"""Weight of a squared color difference, channels in [0, 1], relative to unit normals. Colors a
third of the range apart in each channel weigh the same as a squared normal difference of 1."""
_PLANE_FRACTION, _MAX_SPREAD_DEG = 0.5, 20.0
"""Fraction by which a point normal is turned to the mean normal of its plane, and the maximum RMS
angle of the normals of such a plane. Noise and edges perturb normals, but not a plane's mean. In a
column, the RMS angle is 45 degrees."""
_POSITION_SPACINGS = 150.0
"""Length, in spacings, that scales positions to features. It separates boards, pictures and doors
that are flush with a wall."""
_STEP_WEIGHT = 0.25
"""Weight of the squared sine of the angle between a contact and the surface. A perpendicular
contact, as at a step, weighs the same as normals that differ by 29 degrees."""
_PLANE_WEIGHT = 0.25
"""Weight of a contact between points of different planes, equal to normals that differ by 29
degrees."""
_MIN_DIFFERENCE = 0.01
"""Squared normal difference, equal to 6 degrees, added even between regions of one surface."""
_MAX_EDGES = 64
"""Maximum number of listed edges per vertex, which bounds the memory; reconstructions have 6."""
_MERGE_DIVISOR = 8
"""When merging to a number of superpoints, the cheapest 1/8 of the boundaries are eligible per
round."""
_MIN_SIZE_RATIO = 16
"""Minimum size ratio at which a region merges, in one round, with all smaller ones that prefer it:
they hardly change it. Otherwise a floor would take one speck per round."""


@eager_only
def partition_points(
    points: Tensor,
    normals: Tensor,
    labels: Tensor,
    config: SuperpointsConfig,
    colors: Tensor | None = None,
    faces: Tensor | None = None,
    neighbors: Neighbors | None = None,
) -> Superpoints:
    r"""Partition a cloud; see :func:`torchrg.make_superpoints`.

    Initial regions are single points, or complete planes and single points. Merging two adjacent
    regions of :math:`n_a` and :math:`n_b` points costs

    .. math:: \frac{n_a n_b}{n_a + n_b} (d_{ab} + \epsilon) / \sqrt{c_{ab}},

    where c is the number of contacts and d the difference. The difference is the squared difference
    of the region features (mean of :math:`n n^T` [1], color, and position in units of 150 spacings)
    plus the mean difference along contacts (normals, steps between parallel surfaces, different
    planes). The first factor is Ward's [2], the increase of the variance within regions. Divided by
    the length of the removed boundary, it is the regularization strength at which the Mumford-Shah
    energy falls [3]. Cut pursuit minimizes this energy [4], and, with positions and normals, so do
    the supervoxels of [5] and [6]; normals come first as in [7]. Contacts measure the boundary
    length up to noise, hence the root. Pairs merge up to each configured strength, or until each
    configured number of superpoints remains. Each round merges mutually cheapest partners, and
    small regions into a much larger cheapest partner, so no visiting order is needed.

    Rounding of quantized coordinates makes terraces of a surface. Their points are moved to the
    plane of their label, so that steps between terraces neither cost nor separate.

    If the normals of a plane agree, each point normal is moved halfway to the plane normal, which
    gives noise less weight and positions more.

    ``labels`` ``(N,)`` are plane IDs, negative if unlabeled; ``colors`` ``(N, 3)`` are in [0, 1],
    floating point and finite. For a mesh with ``faces`` ``(F, 3)`` contacts are its edges,
    otherwise edges to the 8 nearest points. These are ``neighbors`` of the distinct finite points
    in canonical order, searched by default.

    References:
        [1] H. Knutsson. Representing local structure using tensors. SCIA, 1989.
        [2] J. Ward. Hierarchical grouping to optimize an objective function. JASA, 1963.
        [3] G. Koepfler, C. Lopez, J.-M. Morel. A multiscale algorithm for image segmentation by
        variational method. SIAM J. Numerical Analysis, 1994.
        [4] L. Landrieu, G. Obozinski. Cut pursuit: fast algorithms to learn piecewise constant
        functions on general weighted graphs. SIAM J. Imaging Sciences, 2017.
        [5] J. Papon et al. Voxel cloud connectivity segmentation (VCCS): supervoxels for point
        clouds. CVPR, 2013.
        [6] Y. Lin et al. Toward better boundary preserved supervoxel segmentation for 3D point
        clouds. ISPRS J. Photogrammetry and Remote Sensing, 2018.
        [7] J. Walczak et al. Normal grouping density separation (NGDS): a novel object-driven
        indoor point cloud partition method. ICCS, 2020.
    """
    distinct, unique_colors = merge_duplicates(points, normals, labels, colors)
    if is_terraced(_measure(distinct.points, neighbors)):
        rows = distinct.rows
        flat = _flatten_terraces(distinct.points.detach(), normals[rows], labels[rows])
        points, neighbors = distinct.restore(flat, fill=torch.nan), None
        distinct, unique_colors = merge_duplicates(points, normals, labels, colors)
    edges = None
    if faces is not None:
        edges = _mesh_edges(faces.cpu(), distinct.inverse.cpu())
    partitions = _partition_distinct(
        distinct.points.detach().cpu(),
        normals[distinct.rows].detach().cpu(),
        labels[distinct.rows].long().cpu(),
        config,
        None if unique_colors is None else unique_colors.cpu(),
        edges,
        neighbors,
    )
    levels = []
    for level in partitions:
        of_points = distinct.restore(level.to(points.device), fill=UNLABELED)
        levels.append(rank_by_count(of_points)[of_points])
    return Superpoints(levels[0], majority_planes(levels[0], labels), tuple(levels[1:]))


def _measure(points: Tensor, neighbors: Neighbors | None) -> Sampling:
    """Measure the sampling of distinct points; search a few neighborhoods if not known."""
    if neighbors is not None and neighbors.indices.shape[1] == _NUM_MEASURED:
        return measure_sampling(points, neighbors)
    if len(points) < _NUM_MEASURED:
        return Sampling()
    return measure_sampling(points, prepare_search(points.numpy(force=True), _NUM_MEASURED))


def _flatten_terraces(points: Tensor, normals: Tensor, labels: Tensor) -> Tensor:
    """Return points ``(n, 3)`` projected onto the plane of their label, if this is flat."""
    plane = _number_planes(labels)
    fits = fit_planes(Segments(plane), points, normals)
    length = eigh3_lapack(fits.covariance)[0][:, 2].sqrt()
    are_flat = ~fits.curved & (fits.rms <= _MAX_RMS * length)
    reach = value_of_points(torch.where(are_flat, _PLANE_REACH * fits.thickness, -1.0), plane, -1.0)
    offset = fits.signed_distances(points, plane)
    offset = offset.where(offset.abs() <= reach, 0)
    slopes = (value_of_points(column, plane, 0.0) for column in fits.normal.unbind(dim=1))
    return (points - torch.stack([offset * slope for slope in slopes], dim=1)).to(points)


def _number_planes(labels: Tensor) -> Tensor:
    """Return plane IDs ``(n,)`` as consecutive numbers, -1 if unlabeled."""
    values, numbers = torch.unique(labels.clamp(min=UNLABELED), return_inverse=True)
    consecutive: Tensor = numbers - int(torch.count_nonzero(values < 0))
    return consecutive


def merge_duplicates(
    points: Tensor, normals: Tensor, labels: Tensor, colors: Tensor | None
) -> tuple[DistinctPoints, Tensor | None]:
    """Return the distinct points of a cloud, and their colors.

    Among duplicates with different values, the point on the largest plane represents all. Their
    color is the midpoint of the channel minimum and maximum, independent of the order.
    """
    last = torch.iinfo(labels.dtype).max
    ties = labels.where(labels >= 0, last), *normals.detach().unbind(dim=1)
    distinct = distinct_points(points, ties)
    if colors is None:
        return distinct, None
    unique_colors = colors.detach()
    if not distinct.num_copies:
        return distinct, unique_colors[distinct.rows]
    rows = finite_rows(points)
    counts, columns = torch.bincount(distinct.inverse[rows]), unique_colors[rows].unbind(dim=1)
    low, high = (
        torch.stack([reduce_runs(column, counts, side) for column in columns], dim=1)
        for side in ("min", "max")
    )
    return distinct, (low + high) / 2


def _partition_distinct(
    positions: Tensor,
    normals: Tensor,
    labels: Tensor,
    config: SuperpointsConfig,
    colors: Tensor | None,
    edges: Tensor | None,
    neighbors: Neighbors | None,
) -> list[Tensor]:
    """Return the region of each distinct point ``(n,)`` in canonical order, level by level."""
    if len(positions) == 0:
        return [torch.zeros(0, dtype=torch.int64) for _ in range(config.num_levels)]
    k = min(1 + NUM_CONTACTS, len(positions))
    if neighbors is None or neighbors.indices.shape[1] < k:
        neighbors = search_knn(positions, k, canonical=True)
    neighbors = Neighbors(neighbors.indices[:, :k].cpu())
    # The points are assumed to be evenly spread.
    radii = neighborhood_radii(positions.double(), neighbors)
    spacing = float(radii.median()) / _RADIUS_SPACINGS
    normals = _blend_with_planes(normals, labels)
    if colors is not None:
        colors = math.sqrt(_COLOR_WEIGHT) * colors
    nearest = KnnAdjacency(neighbors).neighbors.indices
    nearest = nearest if edges is None else _edge_lists(edges, len(positions))
    regions = torch.arange(len(positions))
    if config.planes == "whole":
        parts = Segments(connected_points(labels, nearest))
        regions[parts.rows] = parts.broadcast(parts.first(regions))
        regions = torch.unique(regions, return_inverse=True)[1]
    bound = math.inf if config.max_extent is None else config.max_extent
    graphs = [
        _Graph(
            _initial_regions(regions, positions, spacing, normals, colors, bound),
            _initial_boundaries(regions, positions, normals, labels, nearest),
        )
    ]
    levels = [partial(_merge_to_strength, strength) for strength in config.strengths]
    if config.counts is not None:
        levels = [partial(_merge_to_count, count) for count in config.counts]
    partitions = []
    for merge in levels:
        graph, merged = merge(graphs, config.min_size, bound)
        graphs, regions = [graph], merged[regions]
        partitions.append(regions)
    return partitions


def _blend_with_planes(normals: Tensor, labels: Tensor) -> Tensor:
    """Return normals halfway between the point normal and the plane normal of flat planes."""
    plane, inputs = _number_planes(labels), normals.double()
    axes, spread = mean_normals(Segments(plane), inputs)
    rows = nonzero_rows(value_of_points(spread <= _MAX_SPREAD_DEG, plane, False))
    shared, inputs = axes[plane[rows]], inputs[rows]
    shared = torch.where((inputs * shared).sum(dim=1, keepdim=True) < 0, -shared, shared)
    blended = functional.normalize(torch.lerp(inputs, shared, _PLANE_FRACTION), dim=1)
    return normals.index_copy(0, rows, blended.to(normals))


def _mesh_edges(faces: Tensor, positions: Tensor) -> Tensor:
    """Return the directed mesh edges as distinct pairs of points ``(E, 2)``, ascending."""
    corners = positions[faces.long()]
    pairs = torch.cat([corners[:, [i, j]] for i in range(3) for j in range(3) if i != j])
    pairs = pairs[(pairs >= 0).all(dim=1) & (pairs[:, 0] != pairs[:, 1])]
    width = len(positions) + 1
    keys = torch.unique(pairs[:, 0] * width + pairs[:, 1])
    return torch.stack([keys // width, keys % width], dim=1)


def _edge_lists(edges: Tensor, num_points: int) -> Tensor:
    """Return up to 64 edge targets of each point ``(n, K)``, padded with the point itself."""
    counts = torch.bincount(edges[:, 0], minlength=num_points)
    column = torch.arange(len(edges)) - (counts.cumsum(0) - counts)[edges[:, 0]]
    first = column < _MAX_EDGES
    width = max(int(counts.max()), 1) if len(edges) else 1
    lists = torch.arange(num_points, dtype=torch.int32)[:, None].repeat(1, min(width, _MAX_EDGES))
    lists[edges[first, 0], column[first]] = edges[first, 1].to(torch.int32)
    return lists


class _Regions(NamedTuple):
    """Sizes of R regions, feature sums ``(R, F)`` and bounding boxes ``(R, 3)``, float64.

    Without an extent bound the boxes have no columns.
    """

    size: Tensor
    features: Tensor
    low: Tensor
    high: Tensor


class _Boundaries(NamedTuple):
    """Adjacent pairs of regions, ``first < second``, ascending, and sums over their contacts.

    The pairs are int32, the sums float64.
    """

    first: Tensor
    second: Tensor
    contacts: Tensor
    difference: Tensor


class _Graph(NamedTuple):
    """Regions and their boundaries."""

    regions: _Regions
    boundaries: _Boundaries


def _initial_regions(
    regions: Tensor,
    positions: Tensor,
    spacing: float,
    normals: Tensor,
    colors: Tensor | None,
    bound: float,
) -> _Regions:
    """Return the feature sums and boxes of the initial regions."""
    positions = positions.double()
    x, y, z = normals.double().unbind(dim=1)
    off = math.sqrt(2)
    features = [x * x, y * y, z * z, off * x * y, off * y * z, off * z * x]
    length = min(_POSITION_SPACINGS * spacing, bound)
    if length > 0:
        features += ((positions - positions.amin(dim=0)) / length).unbind(dim=1)
    if colors is not None:
        features += colors.double().unbind(dim=1)
    corners = positions[:, : 3 if bound < math.inf else 0]
    points = _Regions(torch.ones_like(x), torch.stack(features, dim=1), corners, corners)
    return _merged_regions(points, regions)


def _merged_regions(regions: _Regions, new: Tensor) -> _Regions:
    """Return merged regions: sums and boxes of regions with the same new index ``(R,)``."""
    # bincount adds the elements in order.
    size = torch.bincount(new, weights=regions.size)
    features = regions.features.new_empty(len(size), regions.features.shape[1])
    for column, sums in zip(features.unbind(dim=1), regions.features.unbind(dim=1), strict=True):
        column.copy_(torch.bincount(new, weights=sums))
    rows = new[:, None].expand(regions.low.shape)
    low, high = (
        corners.new_empty(len(size), corners.shape[1]).scatter_reduce(
            0, rows, corners, side, include_self=False
        )
        for side, corners in (("amin", regions.low), ("amax", regions.high))
    )
    return _Regions(size, features, low, high)


def _initial_boundaries(
    regions: Tensor, positions: Tensor, normals: Tensor, labels: Tensor, nearest: Tensor
) -> _Boundaries:
    """Return the boundaries of the initial regions: contacts lead from a point to a near one."""
    difference = torch.empty(nearest.shape, dtype=torch.float64)

    def measure(rows: slice) -> None:
        difference[rows] = _contact_differences(rows, positions, normals, labels, nearest)

    map_chunks(measure, len(regions), ROWS_AT_ONCE, regions.device)
    regions = regions.int()
    source = regions[:, None].expand(nearest.shape).reshape(-1)
    target = regions.index_select(0, nearest.reshape(-1))
    return _aggregate(source, target, None, difference.flatten())


def _contact_differences(
    rows: slice, positions: Tensor, normals: Tensor, labels: Tensor, nearest: Tensor
) -> Tensor:
    """Return the differences between points and near points, shape ``(n, K)``, float64.

    See the formula: squared normal difference, squared sine of the angle between the contact and
    the flatter surface, and whether the planes differ.
    """
    near = nearest[rows]
    if kernels.serve(positions, normals):
        weights = _STEP_WEIGHT, _PLANE_WEIGHT
        first = torch.arange(rows.start, rows.stop)
        arguments = positions, normals, labels, first, near, *weights
        return kernels.call("contact_differences", *arguments)[0]
    columns = [column.double() for column in (*positions.unbind(dim=1), *normals.unbind(dim=1))]
    here = [column[rows, None] for column in columns]
    there = [column[near] for column in columns]
    offset = [b - a for a, b in zip(here[:3], there[:3], strict=True)]
    ends = here[3:], there[3:]
    steps = (sum_products(offset, normal).square() for normal in ends)
    step = torch.minimum(*steps) / sum_squares(offset)
    is_different = (labels[rows, None] != labels[near]).double()
    return sq_chords(*ends) + _STEP_WEIGHT * step + _PLANE_WEIGHT * is_different


def _aggregate(a: Tensor, b: Tensor, contacts: Tensor | None, difference: Tensor) -> _Boundaries:
    """Return one row per pair of different regions, with the sums of its rows.

    Without ``contacts`` each row counts as one.
    """
    if len(a) == 0:
        return _Boundaries(a, b, difference, difference)
    width = int(torch.maximum(a.max(), b.max())) + 1
    if kernels.serve():
        buffers = torch.empty(2, width + 1, dtype=torch.int64)
        rows = kernels.call("aggregate_boundaries", a, b, contacts, difference, *buffers)
        return _Boundaries(*(column[: int(rows[-1])] for column in rows[1:-1]))
    contacts = torch.ones_like(difference) if contacts is None else contacts
    different = nonzero_rows(a != b)
    a, b, contacts, difference = (part[different] for part in (a, b, contacts, difference))
    if len(a) == 0:
        return _Boundaries(a, b, contacts, difference)
    a, b = a.long(), b.long()
    keys, order = (torch.minimum(a, b) * width + torch.maximum(a, b)).sort(stable=True)
    keys, counts = torch.unique_consecutive(keys, return_counts=True)
    contacts, difference = (
        torch.segment_reduce(part[order], "sum", lengths=counts) for part in (contacts, difference)
    )
    return _Boundaries((keys // width).int(), (keys % width).int(), contacts, difference)


def _merge_to_strength(
    strength: float, graphs: list[_Graph], min_size: int, bound: float
) -> tuple[_Graph, Tensor]:
    """Merge pairs that cost at most ``strength``, then small regions; return graph and indices."""
    graph, assignment = _last(_merge_rounds(graphs, bound, lambda cost, graph: cost <= strength))
    graph, merged = _last(_merge_rounds([graph], bound, partial(_is_small, min_size)))
    return graph, merged[assignment]


def _merge_to_count(
    count: int, graphs: list[_Graph], min_size: int, bound: float
) -> tuple[_Graph, Tensor]:
    """Merge the cheapest pairs until ``count`` regions remain, all of them large enough.

    Small regions are merged at the last round with enough large regions: late enough that points
    have become regions, early enough that only final regions count. Returns the same as
    :func:`_merge_to_strength`.
    """
    num_large = 0
    for state in _merge_rounds(graphs, bound, _is_cheap, count):
        num_enough = int((state[0].regions.size >= min_size).sum())
        if num_enough >= min(num_large, count):
            num_large, (graph, assignment) = num_enough, state
    graph, merged = _last(_merge_rounds([graph], bound, partial(_is_small, min_size)))
    graph, remapped = _last(_merge_rounds([graph], bound, _is_cheap, count))
    return graph, remapped[merged[assignment]]


def _last(states: Iterator[tuple[_Graph, Tensor]]) -> tuple[_Graph, Tensor]:
    """Return the last of one or more states."""
    return deque(states, maxlen=1).pop()


def _is_small(min_size: int, cost: Tensor, graph: _Graph) -> Tensor:
    """Return a mask of boundaries of a region smaller than ``min_size``."""
    size = graph.regions.size
    return torch.minimum(size[graph.boundaries.first], size[graph.boundaries.second]) < min_size


def _is_cheap(cost: Tensor, graph: _Graph) -> Tensor:
    """Return a mask of the cheapest boundaries."""
    return cost <= cost.kthvalue(-(-len(cost) // _MERGE_DIVISOR)).values


def _merge_rounds(
    graphs: list[_Graph],
    bound: float,
    is_eligible: Callable[[Tensor, _Graph], Tensor],
    count: int = 1,
) -> Iterator[tuple[_Graph, Tensor]]:
    """Yield the graph and the new region indices while eligible pairs merge down to ``count``.

    The list is emptied so that the initial (largest) graph can be freed.
    """
    graph = graphs.pop()
    # Merging several regions into one at a time could exceed the extent bound.
    ratio = _MIN_SIZE_RATIO if bound == math.inf else math.inf
    assignment = torch.arange(len(graph.regions.size))
    while True:
        yield graph, assignment
        regions, boundaries = graph
        max_merges = len(regions.size) - count
        if max_merges <= 0 or len(boundaries.first) == 0:
            return
        cost = _merge_costs(regions, boundaries, bound)
        cost.masked_fill_(~is_eligible(cost, graph), math.inf)
        if not bool((cost < math.inf).any()):
            return
        chosen = _choose_pairs(boundaries, cost, regions.size, ratio, max_merges)
        del cost
        graph, new = _merge(graph, *chosen)
        assignment = new[assignment]


def _merge_costs(regions: _Regions, boundaries: _Boundaries, bound: float) -> Tensor:
    """Return the merge cost of each boundary, infinite if the box would exceed the bound."""
    means = regions.features / regions.size[:, None]
    if kernels.serve():
        boxes = regions.low, regions.high
        limits = _MIN_DIFFERENCE, bound
        return kernels.call("merging_costs", regions.size, means, *boxes, *boundaries, *limits)[0]
    cost = torch.empty_like(boundaries.contacts)
    for rows in split_rows(len(cost), ROWS_AT_ONCE):
        a, b = boundaries.first[rows], boundaries.second[rows]
        difference = boundaries.difference[rows] / boundaries.contacts[rows] + _MIN_DIFFERENCE
        for step in (means[a] - means[b]).unbind(dim=1):
            difference += step * step
        size_a, size_b = regions.size[a], regions.size[b]
        ward = size_a * size_b / (size_a + size_b)
        cost[rows] = ward * difference / boundaries.contacts[rows].sqrt()
        if bound < math.inf:
            high = torch.maximum(regions.high[a], regions.high[b])
            low = torch.minimum(regions.low[a], regions.low[b])
            cost[rows] = cost[rows].where((high - low).amax(dim=1) <= bound, math.inf)
    return cost


def _choose_pairs(
    boundaries: _Boundaries, cost: Tensor, size: Tensor, ratio: float, max_merges: int
) -> tuple[Tensor, Tensor]:
    """Return regions to merge and their targets, which remain.

    A pair is mutually cheapest, or the source's cheapest partner has ``ratio`` times its points.
    Returns at most ``max_merges`` pairs, cheapest first; ties go to the first boundary.
    """
    num_regions, num_boundaries = len(size), len(cost)
    min_cost, best = _cheapest(boundaries, cost, num_regions)
    source = (best < num_boundaries).nonzero().squeeze(1)
    target = boundaries.first[best[source]] - source + boundaries.second[best[source]]
    joins = size[target] >= ratio * size[source]
    is_joining = torch.zeros(num_regions, dtype=torch.bool).index_copy(0, source, joins)
    joins &= ~is_joining[target]
    mutual = (best[target] == best[source]) & ~is_joining[source] & ~is_joining[target]
    joins |= mutual & (source > target)
    source, target = source[joins], target[joins]
    if len(source) > max_merges:
        cheapest = min_cost[source].argsort(stable=True)[:max_merges]
        source, target = source[cheapest], target[cheapest]
    owner = torch.arange(num_regions).index_copy(0, source, target)
    # The target may itself have merged into its mutual partner.
    return source, owner[target]


def _cheapest(boundaries: _Boundaries, cost: Tensor, num_regions: int) -> tuple[Tensor, Tensor]:
    """Return each region's minimum boundary cost, and its first boundary of that cost, or E."""
    min_cost = cost.new_full((num_regions,), math.inf)
    if kernels.serve():
        (best,) = kernels.call(
            "cheapest_boundaries", boundaries.first, boundaries.second, cost, min_cost
        )
        return min_cost, best
    ends, costs = torch.cat([boundaries.first, boundaries.second]).long(), cost.repeat(2)
    min_cost = min_cost.scatter_reduce(0, ends, costs, "amin")
    rows = torch.arange(len(cost)).repeat(2)
    is_min = (costs == min_cost[ends]) & costs.isfinite()
    best = torch.full((num_regions,), len(cost))
    return min_cost, best.scatter_reduce(0, ends[is_min], rows[is_min], "amin")


def _merge(graph: _Graph, sources: Tensor, targets: Tensor) -> tuple[_Graph, Tensor]:
    """Merge regions into their targets; also return the new index of each region."""
    regions, (first, second, *sums) = graph
    rows = torch.arange(len(regions.size))
    owner = rows.index_copy(0, sources, targets)
    new = ((owner == rows).cumsum(0) - 1)[owner]
    ends = (new.int().index_select(0, side) for side in (first, second))
    return _Graph(_merged_regions(regions, new), _aggregate(*ends, *sums)), new


def majority_planes(superpoints: Tensor, labels: Tensor) -> Tensor:
    """Return the plane ID of more than half of each superpoint's points, or -1."""
    is_assigned = superpoints >= 0
    count = int(superpoints.max()) + 1 if bool(is_assigned.any()) else 0
    sizes = torch.bincount(superpoints[is_assigned], minlength=count)
    main = torch.full((count,), UNLABELED, device=labels.device)
    on_plane = is_assigned & (labels >= 0)
    if not bool(on_plane.any()):
        return main
    planes, rows = torch.unique(labels[on_plane].long(), return_inverse=True)
    keys = superpoints[on_plane] * len(planes) + rows
    keys, shared = torch.unique(keys, return_counts=True)
    mostly = 2 * shared > sizes[keys // len(planes)]
    chosen = keys[mostly]
    return main.index_copy(0, chosen // len(planes), planes[chosen % len(planes)])
