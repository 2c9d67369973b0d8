"""A tile with the points around it that a stage looks at, as a small cloud of its own."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg.structures import Neighbors


class Part(NamedTuple):
    """Some points of a cloud, in its order.

    Attributes:
        rows: Their rows in the cloud, ascending, shape ``(n,)``, int64.
        own: Which of them are the tile; the others are around it.
        neighbors: Their neighbours among them. Where one is missing, which is at the rim alone, the
            point itself stands in its place.
    """

    rows: Tensor
    own: slice
    neighbors: Neighbors


def cut_part(indices: Tensor, tile: slice, steps: int) -> Part:
    """Return a tile with all points that so many steps from neighbour to neighbour lead to.

    ``indices`` are those of the neighbours of the whole cloud, shape ``(N, K)``; only the rows of
    the part are read. What a function finds at points whose steps end within the part is what it
    finds in the whole cloud.

    Example:
        >>> chain = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4], [4, 3]])
        >>> part = cut_part(chain, slice(0, 2), 1)
        >>> part.rows.tolist()
        [0, 1, 2]
        >>> part.neighbors.indices.tolist()
        [[0, 1], [1, 2], [2, 2]]
    """
    lists = indices.numpy()
    inside = np.zeros(len(lists), dtype=bool)
    inside[tile] = True
    new = np.arange(tile.start, tile.stop)
    for _ in range(steps):
        reached = np.zeros_like(inside)
        reached[lists[new].ravel()] = True
        new = np.flatnonzero(reached & ~inside)
        inside[new] = True
    rows = np.flatnonzero(inside)
    numbers = torch.full((len(lists),), -1, dtype=torch.int32)
    numbers[torch.from_numpy(rows)] = torch.arange(len(rows), dtype=torch.int32)
    near = torch.from_numpy(lists[rows])
    near = numbers.index_select(0, near.reshape(-1)).view(near.shape)
    itself = torch.arange(len(rows), dtype=torch.int32)[:, None]
    near = torch.where(near < 0, itself, near)
    first = int(np.searchsorted(rows, tile.start))
    own = slice(first, first + tile.stop - tile.start)
    return Part(torch.from_numpy(rows), own, Neighbors(near))
