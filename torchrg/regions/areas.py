"""The area that the points of each region cover."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.regions.extents import Rectangles
from torchrg.regions.segments import Segments

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
        >>> from torchrg.regions.extents import fit_rectangles
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
