"""Under-segmentation repair: splitting regions at bridges and at parallel levels.

A bridge is a few points that connect two surfaces: :func:`cut_bridges` grows regions again under
stricter limits, which yields their *cores*. Two parallel surfaces, such as a wall and a board on
it, are separated by :func:`split_levels`.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from torchrg import scratch
from torchrg._parallel import ROWS_IN_CACHE, map_chunks, nonzero_rows, split_rows
from torchrg.config import GrowingConfig
from torchrg.linalg import unsigned_angle_deg
from torchrg.linalg.angles import deg_to_sq_chord, sq_chords
from torchrg.linalg.moments import Segments, sum_neighbors
from torchrg.neighbors.order import connected_components
from torchrg.regions.adjacency import PARALLEL_DEG, KnnAdjacency
from torchrg.regions.edges import GrowingInput, accept_edges, within_angle
from torchrg.regions.fit import MAX_FITTED, RegionPlanes, fit_planes, fit_regions
from torchrg.regions.repair import (
    keep_regions,
    pairwise_misfit,
    remap_labels,
    remove_small,
    value_of_points,
)
from torchrg.robust.scale import MAD_FACTOR
from torchrg.structures import UNLABELED, Neighbors

_CORE_FRACTION = 0.5
"""Fraction of the angle and distance limits within which the core of a surface is connected."""
_SMOOTH_FRACTION = 0.3
"""A surface is smooth where neighboring normals differ by less than this fraction of the maximum
angle."""
_MIN_SMOOTH_RATIO = 0.7
"""Cores grow only through points whose fraction of smooth neighbors is at least 0.7 of the region's
median. At other points noise may hide an edge."""
_MAX_OFF_PLANE_FRACTION = 0.1
"""Maximum fraction of a region's points off its plane for which the plane is one surface."""
_EXACT_REACH = 4.0
"""Maximum distance of the points of an exact surface to its plane, in minimum thicknesses."""
_MIN_FLAT_FRACTION = 0.5
"""Minimum fraction of points in flat cores of a piecewise planar region: a noisy column breaks into
few, curved cores."""
_MIN_FACE_FRACTION = 0.05
"""Minimum fraction of the region's points in a flat core next to curved ones, such as a panel
framed by a molding. Smaller ones belong to the bend."""
_MIN_OPEN_FRACTION = 0.1
"""Minimum fraction of edges between two cores of one surface that pass the criteria; few do across
a bridge."""
_MAX_MISFIT = 2.0
"""Two cores are coplanar if their misfit is below this many thicknesses, as for parts of a surface
bent by noise."""
_MAX_DIHEDRAL_DEG = 30.0
"""Maximum angle between the planes of joined cores, in degrees. ``_MAX_MISFIT`` alone would join
narrow strips on both sides of an edge."""
_NUM_AVERAGED = 16
"""Nearest neighbors whose residuals are averaged, which reduces white noise to a quarter."""
_MIN_SIZE_FACTOR = 3
"""Minimum size of a region that may contain two surfaces, in multiples of ``min_size``."""
_NOISE_QUANTILE, _NOISE_FACTOR = 0.33, 2.345
"""Quantile of the absolute residuals, and the factor that converts it to a standard deviation of
normal noise. The lower third belongs to the main level even if a second one has nearly half of the
points."""
_SEED_NOISE_FACTOR = 1.5
"""Minimum averaged residual of a candidate, in standard deviations; six of the average itself."""
_STEP_NOISE_FACTOR = 2.0
"""Minimum step between two levels, in standard deviations of the residuals."""
_MAX_THICKNESS = 0.6
"""Maximum thickness of a second level, as a fraction of its step: a thicker one is a slope."""
_MAX_VALLEY = 0.8
"""Maximum ratio of points halfway to the second level to points on it. A step has a valley between
its levels; a bend and the edge of a region have none."""
_VALLEY_WIDTH = 1 / 6
"""Half-width of each counted band of residuals, as a fraction of the step."""
_NUM_RINGS = 4
"""Rings of nearest neighbors around a level that are counted with it: they cross the step."""
_MAX_LEVELS = 2
"""Maximum number of searches per region: a board may contain another level."""
_BINS, _WINDOW, _PEAK_WIDTH = 64, (1, 2, 3, 2, 1), 1.5
"""Number of half-standard-deviation bins of the main-level histogram, its smoothing weights, and
the half-width of the averaged peak in standard deviations."""


