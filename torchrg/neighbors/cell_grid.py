"""A cloud sorted by the cells of a grid."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_FAR = 1e6
"""Distance of what fills up rows of candidates, in extents of the cloud."""

WIDTH_STEP = 64
"""Rows of candidates are filled up to a multiple of this."""


class CellGrid(NamedTuple):
    """A cloud sorted by cells; places are positions in that order.

    Attributes:
        columns: Coordinates by place, and a last one far away, each shape ``(N + 1,)``.
        rows: Row of each place, shape ``(N + 1,)``.
        asked: Places to answer for, ascending, shape ``(n,)``.
        first_asked: First of each asked cell in ``asked``, shape ``(C,)``.
        num_asked: Number of them, shape ``(C,)``.
        centers: Centres of the asked cells, shape ``(3, C)``.
        starts: First place of each of the nine columns of three cells about a cell, ``(C, 9)``.
        lengths: Number of points in each, shape ``(C, 9)``.
        size: Side of a cell.
    """

    columns: list[NDArray[np.float64]]
    rows: NDArray[np.int32]
    asked: NDArray[np.int64]
    first_asked: NDArray[np.int64]
    num_asked: NDArray[np.int64]
    centers: NDArray[np.float64]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    size: float


def make_grid(points: NDArray[np.float64], size: float, rows: NDArray[np.int64]) -> CellGrid:
    """Sort a cloud by cells, and list those around each cell that holds an asked row."""
    low, high = points.min(axis=0), points.max(axis=0)
    far = low + _FAR * (high - low).max()
    cell = np.floor((points - low) / size).astype(np.int64) + 1
    _, width, height = (int(count) + 2 for count in cell.max(axis=0))
    keys = (cell[:, 0] * width + cell[:, 1]) * height + cell[:, 2]
    order = np.argsort(keys)
    keys = keys[order]
    first = run_starts(keys)
    cell_keys, ends = keys[first], np.append(first, len(points))
    is_asked = np.zeros(len(points), dtype=bool)
    is_asked[rows] = True
    asked = np.flatnonzero(is_asked[order])
    first_asked = run_starts(keys[asked])
    own = asked[first_asked]
    # Cells that differ in z alone have consecutive keys: three of them are one range.
    around = np.array([x * width + y for x in (-1, 0, 1) for y in (-1, 0, 1)]) * height
    starts = ends[np.searchsorted(cell_keys, keys[own][:, None] + (around - 1))]
    stops = ends[np.searchsorted(cell_keys, keys[own][:, None] + (around + 2))]
    return CellGrid(
        columns=[np.append(points[order, axis], far[axis]) for axis in range(3)],
        rows=np.append(order, -1).astype(np.int32),
        asked=asked,
        first_asked=first_asked,
        num_asked=np.diff(first_asked, append=len(asked)),
        centers=(low + (cell[order[own]] - 0.5) * size).T.copy(),
        starts=starts,
        lengths=stops - starts,
        size=size,
    )


def run_starts(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where runs of equal values begin."""
    return np.flatnonzero(np.append(True, values[1:] != values[:-1])) if len(values) else values


def list_candidates(grid: CellGrid, cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the places of all points about each cell, the rest of a row the place far away."""
    starts, lengths = grid.starts[cells].ravel(), grid.lengths[cells].ravel()
    total = grid.lengths[cells].sum(axis=1)
    before = np.cumsum(lengths) - lengths
    width = -(-int(total.max()) // WIDTH_STEP) * WIDTH_STEP
    places = np.full((len(cells), width), len(grid.rows) - 1)
    places[np.arange(width) < total[:, None]] = np.arange(total.sum()) + np.repeat(
        starts - before, lengths
    )
    return places
