"""Growth of regions from the edges of tiles: exact, without all edges in memory.

Where growth is free of order, the first seed that reaches a point has it. Points that reach one
another have the same: within a tile such components shrink to one node each, and what is left of
the graph fits into memory. Otherwise the edges lie in one file, of which growth reads what it needs.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.regions.edges import EdgeLists
from torchrg.regions.growth import first_to_reach


class Condensed(NamedTuple):
    """The edges of a tile without those between points that reach one another.

    Attributes:
        components: Component of each point, 0 to C-1, shape ``(n,)``, int32.
        sources: Component that each edge leaves, shape ``(E,)``, int32.
        targets: Row in the whole cloud that it leads to, shape ``(E,)``, int64.
    """

    components: NDArray[np.int32]
    sources: NDArray[np.int32]
    targets: NDArray[np.int64]


def condense(edges: EdgeLists, first_row: int) -> Condensed:
    """Shrink points of a tile that reach one another to one node.

    The edges are those of the points of the tile, which begins at ``first_row``; their targets are
    rows of the whole cloud. Equal edges are left once.

    Example:
        >>> edges = EdgeLists(np.array([0, 1, 3, 4]), np.array([11, 10, 12, 7], dtype=np.int32))
        >>> found = condense(edges, 10)
        >>> found.components[0] == found.components[1], found.targets.tolist()
        (np.True_, [12, 7])
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    num_points = len(edges.starts) - 1
    targets = edges.targets[: edges.starts[-1]] - np.int32(first_row)
    is_inner = (targets >= 0) & (targets < num_points)
    before = np.zeros(len(targets) + 1, dtype=np.int64)
    np.cumsum(is_inner, out=before[1:])
    inner = targets[is_inner]
    weights = np.broadcast_to(np.float64(1), len(inner))
    starts = before[edges.starts].astype(np.int32)
    graph = csr_array((weights, inner, starts), shape=(num_points, num_points))
    number, components = connected_components(graph, directed=True, connection="strong")
    sources = np.repeat(components, np.diff(edges.starts))
    # All points of a component do as target: the last one serves for all.
    last = np.zeros(number, dtype=np.int64)
    last[components] = np.arange(num_points)
    reached = components[inner]
    targets[is_inner] = last[reached]
    leaves = ~is_inner
    leaves[is_inner] = sources[is_inner] != reached
    places = np.stack([sources[leaves], targets[leaves]])
    order = np.lexsort(places[::-1])
    places = places[:, order]
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (places[:, 1:] != places[:, :-1]).any(axis=0)
    sources, targets = places[:, is_new]
    return Condensed(components, sources, targets.astype(np.int64) + first_row)


def join_condensed(parts: list[Condensed], seeds: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return for each point of all tiles the first of the seeds that reaches it, -1 for none."""
    counts = [int(part.components.max(initial=-1)) + 1 for part in parts]
    offsets = np.cumsum([0, *counts])
    node_of = np.concatenate(
        [part.components + np.int32(start) for part, start in zip(parts, offsets, strict=False)]
    )
    sources = np.concatenate(
        [part.sources + np.int32(start) for part, start in zip(parts, offsets, strict=False)]
    )
    targets = node_of[np.concatenate([part.targets for part in parts])]
    first_seeds, places = np.unique(node_of[seeds], return_index=True)
    by_seed = np.argsort(places)
    nodes, places = first_seeds[by_seed], places[by_seed]
    starts = np.zeros(int(offsets[-1]) + 1, dtype=np.int32)
    np.cumsum(np.bincount(sources, minlength=int(offsets[-1])), out=starts[1:])
    room = np.empty(len(targets) + 2 * len(nodes), dtype=np.int32)
    # The edges of each tile are in the order of their components.
    room[: len(targets)] = targets
    heads = first_to_reach(EdgeLists(starts, room), nodes, int(offsets[-1]))
    seed_of = np.full(int(offsets[-1]) + 1, -1, dtype=np.int32)
    seed_of[nodes] = seeds[places]
    return seed_of[heads][node_of]
