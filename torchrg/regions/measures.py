"""What a region measures: the area it covers, the rectangle about it, its outline."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._optional import require
from torchrg.linalg.moments import Segments

_TIE = 1e-9
"""Rectangles whose areas differ by less than this share are equal but for rounding."""

_COMPASS = np.array([[1.0, 0], [1, 1], [0, 1], [-1, 1]])
"""Four directions counter-clockwise; the opposite ones follow."""

_ROUNDING = 1e-12
"""Share of the coordinates by which a point inside an octagon is inside beyond rounding."""

_TO_OTHER_SIDES = np.array([[1.5], [2.0], [2.5]])
"""From an edge to the edges across its direction in front, to the opposite one, and to those behind
it: 0.5, 1 and 1.5 times pi, and another pi that the range of angles begins below 0."""


class Rectangles(NamedTuple):
    """Rectangles about M regions.

    Lengths of the long and of the short side, shape ``(M, 2)``; their unit directions in the
    plane's coordinates, ``(M, 2, 2)``; and the centers, ``(M, 2)``, along those directions.
    """

    sides: Tensor
    directions: Tensor
    center: Tensor


def fit_rectangles(segments: Segments, u: Tensor, v: Tensor) -> Rectangles:
    """Find the rectangle of least area about each region.

    One of its sides runs along an edge of the region's convex hull [1]. Of equally small ones it is
    that with the least angle to the coordinates ``u`` and ``v`` in the plane, given in the order of
    :meth:`Segments.take`. A region on one line has a short side of 0, one of one place two.

    References:
        [1] H. Freeman, R. Shapira. Determining the minimum-area encasing rectangle for an arbitrary
        closed curve. Communications of the ACM 18(7), 1975.
    """
    regions = torch.split(torch.stack([u, v], dim=1).cpu(), segments.counts.tolist())
    angles = [_least_area_angle(places.numpy().astype(np.float64)) for places in regions]
    cosine = u.new_tensor([math.cos(angle) for angle in angles])
    sine = u.new_tensor([math.sin(angle) for angle in angles])
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


def _least_area_angle(places: NDArray[np.float64]) -> float:
    """Return the angle of the smallest rectangle about points ``(n, 2)``, in [0, 90) degrees.

    A corner of the hull is the farthest in a direction if the edges before and after it are on
    either side of the edge that would be across it: a search among the angles of the edges.
    """
    corners = places[_hull_corners(places)] @ [1, 1j]
    angles = np.angle(np.roll(corners, -1) - corners)
    order = np.argsort(angles)
    corners, angles = corners[order], angles[order]
    across = (angles + np.pi * _TO_OTHER_SIDES) % (2 * np.pi) - np.pi
    front, top, back = corners[np.searchsorted(angles, across) % len(corners)]
    to_edge = np.exp(-1j * angles)
    length, height = ((front - back) * to_edge).real, ((top - corners) * to_edge).imag
    area = (length * height).clip(min=0)
    smallest = angles[area <= area.min() * (1 + _TIE)] % (np.pi / 2)
    return float(np.where(smallest < np.pi / 2 - _TIE, smallest, smallest - np.pi / 2).min())


def _hull_corners(places: NDArray[np.float64]) -> NDArray[np.integer]:
    """Return the corners of the convex hull, counter-clockwise; the two ends of a line."""
    from scipy.spatial import ConvexHull, QhullError

    outer = _outer_places(places)
    try:
        corners: NDArray[np.integer] = outer[ConvexHull(places[outer]).vertices]
    except QhullError:
        corners = np.lexsort(places.T)[[0, -1]]
    return corners


def _outer_places(places: NDArray[np.float64]) -> NDArray[np.integer]:
    """Return the rows of points ``(n, 2)`` that may be corners of their convex hull.

    Not those inside the octagon of the farthest points in eight directions [1].

    References:
        [1] S. Akl, G. Toussaint. A fast convex hull algorithm. Information Processing Letters 7(5),
        1978.
    """
    along = _COMPASS @ places.T
    ends = np.concatenate([along.argmax(axis=1), along.argmin(axis=1)])
    octagon = places[ends[ends != np.roll(ends, 1)]]
    if len(octagon) < 3:
        return np.arange(len(places))
    edges = np.roll(octagon, -1, axis=0) - octagon
    inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
    offsets = (inward * octagon).sum(axis=1)
    rounding = _ROUNDING * np.abs(inward).max(axis=1) * np.abs(places).max()
    inside = (inward @ places.T > (offsets + rounding)[:, None]).all(axis=0)
    return np.flatnonzero(~inside)


_POINTS_PER_CELL = 9.0
"""So many points in an average cell leave one of 8,000 empty by chance."""

_NUM_DOUBLINGS = 4
_SETTLED = 1.05
"""Cells are wide enough when cells twice as wide give less than this times the area."""

_CELL_ANGLE = math.radians(28.0)
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

    Returns areas ``(M,)``, 0 where the points are on one line, and the width of cells that leaves
    no holes between points ``(M,)``.
    """
    box = boxes.sides.prod(dim=1)
    size = (box * _POINTS_PER_CELL / segments.counts).sqrt()
    # A strip thinner than the spacing would have more cells than points.
    size = torch.maximum(size, boxes.sides[:, 0] / segments.counts)
    cosine, sine = boxes.directions[:, 0].unbind(dim=1)
    c = segments.spread(cosine * math.cos(_CELL_ANGLE) - sine * math.sin(_CELL_ANGLE))
    s = segments.spread(sine * math.cos(_CELL_ANGLE) + cosine * math.sin(_CELL_ANGLE))
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

    Holes and dents narrower than ``width``, that of the cells, are filled. Outer rings ``(V, 2)``,
    the first point not repeated, run counter-clockwise, holes clockwise; points on one line have
    none.

    Raises:
        MissingDependencyError: If shapely is not installed.
    """
    from scipy.ndimage import binary_erosion
    from scipy.spatial import Delaunay, QhullError

    shapely = require("shapely", extra="outline", purpose="trace outlines")
    if width <= 0:
        return []
    cells = np.floor((places - places.min(axis=0)) / width).astype(np.int64) + 1
    occupied = np.zeros(cells.max(axis=0) + 2, dtype=bool)
    occupied[tuple(cells.T)] = True
    inside = binary_erosion(occupied, np.ones((3, 3), dtype=bool))
    corners = places[~inside[tuple(cells.T)]]
    try:
        triangles = corners[Delaunay(corners).simplices]
    except (QhullError, ValueError):
        return []
    ends = np.roll(triangles, 1, axis=1)
    tried = np.concatenate([(triangles + ends) / 2, triangles.mean(axis=1, keepdims=True)], axis=1)
    reached = np.floor((tried - places.min(axis=0)) / width).astype(np.int64) + 1
    covered = occupied[reached[..., 0], reached[..., 1]].all(axis=1)
    # Triangles that share whole edges are a coverage, which is united twenty times as fast.
    shape = shapely.coverage_union_all(shapely.polygons(triangles[covered]))
    return _rings(shapely, shapely.simplify(shape, width / 6), width * width)


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
