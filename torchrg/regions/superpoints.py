"""Superpoints: a partition of all points into connected parts of one orientation, in levels.

Regions of a graph of neighbours merge pair by pair, the pair that costs the energy least first.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, chunks_of, map_chunks
from torchrg.config import SuperpointsConfig
from torchrg.linalg import sq_chords
from torchrg.linalg.moments import Segments
from torchrg.neighbors import finite_rows, restore_rows, search_knn
from torchrg.neighbors.voxels import cell_keys
from torchrg.regions.adjacency import NUM_CONTACTS, NearestPoints
from torchrg.structures import UNLABELED, Neighbors, Superpoints

_NUM_NEIGHBORS = 1 + NUM_CONTACTS
"""The point itself, and those that surround it on a surface; with one more, accuracy at equal
numbers was up to .01 lower on an office."""

_SPACINGS_IN_REACH = 1.6
"""A circle around 8 points that are one spacing apart has this many spacings for its radius."""

_PIECE_SPACINGS = 8.0
"""Side of the pieces that planes enter as, in spacings: some 64 points, as the smallest plane."""

_LEAST_DIFFERENCE = 0.01
"""Squared difference of normals, that of 6 degrees, which counts even between regions of one
surface. With a tenth of it the oracle IoU of a made room at 185 superpoints was .03 lower."""

_MUCH_LARGER = 16
"""A region of so many times the points of another hardly changes by it, so it takes in all such
that would rather join it than any other at a time. Else a floor takes in one speck at a time."""


def partition_points(
    points: Tensor,
    normals: Tensor,
    labels: Tensor,
    config: SuperpointsConfig,
    colors: Tensor | None = None,
) -> Superpoints:
    r"""Partition a cloud; see :func:`torchrg.make_superpoints`.

    The first regions are compact pieces of planes, or whole planes, and single points. Of two
    regions that touch, of :math:`n_a` and :math:`n_b` points, merging costs

    .. math:: \frac{n_a n_b}{n_a + n_b} (d_{ab} + \epsilon) / \sqrt{c_{ab}},

    where d is the squared difference of what the regions are (mean of :math:`n n^T` [1], of the
    colour, and of the place where their extent is bounded) and, at their contacts, the mean squared
    difference of the normals, and c the number of contacts. The first factor is Ward's [2]: the
    increase of the variance within regions. Divided by the length of the border that vanishes it is
    the strength of regularisation at which the energy of Mumford and Shah falls [3], the energy
    that cut pursuit minimises [4] and, with places and normals, the supervoxels of [5] and [6];
    normals come first as in [7].
    Contacts are that length up to noise, hence their root. Regions that are each other's cheapest
    partner merge at a time, and small ones with a much larger one that is theirs: this needs no
    order of visits.

    ``labels`` ``(N,)`` are those of planes, negative for none.

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
    partitions = _partition_places(
        ordered[is_first].cpu(),
        normals[distinct].detach().cpu(),
        labels[distinct].cpu(),
        config,
        None if colors is None else _unit_colors(colors[distinct]).cpu(),
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
) -> list[Tensor]:
    """Return the region of each of distinct points ``(n,)`` in canonical order, level by level."""
    if len(places) == 0:
        return [torch.zeros(0, dtype=torch.int64) for _ in config.strengths]
    neighbors = search_knn(places, min(_NUM_NEIGHBORS, len(places)), canonical=True)
    regions = _first_regions(places, neighbors, labels, config)
    graph = _Graph(
        _describe(Segments(regions), places, normals, colors, config),
        _describe_borders(regions, normals, neighbors),
    )
    bound = math.inf if config.max_extent is None else config.max_extent
    partitions = []
    for strength in config.strengths:
        for least in (0, config.min_size):
            graph, merged = _merge_regions(graph, strength, least, bound)
            regions = merged[regions]
        partitions.append(regions)
    return partitions


class _Regions(NamedTuple):
    """Sums over the points of R regions, and the boxes around them, float64.

    ``size`` ``(R,)``, ``features`` ``(F, R)``, ``low`` and ``high`` ``(3, R)``.
    """

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


