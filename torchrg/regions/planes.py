"""The plane table: one plane fitted to each region, measured and classified."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._parallel import ROWS_AT_ONCE, chunks_of, run_beside
from torchrg.config import GrowingConfig
from torchrg.errors import ConfigError
from torchrg.linalg import coordinate_resolution, eigh3_of_few, second_moments
from torchrg.linalg.moments import Segments
from torchrg.regions.adjacency import find_adjacency
from torchrg.regions.edges import GrowingCloud, neighborhood_radii
from torchrg.regions.measures import covered_areas, fit_rectangles, trace_outline
from torchrg.robust.scale import MAD_FACTOR
from torchrg.structures import PLANE_KINDS, Neighbors, PlaneAdjacency, Planes

_POINTS_AT_ONCE = 2**18
"""Points of regions that are measured together: at some 400 bytes each."""

_BISQUARE_CUT = 4.685
"""Residuals of this many standard deviations have weight 0: 95 % efficiency for normal data."""

_NUM_FITS = 4
"""So many reweighted fits settle the plane."""

_FLAT_RATIO = 4.0
"""Where one variance is not this many times the next smaller one, rounding and noise decide between
their directions."""

_SAME_MAGNITUDE = 1e-6
"""Components of a normal that differ by less than this share are equal but for rounding."""

_CURVED_SPREAD_DEG = 8.0
"""Root mean square angle of a region's normals to the direction they share, from which on it is
curved: a smooth bend by three to four times this angle has this spread, a full column 45."""

MOST_FITTED = 4096
"""Points of a region that its plane is fitted to while regions change: more of them move it by less
than a fiftieth of their noise."""

LEAST_FITTED = 10
"""Points whose plane says where others at its border belong: that of three passes through them."""

_BENT = 0.5
"""Reaches. A region thicker than this share of the reach that its points have is bent: twice as
thick as the neighbourhoods in it. From 0.3 to 0.5 made rooms come out the same."""

_LEAST_HEIGHT = 0.2
"""Of the product of angle and width, both as standard deviations: an arc is 0.45 of it thick, a cap
of a sphere 0.41. Scattered normals in a thin region are noise."""

_MAX_TILT_DEG = 15.0
"""A floor or ceiling is within this angle of horizontal, a wall of vertical."""

_END_SHARE = 0.15
"""A floor lies in this lowest share of the cloud's height, a ceiling in the highest."""

_LEAST_AREA_SHARE = 0.1
"""A floor or ceiling has at least this share of the largest horizontal plane's area."""

_LEAST_WALL_SHARE = 0.5
"""A wall reaches over at least this share of the cloud's height."""


class FittedPlanes(NamedTuple):
    """Planes of M regions, in float64.

    Attributes:
        normal: Unit normals, shape ``(M, 3)``.
        center: A point of each plane, the weighted mean, shape ``(M, 3)``.
        along: Unit direction of largest variance in the plane, shape ``(M, 3)``.
        covariance: Weighted covariance, shape ``(M, 3, 3)``.
        thickness: Robust standard deviation of the points from the plane, shape ``(M,)``.
        residuals: Signed distance of each point, in the order of :meth:`Segments.take`.
        num_points: Number of points, shape ``(M,)``, int64.
        curved: Whether the points' normals are spread too much for a plane, shape ``(M,)``, bool.
    """

    normal: Tensor
    center: Tensor
    along: Tensor
    covariance: Tensor
    thickness: Tensor
    residuals: Tensor
    num_points: Tensor
    curved: Tensor


