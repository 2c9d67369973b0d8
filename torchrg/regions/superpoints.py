"""Superpoints: a partition of all points into connected parts of one orientation, in levels.

Regions of a graph of neighbours merge pair by pair, the pair that costs the energy least first.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, chunks_of, map_chunks, places_of
from torchrg.config import SuperpointsConfig
from torchrg.linalg import sq_chords
from torchrg.linalg.moments import Segments
from torchrg.neighbors import finite_rows, restore_rows, search_knn
from torchrg.neighbors.voxels import cell_keys
from torchrg.regions.adjacency import NUM_CONTACTS, NearestPoints
from torchrg.structures import UNLABELED, Neighbors, Superpoints

_NUM_NEIGHBORS = 1 + NUM_CONTACTS
"""The point itself, and those that surround it on a surface."""

_SPACINGS_IN_REACH = 1.6
"""A circle around 8 points that are one spacing apart has this many spacings for its radius."""

_PIECE_SPACINGS = 8.0
"""Side of the pieces that planes enter as, in spacings: some 64 points, as the smallest plane."""

_PIECES_EACH = 2
"""Least mean number of pieces in a superpoint where their number is set, so that there is a
choice."""

_COLOR_WEIGHT = 3.0
"""Weight of a squared difference of colours in [0, 1] against one of unit normals: colours that are
a third of the range apart in each channel weigh as much as a squared difference of normals of 1."""

_COLOR_VARIATION = 0.1
"""Weighted squared differences of the colours of a piece from their mean, added up, above which the
piece is cut: four points that are off by 0.09 of the range from black to white reach it."""

_PLACE_SPACINGS = 100.0
"""Length by which places are divided to become features, in spacings. It tells boards, pictures and
doors apart that are flush with a wall."""

_LEAST_DIFFERENCE = 0.01
"""Squared difference of normals, that of 6 degrees, which counts even between regions of one
surface."""

_MOST_EDGES = 64
"""Edges of a vertex that it lists at most, which bounds the memory; reconstructions have 6."""

_BORDERS_A_TURN = 8
"""Towards a given number of superpoints one of so many borders, the cheapest, may vanish at a
time."""

_MUCH_LARGER = 16
"""A region of so many times the points of another hardly changes by it, so it takes in all such
that would rather join it than any other at a time. Else a floor takes in one speck at a time."""


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

    The first regions are compact pieces of planes, or whole planes, and single points. Of two
    regions that touch, of :math:`n_a` and :math:`n_b` points, merging costs

    .. math:: \frac{n_a n_b}{n_a + n_b} (d_{ab} + \epsilon) / \sqrt{c_{ab}},

    where d is the squared difference of what the regions are (mean of :math:`n n^T` [1], of the
    colour, and of the place in units of 100 spacings) and, at their contacts, the mean squared
    difference of the normals, and c the number of contacts. The first factor is Ward's [2]: the
    increase of the variance within regions. Divided by the length of the border that vanishes it is
    the strength of regularisation at which the energy of Mumford and Shah falls [3], the energy
    that cut pursuit minimises [4] and, with places and normals, the supervoxels of [5] and [6];
    normals come first as in [7]. Contacts are that length up to noise, hence their root. Pairs
    merge up to each strength of the configuration, or until each of its numbers of superpoints is
    left. Regions that are each other's cheapest partner merge at a time, and small ones with a much
    larger one that is theirs: this needs no order of visits.

    ``labels`` ``(N,)`` are those of planes, negative for none. Of a mesh with ``faces`` ``(F, 3)``
    contacts are its edges, else those of a point to the 8 nearest: ``neighbors`` of the finite
    points in canonical order are searched unless they are given, and no two points are equal.

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
    rows = finite_rows(points)
    ordered = points[rows].detach()
    is_first = torch.ones(len(rows), dtype=torch.bool, device=points.device)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(dim=1)
    place = is_first.cumsum(0) - 1
    distinct = rows[is_first]
    edges = None
    if faces is not None:
        edges = _mesh_edges(faces.cpu(), restore_rows(place, rows, len(points), fill=-1).cpu())
    if neighbors is not None and not bool(is_first.all()):
        neighbors = None
    partitions = _partition_places(
        ordered[is_first].cpu(),
        normals[distinct].detach().cpu(),
        labels[distinct].cpu(),
        config,
        None if colors is None else _unit_colors(colors[distinct]).cpu(),
        edges,
        neighbors,
    )
    levels = tuple(
        restore_rows(level.to(place.device)[place], rows, len(points), fill=UNLABELED)
        for level in (_by_size(level, place.cpu()) for level in partitions)
    )
    return Superpoints(levels[0], main_planes(levels[0], labels), levels[1:])


def _partition_places(
    places: Tensor,
    normals: Tensor,
    labels: Tensor,
    config: SuperpointsConfig,
    colors: Tensor | None,
    edges: Tensor | None,
    neighbors: Neighbors | None,
) -> list[Tensor]:
    """Return the region of each of distinct points ``(n,)`` in canonical order, level by level."""
    if len(places) == 0:
        return [torch.zeros(0, dtype=torch.int64) for _ in range(config.num_levels)]
    k = min(_NUM_NEIGHBORS, len(places))
    if neighbors is None or neighbors.indices.shape[1] < k:
        neighbors = search_knn(places, k, canonical=True)
    neighbors = Neighbors(neighbors.indices[:, :k].cpu())
    spacing = _median_spacing(places, neighbors)
    if colors is not None:
        colors = math.sqrt(_COLOR_WEIGHT) * colors
    pieces = labels
    if config.planes == "pieces":
        pieces = _cut_planes(places, spacing, neighbors, labels, colors, config)
    nearest = NearestPoints(neighbors).neighbors.indices
    nearest = nearest if edges is None else _listed(edges, len(places))
    regions = _first_regions(pieces, nearest)
    graph = _Graph(
        _describe(Segments(regions), places, spacing, normals, colors, config),
        _describe_borders(regions, normals, nearest),
    )
    levels: list[Callable[..., tuple[_Graph, Tensor]]]
    if config.counts is None:
        levels = [partial(_merge_to_strength, strength) for strength in config.strengths]
    else:
        levels = [partial(_merge_to_count, count) for count in config.counts]
    bound = math.inf if config.max_extent is None else config.max_extent
    partitions = []
    for merge in levels:
        graph, merged = merge(graph, config.min_size, bound)
        regions = merged[regions]
        partitions.append(regions)
    return partitions


def _mesh_edges(faces: Tensor, places: Tensor) -> Tensor:
    """Return the pairs of places ``(E, 2)`` that edges of a mesh lead from and to, ascending."""
    corners = places[faces.long()]
    pairs = torch.cat([corners[:, [i, j]] for i in range(3) for j in range(3) if i != j])
    pairs = pairs[(pairs >= 0).all(dim=1) & (pairs[:, 0] != pairs[:, 1])]
    width = len(places) + 1
    keys = torch.unique(pairs[:, 0] * width + pairs[:, 1])
    return torch.stack([keys // width, keys % width], dim=1)


def _listed(edges: Tensor, num_places: int) -> Tensor:
    """Return the first 64 places that edges lead to from each ``(n, K)``; itself where fewer."""
    counts = torch.bincount(edges[:, 0], minlength=num_places)
    column = torch.arange(len(edges)) - (counts.cumsum(0) - counts)[edges[:, 0]]
    kept = column < _MOST_EDGES
    width = max(int(counts.max()), 1) if len(edges) else 1
    listed = torch.arange(num_places)[:, None].repeat(1, min(width, _MOST_EDGES))
    listed[edges[kept, 0], column[kept]] = edges[kept, 1]
    return listed


class _Regions(NamedTuple):
    """Sums over the points of R regions along the last axis, and the boxes around them, float64."""

    size: Tensor
    features: Tensor
    low: Tensor
    high: Tensor


class _Borders(NamedTuple):
    """Pairs of regions that touch, ``first < second``, ascending, and sums over their contacts."""

    first: Tensor
    second: Tensor
    contacts: Tensor
    sq_chord: Tensor


class _Graph(NamedTuple):
    """Regions and their borders."""

    regions: _Regions
    borders: _Borders


def _median_spacing(places: Tensor, neighbors: Neighbors) -> float:
    """Return the median distance to the nearest point that evenly spread points would have."""
    last = neighbors.indices[:, -1].long()
    reach = (places[last].double() - places.double()).norm(dim=1).median()
    return float(reach) / _SPACINGS_IN_REACH


def _cut_planes(
    places: Tensor,
    spacing: float,
    neighbors: Neighbors,
    labels: Tensor,
    colors: Tensor | None,
    config: SuperpointsConfig,
) -> Tensor:
    """Return the piece of a plane that each point is on, shape ``(n,)``, negative for none.

    Pieces are what is in a cell of a cubic grid. Those whose colours vary, more than by the noise
    that neighbours show, or that have too many points for the number of superpoints, are cut at
    half the side again and again, in the end into points.
    """
    side = _PIECE_SPACINGS * spacing
    if config.max_extent is not None:
        side = min(side, config.max_extent)
    most = math.inf if config.counts is None else len(places) / (_PIECES_EACH * config.counts[0])
    if colors is not None:
        nearest = neighbors.indices[:, min(1, neighbors.indices.shape[1] - 1)].long()
        noise = float((colors[nearest] - colors).square().sum(dim=1).median())
    columns = [column - column.min() for column in places.double().unbind(dim=1)]
    pieces = labels.clamp(min=UNLABELED)
    rows, num_pieces = places_of(labels >= 0), 0
    while len(rows) and side >= spacing > 0:
        cells = [(column[rows] / side).floor() for column in columns]
        numbers = torch.unique(cell_keys([labels[rows], *cells]), return_inverse=True)[1]
        pieces[rows] = numbers + num_pieces
        num_pieces += int(numbers.max()) + 1
        segments = Segments(numbers)
        is_cut = segments.counts > most
        if colors is not None:
            variation = _sum_of_squares(segments, colors[rows])
            is_cut |= variation > _COLOR_VARIATION + noise * segments.counts
        rows, side = rows[is_cut[numbers]], side / 2
    pieces[rows] = UNLABELED
    return pieces


def _sum_of_squares(segments: Segments, vectors: Tensor) -> Tensor:
    """Return the squared differences of vectors ``(n, 3)`` from the mean of each region, added."""
    total = torch.zeros_like(segments.counts, dtype=torch.float64)
    for column in segments.take_columns(vectors):
        differences = column - segments.spread(segments.mean(column))
        total += segments.sum(differences * differences)
    return total


def _first_regions(pieces: Tensor, nearest: Tensor) -> Tensor:
    """Return the first region of each point ``(n,)``: connected parts of pieces, and points."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    def find(rows: slice) -> tuple[Tensor, Tensor]:
        inside = (pieces[nearest[rows]] == pieces[rows, None]) & (pieces[rows, None] >= 0)
        return inside.sum(dim=1), nearest[rows][inside].to(torch.int32)

    parts = map_chunks(find, len(pieces), ROWS_AT_ONCE, pieces.device)
    counts, targets = (torch.cat(parts) for parts in zip(*parts, strict=True))
    starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    links = np.ones(len(targets), dtype=np.int8)
    shape = (len(pieces), len(pieces))
    edges = csr_array((links, targets.numpy(), starts.numpy()), shape=shape)
    numbers = torch.from_numpy(connected_components(edges, directed=False)[1]).long()
    return _by_first_point(numbers)


