"""Shared nearest neighbours: whether two points have enough of them in common, counted exactly."""

import math

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import chunks_of, map_tasks
from torchrg.structures import Neighbors

_BLOCK_SIZE = 64
"""Points of a block: smaller ones repeat the lists around them more often, larger ones have larger
products of matrices."""

_MAX_IN_KERNEL = kernels.MAX_NEIGHBORS // 8
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

    Lists of a block of points are rows of a matrix with a column for each of its members, the
    points that occur in them; the product of two rows counts what they share. Lists of points
    outside of the block lose only members that no list of the block has, so the counts are exact.
    Points should be in canonical order: then a block is a patch of surface and has few members.
    Each is among its own neighbours.

    Example:
        >>> lists = torch.tensor([[0, 1, 2], [1, 0, 2], [2, 1, 3], [3, 2, 1]])
        >>> shared = SharedNeighbors(Neighbors(lists), 3)
        >>> shared.connected(slice(0, 1), torch.ones(1, 3, dtype=torch.bool))
        tensor([[ True,  True, False]])
    """

    def __init__(self, neighbors: Neighbors, min_shared: int) -> None:
        self._neighbors = neighbors
        self._min_shared = min_shared
        self._buffers: list[Tensor] = []

    def connected(self, rows: slice, asked: Tensor) -> Tensor:
        """Tell which of a block's edges join connected points, eq. (10).

        ``asked`` says which of the edges from the points ``rows`` to test, shape ``(n, K)``, bool;
        the others are False.
        """
        if self._min_shared <= 0:
            return asked.clone()
        k = asked.shape[1]
        if k <= _MAX_IN_KERNEL and kernels.serve(*self._neighbors, asked, k=k):
            numbers = self._buffer()
            edges = *self._neighbors, asked, numbers, rows.start, self._min_shared
            (joined,) = kernels.call("connected", *edges)
            self._buffers.append(numbers)
            return joined
        result = asked.clone()

        def test(block: slice) -> None:
            if bool(result[block].any()):
                first = rows.start + block.start
                shared = self._count(first, first + len(result[block]))
                result[block] &= shared >= self._min_shared

        map_tasks(test, chunks_of(len(result), _BLOCK_SIZE), asked.device)
        return result

    def _count(self, start: int, stop: int) -> Tensor:
        """Return the number of common neighbours along all edges of a block, shape ``(n, K)``."""
        lists, numbers = self._neighbors.indices[start:stop].long(), self._buffer()
        members = lists.flatten()
        places = torch.arange(len(members), dtype=numbers.dtype, device=numbers.device)
        numbers[members] = places
        members = members[numbers[members] == places]
        numbers[members] = places[: len(members)]
        theirs = self._neighbors.at(members)
        columns = numbers[theirs.indices.long()].long().clamp(max=len(members) - 1)
        counted = (members[columns] == theirs.indices) & theirs.counted()
        occurs = torch.zeros(len(members), len(members) + 1, device=members.device)
        # What is no member falls into the last column.
        occurs.scatter_(1, torch.where(counted, columns, len(members)), 1.0)
        occurs = occurs[:, :-1]
        shared = (occurs[numbers[start:stop]] @ occurs.T).gather(1, numbers[lists].long())
        self._buffers.append(numbers)
        return shared

    def _buffer(self) -> Tensor:
        """Return room for a number of each point, of a block before if there is one."""
        try:
            return self._buffers.pop()
        except IndexError:
            indices = self._neighbors.indices
            return torch.zeros(len(indices), dtype=torch.int32, device=indices.device)