class RegionPlanes(NamedTuple):
    """Planes of M regions, and what is known of their noise, in float64.

    Attributes:
        fit: Planes of some thousand points of each region, in even steps. ``curved`` are regions
            whose normals are spread and that noise alone does not make so thick: in faces a few
            centimetres wide, noise spreads normals, too.
        floor: Least thickness that counts, shape ``(M,)``: a fraction of the median
            neighbourhood's radius, as in the test of coplanarity.
        reach: Median distance within which the points take others for coplanar, shape ``(M,)``,
            infinite where that is not known.
        bent: Whether noise does not explain the thickness, shape ``(M,)``, bool.
    """

    fit: FittedPlanes
    floor: Tensor
    reach: Tensor
    bent: Tensor

    @property
    def thickness(self) -> Tensor:
        """Standard deviation of the points from the plane, positive, shape ``(M,)``."""
        return torch.maximum(self.fit.thickness, self.floor)

    @property
    def noise(self) -> Tensor:
        """The thickness where it is known to be noise, shape ``(M,)``, else 0."""
        known = self.reach.isfinite() & ~self.bent & ~self.fit.curved
        return torch.where(known, self.thickness, 0.0)

    def distances(self, points: Tensor, regions: Tensor) -> Tensor:
        """Return the distance of each point ``(n, 3)`` from the plane of a region ``(n,)``."""
        away = points.new_zeros(len(points), dtype=torch.float64)
        columns = [values.unbind(dim=1) for values in (points, self.fit.center, self.fit.normal)]
        for some in chunks_of(len(points), ROWS_AT_ONCE):
            owner = regions[some]
            for place, center, normal in zip(*columns, strict=True):
                away[some] += (place[some].double() - center[owner]) * normal[owner]
        return away.abs_()


def summarize_planes(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    labels: Tensor | NDArray[np.integer],
    *,
    neighbors: Neighbors | None = None,
    up: Sequence[float] | None = None,
    outline: bool = False,
) -> Planes:
    """Fit a plane to each region and measure it.

    Args:
        points: Points, shape ``(N, 3)``; those without a label may hold anything.
        normals: Unit normals of any sign, shape ``(N, 3)``. They tell curved regions from flat
            ones, and decide where points do not: in regions of one or two points, or along a line.
        labels: Region of each point, shape ``(N,)``: 0 to M-1, each at least once, or negative.
        neighbors: Neighbours of each point, to tell which planes meet.
        up: The upward direction, to tell floors, ceilings and walls.
        outline: Whether to trace outlines; needs shapely (``torchrg[outline]``).

    Returns:
        The table, M rows.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If ``up`` is not a direction.
        MissingDependencyError: If outlines are asked for and shapely is not installed.

    Example:
        >>> points = torch.tensor([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 2]])
        >>> normals, labels = torch.eye(3)[[2] * 4], torch.zeros(4, dtype=torch.int64)
        >>> planes = summarize_planes(points, normals, labels)
        >>> planes.normal.tolist(), planes.offset.tolist(), planes.count.tolist()
        ([[0.0, 0.0, 1.0]], [2.0], [4])
    """
    points = as_tensor("summarize_planes", "points", points).detach()
    normals = as_tensor("summarize_planes", "normals", normals).detach()
    labels = as_tensor("summarize_planes", "labels", labels)
    check_shapes(
        "summarize_planes", points=(points, "N 3"), normals=(normals, "N 3"), labels=(labels, "N")
    )
    check_floating("summarize_planes", points=points, normals=normals)
    groups = Segments(labels).split(_POINTS_AT_ONCE)
    fits, squares = zip(*(_fit(points, normals, some) for some in groups), strict=True)
    fit = FittedPlanes(*(torch.cat(parts) for parts in zip(*fits, strict=True)))
    first, second = _plane_axes(fit)

    def measure() -> list[_Measures]:
        found, start = [], 0
        for some in groups:
            rows = slice(start, start + len(some.counts))
            frame = (fit.center[rows], first[rows], second[rows])
            found.append(_measure(points, some, frame, outline=outline))
            start = rows.stop
        return found

    def meet() -> PlaneAdjacency | None:
        if neighbors is None:
            return None
        return find_adjacency(
            points, labels, neighbors, fit.normal, fit.thickness, curved=fit.curved
        )

    measures, found = run_beside(measure, meet, points.device)
    mean, area, sides, directions, middle = (
        torch.cat(parts) for parts in list(zip(*measures, strict=True))[:5]
    )
    axes = directions @ torch.stack([first, second], dim=1)

    def own(values: Tensor) -> Tensor:
        return values.to(points.dtype)

    planes = Planes(
        normal=own(fit.normal),
        offset=own((fit.center * fit.normal).sum(dim=1)),
        centroid=own(fit.center + mean),
        area=own(area),
        count=fit.num_points,
        rms=own(torch.cat(squares).sqrt()),
        extent=own(sides),
        axes=own(axes),
        center=own(fit.center + (middle[:, None] @ axes).squeeze(1)),
        curved=fit.curved,
    )
    if up is not None:
        planes = planes._replace(kind=classify_planes(planes, _direction(up, points)))
    if outline:
        planes = planes._replace(outline=sum((part.outline for part in measures), ()))
    if found is not None:
        lengths, angles = own(found.boundary_length), own(found.dihedral_deg)
        planes = planes._replace(adjacency=PlaneAdjacency(found.pairs, lengths, angles))
    return planes