def _by_first_point(numbers: Tensor) -> Tensor:
    """Number regions by their first points, so that ties do not depend on scipy's numbering."""
    first = torch.full((int(numbers.max()) + 1,), len(numbers))
    first = first.scatter_reduce(0, numbers, torch.arange(len(numbers)), "amin")
    return first.argsort().argsort()[numbers]


def _describe(
    segments: Segments,
    places: Tensor,
    spacing: float,
    normals: Tensor,
    colors: Tensor | None,
    config: SuperpointsConfig,
) -> _Regions:
    """Return sums and boxes of the first regions."""
    x, y, z = segments.take_columns(normals)
    off = math.sqrt(2)
    features = [x * x, y * y, z * z, off * x * y, off * y * z, off * z * x]
    length = _PLACE_SPACINGS * spacing
    if config.max_extent is not None:
        length = min(length, config.max_extent)
    if length > 0:
        origin = places.double().amin(dim=0)
        features += segments.take_columns((places.double() - origin) / length)
    if colors is not None:
        features += segments.take_columns(colors)
    boxes = [segments.bounds(column) for column in segments.take_columns(places)]
    low, high = (torch.stack(side) for side in zip(*boxes, strict=True))
    sums = torch.stack([segments.sum(feature) for feature in features])
    return _Regions(segments.counts.double(), sums, low, high)


