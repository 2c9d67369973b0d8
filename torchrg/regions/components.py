"""Order-free growth: who reaches whom, without a queue."""

import numpy as np
from numpy.typing import NDArray

from torchrg.regions.graph import EdgeLists


def first_to_reach(
    edges: EdgeLists, seeds: NDArray[np.int32], num_points: int
) -> NDArray[np.int32]:
    """Return for each point the first of the seeds that reaches it along edges.

    This is what growing one region after the other, from each seed that is still free, comes to,
    if every point spreads alike whoever claimed it: the first seed that reaches a point finds all
    of its way free. One depth-first search does it, through a chain of extra nodes that each lead
    to one seed and then to the next node.

    Args:
        edges: Edges of points that spread; those that do not have none. Room for two more edges
            for each seed; it is written.
        seeds: Rows, in the order in which regions start.
        num_points: Number of points.

    Returns:
        The row of that seed, shape ``(N,)``; -1 where none does.

    Example:
        >>> starts, targets = np.array([0, 1, 1, 2]), np.array([1, 1] + [0] * 4)
        >>> edges = EdgeLists(starts.astype(np.int32), targets.astype(np.int32))
        >>> first_to_reach(edges, np.array([2, 0], dtype=np.int32), 3).tolist()
        [0, 2, 2]
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import depth_first_order

    heads = np.full(num_points, -1, dtype=np.int32)
    if len(seeds) == 0:
        return heads
    num_nodes = num_points + len(seeds)
    num_edges = int(edges.starts[-1])
    total = num_edges + 2 * len(seeds) - 1
    edges.targets[num_edges:total:2] = seeds
    edges.targets[num_edges + 1 : total : 2] = np.arange(num_points + 1, num_nodes)
    ends = num_edges + 2 * np.arange(1, len(seeds) + 1, dtype=edges.starts.dtype)
    ends[-1] = total
    # The search reads no weights; an array of one repeated value takes no memory.
    weights = np.broadcast_to(np.float64(1), total)
    graph = csr_array(
        (weights, edges.targets[:total], np.concatenate([edges.starts, ends])),
        shape=(num_nodes, num_nodes),
    )
    visited, parents = depth_first_order(graph, num_points, directed=True)
    visited = visited[visited < num_points]
    is_head = parents[visited] >= num_points
    heads[visited] = visited[is_head][np.cumsum(is_head) - 1]
    return heads


def claim_leftovers(
    sources: NDArray[np.int32],
    targets: NDArray[np.int32],
    heads: NDArray[np.int32],
    order: NDArray[np.int32],
) -> None:
    """Let points that no seed reaches claim their free neighbours, one hop, in order.

    Args:
        sources: Points that the edges lead from, ascending, shape ``(E,)``: points that do not
            spread beyond their own neighbours.
        targets: Points that they lead to, shape ``(E,)``.
        heads: Head of each point's region, or -1; written.
        order: All points that may start a region, in the order in which they do.

    Example:
        >>> heads = np.full(4, -1, dtype=np.int32)
        >>> claim_leftovers(np.array([0, 1, 3]), np.array([1, 2, 2]), heads, np.arange(4))
        >>> heads.tolist()
        [0, 0, 2, 3]
    """
    free = heads < 0
    turn = np.empty(len(heads), dtype=np.int32)
    turn[order] = np.arange(len(order), dtype=np.int32)
    # A free point whose turn was before has started a region of its own.
    open_edges = free[sources] & free[targets] & (turn[sources] < turn[targets])
    sources, targets = sources[open_edges], targets[open_edges]
    starts = np.searchsorted(sources, np.arange(len(heads) + 1))
    claiming = order[free[order] & (np.diff(starts)[order] > 0)]
    for point in claiming.tolist():
        if heads[point] < 0:
            reached = targets[starts[point] : starts[point + 1]]
            heads[reached[heads[reached] < 0]] = point
            heads[point] = point
    alone = order[heads[order] < 0]
    heads[alone] = alone
