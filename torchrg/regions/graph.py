"""Lists of accepted edges, packed block by block."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class EdgeLists(NamedTuple):
    """Edges of a directed graph in compressed rows.

    Attributes:
        starts: The edges of point i are ``starts[i]`` to ``starts[i + 1]``, shape ``(N + 1,)``.
        targets: Targets (or codes of targets), shape ``(capacity,)``, of which ``starts[N]`` are
            used: what is behind them is room for more.
    """

    starts: NDArray[np.signedinteger]
    targets: NDArray[np.int32]


def pack_edges(
    blocks: Iterable[tuple[NDArray[np.int32], NDArray[np.bool_]]], num_points: int, capacity: int
) -> EdgeLists:
    """Collect the accepted edges of successive blocks of points.

    Args:
        blocks: For each block, in the order of the points: targets and which of them are accepted,
            both of shape ``(n, K)``.
        num_points: Number of points of all blocks together.
        capacity: Length of the array of targets, at least the number of accepted edges. Memory
            that is not used is not touched.

    Returns:
        The lists, in the order of the columns.

    Example:
        >>> targets = np.array([[0, 1], [1, 0]], dtype=np.int32)
        >>> lists = pack_edges([(targets, np.array([[False, True], [True, True]]))], 2, 4)
        >>> lists.starts.tolist(), lists.targets[:3].tolist()
        ([0, 1, 3], [1, 1, 0])
    """
    width = np.int32 if capacity < 2**31 else np.int64
    starts: NDArray[np.signedinteger] = np.zeros(num_points + 1, dtype=width)
    targets = np.empty(capacity, dtype=np.int32)
    row = used = 0
    for block, accepted in blocks:
        chosen = block[accepted]
        targets[used : used + len(chosen)] = chosen
        counts = np.count_nonzero(accepted, axis=1)
        starts[row + 1 : row + 1 + len(block)] = used + np.cumsum(counts)
        used += len(chosen)
        row += len(block)
    return EdgeLists(starts, targets)
