"""Shared nearest neighbours: whether two points have enough of them in common, counted exactly."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import chunks_of, map_tasks
from torchrg.structures import Neighbors

_BITS_IN_LINE = 512
"""Bits of a cache line: bit sets are as wide as one or a few of them."""

_BLOCK_SIZE = 128
"""Points of a block: smaller ones repeat the lists around them more often, larger ones have wider
bit sets."""

_PATCH_SIZE = 1024
"""Points worked on together, several blocks: each step is long enough for threads to go on side by
side."""

_MOST_IN_KERNEL = kernels.MOST_NEIGHBORS // 8
"""Neighbours up to which the kernel is the faster one: the points that occur in the lists of one of
its blocks are at most eight times as many."""


def min_shared_neighbors(connectivity: float, k: int) -> int:
    """Return the least number of common neighbours of connected points, eq. (10).

    ``ceil(connectivity * k)`` of the decimal fraction that was written: 0.07 * 100 is 7, not the
    7.000000000000001 of binary arithmetic.
    """
    return math.ceil(round(connectivity * k, 9))


class SharedNeighbors:
    """Tells which points of a cloud are connected: share at least so many of their neighbours.

    The lists of a block of points are held as bit sets over the points that occur in them, so that
    an edge costs a few AND and popcount instructions; lists of points outside the block lose only
    members that no list of the block has, so the counts are exact. Points should be in canonical
    order: then a block is a patch of surface and its dictionary is small. Each is among its own
    neighbours.

    Example:
        >>> lists = torch.tensor([[0, 1, 2], [1, 0, 2], [2, 1, 3], [3, 2, 1]])
        >>> shared = SharedNeighbors(Neighbors(lists), 3)
        >>> shared.connected(slice(0, 1), torch.ones(1, 3, dtype=torch.bool))
        tensor([[ True,  True, False]])
    """

    def __init__(self, neighbors: Neighbors, min_shared: int) -> None:
        self._neighbors = neighbors
        self._indices = neighbors.indices.cpu().numpy()
        self._counted = None if neighbors.valid is None else neighbors.valid.cpu().numpy()
        self._min_shared = min_shared
        self._free_numbers: list[NDArray[np.intp]] = []
        self._buffers: list[Tensor] = []

    def connected(self, rows: slice, asked: Tensor) -> Tensor:
        """Tell which of a block's edges join connected points, eq. (10).

        ``asked`` says which of the edges from the points ``rows`` to test, shape ``(n, K)``, bool;
        the others are False.
        """
        if self._min_shared <= 0:
            return asked.clone()
        k = asked.shape[1]
        if k <= _MOST_IN_KERNEL and kernels.serve(*self._neighbors, asked, k=k):
            try:
                numbers = self._buffers.pop()
            except IndexError:
                numbers = torch.empty(len(self._indices), dtype=torch.int32, device="cpu")
            edges = *self._neighbors, asked, numbers, rows.start, self._min_shared
            (joined,) = kernels.call("connected", *edges)
            self._buffers.append(numbers)
            return joined
        result = asked.cpu().numpy().copy()

        def test(block: slice) -> None:
            if result[block].any():
                first = rows.start + block.start
                counts = self._count(first, first + len(result[block]))
                result[block] &= counts >= self._min_shared

        map_tasks(test, chunks_of(len(result), _PATCH_SIZE), torch.device("cpu"))
        return torch.from_numpy(result).to(asked.device)

    def _count(self, start: int, stop: int) -> NDArray[np.unsignedinteger]:
        """Return the number of common neighbours along all edges of a patch, shape ``(n, K)``."""
        own, lists, of_members = self._local_lists(start, stop)
        # Every block has a column for each member of the patch, and one for what is none.
        stride = len(of_members) + 1
        first = np.arange(len(lists)) // _BLOCK_SIZE * stride
        others = (lists + first[:, None]).ravel()
        occurs = np.zeros((first[-1] // stride + 1, stride), dtype=bool)
        occurs.ravel()[others] = True
        occurs[:, -1] = False
        rows, sets = _bit_sets(of_members, occurs)
        # Entries that are no neighbours have place -1 and count nonsense; nobody asks for them.
        common = sets.take(rows.take(others), axis=0)
        common &= np.repeat(sets.take(rows.take(own + first), axis=0), lists.shape[1], axis=0)
        return _sum_of_bits(common, at_most=lists.shape[1]).reshape(lists.shape)

    def _local_lists(
        self, start: int, stop: int
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Number the points that occur in the lists of a patch, its members, -1 for the others.

        Returns the numbers of the points of the patch ``(n,)``, and by these numbers their lists
        ``(n, K)`` and those of all members ``(M, K)``.
        """
        # Kept between patches, because filling it takes longer than a patch.
        numbers = (
            self._free_numbers.pop() if self._free_numbers else np.full(len(self._indices), -1)
        )
        rows = self._indices[start:stop].astype(np.intp)
        members = rows.ravel() if self._counted is None else rows[self._counted[start:stop]]
        places = np.arange(len(members))
        numbers[members] = places
        members = members[numbers.take(members) == places]
        numbers[members] = places[: len(members)]
        own, lists = numbers[start:stop].copy(), numbers.take(rows)
        of_members = numbers.take(self._indices.take(members, axis=0))
        if self._counted is not None:
            of_members[~self._counted[members]] = -1
        numbers[members] = -1
        self._free_numbers.append(numbers)
        return own, lists, of_members


def _bit_sets(
    lists: NDArray[np.intp], occurs: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.uint64]]:
    """Hold the lists of the members that occur in a block as bit sets over these, block by block.

    From the list of each member ``(M, K)``, -1 for what is none, and the members of each block
    ``(blocks, M + 1)``, none in the last column: the row of each member of each block among the
    sets, shape ``(blocks * (M + 1),)``, and the sets, shape ``(rows, words)``.
    """
    stride = occurs.shape[1]
    occurring = np.flatnonzero(occurs)
    sizes = np.count_nonzero(occurs, axis=1)
    rows = np.zeros(occurs.size, dtype=np.intp)
    rows[occurring] = np.arange(len(occurring))
    # What is not in the block falls into the first eight columns, which are cut off.
    columns = np.full(occurs.size, -8)
    columns[occurring] = np.arange(len(occurring)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    block, member = np.divmod(occurring, stride)
    of_occurring = lists.take(member, axis=0)
    of_occurring += (block * stride)[:, None]
    width = 8 + -(-int(sizes.max()) // _BITS_IN_LINE) * _BITS_IN_LINE
    bits = np.zeros(len(occurring) * width, dtype=bool)
    places = columns.take(of_occurring, mode="wrap")
    places += np.arange(8, len(bits), width)[:, None]
    bits[places.ravel()] = True
    return rows, np.packbits(bits.reshape(-1, width)[:, 8:], axis=1).view(np.uint64)


def _sum_of_bits(words: NDArray[np.uint64], at_most: int) -> NDArray[np.unsignedinteger]:
    """Return the number of bits in each row of words ``(E, 8 n)``, known to be at most so many."""
    counts = np.bitwise_count(words)
    if at_most >= 2**8:
        total: NDArray[np.unsignedinteger] = counts.sum(axis=1, dtype=np.uint64)
        return total
    sums = counts.view(np.uint64)
    total = sums[:, 0].copy()
    for column in range(1, sums.shape[1]):
        total += sums[:, column]
    # The product adds all eight bytes up in the highest one.
    total *= np.uint64(0x0101010101010101)
    total >>= np.uint64(56)
    return total