def _fit(points: Tensor, normals: Tensor, segments: Segments) -> tuple[FittedPlanes, Tensor]:
    """Return planes without the residuals of the points, and the mean square of these."""
    fit = fit_planes(segments, points, normals)
    squares = segments.mean(fit.residuals * fit.residuals)
    return fit._replace(residuals=fit.residuals[:0]), squares


class _Measures(NamedTuple):
    """What is measured in the planes of some regions.

    The mean of the points about the center ``(M, 3)``, the area ``(M,)``, sides, directions and
    middle of the rectangles as :class:`torchrg.regions.measures.Rectangles` has them, and outlines
    if asked for.
    """

    mean: Tensor
    area: Tensor
    sides: Tensor
    directions: Tensor
    middle: Tensor
    outline: tuple[tuple[Tensor, ...], ...]


def _measure(
    points: Tensor, segments: Segments, frame: tuple[Tensor, Tensor, Tensor], *, outline: bool
) -> _Measures:
    """Measure regions in their planes, given by centers and two directions, each ``(M, 3)``."""
    center, first, second = frame
    centered = segments.take_about(points, center)
    mean = torch.stack([segments.mean(column) for column in centered], dim=1)
    u, v = (_along(segments, centered, axis) for axis in (first, second))
    del centered
    boxes = fit_rectangles(segments, u, v)
    area, width = covered_areas(segments, u, v, boxes)
    rings = _outlines(segments, u, v, width, frame, points.dtype) if outline else ()
    return _Measures(mean, area, boxes.sides, boxes.directions, boxes.center, rings)


def _plane_axes(fit: FittedPlanes) -> tuple[Tensor, Tensor]:
    """Return two unit directions that span each plane, the first along the region."""
    first = _without(fit.along, fit.normal)
    # The points of one place have no direction of their own: any in the plane will do.
    least = fit.normal.abs().argmin(dim=1)
    other = _without(torch.eye(3, dtype=first.dtype, device=first.device)[least], fit.normal)
    first = torch.where(first.norm(dim=1, keepdim=True) > 0.5, first, other)
    first = first / first.norm(dim=1, keepdim=True)
    return first, torch.linalg.cross(fit.normal, first)


def _without(vectors: Tensor, normals: Tensor) -> Tensor:
    """Return vectors less their component along the normals."""
    return vectors - (vectors * normals).sum(dim=1, keepdim=True) * normals


def _direction(up: Sequence[float], points: Tensor) -> Tensor:
    """Return a direction beside the points, or say what is wrong with it."""
    direction = torch.tensor(list(up), dtype=points.dtype, device=points.device)
    if direction.shape != (3,) or not bool(direction.isfinite().all() and direction.any()):
        raise ConfigError(
            f"summarize_planes: expected up to be three numbers, not all zero, got {up!r}."
        )
    return direction