def _first_regions(
    places: Tensor, neighbors: Neighbors, labels: Tensor, config: SuperpointsConfig
) -> Tensor:
    """Return the first region of each point, shape ``(n,)``: connected pieces of planes, points."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    piece = labels
    if config.planes == "pieces":
        cell = _cells(places, neighbors, config.max_extent)
        piece = torch.unique(labels * (int(cell.max()) + 1) + cell, return_inverse=True)[1]
        piece = torch.where(labels >= 0, piece, UNLABELED)
    nearest = NearestPoints(neighbors).neighbors.indices

    def find(rows: slice) -> tuple[Tensor, Tensor]:
        inside = (piece[nearest[rows]] == piece[rows, None]) & (piece[rows, None] >= 0)
        return inside.sum(dim=1), nearest[rows][inside].to(torch.int32)

    found = map_chunks(find, len(places), ROWS_AT_ONCE, places.device)
    counts, targets = (torch.cat(parts) for parts in zip(*found, strict=True))
    starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    links = np.ones(len(targets), dtype=np.int8)
    shape = (len(places), len(places))
    edges = csr_array((links, targets.numpy(), starts.numpy()), shape=shape)
    numbers = torch.from_numpy(connected_components(edges, directed=False)[1]).long()
    return _by_first_point(numbers)


def _cells(places: Tensor, neighbors: Neighbors, max_extent: float | None) -> Tensor:
    """Return the number of the cell of a cubic grid that each point is in, shape ``(n,)``.

    Its side follows the median spacing, so where points are dense, pieces have more of them.
    """
    last = neighbors.indices[:, -1].long()
    reach = (places[last].double() - places.double()).norm(dim=1).median()
    side = _PIECE_SPACINGS / _SPACINGS_IN_REACH * float(reach)
    if max_extent is not None:
        side = min(side, max_extent)
    if side == 0:
        return torch.zeros(len(places), dtype=torch.int64)
    columns = places.double().unbind(dim=1)
    keys = cell_keys([((column - column.min()) / side).floor() for column in columns])
    numbers: Tensor = torch.unique(keys, return_inverse=True)[1]
    return numbers


def _by_first_point(numbers: Tensor) -> Tensor:
    """Number regions by their first points, so that ties do not depend on scipy's numbering."""
    first = torch.full((int(numbers.max()) + 1,), len(numbers))
    first = first.scatter_reduce(0, numbers, torch.arange(len(numbers)), "amin")
    return first.argsort().argsort()[numbers]


def _describe(
    segments: Segments,
    places: Tensor,
    normals: Tensor,
    colors: Tensor | None,
    config: SuperpointsConfig,
) -> _Regions:
    """Return sums and boxes of the first regions."""
    x, y, z = segments.take_columns(normals)
    off = math.sqrt(2)
    features = [x * x, y * y, z * z, off * x * y, off * y * z, off * z * x]
    if config.max_extent is not None:
        origin = places.double().amin(dim=0)
        features += segments.take_columns((places.double() - origin) / config.max_extent)
    if colors is not None:
        features += segments.take_columns(math.sqrt(config.color_weight) * colors)
    boxes = [segments.bounds(column) for column in segments.take_columns(places)]
    low, high = (torch.stack(side) for side in zip(*boxes, strict=True))
    sums = torch.stack([segments.sum(feature) for feature in features])
    return _Regions(segments.counts.double(), sums, low, high)


def _describe_borders(regions: Tensor, normals: Tensor, neighbors: Neighbors) -> _Borders:
    """Return the borders of the first regions: a contact leads from a point to a near one."""
    nearest = NearestPoints(neighbors).neighbors.indices

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


def _merge_regions(
    graph: _Graph, strength: float, min_size: int, bound: float
) -> tuple[_Graph, Tensor]:
    """Merge pairs that cost at most ``strength``, and with a minimum size those that are smaller.

    Returns the graph of what is left, and what each region has become, shape ``(R,)``.
    """
    regions, borders = graph
    # Two that fit into the box of a third one by one may not fit together.
    ratio = _MUCH_LARGER if bound == math.inf else math.inf
    become = torch.arange(len(regions.size))
    while True:
        cost = _costs(regions, borders, bound)
        if min_size:
            smaller = torch.minimum(regions.size[borders.first], regions.size[borders.second])
            eligible = (smaller < min_size) & cost.isfinite()
        else:
            eligible = cost <= strength
        if not bool(eligible.any()):
            return _Graph(regions, borders), become
        cost = torch.where(eligible, cost, math.inf)
        chosen = _choose_pairs(borders, cost, regions.size, ratio)
        regions, borders, new = _merge(regions, borders, *chosen)
        become = new[become]


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
    borders: _Borders, cost: Tensor, size: Tensor, ratio: float
) -> tuple[Tensor, Tensor]:
    """Return regions, and those that they are to become part of, each of which stays itself.

    Those are each other's cheapest, or the cheapest of one that has ``ratio`` times fewer points.
    Of equal costs the first border's counts.
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
    owner = torch.arange(num_regions).index_copy(0, asking[joins], wanted[joins])
    gone = asking[joins]
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
