"""Extents of planar regions: minimum-area rectangles and covered areas."""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import nonzero_rows
from torchrg.linalg.moments import Segments, reduce_runs

_REL_TOL = 1e-9
"""Relative area difference below which rectangles count as equal (rounding)."""
_ROUNDING = 1e-12
"""Relative margin by which a discarded point must be inside the octagon (rounding)."""
_SIDE_TURNS = np.array([[1.5], [2.0], [2.5]])
"""Angles, in units of pi, from an edge to the front, opposite and back edges of its rectangle: 0.5,
1 and 1.5, plus 1 because angles start at -pi."""
_POINTS_PER_CELL = 9.0
"""Mean number of points per cell; one cell in 8,000 is then empty by chance."""
_NUM_DOUBLINGS = 4
"""Maximum number of times the cell width is doubled."""
_MAX_AREA_GROWTH = 1.05
"""Cells are wide enough if doubling their width gives less than this times the area."""
_CELL_ANGLE = math.radians(28.0)
"""Angle between cell grid and rectangle: a parallel edge would cut all its cells equally."""


class Rectangles(NamedTuple):
    """Minimum-area rectangles of M regions.

    Lengths of the long and the short side, shape ``(M, 2)``; their unit directions in plane
    coordinates, ``(M, 2, 2)``; and the centers, ``(M, 2)``, along those directions.
    """

    sides: Tensor
    directions: Tensor
    center: Tensor


def fit_rectangles(segments: Segments, u: Tensor, v: Tensor) -> Rectangles:
    """Fit the minimum-area rectangle to each region.

    One side lies along an edge of the convex hull [1]. Ties go to the smallest angle to the plane
    coordinates ``u`` and ``v``, which are in the order of :meth:`Segments.gather`. A collinear
    region has a short side of 0; for a single position both sides are 0.

    References:
        [1] H. Freeman, R. Shapira. Determining the minimum-area encasing rectangle for an arbitrary
        closed curve. Communications of the ACM 18(7), 1975.
    """
    rectangles = [_min_rectangle(positions) for positions in hull_candidates(segments, u, v)]
    table = u.new_tensor(np.array(rectangles)).view(-1, 2, 4)
    return Rectangles(table[:, :, 0], table[:, :, 1:3], table[:, :, 3])


def _min_rectangle(positions: NDArray[np.float64]) -> list[tuple[float, ...]]:
    """Return length, direction and center of the long and the short side, four numbers each."""
    angle = _min_area_angle(positions)
    cosine, sine = math.cos(angle), math.sin(angle)
    (u, v), sides = positions.T, list[tuple[float, ...]]()
    for x, y, axis in ((u, v, (cosine, sine)), (v, -u, (-sine, cosine))):
        along = x * cosine + y * sine
        low, high = along.min(), along.max()
        sides.append((high - low, *axis, (high + low) / 2))
    return sides[::-1] if sides[0][0] < sides[1][0] else sides


def _min_area_angle(positions: NDArray[np.float64]) -> float:
    """Return the angle of the minimum-area rectangle of points ``(n, 2)``, in [0, 90) degrees.

    The farthest corner in a direction lies between the two hull edges whose angles enclose the
    perpendicular. It is found by a search among the edge angles.
    """
    # Adding zero removes its sign, which would turn an angle of 180 degrees.
    corners = (positions[_hull_corners(positions)] + 0.0).view(np.complex128)[:, 0]
    angles = np.angle(np.append(corners[1:], corners[0]) - corners)
    order = np.argsort(angles)
    corners, angles = corners[order], angles[order]
    across = (angles + np.pi * _SIDE_TURNS) % (2 * np.pi) - np.pi
    front, top, back = corners[np.searchsorted(angles, across) % len(corners)]
    to_edge = np.exp(-1j * angles)
    length, height = ((front - back) * to_edge).real, ((top - corners) * to_edge).imag
    area = (length * height).clip(min=0)
    smallest = angles[area <= area.min() * (1 + _REL_TOL)] % (np.pi / 2)
    return float(np.where(smallest < np.pi / 2 - _REL_TOL, smallest, smallest - np.pi / 2).min())