def _describe_borders(regions: Tensor, normals: Tensor, nearest: Tensor) -> _Borders:
    """Return the borders of the first regions: a contact leads from a point to a near one."""

    def find(rows: slice) -> tuple[Tensor, Tensor, Tensor]:
        across = regions[nearest[rows]] != regions[rows, None]
        target = nearest[rows][across]
        source = torch.arange(rows.start, rows.stop)[:, None].expand(across.shape)[across]
        own, other = (normals[ends].double().unbind(dim=1) for ends in (source, target))
        return regions[source], regions[target], sq_chords(own, other)

    parts = map_chunks(find, len(regions), ROWS_AT_ONCE, regions.device)
    source, target, sq_chord = (torch.cat(part) for part in zip(*parts, strict=True))
    return _gather_borders(source, target, torch.ones_like(sq_chord), sq_chord)


def _gather_borders(a: Tensor, b: Tensor, contacts: Tensor, sq_chord: Tensor) -> _Borders:
    """Return one row for each pair of different regions, with the sums of its rows."""
    different = a != b
    a, b, contacts, sq_chord = (part[different] for part in (a, b, contacts, sq_chord))
    if len(a) == 0:
        return _Borders(a, b, contacts, sq_chord)
    width = int(torch.maximum(a.max(), b.max())) + 1
    keys, order = (torch.minimum(a, b) * width + torch.maximum(a, b)).sort(stable=True)
    keys, counts = torch.unique_consecutive(keys, return_counts=True)
    contacts, sq_chord = (
        torch.segment_reduce(part[order], "sum", lengths=counts) for part in (contacts, sq_chord)
    )
    return _Borders(keys // width, keys % width, contacts, sq_chord)


def _merge_to_strength(
    strength: float, graph: _Graph, min_size: int, bound: float
) -> tuple[_Graph, Tensor]:
    """Merge pairs that cost at most ``strength``, then small regions; return what each became."""
    graph, become = _last(_merging(graph, bound, lambda cost, graph: cost <= strength))
    graph, merged = _last(_merging(graph, bound, partial(_joins_small, min_size)))
    return graph, merged[become]


def _merge_to_count(
    count: int, graph: _Graph, min_size: int, bound: float
) -> tuple[_Graph, Tensor]:
    """Merge the pairs that cost least until ``count`` regions are left, none of them too small.

    Those that are too small join others at the last time when enough of the rest are left: so late
    that points have become regions, and early enough to count only what stays. Returns what
    :func:`_merge_to_strength` returns.
    """
    num_large, chosen = 0, (graph, torch.arange(len(graph.regions.size)))
    for state in _merging(graph, bound, _is_cheap, count):
        num_enough = int((state[0].regions.size >= min_size).sum())
        if num_enough >= min(num_large, count):
            num_large, chosen = num_enough, state
    graph, become = chosen
    graph, merged = _last(_merging(graph, bound, partial(_joins_small, min_size)))
    graph, again = _last(_merging(graph, bound, _is_cheap, count))
    return graph, again[merged[become]]


def _last(states: Iterator[tuple[_Graph, Tensor]]) -> tuple[_Graph, Tensor]:
    """Return the last of one or more states."""
    return deque(states, maxlen=1).pop()


def _joins_small(min_size: int, cost: Tensor, graph: _Graph) -> Tensor:
    """Return which borders are those of a region with fewer points."""
    size = graph.regions.size
    return torch.minimum(size[graph.borders.first], size[graph.borders.second]) < min_size


def _is_cheap(cost: Tensor, graph: _Graph) -> Tensor:
    """Return which borders are among those that cost least."""
    return cost <= cost.kthvalue(-(-len(cost) // _BORDERS_A_TURN)).values


def _merging(
    graph: _Graph,
    bound: float,
    is_eligible: Callable[[Tensor, _Graph], Tensor],
    count: int = 1,
) -> Iterator[tuple[_Graph, Tensor]]:
    """Yield the graph and what regions become while eligible pairs merge to ``count``."""
    # Two that fit into the box of a third one by one may not fit together.
    ratio = _MUCH_LARGER if bound == math.inf else math.inf
    become = torch.arange(len(graph.regions.size))
    while True:
        yield graph, become
        regions, borders = graph
        most = len(regions.size) - count
        if most <= 0 or len(borders.first) == 0:
            return
        cost = _costs(regions, borders, bound)
        cost = cost.where(is_eligible(cost, graph), math.inf)
        if not bool(cost.isfinite().any()):
            return
        chosen = _choose_pairs(borders, cost, regions.size, ratio, most)
        regions, borders, new = _merge(regions, borders, *chosen)
        graph, become = _Graph(regions, borders), new[become]


def _costs(regions: _Regions, borders: _Borders, bound: float) -> Tensor:
    """Return what merging at each border costs, infinite where the box would exceed the bound."""
    cost = torch.empty_like(borders.contacts)
    for rows in chunks_of(len(cost), ROWS_AT_ONCE):
        a, b = borders.first[rows], borders.second[rows]
        size_a, size_b = regions.size[a], regions.size[b]
        difference = borders.sq_chord[rows] / borders.contacts[rows] + _LEAST_DIFFERENCE
        for feature in regions.features:
            step = feature[a] / size_a - feature[b] / size_b
            difference += step * step
        ward = size_a * size_b / (size_a + size_b)
        cost[rows] = ward * difference / borders.contacts[rows].sqrt()
        if bound < math.inf:
            high = torch.maximum(regions.high[:, a], regions.high[:, b])
            low = torch.minimum(regions.low[:, a], regions.low[:, b])
            cost[rows] = cost[rows].where((high - low).amax(dim=0) <= bound, math.inf)
    return cost


def _choose_pairs(
    borders: _Borders, cost: Tensor, size: Tensor, ratio: float, most: int
) -> tuple[Tensor, Tensor]:
    """Return regions, and those that they are to become part of, each of which stays itself.

    Those are each other's cheapest, or the cheapest of one that has ``ratio`` times fewer points;
    at most so many, those that cost least. Of equal costs the first border's counts.
    """
    num_regions, num_borders = len(size), len(cost)
    ends, costs = torch.cat([borders.first, borders.second]), cost.repeat(2)
    least = cost.new_full((num_regions,), math.inf)
    least = least.scatter_reduce(0, ends, costs, "amin")
    rows = torch.arange(num_borders).repeat(2)
    is_least = (costs == least[ends]) & costs.isfinite()
    best = torch.full((num_regions,), num_borders)
    best = best.scatter_reduce(0, ends[is_least], rows[is_least], "amin")
    asking = (best < num_borders).nonzero().squeeze(1)
    wanted = borders.first[best[asking]] + borders.second[best[asking]] - asking
    joins = size[wanted] >= ratio * size[asking]
    is_joining = torch.zeros(num_regions, dtype=torch.bool).index_copy(0, asking, joins)
    joins &= ~is_joining[wanted]
    mutual = (best[wanted] == best[asking]) & ~is_joining[asking] & ~is_joining[wanted]
    joins |= mutual & (asking > wanted)
    asking, wanted = asking[joins], wanted[joins]
    if len(asking) > most:
        cheapest = least[asking].argsort(stable=True)[:most]
        asking, wanted = asking[cheapest], wanted[cheapest]
    owner = torch.arange(num_regions).index_copy(0, asking, wanted)
    gone = asking
    # What joins one of a mutual pair may find it gone.
    return gone, owner[owner[gone]]


def _merge(
    regions: _Regions, borders: _Borders, gone: Tensor, kept: Tensor
) -> tuple[_Regions, _Borders, Tensor]:
    """Make regions part of others that stay; return the new number of each region too."""
    num_regions = len(regions.size)
    owner = torch.arange(num_regions).index_copy(0, gone, kept)
    stays = owner == torch.arange(num_regions)
    new = (stays.cumsum(0) - 1)[owner]
    sums = torch.cat([regions.size[None], regions.features])
    # One row at a time, index_add adds one element after the other.
    sums = torch.stack([row.index_add(0, kept, row[gone]) for row in sums])[:, stays]
    into = kept.expand(3, -1)
    low = regions.low.scatter_reduce(1, into, regions.low[:, gone], "amin")
    high = regions.high.scatter_reduce(1, into, regions.high[:, gone], "amax")
    merged = _Regions(sums[0], sums[1:], low[:, stays], high[:, stays])
    first, second = new[borders.first], new[borders.second]
    return merged, _gather_borders(first, second, borders.contacts, borders.sq_chord), new


def _unit_colors(colors: Tensor) -> Tensor:
    """Return colours in [0, 1], float64, those that are not finite black."""
    largest = 1.0 if colors.is_floating_point() else float(torch.iinfo(colors.dtype).max)
    return (colors.detach().double() / largest).nan_to_num(0.0, 0.0, 0.0)


def _by_size(regions: Tensor, place: Tensor) -> Tensor:
    """Number regions of places by descending number of points, ties by their first points."""
    if len(regions) == 0:
        return regions
    counts = torch.bincount(regions[place])
    return counts.argsort(descending=True, stable=True).argsort()[regions]


def main_planes(superpoints: Tensor, labels: Tensor) -> Tensor:
    """Return the plane that more than half of the points of each superpoint are on, or -1."""
    has_one = superpoints >= 0
    count = int(superpoints.max()) + 1 if bool(has_one.any()) else 0
    sizes = torch.bincount(superpoints[has_one], minlength=count)
    main = torch.full((count,), UNLABELED, device=labels.device)
    on_plane = has_one & (labels >= 0)
    if not bool(on_plane.any()):
        return main
    width = int(labels.max()) + 1
    keys = superpoints[on_plane] * width + labels[on_plane]
    keys, shared = torch.unique(keys, return_counts=True)
    mostly = 2 * shared > sizes[keys // width]
    return main.index_copy(0, keys[mostly] // width, keys[mostly] % width)
