"""Levels: a region that holds two parallel surfaces, as a wall and a board on it, is split."""

import torch
from torch import Tensor

from torchrg._parallel import ROWS_IN_CACHE, map_chunks, places_of
from torchrg.config import GrowingConfig
from torchrg.linalg import unsigned_angle_deg
from torchrg.linalg.moments import Segments, sum_neighbors
from torchrg.regions.adjacency import PARALLEL_DEG, NearestPoints
from torchrg.regions.edges import GrowingCloud
from torchrg.regions.fit import RegionPlanes, fit_planes, fit_regions
from torchrg.regions.repair import renumber
from torchrg.robust.scale import MAD_FACTOR
from torchrg.structures import UNLABELED, Neighbors

_NUM_AVERAGED = 16
"""Nearest neighbors whose residuals are averaged: a quarter of white noise remains."""

_MIN_POINTS = 3
"""Points of a region, in multiples of the least size, from which on it may hold two surfaces."""

_NOISE_QUANTILE, _NOISE_FACTOR = 0.33, 2.345
"""Quantile of the absolute residuals and its ratio to a standard deviation of normal noise. The
lower third belongs to the main level even where a second one has nearly half of the points."""

_SEED_NOISES = 1.5
"""Averaged residuals of this many standard deviations are six of their own."""

_STEP_NOISES = 2.0
"""Least step between two levels, in standard deviations of the residuals."""

_MAX_THICKNESS = 0.6
"""Largest thickness of a second level, as a fraction of its step: a thicker one is a slope."""

_MAX_VALLEY = 0.8
"""Largest ratio of the points halfway to the second level to those on it. A step has a valley
between its levels; a bend and the edge of a region have none."""

_VALLEY_WIDTH = 1 / 6
"""Half width of either band of residuals that is counted, as a fraction of the step."""

_NUM_RINGS = 4
"""Rings of nearest neighbors around a level that are counted with it: they cross the step."""

_MAX_LEVELS = 2
"""Times that a region is searched: a board may hold a further level."""

_BINS, _WINDOW, _PEAK_WIDTH = 64, (1, 2, 3, 2, 1), 1.5
"""Bins of half a standard deviation among which the main level is sought, the weights by which
their counts are smoothed, and the standard deviations around the peak that are averaged."""


def split_levels(
    cloud: GrowingCloud, labels: Tensor, planes: RegionPlanes, config: GrowingConfig
) -> Tensor:
    """Split regions that hold a second, parallel level of points beyond their noise.

    The residuals of a region are measured from its main level, the mode, and averaged over the 16
    nearest points of the region. Connected points whose average is more than 1.5 standard
    deviations off are candidates, as far as they lie beyond half of their median step. A candidate
    becomes a region of its own if

    - it has ``min_size`` points, and its step is two standard deviations and a facet tolerance;
    - its plane is parallel to the region's, and its own thickness is below .6 of the step;
    - in the rings around it fewer points lie halfway than on the level: there is a valley.

    Args:
        cloud: Points, normals and neighbors, in canonical order.
        labels: Regions, 0 to M-1 or negative, shape ``(N,)``.
        planes: Planes of the regions.
        config: Settings; ``min_size`` and ``facet_tolerance`` are numbers.

    Returns:
        Labels, shape ``(N,)``; second levels are numbered from M on. ``labels`` itself if there are
        none.
    """
    searched = labels
    for _ in range(_MAX_LEVELS):
        large = (planes.num_points >= _MIN_POINTS * int(config.min_size)) & ~planes.curved
        if not bool(large.any()):
            break
        region = renumber(searched, _numbers(large))
        level, owner = _find_levels(
            cloud, region, RegionPlanes(*(v[large] for v in planes)), config
        )
        if not len(owner):
            break
        labels = torch.where(level >= 0, level + int(labels.max()) + 1, labels)
        # Only regions that were split are searched again.
        rows = places_of(torch.isin(region, owner))
        searched = torch.full_like(labels, UNLABELED)
        searched[rows] = torch.unique(labels[rows], return_inverse=True)[1]
        planes = fit_regions(cloud, searched, config)
    return labels


def _find_levels(
    cloud: GrowingCloud, region: Tensor, planes: RegionPlanes, config: GrowingConfig
) -> tuple[Tensor, Tensor]:
    """Return the second level of each point ``(N,)``, -1 for none, and the region of each level."""
    residual, average, noise = _measure_residuals(cloud, region, planes)
    beside = NearestPoints(cloud.neighbors)
    limit = _SEED_NOISES * torch.cat([noise, noise.new_tensor([torch.inf])])
    level = _components(average.abs() > limit[region], 2 * region + (average > 0), beside)
    step = _steps(level, residual)
    level = _components(average.abs() > step[level] / 2, level, beside)
    step, owner = _steps(level, residual)[:-1], Segments(level).first(region)
    min_step = (_STEP_NOISES * noise[owner]).clamp(min=float(config.facet_tolerance or 0.0))
    num_points = torch.bincount(level + 1, minlength=1)[1:]
    kept = (num_points >= int(config.min_size)) & (step >= min_step)
    level, step, owner = renumber(level, _numbers(kept)), step[kept], owner[kept]
    fits = fit_planes(Segments(level), cloud.points, cloud.normals)
    turn = unsigned_angle_deg(fits.normal, planes.normal[owner])
    kept = (turn <= PARALLEL_DEG) & (fits.thickness <= _MAX_THICKNESS * step)
    kept &= _have_valleys(level, step, average, region, beside)
    return renumber(level, _numbers(kept)), owner[kept]


