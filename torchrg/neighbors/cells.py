"""Nearest neighbours by a grid of cells: most points of a cloud at a third of a tree's time.

A cell and the 26 around it hold a few hundred points: all distances from the points of the cell to
these are one small matrix product, of which a sorting network takes the smallest. A result counts
only if no point outside the cells can be nearer; the tree answers for the others. Kernels take the
distances point by point, and list the cells of the box about the cloud, empty ones too.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg import kernels
from torchrg._parallel import CACHE_BYTES, ROWS_IN_CACHE, chunks_of, map_tasks
from torchrg.structures import bounding_box

Store = Callable[[NDArray[np.integer], NDArray[np.float64], NDArray[np.integer]], None]
"""Takes rows ``(n,)``, distances ``(n, k)`` and neighbours ``(n, k)``."""

Scalar = TypeVar("Scalar", bound=np.generic)

MIN_FOR_CELLS = 2000
"""Points below which a tree is as fast as cells."""

_MAX_CANDIDATES = 512
"""Candidates of a point at most: what NumPy sorts without a branch (AVX-512)."""

_MIN_CANDIDATES = 2.4
"""Candidates for a neighbour wanted; with fewer, most results would not count."""

_WIDTH_STEP = 64
"""Rows of candidates are filled up to a multiple of this."""

_POSITION = _MAX_CANDIDATES - 1
"""The bits of a sorted distance that hold the place of its candidate."""

_SPARE = 6
"""Neighbours selected beyond k, for the bits that the selection does not see."""

_SIZE_STEP = 1.5
"""Cells of one size answer for points whose k-th neighbour is from 1 / 1.75 to 1 size away."""

_MIN_SHARE = 0.03
"""Share of the points for which another size of cells is worth its sort."""

_FAR = 1e6
"""Distance of what fills up rows of candidates, in extents of the cloud."""

_MAX_KEY = 2.0**62
"""Cells of a grid that int64 still numbers."""

_CELLS_A_POINT = 8
"""Cells of the box about a cloud, empty ones too, that are worth their memory, 4 bytes each."""


def search_cells(
    points: NDArray[np.float64],
    k: int,
    rows: NDArray[np.int64],
    reach: NDArray[np.float64],
    store: Store,
) -> NDArray[np.int64]:
    """Find the k nearest of distinct points ``(N, 3)`` for rows that cells of some size answer for.

    The point itself counts. ``reach`` are distances of the k-th neighbour of a sample of the
    points. ``store`` gets each answered row once, from several threads, its neighbours sorted by
    distance, then by row. Returns the rows that are left, ascending.
    """
    left = rows
    if _MIN_CANDIDATES * (k + _SPARE) <= _MAX_CANDIDATES:
        for size in cell_sizes(reach):
            if len(left) >= MIN_FOR_CELLS:
                left = _search_level(points, k, size, left, store)
    return left


def cell_sizes(reach: NDArray[np.float64]) -> list[float]:
    """Return ascending sizes of cells that together answer for nearly all of a sample."""
    sizes: list[float] = []
    reach = np.sort(reach[reach > 0])
    few = int(_MIN_SHARE * len(reach))
    while len(reach) > few:
        sizes.append(_SIZE_STEP * float(reach[few]))
        reach = reach[reach > sizes[-1]]
    return sizes


def _search_level(
    points: NDArray[np.float64], k: int, size: float, rows: NDArray[np.int64], store: Store
) -> NDArray[np.int64]:
    """Answer for the rows that cells of one size can answer for, and return the others."""
    columns = np.ascontiguousarray(points.T)
    if (np.ptp(columns, axis=1) / size + 4).prod() > _MAX_KEY:
        return rows
    grid = _make_grid(columns, size, rows)
    answered = np.zeros(len(points), dtype=bool)

    def work(cells: NDArray[np.int64]) -> None:
        answers = _search_task(grid, cells, k)
        answered[answers[0]] = True
        store(*answers)

    map_tasks(work, _make_tasks(grid, k), torch.device("cpu"))
    return rows[~answered[rows]]


class _CellGrid(NamedTuple):
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


def _make_grid(columns: NDArray[np.float64], size: float, rows: NDArray[np.int64]) -> _CellGrid:
    """Sort a cloud ``(3, N)`` by cells, and list those around each cell that holds an asked row."""
    num_points = columns.shape[1]
    low, high = columns.min(axis=1), columns.max(axis=1)
    far = low + _FAR * (high - low).max()
    cell = np.floor((columns - low[:, None]) / size).astype(np.int64) + 1
    _, width, height = (int(count) + 2 for count in cell.max(axis=1))
    keys = (cell[0] * width + cell[1]) * height + cell[2]
    order = np.argsort(keys)
    keys = keys[order]
    first = _run_starts(keys)
    cell_keys, ends = keys[first], np.append(first, num_points)
    is_asked = np.zeros(num_points, dtype=bool)
    is_asked[rows] = True
    asked = np.flatnonzero(is_asked[order])
    first_asked = _run_starts(keys[asked])
    firsts = asked[first_asked]
    # Cells that differ in z alone have consecutive keys: three of them are one range.
    around = np.array([x * width + y for x in (-1, 0, 1) for y in (-1, 0, 1)]) * height
    starts = ends[np.searchsorted(cell_keys, keys[firsts][:, None] + (around - 1))]
    stops = ends[np.searchsorted(cell_keys, keys[firsts][:, None] + (around + 2))]
    return _CellGrid(
        columns=[np.append(column[order], end) for column, end in zip(columns, far, strict=True)],
        rows=np.append(order, -1).astype(np.int32),
        asked=asked,
        first_asked=first_asked,
        num_asked=np.diff(first_asked, append=len(asked)),
        centers=low[:, None] + (cell[:, order[firsts]] - 0.5) * size,
        starts=starts,
        lengths=stops - starts,
        size=size,
    )


def _make_tasks(grid: _CellGrid, k: int) -> list[NDArray[np.int64]]:
    """Group cells with enough candidates, and not too many, by the shape of their matrix."""
    total = grid.lengths.sum(axis=1)
    enough = (total <= _MAX_CANDIDATES) & (total >= _MIN_CANDIDATES * (k + _SPARE))
    cells = np.flatnonzero(enough)
    width, height = (
        -(-total[cells] // _WIDTH_STEP) * _WIDTH_STEP,
        -(-grid.num_asked[cells] // 8) * 8,
    )
    shape = width * (_MAX_CANDIDATES + 1) + height
    by_shape = np.argsort(shape, kind="stable")
    tasks = []
    for same in np.split(by_shape, _run_starts(shape[by_shape])[1:]):
        if len(same):
            step = max(1, CACHE_BYTES // int(width[same[0]] * height[same[0]] * 4))
            tasks += [cells[same[chunk]] for chunk in chunks_of(len(same), step)]
    return tasks


def _run_starts(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where runs of equal values begin."""
    return np.flatnonzero(np.append(True, values[1:] != values[:-1])) if len(values) else values


