"""A tile with the points around it that a stage looks at, as a small cloud of its own."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
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
    rows = new = np.arange(tile.start, tile.stop)
    for _ in range(steps):
        new = _not_among(rows, lists[new].ravel())
        rows = np.sort(np.concatenate([rows, new]))
    first = int(np.searchsorted(rows, tile.start))
    own = slice(first, first + tile.stop - tile.start)
    # Neighbours before and behind all rows of the part are at the ends, which have no number.
    low, high = (int(end) for end in (rows[0] - 1, rows[-1] + 1))
    numbers = torch.full((high - low + 1,), -1, dtype=torch.int32)
    itself = torch.arange(len(rows), dtype=torch.int32)
    numbers[torch.from_numpy(rows - low)] = itself
    near = torch.from_numpy(lists[rows]).clamp_(low, high).sub_(low)
    near = numbers.index_select(0, near.view(-1)).view(near.shape)
    near = torch.where(near < 0, itself[:, None], near)
    return Part(torch.from_numpy(rows), own, Neighbors(near))


def _not_among(rows: NDArray[np.int64], near: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return those near that are not among ascending rows, ascending, each once.

    A mask over their range takes a tenth of the time of sorting.
    """
    low, high = (int(end) for end in (near.min(initial=rows[0]), near.max(initial=rows[-1])))
    reached = np.zeros(high - low + 1, dtype=bool)
    reached[near - np.int32(low)] = True
    reached[rows - low] = False
    return np.flatnonzero(reached) + low