def cut_bridges(
    cloud: GrowingInput,
    labels: Tensor,
    planes: RegionPlanes,
    config: GrowingConfig,
    chunk_size: int,
    grow_cores: Callable[[GrowingInput], Tensor],
) -> Tensor:
    """Split regions whose surfaces are connected only by a few points.

    Regions with ``min_size`` points off their plane are grown again under the core limits, from
    points where the surface is as smooth as is typical for the region. ``grow_cores`` returns the
    cores, 0 to C-1 or :data:`torchrg.UNLABELED`. If nearly all points are on a plane, only the
    others grow, and the plane is a core too. Cores are one surface if a tenth of the edges between
    them pass the full limits, or if one plane explains both. Regions with several surfaces are
    split: each remaining point joins the core of the nearest neighbor connected by an edge, without
    growing through other cores. If most points are in curved cores, all cores except large flat
    ones form one core.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`, ``planes`` the planes of the
    regions. The returned labels may have gaps; ``labels`` itself is returned if none is split.
    """
    rows, others, on_plane = _find_mixed(cloud, labels, planes, int(config.min_size))
    cores = torch.full_like(labels, UNLABELED)
    if len(rows):
        cores[rows] = grow_cores(_core_cloud(cloud, labels, rows, config, chunk_size))
        rows = rows[cores[rows] >= 0]
    if len(rows) == 0:
        return labels
    has_core = torch.zeros_like(on_plane)
    has_core[labels[rows]] = True
    others = others[has_core[labels[others]]]
    ours, theirs = cloud.normals[others].double(), planes.normal[labels[others]]
    turn = sq_chords(ours.unbind(dim=1), theirs.unbind(dim=1))
    near = others[turn <= deg_to_sq_chord(config.max_angle_deg)]
    # Only points aligned with the plane show which cores it meets.
    aligned = others[turn <= deg_to_sq_chord(_CORE_FRACTION * config.max_angle_deg)]
    cores[aligned] = labels[aligned] + int(cores.max()) + 1
    cores = remove_small(cores, 1)
    members = torch.cat([rows, aligned])
    owner = labels.new_empty(int(cores.max()) + 1).index_copy_(0, cores[members], labels[members])
    if not bool((torch.bincount(owner) > 1).any()):
        return labels
    narrow = cores.to(torch.int32)

    def meets_other(chunk: Tensor) -> Tensor:
        near = cloud.neighbors.gather(narrow, chunk)
        return ((near >= 0) & (near != near[:, :1])).any(dim=1)

    rows = rows[torch.cat([meets_other(chunk) for chunk in torch.split(rows, chunk_size)])]
    cores = _join_cores(cloud, cores, *_find_edges(cloud, labels, config, rows, chunk_size))
    cores, split = _join_curved(cloud, labels, cores, on_plane)
    if not bool(split.any()):
        return labels
    plane_of = torch.full_like(split, UNLABELED, dtype=torch.int64)
    plane_of[labels[aligned]] = cores[aligned]
    free = value_of_points(split, labels, False)
    near = near[free[near] & (cores[near] < 0)]
    cores[near] = plane_of[labels[near]]
    unassigned = nonzero_rows(free & (cores < 0))
    cores = _propagate(cores, *_find_edges(cloud, labels, config, unassigned, chunk_size))
    new = torch.where(cores >= 0, cores + len(split), UNLABELED)
    return torch.where(free, new, labels)