def _search_task(
    grid: _CellGrid, cells: NDArray[np.int64], k: int
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """Return those rows of some cells whose neighbours are certain, distances and neighbours."""
    places = _list_candidates(grid, cells)
    width = places.shape[1]
    candidates = [_take(column, places) for column in grid.columns]
    counts = grid.num_asked[cells]
    lanes = np.repeat(np.arange(len(cells)), counts)
    slots = np.arange(len(lanes)) - np.repeat(np.cumsum(counts) - counts, counts)
    askers = _take(grid.asked, grid.first_asked[cells][lanes] + slots)
    points = [_take(column, askers) for column in grid.columns]

    centers = grid.centers[:, cells]
    about = np.stack([c - m[:, None] for c, m in zip(candidates, centers, strict=True)], axis=1)
    offsets = np.stack([p - m[lanes] for p, m in zip(points, centers, strict=True)], axis=1)
    queries = np.zeros((len(cells), int(counts.max()), 3), np.float32)
    queries[lanes, slots] = offsets
    sq_distances = _sq_distances_between(queries, about.astype(np.float32)).reshape(-1, width)
    asked = lanes * queries.shape[1] + slots
    selected, sq_beyond = _select_smallest(_take(sq_distances, asked), k + _SPARE)

    selected += (lanes * width)[:, None]
    exact = np.zeros(selected.shape)
    for candidate, point in zip(candidates, points, strict=True):
        difference = _take(candidate.reshape(-1), selected)
        difference -= point[:, None]
        exact += np.multiply(difference, difference, out=difference)
    rows = _take(grid.rows, _take(places.reshape(-1), selected))
    distances, rows = _sort_by_distance(np.sqrt(exact, out=exact), rows, k)

    # Rounding of the matrix product, and of which cell a point on a border is in.
    sq_beyond -= 64 * np.finfo(np.float32).eps * grid.size**2
    border = (1.5 * grid.size - np.abs(offsets).max(axis=1)) * (1 - 1e-6)
    certain = (distances[:, -1] < border) & (distances[:, -1] ** 2 < sq_beyond)
    answered = np.flatnonzero(certain)
    return grid.rows[askers[answered]], _take(distances, answered), _take(rows, answered)


def _list_candidates(grid: _CellGrid, cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the places of all points about each cell, the rest of a row the place far away."""
    starts, lengths = grid.starts[cells].ravel(), grid.lengths[cells].ravel()
    total = grid.lengths[cells].sum(axis=1)
    before = np.cumsum(lengths) - lengths
    width = -(-int(total.max()) // _WIDTH_STEP) * _WIDTH_STEP
    places = np.full((len(cells), width), len(grid.rows) - 1)
    places[np.arange(width) < total[:, None]] = np.arange(total.sum()) + np.repeat(
        starts - before, lengths
    )
    return places


def _sq_distances_between(
    queries: NDArray[np.float32], candidates: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return squared distances from ``(C, Q, 3)`` to ``(C, 3, W)``, shape ``(C, Q, W)``."""
    lengths = (candidates * candidates).sum(axis=1, keepdims=True)
    product = torch.baddbmm(
        torch.from_numpy(lengths), torch.from_numpy(queries), torch.from_numpy(candidates), alpha=-2
    )
    result: NDArray[np.float32] = product.numpy()
    result += (queries * queries).sum(axis=2)[:, :, None]
    return result


def _select_smallest(
    sq_distances: NDArray[np.float32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return where the smallest values of each row are, and what the others are not below.

    The last bits of a value give way to its position: one sort does for both.
    """
    keys = sq_distances.view(np.int32)
    keys &= ~_POSITION
    keys |= np.arange(keys.shape[1], dtype=np.int32)
    keys.sort(axis=1)
    bound = (keys[:, count] & ~_POSITION).view(np.float32)
    return (keys[:, :count] & _POSITION).astype(np.int64), bound.astype(np.float64)


def _sort_by_distance(
    distances: NDArray[np.float64], rows: NDArray[np.int32], k: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the k nearest by (distance, row)."""
    num_rows, count = distances.shape
    position = np.int64(2 ** (count - 1).bit_length() - 1)
    keys = distances.view(np.int64) & ~position
    keys |= np.arange(count)
    keys.sort(axis=1)
    order = keys & position
    order += (np.arange(num_rows) * count)[:, None]
    distances, rows = _take(distances.reshape(-1), order), _take(rows.reshape(-1), order)
    keys &= ~position
    sort_ties(distances, rows, keys[:, 1:] == keys[:, :-1])
    return distances[:, :k], rows[:, :k]


def sort_ties(
    distances: NDArray[np.float64], rows: NDArray[np.integer], is_tie: NDArray[np.bool_]
) -> None:
    """Sort lists ``(n, k)`` that have a tie ``(n, k - 1)`` by (distance, row), in place."""
    if is_tie.any():
        tied = np.flatnonzero(is_tie.any(axis=1))
        by_both = np.lexsort((rows[tied], distances[tied]))
        distances[tied] = np.take_along_axis(distances[tied], by_both, axis=1)
        rows[tied] = np.take_along_axis(rows[tied], by_both, axis=1)


def _take(values: NDArray[Scalar], places: NDArray[np.integer]) -> NDArray[Scalar]:
    """Return ``values[places]``, rows of ``values`` at places of any shape.

    NumPy's indexing and ``take`` hold the interpreter's lock, and keep other threads waiting.
    """
    rows = torch.from_numpy(values).index_select(0, torch.from_numpy(places.reshape(-1)))
    return rows.numpy().reshape(places.shape + values.shape[1:])


def search_grid(
    points: NDArray[np.float64],
    rows: NDArray[np.int64],
    reach: NDArray[np.float64],
    found: NDArray[np.int32],
    order: NDArray[np.int64] | None = None,
    first_row: int = 0,
) -> NDArray[np.int64]:
    """Do as :func:`search_cells` by kernels.

    Args:
        points: Distinct points.
        rows: Those that are asked for, ascending.
        reach: Distances of the k-th neighbour of a sample of the points.
        found: Where the neighbours of each point go, ``(N, k)``, sorted by distance, then by row.
        order: Row of ``found`` for each point, and its number there. Default: its own.
        first_row: What is added to each number.

    Returns:
        The rows that are left, ascending. What is in ``found`` for them means nothing.
    """
    low, high = bounding_box(points)
    extent = high - low
    places = torch.from_numpy(np.ascontiguousarray(points))
    into, by_row = torch.from_numpy(found), None if order is None else torch.from_numpy(order)
    certain = torch.zeros(len(points), dtype=torch.bool, device="cpu")
    asked = torch.zeros_like(certain)
    for size in cell_sizes(reach):
        if len(rows) < MIN_FOR_CELLS:
            break
        counts = extent / size + 4
        if counts.prod() > max(_CELLS_A_POINT * len(points), 2**20):
            continue
        _, width, height = (int(count) for count in counts)
        starts = torch.empty(int(counts[0]) * width * height + 1, dtype=torch.int32, device="cpu")
        shape = width, height, *low.tolist(), size
        of_place, _, sorted_places = kernels.call("fill_cells", places, starts, *shape)
        asked.zero_()[torch.from_numpy(rows)] = True
        # Tasks of about so many points each.
        ends = np.arange(ROWS_IN_CACHE, len(points), ROWS_IN_CACHE)
        bounds = [1, *np.searchsorted(starts.numpy(), ends, side="right").tolist(), len(starts) - 1]

        def work(
            cells: tuple[int, int],
            shape: tuple[float, ...] = shape,
            grid: tuple[torch.Tensor, ...] = (sorted_places, of_place, starts),
        ) -> None:
            numbers = *cells, *shape[:2], first_row, *shape[2:]
            kernels.call("search_cells", *grid, asked, by_row, into, certain, *numbers)

        map_tasks(work, list(itertools.pairwise(bounds)), torch.device("cpu"))
        rows = rows[~certain.numpy()[rows]]
    return rows
