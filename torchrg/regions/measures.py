"""What a region measures: the area it covers, the rectangle about it, its outline."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._optional import require
from torchrg.linalg.moments import Segments

_NUM_DIRECTIONS = 32
_SLACK = 1 - 1e-6
_COARSE_STEP_DEG, _FINE_STEP_DEG = 2.0, 0.1


class Rectangles(NamedTuple):
    """Rectangles about M regions.

    Attributes:
        sides: Length of the long and of the short side, shape ``(M, 2)``.
        directions: Unit directions of the long and of the short side in the plane's coordinates,
            shape ``(M, 2, 2)``.
        center: Center of each rectangle, shape ``(M, 2)``, along those directions.
    """

    sides: Tensor
    directions: Tensor
    center: Tensor


def fit_rectangles(segments: Segments, u: Tensor, v: Tensor) -> Rectangles:
    """Find the rectangle of least area about each region, to a tenth of a degree.

    The turn is searched with the extreme points of 64 directions; the sides then hold all points.

    Args:
        segments: The regions.
        u: First coordinate in the plane, in the order of :meth:`Segments.take`.
        v: Second coordinate.

    Returns:
        The rectangles. A region of one place has sides 0.

    Example:
        >>> corners = torch.tensor([[0.0, 0], [2, 2], [3, 1], [1, -1]])
        >>> segments = Segments(torch.zeros(4, dtype=torch.int64))
        >>> fit_rectangles(segments, *corners.unbind(1)).sides
        tensor([[2.8284, 1.4142]])
    """
    turn = _best_turn(*_extreme_points(segments, u, v))
    cosine, sine = turn.cos(), turn.sin()
    c, s = segments.spread(cosine), segments.spread(sine)
    one, other = segments.bounds(u * c + v * s), segments.bounds(v * c - u * s)
    low, high = (torch.stack(pair, dim=1) for pair in zip(one, other, strict=True))
    directions = torch.stack([cosine, sine, -sine, cosine], dim=1).view(-1, 2, 2)
    sides, centers = high - low, (high + low) / 2
    swap = sides[:, 0] < sides[:, 1]
    return Rectangles(
        torch.where(swap[:, None], sides.flip(1), sides),
        torch.where(swap[:, None, None], directions.flip(1), directions),
        torch.where(swap[:, None], centers.flip(1), centers),
    )


def _extreme_points(segments: Segments, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return corners of each region's convex hull, two arrays ``(M, 2 * directions)``."""
    # Stretching keeps the corners of a hull; a thin strip needs it to have more than two.
    scale_u, scale_v = (segments.spread(segments.mean(x.abs())) for x in (u, v))
    wide_u = u / torch.where(scale_u > 0, scale_u, 1.0)
    wide_v = v / torch.where(scale_v > 0, scale_v, 1.0)
    corners = _extremes(segments, wide_u, wide_v, (0.0, math.pi / 2))
    angles = [math.pi * step / _NUM_DIRECTIONS for step in range(_NUM_DIRECTIONS)]
    # Nearer to the origin than the hull of four of its points is anywhere: no corner of the hull.
    near = _least_reach(wide_u[corners], wide_v[corners], angles) * _SLACK
    outer = wide_u * wide_u + wide_v * wide_v >= segments.spread(near * near.abs())
    rows = outer.nonzero().squeeze(1)
    corners = rows[_extremes(Segments(segments.labels[rows]), wide_u[rows], wide_v[rows], angles)]
    return u[corners], v[corners]


def _extremes(segments: Segments, u: Tensor, v: Tensor, angles: Sequence[float]) -> Tensor:
    """Return the places of the points that reach farthest along and against directions."""
    places = []
    for angle in angles:
        reach = u * math.cos(angle) + v * math.sin(angle)
        places += [
            segments.first_of_each(reach == segments.spread(bound))
            for bound in segments.bounds(reach)
        ]
    return torch.stack(places, dim=1)


def _least_reach(u: Tensor, v: Tensor, angles: Sequence[float]) -> Tensor:
    """Return how far some points reach along that direction, or against, where it is least."""
    reach = [u * math.cos(angle) + v * math.sin(angle) for angle in angles]
    ends = [bound for along in reach for bound in (along.amax(dim=1), -along.amin(dim=1))]
    return torch.stack(ends).amin(dim=0)


