"""Nearest neighbours by a grid of cells: most points of a cloud at a third of a tree's time.

A cell and the 26 around it hold a few hundred points: all distances from the points of the cell to
these are one small matrix product, of which a sorting network takes the smallest. A result counts
only if no point outside the cells can be nearer; the tree answers for the others.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg._chunks import run_chunks
from torchrg._take import take
from torchrg.neighbors.cell_grid import (
    WIDTH_STEP,
    CellGrid,
    list_candidates,
    make_grid,
    run_starts,
)
from torchrg.neighbors.selection import (
    MAX_CANDIDATES,
    select_smallest,
    sort_by_distance,
    sq_distances_between,
)

Store = Callable[[NDArray[np.integer], NDArray[np.float64], NDArray[np.integer]], None]
"""Takes rows ``(n,)``, distances ``(n, k)`` and neighbours ``(n, k)``."""

MIN_FOR_CELLS = 2000
"""Points below which a tree is as fast as cells."""

_MIN_CANDIDATES = 2.4
"""Candidates for a neighbour wanted; with fewer, most results would not count."""

_SPARE = 6
"""Neighbours selected beyond k, for the bits that the selection does not see."""

_SIZE_STEP = 1.5
"""Cells of one size answer for points whose k-th neighbour is from 1 / 1.75 to 1 size away."""

_MIN_SHARE = 0.03
"""Share of the points for which another size of cells is worth its sort."""

_MAX_KEY = 2.0**62
_CHUNK_BYTES = 2**22


def search_cells(
    points: NDArray[np.float64], k: int, reach: NDArray[np.float64], store: Store
) -> NDArray[np.int64]:
    """Find the k nearest points of every point that cells of some size can answer for.

    Args:
        points: Distinct points, shape ``(N, 3)``.
        k: Number of neighbours, the point itself included.
        reach: Distances of the k-th neighbour of a sample of the points.
        store: Called with the results, sorted by distance, then by row; by several threads, each
            row once.

    Returns:
        Rows that are left, shape ``(m,)``, ascending.

    Example:
        >>> grid = np.argwhere(np.ones((50, 50, 1))) * 1.0
        >>> found = {}
        >>> def store(rows, distances, neighbors):
        ...     found.update(zip(rows.tolist(), distances[:, -1].tolist()))
        >>> left = search_cells(grid, 9, np.full(5, 1.5), store)
        >>> len(left) + len(found), found[1225]
        (2500, 1.4142135623730951)
    """
    left = np.arange(len(points))
    if _MIN_CANDIDATES * (k + _SPARE) <= MAX_CANDIDATES:
        for size in _cell_sizes(reach):
            if len(left) >= MIN_FOR_CELLS:
                left = _search_level(points, k, size, left, store)
    return left


def _cell_sizes(reach: NDArray[np.float64]) -> list[float]:
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
    if (np.ptp(points, axis=0) / size + 4).prod() > _MAX_KEY:
        return rows
    grid = make_grid(points, size, rows)
    tasks = _make_tasks(grid, k)
    settled = np.zeros(len(points), dtype=bool)

    def work(chunk: slice) -> None:
        for cells in tasks[chunk]:
            found = _search_task(grid, cells, k)
            settled[found[0]] = True
            store(*found)

    run_chunks(work, [slice(i, i + 1) for i in range(len(tasks))], torch.device("cpu"))
    return rows[~settled[rows]]


def _make_tasks(grid: CellGrid, k: int) -> list[NDArray[np.int64]]:
    """Group cells with enough candidates, and not too many, by the shape of their matrix."""
    total = grid.lengths.sum(axis=1)
    enough = (total <= MAX_CANDIDATES) & (total >= _MIN_CANDIDATES * (k + _SPARE))
    cells = np.flatnonzero(enough)
    width, height = -(-total[cells] // WIDTH_STEP) * WIDTH_STEP, -(-grid.num_asked[cells] // 8) * 8
    shape = width * (MAX_CANDIDATES + 1) + height
    by_shape = np.argsort(shape, kind="stable")
    tasks = []
    for same in np.split(by_shape, run_starts(shape[by_shape])[1:]):
        if len(same):
            step = max(1, _CHUNK_BYTES // int(width[same[0]] * height[same[0]] * 4))
            tasks += [cells[same[i : i + step]] for i in range(0, len(same), step)]
    return tasks


def _search_task(
    grid: CellGrid, cells: NDArray[np.int64], k: int
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """Return those rows of some cells whose neighbours are certain, distances and neighbours."""
    places = list_candidates(grid, cells)
    width = places.shape[1]
    candidates = [take(column, places) for column in grid.columns]
    counts = grid.num_asked[cells]
    lanes = np.repeat(np.arange(len(cells)), counts)
    slots = np.arange(len(lanes)) - np.repeat(np.cumsum(counts) - counts, counts)
    own = take(grid.asked, grid.first_asked[cells][lanes] + slots)
    points = [take(column, own) for column in grid.columns]

    centers = grid.centers[:, cells]
    about = np.stack([c - m[:, None] for c, m in zip(candidates, centers, strict=True)], axis=1)
    offsets = np.stack([p - m[lanes] for p, m in zip(points, centers, strict=True)], axis=1)
    queries = np.zeros((len(cells), int(counts.max()), 3), np.float32)
    queries[lanes, slots] = offsets
    sq_distances = sq_distances_between(queries, about.astype(np.float32)).reshape(-1, width)
    asked = lanes * queries.shape[1] + slots
    selected, sq_beyond = select_smallest(take(sq_distances, asked), k + _SPARE)

    selected += (lanes * width)[:, None]
    exact = np.zeros(selected.shape)
    for candidate, point in zip(candidates, points, strict=True):
        difference = take(candidate.reshape(-1), selected)
        difference -= point[:, None]
        exact += np.multiply(difference, difference, out=difference)
    rows = take(grid.rows, take(places.reshape(-1), selected))
    distances, rows = sort_by_distance(np.sqrt(exact, out=exact), rows, k)

    # Rounding of the matrix product, and of which cell a point on a border is in.
    sq_beyond -= 64 * np.finfo(np.float32).eps * grid.size**2
    border = (1.5 * grid.size - np.abs(offsets).max(axis=1)) * (1 - 1e-6)
    certain = (distances[:, -1] < border) & (distances[:, -1] ** 2 < sq_beyond)
    kept = np.flatnonzero(certain)
    return grid.rows[own[kept]], take(distances, kept), take(rows, kept)