def fit_planes(segments: Segments, points: Tensor, normals: Tensor) -> FittedPlanes:
    r"""Fit planes by total least squares, iteratively reweighted with Tukey's bisquare [1].

    The weight of a point falls to 0 at 4.685 times the robust standard deviation of the residuals
    (1.4826 times their median), so that points of another surface do not tilt the plane.

    ``normals`` of any sign decide where points do not, in regions of one or two points or along a
    line. Of a plane's normal the component of largest magnitude, of equal ones the last, is
    positive.

    References:
        [1] P. Huber, E. Ronchetti. Robust Statistics, 2nd edition. Wiley, 2009.
    """
    parts = [_fit_together(some, points, normals) for some in segments.split(_POINTS_AT_ONCE)]
    return FittedPlanes(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _fit_together(segments: Segments, points: Tensor, normals: Tensor) -> FittedPlanes:
    """Fit planes to regions that are held in memory together; see :func:`fit_planes`."""
    shares, directions = eigh3_of_few(_spread_of(segments, normals))
    # The direction that the normals of a region share, signs aside, and their angle to it.
    usual = directions[:, :, 2]
    spread = (1 - shares[:, 2]).clamp(min=0, max=1).sqrt().asin().rad2deg()
    origin = segments.first(points).double()
    local = segments.take_about(points, origin)
    weights = torch.ones_like(local[0])
    resolution = coordinate_resolution(segments.first(points)).double()
    for last in range(_NUM_FITS):
        total = segments.sum(weights)
        mean = torch.stack([segments.sum(x * weights) / total for x in local], dim=1)
        centered = [x - segments.spread(m) for x, m in zip(local, mean.unbind(dim=1), strict=True)]
        covariance = _covariances(segments, centered, weights)
        variances, axes = eigh3_of_few(covariance)
        normal = _with_sign(_plane_normals(variances, axes, usual))
        residuals = _along(segments, centered, normal)
        thickness = MAD_FACTOR * segments.median(residuals.abs())
        if last == _NUM_FITS - 1:
            break
        cut = _BISQUARE_CUT * torch.maximum(thickness, resolution)
        # A region of one place at the origin has cut 0: its residuals are 0 too.
        ratio = residuals / segments.spread(torch.where(cut > 0, cut, 1.0))
        weights = (1 - ratio * ratio).clamp(min=0).square()
    along = axes[:, :, 2]
    # The angle times the width across the bend, which is at least the middle one, is its height.
    height = _LEAST_HEIGHT * spread.deg2rad() * variances[:, 1].clamp(min=0).sqrt()
    # Of an arc without width the plane is its own, and says nothing of its thickness.
    crosses = (usual * normal).sum(dim=1).abs() > math.sqrt(0.5)
    curved = (spread > _CURVED_SPREAD_DEG) & ~(crosses & (thickness < height))
    center, sizes = origin + mean, segments.counts
    return FittedPlanes(normal, center, along, covariance, thickness, residuals, sizes, curved)


def fit_regions(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> RegionPlanes:
    """Return the planes of the regions of a cloud in canonical order.

    ``labels`` ``(N,)`` are 0 to M-1, each at least once, or negative.
    """
    segments = Segments(labels, most=MOST_FITTED)
    fit = fit_planes(segments, cloud.points, cloud.normals)
    indices, counted = cloud.neighbors
    radii = [
        neighborhood_radii(
            cloud.points, Neighbors(indices[rows], None if counted is None else counted[rows])
        )
        for rows in torch.split(segments.rows, ROWS_AT_ONCE)
    ]
    radius = segments.median(torch.cat(radii)).double()
    floor = config.coplanarity_floor * radius
    fit = fit._replace(num_points=torch.bincount(labels + 1, minlength=1)[1:])
    if cloud.reach is None:
        flat = torch.zeros_like(fit.curved)
        return RegionPlanes(fit, floor, torch.full_like(floor, torch.inf), flat)
    reach = segments.median(segments.take(cloud.reach)).double()
    explained = torch.where(reach.isfinite(), torch.maximum(_BENT * reach, floor), floor)
    bent = torch.maximum(fit.thickness, floor) > explained
    return RegionPlanes(fit._replace(curved=fit.curved & bent), floor, reach, bent)


def _along(segments: Segments, columns: Sequence[Tensor], axes: Tensor) -> Tensor:
    """Return coordinates of points, given by columns, along the axis ``(M, 3)`` of their region."""
    total = torch.zeros_like(columns[0])
    # Products and sums apart: their rounding must not depend on where a block of memory ends.
    for column, part in zip(columns, axes.unbind(dim=1), strict=True):
        total += column * segments.spread(part)
    return total


def _spread_of(segments: Segments, normals: Tensor) -> Tensor:
    """Return the second moments of the regions' normals, shape ``(M, 3, 3)``."""
    columns = segments.take_columns(normals)
    return _covariances(segments, columns, torch.ones_like(columns[0]))


def _covariances(segments: Segments, columns: list[Tensor], weights: Tensor) -> Tensor:
    """Return weighted second moments about zero, shape ``(M, 3, 3)``."""
    return second_moments(columns, weights, segments.sum, segments.sum(weights))


def _plane_normals(variances: Tensor, axes: Tensor, usual: Tensor) -> Tensor:
    """Return the normals of planes, from the points' own normals where the points give none."""
    low, middle, high = variances.unbind(dim=1)
    along = axes[:, :, 2]
    is_line = high > _FLAT_RATIO * middle
    component = (usual * along).sum(dim=1, keepdim=True) * along
    across = usual - torch.where(is_line[:, None], component, 0.0)
    length = across.norm(dim=1, keepdim=True)
    across = torch.where(length > 0, across / length, axes[:, :, 0])
    is_flat = middle > _FLAT_RATIO * low
    return torch.where(is_flat[:, None], axes[:, :, 0], across)


def _with_sign(normals: Tensor) -> Tensor:
    """Return normals whose component of largest magnitude, of equal ones the last, is positive."""
    magnitudes = normals.abs()
    near = magnitudes >= (1 - _SAME_MAGNITUDE) * magnitudes.amax(dim=1, keepdim=True)
    last = 2 - near.flip(1).to(torch.uint8).argmax(dim=1, keepdim=True)
    return torch.where(normals.gather(1, last) < 0, -normals, normals)


def classify_planes(planes: Planes, up: Tensor) -> Tensor:
    """Return a simple class for each plane, places in :data:`torchrg.structures.PLANE_KINDS`.

    A plane within 15 degrees of horizontal is a floor in the lowest 15 % of the height that all
    planes take up, a ceiling in the highest, if it is not small beside the largest horizontal one.
    A plane within 15 degrees of vertical is a wall if it takes up half of that height. What is
    left, and what is curved, is "other". A single horizontal plane is a floor.
    """
    other, floor, ceiling, wall = (
        PLANE_KINDS.index(name) for name in ("other", "floor", "ceiling", "wall")
    )
    kind = torch.full_like(planes.count, other)
    if len(kind) == 0:
        return kind
    up = up.to(planes.normal.dtype) / up.to(planes.normal.dtype).norm()
    steepness = (planes.normal * up).sum(dim=1).abs()
    height = (planes.center * up).sum(dim=1)
    reach = ((planes.axes * up).sum(dim=2).abs() * planes.extent).sum(dim=1) / 2
    low, high = (height - reach).amin(), (height + reach).amax()
    level = ~planes.curved & (steepness >= math.cos(math.radians(_MAX_TILT_DEG)))
    largest = torch.where(level, planes.area, 0).amax()
    broad = level & (planes.area >= _LEAST_AREA_SHARE * largest)
    upright = ~planes.curved & (steepness <= math.sin(math.radians(_MAX_TILT_DEG)))
    kind[upright & (2 * reach >= _LEAST_WALL_SHARE * (high - low))] = wall
    kind[broad & (height >= high - _END_SHARE * (high - low))] = ceiling
    kind[broad & (height <= low + _END_SHARE * (high - low))] = floor
    return kind


def _outlines(
    segments: Segments,
    u: Tensor,
    v: Tensor,
    width: Tensor,
    frame: tuple[Tensor, Tensor, Tensor],
    dtype: torch.dtype,
) -> tuple[tuple[Tensor, ...], ...]:
    """Trace the outline of each region, and lift it into space."""
    outlines = []
    counts = segments.counts.tolist()
    parts = torch.split(torch.stack([u, v], dim=1), counts)
    for part, size, center, first, second in zip(parts, width.tolist(), *frame, strict=True):
        rings = (
            torch.from_numpy(ring).to(u.device) for ring in trace_outline(part.cpu().numpy(), size)
        )
        lifted = (center + ring[:, :1] * first + ring[:, 1:] * second for ring in rings)
        outlines.append(tuple(ring.to(dtype) for ring in lifted))
    return tuple(outlines)
