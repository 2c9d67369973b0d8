"""How many neighbours two points have in common, counted exactly."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._chunks import chunks_of, run_chunks
from torchrg.structures import Neighbors

_BLOCK_SIZE = 256
"""Points of a block: smaller ones repeat the lists around them more often, larger ones have wider
bit sets."""


class SharedNeighbors:
    """Neighbour lists of a cloud, prepared for counting what two of them have in common.

    The lists of a block of points are held as bit sets over the points that occur in them, so that
    an edge costs a few AND and popcount instructions; lists of points outside the block lose only
    members that no list of the block has, so the counts are exact. Points should be in canonical
    order: then a block is a patch of surface and its dictionary is small.

    Args:
        neighbors: Neighbours of all points, each with itself among them.

    Example:
        >>> lists = torch.tensor([[0, 1, 2], [1, 0, 2], [2, 1, 3], [3, 2, 1]])
        >>> SharedNeighbors(Neighbors(lists)).at_least(3, slice(0, 1), torch.ones(1, 3).bool())
        tensor([[ True,  True, False]])
    """

    def __init__(self, neighbors: Neighbors) -> None:
        self._indices = neighbors.indices.cpu().numpy()
        self._counted = None if neighbors.valid is None else neighbors.valid.cpu().numpy()
        self._free_slots: list[NDArray[np.intp]] = []

    def at_least(self, min_shared: int, rows: slice, asked: Tensor) -> Tensor:
        """Tell which edges join points that share enough neighbours, eq. (10).

        Args:
            min_shared: Least number of common neighbours.
            rows: The points that the edges lead from.
            asked: Which of the edges to their neighbours to test, shape ``(n, K)``, bool.

        Returns:
            Shape ``(n, K)``, bool; False where not asked.
        """
        if min_shared <= 0:
            return asked.clone()
        result = asked.cpu().numpy().copy()

        def test(block: slice) -> None:
            if result[block].any():
                first = rows.start + block.start
                counts = self._count(first, first + len(result[block]))
                result[block] &= counts >= min_shared

        run_chunks(test, chunks_of(len(result), _BLOCK_SIZE), torch.device("cpu"))
        return torch.from_numpy(result).to(asked.device)

    def _count(self, start: int, stop: int) -> NDArray[np.unsignedinteger]:
        """Return the number of common neighbours along all edges of a block, shape ``(n, K)``."""
        # Place of each point in the dictionary of the block, -1 for the others; kept between
        # blocks, because filling it takes longer than a block.
        slots = self._free_slots.pop() if self._free_slots else np.full(len(self._indices), -1)
        lists = self._indices[start:stop].astype(np.intp)
        members = lists.ravel() if self._counted is None else lists[self._counted[start:stop]]
        places = np.arange(len(members))
        slots[members] = places
        members = members[slots[members] == places]
        slots[members] = places[: len(members)]
        words = self._bit_sets(members, slots)
        own, others = slots[start:stop], slots[lists.ravel()]
        counts = np.zeros(lists.shape, np.uint8 if lists.shape[1] < 256 else np.uint16)
        for word in words:
            # Entries that are no neighbours have place -1 and count nonsense; nobody asks for them.
            common = word.take(others, mode="clip").reshape(lists.shape)
            common &= word.take(own)[:, None]
            counts += np.bitwise_count(common)
        slots[members] = -1
        self._free_slots.append(slots)
        return counts

    def _bit_sets(self, members: NDArray[np.intp], slots: NDArray[np.intp]) -> NDArray[np.uint64]:
        """Return the lists of ``members`` as bit sets over them, shape ``(words, members)``."""
        size = len(members)
        width = -(-size // 64) * 64
        columns = slots[self._indices[members]]
        if self._counted is not None:
            columns[~self._counted[members]] = -1
        # Place -1 falls into the last column of the row before, which is cut off.
        columns += np.arange(0, size * (width + 1), width + 1)[:, None]
        bits = np.zeros(size * (width + 1), dtype=bool)
        bits[columns.ravel()] = True
        packed = np.packbits(bits.reshape(size, width + 1)[:, :width], axis=1)
        return np.ascontiguousarray(packed.view(np.uint64).T)