def _hull_corners(positions: NDArray[np.float64]) -> NDArray[np.integer]:
    """Return the corners of the convex hull, counterclockwise; the two ends of a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners: NDArray[np.integer] = ConvexHull(positions).vertices
    except QhullError:
        corners = np.lexsort(positions.T)[[0, -1]]
    return corners


def hull_candidates(segments: Segments, u: Tensor, v: Tensor) -> list[NDArray[np.float64]]:
    """Return the points ``(n, 2)`` of each region that may be corners of its convex hull.

    The kernel discards points inside the octagon of the extreme points in eight directions: S. Akl,
    G. Toussaint. A fast convex hull algorithm. Information Processing Letters 7(5), 1978.
    """
    u, v, counts = u.double().cpu(), v.double().cpu(), segments.counts.cpu()
    outer = torch.ones_like(u, dtype=torch.bool)
    if kernels.serve() and bool(counts.all()):
        (outer,) = kernels.call("hull_candidates", u, v, counts, _ROUNDING)
    chosen = nonzero_rows(outer)
    ends = torch.searchsorted(chosen, counts.cumsum(0)).tolist()
    positions = torch.stack([u[chosen], v[chosen]], dim=1).numpy()
    return [positions[start:end] for start, end in zip([0, *ends], ends, strict=False)]


class _Cells(NamedTuple):
    """Occupied cells: region, row and column, and the cell and open side counts of each region."""

    owner: Tensor
    row: Tensor
    column: Tensor
    num_cells: Tensor
    num_open: Tensor


def covered_areas(
    segments: Segments, u: Tensor, v: Tensor, boxes: Rectangles
) -> tuple[Tensor, Tensor]:
    """Return the area covered by points, without gaps, holes and dents, and the cell width.

    The plane is divided into square cells, initially three times the mean point spacing. They are
    widened until the area hardly grows, so that sparse parts have no holes. Cells along the
    boundary are only partly covered: the expected excess is subtracted. Areas ``(M,)`` are 0 for
    collinear points and at most the rectangle areas. The cell width ``(M,)`` leaves no holes
    between points.
    """
    box = boxes.sides.prod(dim=1)
    size = (box * _POINTS_PER_CELL / segments.counts).sqrt()
    # A strip narrower than the spacing would have more cells than points.
    size = torch.maximum(size, boxes.sides[:, 0] / segments.counts)
    cosine, sine = boxes.directions[:, 0].unbind(dim=1)
    c = segments.broadcast(cosine * math.cos(_CELL_ANGLE) - sine * math.sin(_CELL_ANGLE))
    s = segments.broadcast(sine * math.cos(_CELL_ANGLE) + cosine * math.sin(_CELL_ANGLE))
    row = _cell_indices(segments, u * c + v * s, size)
    column = _cell_indices(segments, v * c - u * s, size)
    cells = _occupied_cells(segments.labels, row, column, segments.counts)
    area, width = _corrected_area(cells, segments.counts, size), size
    wide_enough = torch.zeros_like(size, dtype=torch.bool)
    for _ in range(_NUM_DOUBLINGS):
        if bool(wide_enough.all()):
            break
        cells = _occupied_cells(cells.owner, cells.row // 2, cells.column // 2, cells.num_cells)
        size = size * 2
        wider = _corrected_area(cells, segments.counts, size)
        wide_enough |= wider <= _MAX_AREA_GROWTH * area
        area, width = torch.where(wide_enough, area, wider), torch.where(wide_enough, width, size)
    return torch.minimum(area, box), width


def _cell_indices(segments: Segments, x: Tensor, size: Tensor) -> Tensor:
    """Return the cell index of each point along one axis, from 0 in each region."""
    low = segments.broadcast(reduce_runs(x, segments.counts, "min"))
    return ((x - low) / segments.broadcast(torch.where(size > 0, size, 1.0))).long()


def _occupied_cells(owner: Tensor, row: Tensor, column: Tensor, counts: Tensor) -> _Cells:
    """Return the distinct occupied cells of consecutive regions with ``counts`` points each."""
    # Pad each region by one empty row and column, so that regions share no cell sides.
    heights, widths = (reduce_runs(position, counts, "max") + 3 for position in (row, column))
    num_regions, ends = len(counts), (heights * widths).cumsum(0)
    starts = ends - heights * widths
    keys = (starts + widths + 1).index_select(0, owner) + row * widths.index_select(0, owner)
    grid = torch.zeros(int(ends[-1]) if num_regions else 0, dtype=torch.bool, device=owner.device)
    grid[keys + column] = True
    keys = nonzero_rows(grid)
    owner = torch.searchsorted(ends, keys, right=True)
    width = widths[owner]
    sides = torch.stack([keys - 1, keys + 1, keys - width, keys + width])
    inside, num_cells = keys - starts[owner], torch.searchsorted(keys, ends)
    num_cells = num_cells.diff(prepend=num_cells.new_zeros(1))
    num_open = reduce_runs((~grid[sides]).sum(dim=0), num_cells, "sum").double()
    return _Cells(owner, inside // width - 1, inside % width - 1, num_cells, num_open)


def _corrected_area(cells: _Cells, counts: Tensor, size: Tensor) -> Tensor:
    """Return the cell area less the expected overshoot at the boundary.

    A convex shape of area A meets A + E/2 - 1 cells on average, areas in cells, E their open sides.
    A cell with covered fraction f is detected with probability 1 - exp(-n f), n points in a full
    cell. Averaged over f, the fraction 1 - 2 (1 - exp(-n)) / n of the excess remains.
    """
    density = (counts / cells.num_cells).double()
    fraction = 1 - 2 * (1 - (-density).exp()) / density
    excess = fraction.clamp(min=0) * (cells.num_open / 2 - 1)
    return (cells.num_cells - excess).clamp(min=0) * size * size
