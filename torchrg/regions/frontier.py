"""Growth in the order of a queue, for rules where the edge that claims a point matters."""

from array import array

import numpy as np
from numpy.typing import NDArray

from torchrg.regions.graph import EdgeLists

_LONG_QUEUE = 32
"""From this many waiting seeds on, whole levels go through NumPy; below, one seed at a time."""


def grow_in_turn(
    edges: EdgeLists, order: NDArray[np.int32], valid: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """Grow one region after the other, each from a first-in first-out queue of seeds (Algorithm 2).

    A point belongs to the first seed in the queue that has an edge to it, and whether it becomes a
    seed itself is a property of that edge. Long queues are taken a level at a time: all edges of
    the waiting seeds in their order, of which the first to a point claims it. This is the order of
    the queue, exactly.

    Args:
        edges: Targets as ``2 * row + spreads``: whether the target, claimed by this edge, becomes
            a seed.
        order: All points that may start a region, in the order in which they do.
        valid: Points that may belong to a region, shape ``(N,)``.

    Returns:
        Head of each point's region, shape ``(N,)``; -1 where not valid.

    Example:
        >>> edges = EdgeLists(np.array([0, 1, 2, 2]), np.array([2, 5], dtype=np.int32))
        >>> grow_in_turn(edges, np.arange(3, dtype=np.int32), np.ones(3, dtype=bool)).tolist()
        [0, 0, 2]
    """
    codes = edges.targets
    starts = memoryview(edges.starts.data)
    free = bytearray(valid.tobytes())
    heads = array("i", bytes(4 * len(valid)))
    open_points = np.frombuffer(free, dtype=np.bool_)
    heads_view = np.frombuffer(heads, dtype=np.int32)
    heads_view[:] = -1
    slots = np.empty(len(valid), dtype=np.int32)
    for head in order.tolist():
        if not free[head]:
            continue
        free[head] = 0
        heads[head] = head
        queue = [head]
        done = 0
        while done < len(queue):
            if len(queue) - done >= _LONG_QUEUE:
                level = np.array(queue[done:], dtype=np.int32)
                while len(level) >= _LONG_QUEUE:
                    level = _claim_level(edges, level, head, open_points, heads_view, slots)
                queue, done = level.tolist(), 0
                continue
            seed = queue[done]
            done += 1
            for code in codes[starts[seed] : starts[seed + 1]].tolist():
                target = code >> 1
                if free[target]:
                    free[target] = 0
                    heads[target] = head
                    if code & 1:
                        queue.append(target)
    return heads_view


def _claim_level(
    edges: EdgeLists,
    level: NDArray[np.int32],
    head: int,
    open_points: NDArray[np.bool_],
    heads: NDArray[np.int32],
    slots: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Let a level of seeds claim points, and return the seeds among them in queue order."""
    starts = edges.starts[level]
    counts = edges.starts[level + 1] - starts
    ends = np.cumsum(counts)
    places = np.repeat(starts - ends + counts, counts)
    places += np.arange(len(places), dtype=places.dtype)
    codes = edges.targets[places]
    codes = codes[open_points[codes >> 1]]
    targets = codes >> 1
    turn = np.arange(len(targets), dtype=np.int32)
    # Of several writes to one place the last one stays: in reverse, the first edge to a point.
    slots[targets[::-1]] = turn[::-1]
    first = slots[targets] == turn
    codes, targets = codes[first], targets[first]
    open_points[targets] = False
    heads[targets] = head
    seeds: NDArray[np.int32] = targets[(codes & 1).astype(bool)]
    return seeds
