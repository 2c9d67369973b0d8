"""Nearest neighbours by a grid of cells: most points of a cloud at a fraction of a tree's time.

A cell and the 26 around it hold a few hundred points, whose distances a kernel takes. A result
counts only if no point outside the cells can be nearer; the tree answers for the others. The grid
is that of the box about the cloud, empty cells too.
"""

import itertools

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg import kernels
from torchrg._parallel import ROWS_IN_CACHE, map_tasks
from torchrg.structures import bounding_box

MIN_FOR_CELLS = 2000
"""Points below which a tree is as fast as cells."""

_SIZE_STEP = 1.5
"""Cells of one size answer for points whose k-th neighbour is from 1 / 1.75 to 1 size away."""

_MIN_SHARE = 0.03
"""Share of the points for which another size of cells is worth its sort."""

_CELLS_A_POINT = 8
"""Cells of the box about a cloud, empty ones too, that are worth their memory, 4 bytes each."""


def search_cells(
    points: NDArray[np.float64],
    rows: NDArray[np.int64],
    reach: NDArray[np.float64],
    found: NDArray[np.int32],
    order: NDArray[np.int64] | None = None,
    first_row: int = 0,
) -> NDArray[np.int64]:
    """Find the k nearest of distinct points ``(N, 3)`` for rows that cells of some size answer for.

    The point itself counts. This is for where kernels serve.

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


def cell_sizes(reach: NDArray[np.float64]) -> list[float]:
    """Return ascending sizes of cells that together answer for nearly all of a sample."""
    sizes: list[float] = []
    reach = np.sort(reach[reach > 0])
    few = int(_MIN_SHARE * len(reach))
    while len(reach) > few:
        sizes.append(_SIZE_STEP * float(reach[few]))
        reach = reach[reach > sizes[-1]]
    return sizes
