"""Lists of accepted edges, packed block by block."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg._chunks import chunks_of, run_chunks

_BLOCKS_A_THREAD = 4
"""Blocks found before any is stored: threads wait for each other only so often."""


class EdgeLists(NamedTuple):
    """Edges of a directed graph in compressed rows.

    Attributes:
        starts: The edges of point i are ``starts[i]`` to ``starts[i + 1]``, shape ``(N + 1,)``.
        targets: Targets (or codes of targets), shape ``(capacity,)``, of which ``starts[N]`` are
            used: what is behind them is room for more.
    """

    starts: NDArray[np.signedinteger]
    targets: NDArray[np.int32]


class EdgeBlock(NamedTuple):
    """The edges of a block of points.

    Attributes:
        targets: Targets (or codes) of accepted edges, in the order of points and columns, ``(E,)``.
        counts: Number of edges of each point, shape ``(n,)``.
    """

    targets: NDArray[np.int32]
    counts: NDArray[np.signedinteger]


def pack_edges(
    edges_of: Callable[[slice], EdgeBlock],
    num_points: int,
    *,
    capacity: int,
    chunk_size: int,
    device: torch.device,
) -> EdgeLists:
    """Collect the edges of successive blocks of points, several blocks at a time.

    Args:
        edges_of: Gives the edges of a block; called from as many threads as torch uses.
        num_points: Number of points.
        capacity: Length of the array of targets, at least the number of edges. Memory that is not
            used is not touched.
        chunk_size: Points of a block.
        device: Where the edges are found; blocks run side by side only on a CPU.

    Returns:
        The lists, the same for every chunk size.

    Example:
        >>> def to_next(rows):
        ...     targets = np.arange(rows.start, rows.stop, dtype=np.int32) + 1
        ...     return EdgeBlock(targets, np.ones(len(targets), dtype=np.int64))
        >>> lists = pack_edges(
        ...     to_next, 3, capacity=5, chunk_size=2, device=torch.device("cpu")
        ... )
        >>> lists.starts.tolist(), lists.targets[:3].tolist()
        ([0, 1, 2, 3], [1, 2, 3])
    """
    starts: NDArray[np.signedinteger]
    starts = np.zeros(num_points + 1, dtype=np.int32 if capacity < 2**31 else np.int64)
    targets = np.empty(capacity, dtype=np.int32)
    chunks = chunks_of(num_points, chunk_size)
    at_once = _BLOCKS_A_THREAD * max(torch.get_num_threads(), 1)
    used = 0
    found: dict[int, EdgeBlock] = {}

    def find(rows: slice) -> None:
        found[rows.start] = edges_of(rows)

    for first in range(0, len(chunks), at_once):
        group = chunks[first : first + at_once]
        run_chunks(find, group, device)
        for rows in group:
            block = found.pop(rows.start)
            targets[used : used + len(block.targets)] = block.targets
            starts[rows.start + 1 : rows.stop + 1] = used + np.cumsum(block.counts)
            used += len(block.targets)
    return EdgeLists(starts, targets)