def _numbers(kept: Tensor) -> Tensor:
    """Return new numbers of the kept regions ``(M,)``, -1 for the others."""
    return torch.where(kept, kept.cumsum(0) - 1, UNLABELED)


def _measure_residuals(
    cloud: GrowingCloud, region: Tensor, planes: RegionPlanes
) -> tuple[Tensor, Tensor, Tensor]:
    """Return residuals from the main level, their local average, and their standard deviation.

    The first two are ``(N,)``, 0 without a region, the last is ``(M,)``, at least the floor.
    """
    segments, narrow = Segments(region), region.to(torch.int32)
    (along,) = segments.along(cloud.points, planes.center, planes.normal[:, None])
    residual, average = torch.zeros(2, len(region), device=region.device)
    residual[segments.rows] = along.float()

    def work(block: slice) -> None:
        rows = segments.rows[block]
        near = Neighbors(cloud.neighbors.at(rows).indices[:, :_NUM_AVERAGED])
        same = near.of(narrow) == narrow[rows, None]
        average[rows] = sum_neighbors(near.of(residual) * same) / same.sum(dim=1)

    map_chunks(work, len(segments.rows), ROWS_IN_CACHE, region.device)
    floor = planes.floor.float()
    level = segments.spread(_main_level(segments, segments.take(average), floor))
    residual[segments.rows] -= level
    average[segments.rows] -= level
    noise = segments.quantile(segments.take(residual.abs()), _NOISE_QUANTILE)
    return residual, average, torch.maximum(_NOISE_FACTOR * noise, floor)


def _main_level(segments: Segments, average: Tensor, floor: Tensor) -> Tensor:
    """Return the mode of the averaged residuals of each region, the mean around their peak."""
    middle = segments.median(average)
    away = average - segments.spread(middle)
    width = torch.maximum(MAD_FACTOR * segments.median(away.abs()), floor)
    width = torch.where(width > 0, width, 1.0)
    bins = (2 * away / segments.spread(width)).floor().clamp(-_BINS // 2, _BINS // 2 - 1).long()
    bins += segments.labels * _BINS + _BINS // 2
    counts = torch.bincount(bins, minlength=len(width) * _BINS).view(-1, 1, _BINS)
    window = counts.new_tensor(_WINDOW).view(1, 1, -1)
    peak = torch.conv1d(counts, window, padding=len(_WINDOW) // 2).argmax(dim=2).squeeze(1)
    peak = (peak - _BINS // 2 + 0.5) * width / 2
    near = (away - segments.spread(peak)).abs() <= _PEAK_WIDTH * segments.spread(width)
    total = segments.sum(torch.where(near, away, 0.0).double())
    return (middle + total / segments.sum(near.double()).clamp(min=1)).float()


def _components(chosen: Tensor, groups: Tensor, beside: NearestPoints) -> Tensor:
    """Number the connected components of chosen points of one group, -1 for the other points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rows = places_of(chosen & (groups >= 0))
    number = torch.full_like(groups, UNLABELED).index_copy_(
        0, rows, torch.arange(len(rows), device=rows.device)
    )
    near = beside.around(rows).long()
    joined = (number[near] >= 0) & (groups[near] == groups[rows, None])
    ends = number[rows, None].expand_as(near)[joined].cpu(), number[near][joined].cpu()
    ones = torch.ones(len(ends[0]), dtype=torch.int8)
    graph = coo_array((ones.numpy(), ends), shape=(len(rows), len(rows)))
    found = torch.from_numpy(connected_components(graph, directed=False)[1]).to(groups)
    return number.index_copy_(0, rows, found)


def _steps(level: Tensor, residual: Tensor) -> Tensor:
    """Return the median absolute residual of each level, and infinity for points of none."""
    segments = Segments(level)
    steps = segments.median(segments.take(residual.abs()))
    return torch.cat([steps, steps.new_tensor([torch.inf])])


def _have_valleys(
    level: Tensor, step: Tensor, average: Tensor, region: Tensor, beside: NearestPoints
) -> Tensor:
    """Return whether fewer points lie halfway to each level than on it, in rings around it."""
    ring = places_of(level >= 0)
    owner, side = level.clone(), Segments(level).first(average).sign()
    for _ in range(_NUM_RINGS):
        near = beside.around(ring).long()
        source = owner[ring, None].expand_as(near)
        is_new = (owner[near] < 0) & (region[near] == region[ring, None])
        # Of several levels that reach a point the first takes it, whatever the order of the points.
        target, source = near[is_new], source[is_new]
        first = torch.full_like(owner, len(step)).scatter_reduce_(0, target, source, "amin")
        ring = torch.unique(target)
        owner[ring] = first[ring]
    rows = places_of(owner >= 0)
    owner = owner[rows]
    height = average[rows] * side[owner] / step[owner]
    halfway, top = (
        torch.bincount(owner[(height - at).abs() < _VALLEY_WIDTH], minlength=len(step))
        for at in (0.5, 1.0)
    )
    return halfway <= _MAX_VALLEY * top
