"""Which planes of a cloud lie next to each other."""

import torch
from torch import Tensor

from torchrg.report.grid import CloudGrid
from torchrg.report.morton import shift_codes

_MOST_IN_A_CUBE = 8  # planes of a cube that are paired with each other


def touching_planes(grid: CloudGrid, labels: Tensor, *, max_cells: int) -> Tensor:
    """Return the pairs of planes with points in the same or in neighbouring cubes.

    Args:
        grid: The cloud.
        labels: Of all its points, shape ``(N,)``, int64: 0 to M-1, negative for none.
        max_cells: The cubes are the smallest of which no more are occupied.

    Returns:
        Pairs of labels, the smaller first, ascending, shape ``(E, 2)``. In a cube of very many
        planes not all of them are paired.

    Example:
        >>> from torchrg.report.grid import build_grid
        >>> line = torch.cartesian_prod(torch.arange(64.0), torch.zeros(1), torch.zeros(1))
        >>> touching_planes(build_grid(line), torch.arange(64) // 16, max_cells=8).tolist()
        [[0, 1], [1, 2], [2, 3]]
    """
    own_label = labels[grid.rows]
    labeled = own_label >= 0
    if not bool(labeled.any()):
        return labels.new_zeros((0, 2))
    cell_of, level = grid.cell_of, grid.levels[0]
    for coarser in grid.levels[1:]:
        if len(level.codes) <= max_cells:
            break
        cell_of, level = level.parents[cell_of], coarser
    count = int(own_label.amax()) + 1
    own = torch.unique(cell_of[labeled] * count + own_label[labeled])
    codes, planes = level.codes[own // count], (own % count).repeat(4)
    codes = torch.cat([codes, *(shift_codes(codes, axis) for axis in range(3))])
    both = torch.unique(torch.unique(codes, return_inverse=True)[1] * count + planes)
    cubes, planes = both // count, both % count
    found = []
    for lag in range(1, _MOST_IN_A_CUBE):
        same = cubes[lag:] == cubes[:-lag]
        found.append(planes[:-lag][same] * count + planes[lag:][same])
    pairs = torch.unique(torch.cat(found))
    return torch.stack([pairs // count, pairs % count], dim=-1)
