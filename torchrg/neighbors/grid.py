"""Nearest neighbours by a grid of cells, in kernels: what ``cells`` does in NumPy, in less time."""

import itertools

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg import kernels
from torchrg._parallel import ROWS_IN_CACHE, map_tasks
from torchrg.neighbors.cells import MIN_FOR_CELLS, cell_sizes

_CELLS_A_POINT = 8
"""Cells of the box about a cloud, empty ones too, that are worth their memory, 4 bytes each."""


def search_grid(
    points: NDArray[np.float64],
    rows: NDArray[np.int64],
    reach: NDArray[np.float64],
    found: NDArray[np.int32],
    order: NDArray[np.int64] | None = None,
    first_row: int = 0,
) -> NDArray[np.int64]:
    """Find the nearest of distinct points ``(N, 3)`` for rows that cells of some size answer for.

    Args:
        points: Distinct points.
        rows: Those that are asked for, ascending.
        reach: Distances of the k-th neighbour of a sample of the points.
        found: Where the neighbours of each point go, ``(N, k)``, sorted by distance, then by row.
        order: Row of ``found`` for each point, and its number there. Default: its own.
        first_row: What is added to each number.

    Returns:
        The rows that are left, ascending. What is in ``found`` for them means nothing.

    Example:
        >>> points, rows = np.random.default_rng(0).random((3000, 3)), np.arange(3000)
        >>> found = np.empty((3000, 2), np.int32)
        >>> left = search_grid(points, rows, np.full(9, 0.1), found)
        >>> len(left) < 300, bool((found[:, 0] == rows)[~np.isin(rows, left)].all())
        (True, True)
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
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
