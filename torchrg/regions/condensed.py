"""Growth of regions from the edges of tiles: exact, without all edges in memory.

Where growth is free of order, the first seed that reaches a point has it. Points that reach one
another have the same: within a tile such components shrink to one node each, and what is left
of the graph fits into memory. Otherwise the edges lie in one file, which growth reads in parts.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg._parallel import ROWS_IN_CACHE, chunks_of
from torchrg.neighbors.tiles import Part
from torchrg.regions.edges import EdgeLists
from torchrg.regions.growth import chain_of, first_to_reach


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


def condense(edges: EdgeLists, part: Part) -> Condensed:
    """Shrink points of a tile that reach one another to one node.

    The edges are those of the points of a part, none of them twice (SciPy would search without
    end); those that leave the tile stay, one for all between two components.

    Example:
        >>> import torch
        >>> from torchrg.structures import Neighbors
        >>> edges = EdgeLists(np.array([0, 1, 3, 4]), np.array([1, 0, 2, 2], dtype=np.int32))
        >>> rows, lists = torch.tensor([10, 11, 17]), Neighbors(torch.zeros(3, 1))
        >>> found = condense(edges, Part(rows, slice(0, 2), lists))
        >>> found.components.tolist()
        [0, 0]
        >>> found.targets.tolist()
        [17]
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    numbers = part.numbers
    first, num_points = part.own.start, part.own.stop - part.own.start
    starts = edges.starts[first : part.own.stop + 1]
    begin = starts[0]
    inner = np.empty(starts[-1] - begin, dtype=np.int32)
    chunks = chunks_of(num_points, ROWS_IN_CACHE)

    def edges_of(rows: slice) -> tuple[slice, NDArray[np.int64], NDArray[np.int32]]:
        """Return the places of the edges of some points, how many each has, and their targets."""
        places = slice(starts[rows.start] - begin, starts[rows.stop] - begin)
        targets = edges.targets[places.start + begin : places.stop + begin] - np.int32(first)
        return places, np.diff(starts[rows.start : rows.stop + 1]), targets

    for rows in chunks:
        places, counts, targets = edges_of(rows)
        # An edge to itself changes nothing.
        itself = np.repeat(np.arange(rows.start, rows.stop, dtype=np.int32), counts)
        inner[places] = np.where((targets >= 0) & (targets < num_points), targets, itself)
    weights = np.broadcast_to(np.float64(1), len(inner))
    graph = csr_array((weights, inner, starts - begin), shape=(num_points, num_points))
    number, components = connected_components(graph, directed=True, connection="strong")
    # All points of a component do as target: the last one serves for all.
    last = np.zeros(number, dtype=np.int32)
    last[components] = np.arange(num_points)
    found = []
    for rows in chunks:
        places, counts, targets = edges_of(rows)
        sources = np.repeat(components[rows], counts)
        # NumPy would first make long numbers of the short ones that it shall take.
        reached = torch.from_numpy(components).index_select(0, torch.from_numpy(inner[places]))
        leaves = np.flatnonzero((targets != inner[places]) | (sources != reached.numpy()))
        sources, targets = sources[leaves], targets[leaves]
        is_inner = (targets >= 0) & (targets < num_points)
        targets[is_inner] = last[components[targets[is_inner]]]
        found.append(sources.astype(np.int64) * len(numbers) + (targets + first))
    keys = np.unique(np.concatenate(found))
    sources = (keys // len(numbers)).astype(np.int32)
    return Condensed(components, sources, numbers[keys % len(numbers)])


def join_condensed(parts: list[Condensed], seeds: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return for each point of all tiles the first of the seeds that reaches it, -1 for none."""
    if not parts:
        return np.empty(0, dtype=np.int32)
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
    # The edges of each tile are in the order of their components.
    edges = EdgeLists(starts, targets).append(chain_of(nodes, len(starts) - 1))
    roots = first_to_reach(edges, len(starts) - 1)
    seed_of = np.full(int(offsets[-1]) + 1, -1, dtype=np.int32)
    seed_of[nodes] = seeds[places]
    found: NDArray[np.int32] = seed_of[roots][node_of]
    return found
