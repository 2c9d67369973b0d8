"""Which of the seeds reaches a point first, along edges that are in many blocks.

Where growth is free of order, the first seed that reaches a point has it. Points that reach one
another have the same: within a block such components shrink to one node each, and what is left of
the graph fits into memory. One graph of all would not where a cloud has over 2^31 edges, some 40
million points: SciPy searches it by copies of the edges in 64 bits.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg._parallel import ROWS_IN_CACHE, chunks_of
from torchrg.regions.edges import EdgeLists, chain_of, first_to_reach


class Condensed(NamedTuple):
    """The edges of a block without those between points that reach one another.

    The component of each point ``(n,)``, 0 to C-1; the component that each edge ``(E,)`` leaves,
    and the row in the whole cloud that it leads to; all int32.
    """

    components: NDArray[np.int32]
    sources: NDArray[np.int32]
    targets: NDArray[np.int32]


def condense(edges: EdgeLists, block: slice) -> Condensed:
    """Shrink points of a block that reach one another to one node.

    The edges are those of the points of the block, none of them twice (SciPy would search without
    end); those that leave it stay, one for all between two components.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    starts, num_points = edges.starts, block.stop - block.start
    inner = np.empty(len(edges.targets), dtype=np.int32)
    chunks = chunks_of(num_points, ROWS_IN_CACHE)

    def edges_of(rows: slice) -> tuple[slice, NDArray[np.signedinteger], NDArray[np.int32]]:
        """Return the places of the edges of some points, how many each has, and their targets."""
        places = slice(starts[rows.start], starts[rows.stop])
        counts = np.diff(starts[rows.start : rows.stop + 1])
        return places, counts, edges.targets[places] - np.int32(block.start)

    for rows in chunks:
        places, counts, targets = edges_of(rows)
        # An edge to itself changes nothing.
        itself = np.repeat(np.arange(rows.start, rows.stop, dtype=np.int32), counts)
        inner[places] = np.where((targets >= 0) & (targets < num_points), targets, itself)
    weights = np.broadcast_to(np.float64(1), len(inner))
    graph = csr_array((weights, inner, starts), shape=(num_points, num_points))
    number, components = connected_components(graph, directed=True, connection="strong")
    # All points of a component do as target: the last one serves for all.
    last = np.zeros(number, dtype=np.int32)
    last[components] = np.arange(num_points)
    keys_of_chunks = []
    for rows in chunks:
        places, counts, targets = edges_of(rows)
        sources = np.repeat(components[rows], counts)
        leaves = np.flatnonzero((targets != inner[places]) | (sources != components[inner[places]]))
        sources, targets = sources[leaves], targets[leaves]
        is_inner = (targets >= 0) & (targets < num_points)
        targets[is_inner] = last[components[targets[is_inner]]]
        # The source above the target, which is at most 2^31, in one number to sort.
        keys_of_chunks.append(sources.astype(np.int64) << 32 | targets + np.int64(block.start))
    keys = np.unique(np.concatenate(keys_of_chunks))
    return Condensed(components, (keys >> 32).astype(np.int32), keys.astype(np.int32))


def join_condensed(parts: list[Condensed], seeds: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return for each point of all blocks the first of the seeds that reaches it, -1 for none."""
    counts = [int(block.components.max(initial=-1)) + 1 for block in parts]
    offsets = np.cumsum([0, *counts])
    node_of = np.concatenate(
        [block.components + np.int32(start) for block, start in zip(parts, offsets, strict=False)]
    )
    sources = np.concatenate(
        [block.sources + np.int32(start) for block, start in zip(parts, offsets, strict=False)]
    )
    targets = node_of[np.concatenate([block.targets for block in parts])]
    first_seeds, places = np.unique(node_of[seeds], return_index=True)
    by_seed = np.argsort(places)
    nodes, places = first_seeds[by_seed], places[by_seed]
    starts = np.zeros(int(offsets[-1]) + 1, dtype=np.int32)
    np.cumsum(np.bincount(sources, minlength=int(offsets[-1])), out=starts[1:])
    # The edges of each block are in the order of their components.
    edges = EdgeLists(starts, targets).append(chain_of(nodes, len(starts) - 1))
    roots = first_to_reach(edges, len(starts) - 1)
    seed_of = np.full(int(offsets[-1]) + 1, -1, dtype=np.int32)
    seed_of[nodes] = seeds[places]
    firsts: NDArray[np.int32] = seed_of[roots][node_of]
    return firsts
