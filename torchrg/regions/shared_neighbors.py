"""Exact shared-nearest-neighbor connectivity."""

import math

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import map_tasks, split_rows
from torchrg.structures import Neighbors

_BLOCK_SIZE = 64
"""Points per block: smaller blocks repeat more of the surrounding lists, larger ones have larger
matrix products."""
_DEVICE_BLOCK_SIZE = 2048
"""The same on other devices, which wait for each block; matrices of some 3,000 members, 40 MB."""


def min_shared_neighbors(connectivity: float, k: int) -> int:
    """Return the minimum number of common neighbors of connected points, eq. (10).

    ``ceil(connectivity * k)`` in decimal arithmetic: 0.07 * 100 is 7, not the binary
    7.000000000000001.
    """
    return math.ceil(round(connectivity * k, 9))


def connected_neighbors(
    neighbors: Neighbors, min_shared: int, spare: list[Tensor], rows: slice, candidates: Tensor
) -> Tensor:
    """Return a mask of the edges between points that share ``min_shared`` neighbors, eq. (10).

    Only edges in the mask ``candidates`` from the points ``rows`` are tested, shape ``(n, K)``,
    bool; all other edges are False. Each point is in its own list. ``spare`` keeps working memory
    for the next call, initially empty; concurrent calls take different parts.

    The lists of a block of points are rows of a matrix with one column per member, i.e. per point
    in any list. The product of two rows counts their common neighbors. Lists of points outside the
    block lose only members that are in no list of the block, so the counts are exact. Points should
    be in canonical order: a block is then a surface patch with few members.
    """
    if min_shared <= 0:
        return candidates.clone()
    if kernels.serve(*neighbors, candidates, k=candidates.shape[1]):
        try:
            numbers = spare.pop()
        except IndexError:
            numbers = torch.empty_like(neighbors.indices[:, 0])
        edges = *neighbors, candidates, numbers, rows.start, min_shared
        (connected,) = kernels.call("connected", *edges)
        spare.append(numbers)
        return connected
    size = _BLOCK_SIZE if candidates.device.type == "cpu" else _DEVICE_BLOCK_SIZE

    def count(block: slice) -> Tensor:
        """Return the number of common neighbors along all edges of a block, shape ``(n, K)``."""
        lists = neighbors.indices[rows.start + block.start : rows.start + block.stop]
        members, lists = torch.unique(lists, return_inverse=True)
        near = neighbors.select(members)
        columns = torch.searchsorted(members, near.indices).clamp(max=len(members) - 1)
        counted = (members[columns] == near.indices) & near.mask()
        occurs = torch.zeros(len(members), len(members) + 1, device=members.device)
        # Non-members are scattered into an extra last column.
        occurs.scatter_(1, torch.where(counted, columns, len(members)), 1.0)
        occurs = occurs[:, :-1]
        # Each point is the first in its list.
        return (occurs[lists[:, 0]] @ occurs.T).gather(1, lists)

    shared = map_tasks(count, split_rows(len(candidates), size), candidates.device)
    return candidates & (torch.cat(shared) >= min_shared)