def _find_mixed(
    cloud: GrowingInput, labels: Tensor, planes: RegionPlanes, min_size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the points that may be of another surface, and those on a plane with such points.

    The first are the points off the plane if nearly all points of the region are on it, otherwise
    the complete region. The last value is the mask of regions ``(M,)`` with nearly all points on
    one plane.
    """
    limit = _EXACT_REACH * planes.floor
    limit = torch.where(planes.reach.isfinite(), torch.maximum(planes.reach, limit), limit)
    distance = planes.signed_distances(cloud.points, labels).abs_()
    off = distance > value_of_points(limit, labels, torch.inf)
    num_off = torch.bincount(labels[nonzero_rows(off)], minlength=len(limit))
    on_plane = num_off <= _MAX_OFF_PLANE_FRACTION * planes.num_points
    is_partial = value_of_points((num_off >= min_size) & on_plane, labels, False)
    is_whole = value_of_points((num_off >= min_size) & ~on_plane, labels, False)
    return nonzero_rows(is_whole | (is_partial & off)), nonzero_rows(is_partial & ~off), on_plane


def _join_curved(
    cloud: GrowingInput, labels: Tensor, cores: Tensor, on_plane: Tensor
) -> tuple[Tensor, Tensor]:
    """Merge the cores ``(N,)`` of each curved region, except its flat surfaces.

    Also returns the mask of the regions ``(M,)`` with several cores.
    """
    segments = Segments(cores, max_points=MAX_FITTED)
    owner, num_points = segments.first(labels), segments.sizes
    split = torch.bincount(owner, minlength=len(on_plane)) > 1
    if bool(on_plane[split].all()):
        return cores, split
    flat = ~fit_planes(segments, cloud.points, cloud.normals).curved
    of_region = torch.bincount(labels + 1, minlength=len(on_plane) + 1)[1:]
    covered = torch.zeros_like(of_region).index_add_(0, owner, num_points * flat)
    curved = ~(on_plane | (covered >= _MIN_FLAT_FRACTION * of_region))
    is_face = flat & (num_points >= _MIN_FACE_FRACTION * of_region[owner])
    joined = curved[owner] & ~is_face
    indices = torch.arange(len(owner), device=cores.device)
    first = torch.full_like(of_region, len(owner))
    first.scatter_reduce_(0, owner[joined], indices[joined], "amin")
    indices[joined] = first[owner[joined]]
    split = torch.bincount(owner[torch.unique(indices)], minlength=len(on_plane)) > 1
    return remap_labels(cores, indices), split


def _are_smooth(
    cloud: GrowingInput, regions: Tensor, max_angle_deg: float, chunk_size: int
) -> Tensor:
    """Return a mask of points where the surface is as smooth as is typical for its region."""
    fractions = torch.zeros_like(cloud.curvature, dtype=torch.float64)
    limit = deg_to_sq_chord(max_angle_deg)
    for chunk in split_rows(len(fractions), chunk_size):
        near, counted = cloud.neighbors.select(chunk), cloud.neighbors.mask(chunk)
        smooth = within_angle(near, cloud.normals.T, limit, signed=False) & counted
        fractions[chunk] = smooth.sum(dim=1).double() / counted.sum(dim=1).clamp(min=1)
    regions = torch.unique(regions, return_inverse=True)[1]
    segments = Segments(regions)
    typical = segments.median(segments.gather(fractions))
    return fractions >= _MIN_SMOOTH_RATIO * typical[regions]


def _core_cloud(
    cloud: GrowingInput, labels: Tensor, rows: Tensor, config: GrowingConfig, chunk_size: int
) -> GrowingInput:
    """Return some points as a cloud with the core limits, and neighbors of the same region."""
    row_of = torch.full((len(labels),), -1, dtype=torch.int32, device=rows.device)
    row_of[rows] = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
    narrow, shape = labels.to(torch.int32), (len(rows), cloud.neighbors.indices.shape[1])
    indices = scratch.new_empty(cloud.neighbors.indices, shape)
    counted = scratch.new_empty(cloud.valid, shape)
    for chunk in split_rows(len(rows), chunk_size):
        near = cloud.neighbors.select(rows[chunk])
        local_rows = near.gather(row_of)
        counted[chunk] = _in_region(near, narrow) & (local_rows >= 0)
        indices[chunk] = torch.where(counted[chunk], local_rows, local_rows[:, :1])
    cores = cloud.select(rows, Neighbors(indices, counted))
    smooth = _are_smooth(cores, labels[rows], _SMOOTH_FRACTION * config.max_angle_deg, chunk_size)
    return cores._replace(
        valid=cores.valid & smooth,
        reach=None if cores.reach is None else _CORE_FRACTION * cores.reach,
        angle_fraction=_CORE_FRACTION,
    )


def _find_edges(
    cloud: GrowingInput, labels: Tensor, config: GrowingConfig, rows: Tensor, chunk_size: int
) -> tuple[Neighbors, Tensor]:
    """Return the neighbors of points in their region, and which edges pass the full limits."""
    shape, narrow = (len(rows), cloud.neighbors.indices.shape[1]), labels.to(torch.int32)
    indices = scratch.new_empty(cloud.neighbors.indices, shape)
    inside, passed = (scratch.new_empty(cloud.valid, shape) for _ in range(2))
    for chunk in split_rows(len(rows), chunk_size):
        near = cloud.neighbors.select(rows[chunk])
        indices[chunk], inside[chunk] = near.indices, _in_region(near, narrow)
        passed[chunk] = accept_edges(cloud, config, rows[chunk], None)[0] & inside[chunk]
    return Neighbors(indices, inside), passed


def _in_region(near: Neighbors, labels: Tensor) -> Tensor:
    """Return a mask of the neighbors in the region of their point, shape ``(n, K)``."""
    theirs = near.gather(labels)
    same = theirs == theirs[:, :1]
    return same if near.valid is None else same & near.valid


def _join_cores(cloud: GrowingInput, cores: Tensor, near: Neighbors, passed: Tensor) -> Tensor:
    """Return the cores ``(N,)`` with cores of one surface merged."""
    num_cores, theirs = int(cores.max()) + 1, near.gather(cores)
    ours = theirs[:, :1].expand_as(theirs)
    between = near.mask() & (theirs >= 0) & (theirs != ours)
    if not bool(between.any()):
        return cores
    first, second = ours[between], theirs[between]
    keys = torch.minimum(first, second) * num_cores + torch.maximum(first, second)
    keys, indices = torch.unique(keys, return_inverse=True)
    pairs = torch.stack([keys // num_cores, keys % num_cores], dim=1)
    num_edges = torch.bincount(indices, minlength=len(pairs))
    num_open = torch.bincount(indices[passed[between]], minlength=len(pairs))
    joined = num_open >= _MIN_OPEN_FRACTION * num_edges
    if not bool(joined.all()):
        planes = fit_planes(Segments(cores, max_points=MAX_FITTED), cloud.points, cloud.normals)
        turn = unsigned_angle_deg(*planes.normal[pairs].unbind(dim=1))
        joined |= (pairwise_misfit(planes, pairs) < _MAX_MISFIT) & (turn <= _MAX_DIHEDRAL_DEG)
    owner, _ = connected_components(num_cores, *pairs[joined].unbind(dim=1))
    return remap_labels(cores, owner.long())


def _propagate(cores: Tensor, near: Neighbors, passed: Tensor) -> Tensor:
    """Assign points between cores to the core of the nearest neighbor they have an edge to."""
    cores, rows = cores.clone(), near.indices[:, 0].long()
    unassigned = torch.arange(len(rows), device=cores.device)
    while len(unassigned):
        owner = near.gather(cores, unassigned)
        connected = passed[unassigned] & (owner >= 0)
        nearest = connected.to(torch.uint8).argmax(dim=1, keepdim=True)
        joined = connected.any(dim=1)
        if not bool(joined.any()):
            break
        cores[rows[unassigned[joined]]] = owner.gather(1, nearest).squeeze(1)[joined]
        unassigned = unassigned[~joined]
    return cores


def split_levels(
    cloud: GrowingInput, labels: Tensor, planes: RegionPlanes, config: GrowingConfig
) -> Tensor:
    """Split off second, parallel levels of points outside the noise of a region.

    The residuals of a region are measured from its main level, the mode, and averaged over the 16
    nearest points of the region. Candidates are connected points whose average exceeds 1.5 standard
    deviations, limited to points beyond half of their median step. A candidate becomes a separate
    region if

    - it has ``min_size`` points, and its step is two standard deviations and a facet tolerance;
    - its plane is parallel to the region's, and its thickness is below 0.6 of the step;
    - in the surrounding rings fewer points lie halfway than on the level: there is a valley.

    The cloud is in canonical order, with the ``planes`` of its regions ``labels`` ``(N,)``, 0 to
    M-1 or negative. Second levels are numbered from M; without any, ``labels`` itself is returned.
    """
    searched = labels
    for search in range(_MAX_LEVELS):
        if search:
            planes = fit_regions(cloud, searched, config)
        large = (planes.num_points >= _MIN_SIZE_FACTOR * int(config.min_size)) & ~planes.curved
        if not bool(large.any()):
            break
        region = keep_regions(searched, large)
        planes = RegionPlanes(*(values[large] for values in planes))
        level, owner = _find_levels(cloud, region, planes, config)
        if not len(owner):
            break
        labels = torch.where(level >= 0, level + int(labels.max()) + 1, labels)
        # Only split regions are searched again.
        is_split = torch.bincount(owner, minlength=len(planes.normal)) > 0
        is_searched = value_of_points(is_split, region, False)
        searched = remove_small(torch.where(is_searched, labels, UNLABELED), 1)
    return labels


def _find_levels(
    cloud: GrowingInput, region: Tensor, planes: RegionPlanes, config: GrowingConfig
) -> tuple[Tensor, Tensor]:
    """Return the second level of each point ``(N,)``, -1 for none, and the region of each level."""
    residual, average, noise = _measure_residuals(cloud, region, planes)
    adjacency = KnnAdjacency(cloud.neighbors)
    nearest, level = adjacency.neighbor_rows(slice(None)), 2 * region + (average > 0)
    limit, group = _SEED_NOISE_FACTOR * noise, region
    for _ in range(2):
        is_beyond = average.abs() > value_of_points(limit, group, torch.inf)
        found = connected_points(level.where(is_beyond, UNLABELED), nearest)
        level = group = remove_small(found, int(config.min_size))
        segments = Segments(level)
        step = segments.median(segments.gather(residual).abs())
        limit = step / 2
    owner = segments.first(region)
    min_step = (_STEP_NOISE_FACTOR * noise[owner]).clamp(min=float(config.facet_tolerance or 0.0))
    level, step, owner = _keep_levels(step >= min_step, level, step, owner)
    if len(owner):
        has_valley = _have_valleys(level, step, average, region, adjacency)
        level, step, owner = _keep_levels(has_valley, level, step, owner)
    if len(owner):
        fits = fit_planes(Segments(level), cloud.points, cloud.normals)
        turn = unsigned_angle_deg(fits.normal, planes.normal[owner])
        is_plane = (turn <= PARALLEL_DEG) & (fits.thickness <= _MAX_THICKNESS * step)
        level, owner = _keep_levels(is_plane, level, owner)
    return level, owner


def _keep_levels(kept: Tensor, level: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    """Return the level of each point and values of levels ``(L,)`` for the ``kept`` ones alone."""
    return keep_regions(level, kept), *(column[kept] for column in values)


def _measure_residuals(
    cloud: GrowingInput, region: Tensor, planes: RegionPlanes
) -> tuple[Tensor, Tensor, Tensor]:
    """Return residuals from the main level, their local average, and their standard deviation.

    The first two are ``(N,)``, 0 if unlabeled; the last is ``(M,)``, at least the floor.
    """
    segments, narrow = Segments(region), region.to(torch.int32)
    (along,) = segments.coordinates(cloud.points, planes.center, planes.normal[:, None])
    zeros = torch.zeros(2, len(region), dtype=torch.float32, device=region.device)
    residual, average = scratch.store(zeros)
    residual[segments.rows] = along = along.float()

    def work(rows: slice) -> None:
        near = Neighbors(cloud.neighbors.indices[rows, :_NUM_AVERAGED])
        same = _in_region(near, narrow)
        average[rows] = sum_neighbors(near.gather(residual) * same) / same.sum(dim=1)

    map_chunks(work, len(region), ROWS_IN_CACHE, region.device)
    floor, nearby = planes.floor.float(), segments.gather(average)
    level = segments.broadcast(_main_level(segments, nearby, floor))
    residual[segments.rows] = along = along - level
    average[segments.rows] = nearby - level
    noise = segments.quantile(along.abs(), _NOISE_QUANTILE)
    return residual, average, torch.maximum(_NOISE_FACTOR * noise, floor)


def _main_level(segments: Segments, average: Tensor, floor: Tensor) -> Tensor:
    """Return the mode of the averaged residuals of each region, as the mean around their peak."""
    middle = segments.median(average)
    offset = average - segments.broadcast(middle)
    width = torch.maximum(MAD_FACTOR * segments.median(offset.abs()), floor)
    width = torch.where(width > 0, width, 1.0)
    unit = segments.broadcast(width)
    bins = (2 * offset / unit).floor().clamp(-_BINS // 2, _BINS // 2 - 1).long()
    bins += segments.labels * _BINS + _BINS // 2
    counts = torch.bincount(bins, minlength=len(width) * _BINS).view(-1, _BINS)
    # A sum of shifted counts, because convolutions of integers exist on the CPU alone.
    padded = torch.nn.functional.pad(counts, (len(_WINDOW) // 2,) * 2)
    window = counts.new_tensor(_WINDOW)
    peak = (padded.unfold(1, len(_WINDOW), 1) * window).sum(dim=2).argmax(dim=1)
    peak = (peak - _BINS // 2 + 0.5) * width / 2
    near = (offset - segments.broadcast(peak)).abs() <= _PEAK_WIDTH * unit
    total = segments.sum(torch.where(near, offset, 0.0).double())
    return (middle + total / segments.sum(near.double()).clamp(min=1)).float()


def connected_points(groups: Tensor, nearest: Tensor) -> Tensor:
    """Label the connected components of points within each group, -1 if that is negative.

    ``nearest`` ``(N, K)`` are the adjacent points, the first component that of the first point.
    """
    rows = nonzero_rows(groups >= 0)
    near, index = nearest[rows].long(), torch.full_like(groups, UNLABELED)
    index[rows] = torch.arange(len(rows), device=rows.device)
    itself = index[rows, None].expand_as(near)
    # A link of a point to itself joins nothing.
    ends = torch.where(groups[near] == groups[rows, None], index[near], itself)
    found, _ = connected_components(len(rows), itself.reshape(-1), ends.view(-1))
    return index.index_copy_(0, rows, found.long())


def _have_valleys(
    level: Tensor, step: Tensor, average: Tensor, region: Tensor, adjacency: KnnAdjacency
) -> Tensor:
    """Return a mask of levels with fewer points halfway to them than on them, in rings around."""
    ring = nonzero_rows(level >= 0)
    owner, side = level.clone(), Segments(level).first(average).sign()
    for _ in range(_NUM_RINGS):
        near = adjacency.neighbor_rows(ring).long()
        source = owner[ring, None].expand_as(near)
        is_new = (owner[near] < 0) & (region[near] == region[ring, None])
        # If several levels reach a point, the first wins, independent of the point order.
        ring = torch.unique(near[is_new])
        owner[ring] = len(step)
        owner.scatter_reduce_(0, near[is_new], source[is_new], "amin")
    rows = nonzero_rows(owner >= 0)
    owner = owner[rows]
    height = average[rows] * side[owner] / step[owner]
    halfway, top = (
        torch.bincount(owner[(height - at).abs() < _VALLEY_WIDTH], minlength=len(step))
        for at in (0.5, 1.0)
    )
    return halfway <= _MAX_VALLEY * top