def _best_turn(u: Tensor, v: Tensor) -> Tensor:
    """Return the angle of least area in [0, 90) degrees, in radians, shape ``(M,)``."""
    best = torch.zeros(len(u), dtype=u.dtype, device=u.device)
    for step, reach in ((_COARSE_STEP_DEG, 90.0), (_FINE_STEP_DEG, _COARSE_STEP_DEG)):
        start = best.clone()
        least = torch.full_like(best, math.inf)
        for place in range(-round(reach / step) + 1, round(reach / step)):
            if reach == 90.0 and place < 0:
                continue
            turn = start + math.radians(place * step)
            cosine, sine = turn.cos()[:, None], turn.sin()[:, None]
            one, other = u * cosine + v * sine, v * cosine - u * sine
            area = (one.amax(1) - one.amin(1)) * (other.amax(1) - other.amin(1))
            best = torch.where(area < least, turn, best)
            least = torch.minimum(least, area)
    return best


_POINTS_PER_CELL = 9.0
"""So many points in an average cell leave one of 8,000 empty by chance."""

_NUM_DOUBLINGS = 4
_SETTLED = 1.05
"""Cells are wide enough when cells twice as wide give less than this times the area."""

_TURN = math.radians(28.0)
"""Angle between cells and rectangle: along a parallel edge all cells would be cut alike."""


class _Cells(NamedTuple):
    """Occupied cells: region, row and column of each, and the open sides of each region's cells."""

    owner: Tensor
    row: Tensor
    column: Tensor
    num_cells: Tensor
    num_open: Tensor


def covered_areas(
    segments: Segments, u: Tensor, v: Tensor, boxes: Rectangles
) -> tuple[Tensor, Tensor]:
    """Return the area covered by points, without gaps, holes and dents, and the cells' width.

    The plane is divided into square cells, at first three times as wide as the mean spacing of the
    points, then wider until the area settles, so that parts of low density are not full of holes.
    Cells along the outline are only partly covered: the expected excess is taken off. The area
    never exceeds that of the rectangle about the region.

    Args:
        segments: The regions.
        u: First coordinate in the plane, in the order of :meth:`Segments.take`.
        v: Second coordinate.
        boxes: Rectangles about the regions.

    Returns:
        Areas, shape ``(M,)``, 0 where the points are on one line; and the width of cells that
        leaves no holes between points, shape ``(M,)``.

    Example:
        >>> from torchrg.regions.measures import fit_rectangles
        >>> u, v = torch.cartesian_prod(torch.arange(60.0), torch.arange(60.0)).unbind(1)
        >>> segments = Segments(torch.zeros(3600, dtype=torch.int64))
        >>> area, width = covered_areas(segments, u, v, fit_rectangles(segments, u, v))
        >>> bool((area - 60 * 60).abs() < 150)
        True
    """
    box = boxes.sides.prod(dim=1)
    size = (box * _POINTS_PER_CELL / segments.counts).sqrt()
    # A strip thinner than the spacing would have more cells than points.
    size = torch.maximum(size, boxes.sides[:, 0] / segments.counts)
    cosine, sine = boxes.directions[:, 0].unbind(dim=1)
    c = segments.spread(cosine * math.cos(_TURN) - sine * math.sin(_TURN))
    s = segments.spread(sine * math.cos(_TURN) + cosine * math.sin(_TURN))
    row = _numbered(segments, u * c + v * s, size)
    column = _numbered(segments, v * c - u * s, size)
    cells = _occupied(segments.labels, row, column, len(size))
    area, width = _corrected(cells, segments.counts, size), size
    settled = torch.zeros_like(size, dtype=torch.bool)
    for _ in range(_NUM_DOUBLINGS):
        cells = _occupied(cells.owner, cells.row // 2, cells.column // 2, len(size))
        size = size * 2
        wider = _corrected(cells, segments.counts, size)
        settled |= wider <= _SETTLED * area
        area, width = torch.where(settled, area, wider), torch.where(settled, width, size)
    return torch.minimum(area, box), width


def _numbered(segments: Segments, x: Tensor, size: Tensor) -> Tensor:
    """Return the number of each point's cell along one axis, from 0 on in each region."""
    low = segments.spread(segments.bounds(x)[0])
    return ((x - low) / segments.spread(torch.where(size > 0, size, 1.0))).long()


def _occupied(owner: Tensor, row: Tensor, column: Tensor, num_regions: int) -> _Cells:
    """Return the cells with points, each once."""
    # One empty row and column on each side, so that no cell has a neighbour of another region.
    heights, widths = (
        torch.zeros(num_regions, dtype=torch.int64, device=owner.device).scatter_reduce_(
            0, owner, place, "amax"
        )
        + 3
        for place in (row, column)
    )
    ends = (heights * widths).cumsum(0)
    starts = ends - heights * widths
    keys = starts[owner] + (row + 1) * widths[owner] + column + 1
    grid = torch.zeros(int(ends[-1]) if num_regions else 0, dtype=torch.bool, device=owner.device)
    grid[keys] = True
    keys = grid.nonzero().squeeze(1)
    owner = torch.searchsorted(ends, keys, right=True)
    width = widths[owner]
    sides = torch.stack([keys - 1, keys + 1, keys - width, keys + width])
    num_open = (~grid[sides]).sum(dim=0)
    inside = keys - starts[owner]
    return _Cells(
        owner,
        inside // width - 1,
        inside % width - 1,
        torch.bincount(owner, minlength=num_regions),
        torch.bincount(owner, weights=num_open.double(), minlength=num_regions),
    )


def _corrected(cells: _Cells, counts: Tensor, size: Tensor) -> Tensor:
    """Return the area of cells less what their outline overshoots.

    A convex shape of area A meets A + E/2 - 1 cells on average, areas in cells, E their open sides.
    A cell covered to a share f is seen if it has a point: with probability 1 - exp(-n f), n points
    in a full cell. Averaged over f this leaves the share 1 - 2 (1 - exp(-n)) / n of the excess.
    """
    density = (counts / cells.num_cells).double()
    share = 1 - 2 * (1 - (-density).exp()) / density
    excess = share.clamp(min=0) * (cells.num_open / 2 - 1)
    return (cells.num_cells - excess).clamp(min=0) * size * size


Ring = NDArray[np.float64]


def trace_outline(places: NDArray[np.float64], width: float) -> list[Ring]:
    """Return the outline of points in a plane: rings through some of them.

    The points near an edge, found with square cells, are triangulated. Triangles over cells without
    points are left out, and the others united.

    Args:
        places: Points, shape ``(n, 2)``.
        width: Width of the cells: holes and dents narrower than this are filled.

    Returns:
        Rings of shape ``(V, 2)``, the first point not repeated: outer ones counter-clockwise, holes
        clockwise. None where the points are on one line.

    Raises:
        MissingDependencyError: If shapely is not installed.

    Example:
        >>> grid = np.stack(np.mgrid[:30, :30], axis=-1).reshape(-1, 2).astype(float)
        >>> frame = grid[((grid < 10) | (grid >= 20)).any(axis=1)]
        >>> outer, hole = trace_outline(frame, 3.0)
        >>> sorted(map(tuple, outer.tolist()))
        [(0.0, 0.0), (0.0, 29.0), (29.0, 0.0), (29.0, 29.0)]
        >>> float(hole.min()), float(hole.max())
        (9.0, 20.0)
    """
    from scipy.spatial import Delaunay, QhullError

    shapely = require("shapely", extra="outline", purpose="trace outlines")
    if width <= 0:
        return []
    cells = np.floor((places - places.min(axis=0)) / width).astype(np.int64) + 1
    occupied = np.zeros(cells.max(axis=0) + 2, dtype=bool)
    occupied[tuple(cells.T)] = True
    corners = places[~_is_inside(occupied)[tuple(cells.T)]]
    try:
        triangles = corners[Delaunay(corners).simplices]
    except (QhullError, ValueError):
        return []
    ends = np.roll(triangles, 1, axis=1)
    tried = np.concatenate([(triangles + ends) / 2, triangles.mean(axis=1, keepdims=True)], axis=1)
    reached = np.floor((tried - places.min(axis=0)) / width).astype(np.int64) + 1
    covered = occupied[reached[..., 0], reached[..., 1]].all(axis=1)
    shape = shapely.union_all(shapely.polygons(triangles[covered]))
    return _rings(shapely, shapely.simplify(shape, width / 6), width * width)


def _is_inside(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which cells have eight occupied neighbours; the border has none."""
    inside = np.zeros_like(occupied)
    inner = np.ones_like(occupied[1:-1, 1:-1])
    height, length = occupied.shape
    for i in range(3):
        for j in range(3):
            inner &= occupied[i : height - 2 + i, j : length - 2 + j]
    inside[1:-1, 1:-1] = inner
    return inside


def _rings(shapely: Any, shape: Any, min_area: float) -> list[Ring]:  # noqa: ANN401
    """Return the rings of a polygon or of several, largest polygon first, without specks."""
    parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
    largest = max((part.area for part in parts), default=0.0)
    parts = [part for part in parts if part.area >= min(min_area, largest)]
    rings: list[Ring] = []
    for part in sorted(parts, key=lambda part: -part.area):
        turned = shapely.geometry.polygon.orient(part)
        holes = [hole for hole in turned.interiors if shapely.Polygon(hole).area >= min_area]
        rings += [np.asarray(ring.coords)[:-1] for ring in (turned.exterior, *holes)]
    return rings
