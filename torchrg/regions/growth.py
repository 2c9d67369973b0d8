"""Region growing: from points, normals and neighbours to labels."""

from array import array
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import CHUNK_SIZE, ROWS_AT_ONCE, chunks_of, sequential_operations
from torchrg.config import GrowingConfig
from torchrg.neighbors import canonical_order
from torchrg.regions.bridges import cut_bridges
from torchrg.regions.criteria import GrowingCloud
from torchrg.regions.edges import (
    EdgeLists,
    checked_cloud,
    find_coded_edges,
    find_edges,
    reordered,
)
from torchrg.regions.refine import refine_regions
from torchrg.structures import UNLABELED, Neighbors

_LONG_QUEUE = 32
"""From this many waiting seeds on, whole levels go through NumPy; below, one seed at a time."""


@sequential_operations()
def grow_regions(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    curvature: Tensor | NDArray[np.floating],
    neighbors: Neighbors,
    config: GrowingConfig | None = None,
    *,
    valid: Tensor | None = None,
    colors: Tensor | NDArray[np.generic] | None = None,
    residual_rms: Tensor | NDArray[np.floating] | None = None,
    canonical: bool = False,
    chunk_size: int = CHUNK_SIZE,
) -> Tensor:
    """Grow regions of similar normals, in the order of ascending curvature (Algorithm 2) [1].

    A region starts at the free point of least curvature. Each of its seeds claims those of its free
    neighbours that pass the criteria of the settings; a claimed point becomes a seed if the seed
    rule holds. With ``connectivity_scope="seed"`` the two must also be connected, and where that
    fails for the seed that claimed the point, any later seed of its region may still make it one:
    without such late promotion regions shatter.

    Convention:
        All limits are inclusive. The curvature limit is the value at place
        ``floor(curvature_quantile * (n - 1))`` of the sorted curvatures of the n valid points.
        Equal curvatures are taken in canonical order. Labels are 0 to M-1 by descending size,
        regions of equal size by their first point in canonical order. They do not depend on the
        order of the points (exact duplicates may swap) or on chunk size.

    Args:
        points: Finite points, shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``; their sign only matters for ``signed_normals``.
        curvature: Surface variation, shape ``(N,)``.
        neighbors: Neighbours of each point, as :func:`torchrg.search_knn` gives them.
        config: Settings. Default: the paper's.
        valid: Points that have a normal, shape ``(N,)``, bool; the others join no region, and no
            region passes through them. Default: all. Points whose normal or curvature is not
            finite never join.
        colors: Colours of the points, shape ``(N, C)``, for ``max_color_distance``.
        residual_rms: How far the neighbours are from the planes of the points, shape ``(N,)``, as a
            :class:`torchrg.structures.NormalFit` has it, for ``plane_reach``.
        canonical: Whether the points already are in canonical order; saves a copy.
        chunk_size: Points handled at a time.

    Returns:
        Labels, shape ``(N,)``, int64; :data:`torchrg.UNLABELED` for points of no region and of
        regions smaller than ``min_size``.

    Raises:
        ShapeError: If a shape, dtype or device is not as above.
        ConfigError: If the settings ask for colours or residuals, and there are none.

    References:
        [1] T. Rabbani, F. van den Heuvel, G. Vosselman. Segmentation of point clouds using
        smoothness constraint. ISPRS Commission V Symposium, 2006.

    Example:
        >>> points = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0), torch.zeros(1))
        >>> normals, curvature = torch.eye(3)[[2] * 16], torch.zeros(16)
        >>> neighbors = Neighbors(torch.arange(16).expand(16, 16))
        >>> grow_regions(points, normals, curvature, neighbors, GrowingConfig(min_size=9)).unique()
        tensor([0])
    """
    config = GrowingConfig() if config is None else config
    cloud = checked_cloud(
        config, points, normals, curvature, neighbors, valid, colors, residual_rms
    )
    if len(cloud.points) == 0:
        return torch.empty(0, dtype=torch.int64, device=cloud.points.device)
    order = None if canonical else canonical_order(cloud.points)
    if order is not None:
        cloud = reordered(cloud, order)
    heads = torch.from_numpy(_grow(cloud, config, chunk_size)).to(cloud.points.device)
    labels = settle_regions(cloud, heads, config, chunk_size)
    return labels if order is None else torch.empty_like(labels).index_copy_(0, order, labels)


def settle_regions(
    cloud: GrowingCloud, heads: Tensor, config: GrowingConfig, chunk_size: int
) -> Tensor:
    """Return labels of regions that have grown, after all that the settings ask for.

    ``heads`` ``(N,)`` tell the regions apart, as :func:`number_by_size` reads them.
    """
    labels = number_by_size(heads, config.min_size)
    if config.cut_bridges and bool((labels >= 0).any()):

        def grow(part: GrowingCloud, share: float) -> Tensor:
            part, strict = _within_share(part, config, share)
            found = torch.from_numpy(_grow(part, strict, chunk_size)).to(part.points.device)
            return number_by_size(found, config.min_size)

        parts = cut_bridges(cloud, labels, config, grow, chunk_size=chunk_size)
        labels = number_by_size(parts, config.min_size)
    if config.is_refined:
        labels = number_by_size(refine_regions(cloud, labels, config), config.min_size)
    return labels


def _within_share(
    cloud: GrowingCloud, config: GrowingConfig, share: float
) -> tuple[GrowingCloud, GrowingConfig]:
    """Return a cloud and settings whose limits of angle and distance are a share of those given."""
    reach = None if cloud.reach is None else share * cloud.reach
    return cloud._replace(reach=reach), replace(config, max_angle_deg=share * config.max_angle_deg)


def number_by_size(regions: Tensor, min_size: int) -> Tensor:
    """Number regions by descending size, those of equal size by their first point.

    ``regions`` ``(N,)`` holds any number below N that is the same in a region and another
    elsewhere, -1 for none. Regions smaller than ``min_size`` become :data:`torchrg.UNLABELED`.
    """
    heads = regions.cpu().numpy()
    sizes = np.bincount(heads[heads >= 0], minlength=len(heads))
    kept = np.flatnonzero(sizes >= max(min_size, 1))
    sizes = sizes[kept]
    # The last entry is what a head of -1 finds.
    numbers = np.full(len(heads) + 1, UNLABELED, dtype=np.int32)
    numbers[kept] = np.arange(len(kept))
    found = numbers[heads]
    firsts = np.full(len(kept) + 1, len(heads))
    for rows in reversed(chunks_of(len(heads), ROWS_AT_ONCE)):
        firsts[found[rows][::-1]] = np.arange(rows.start, rows.stop)[::-1]
    order = np.lexsort((firsts[:-1], -sizes))
    ranks = np.full(len(kept) + 1, UNLABELED, dtype=np.int64)
    ranks[order] = np.arange(len(kept))
    return torch.from_numpy(ranks[found]).to(regions.device)


def _grow(cloud: GrowingCloud, config: GrowingConfig, chunk_size: int) -> NDArray[np.int32]:
    """Return the head of each point's region, by whichever way the settings allow."""
    order, limit = growing_order(cloud.curvature, cloud.valid, config)
    valid = cloud.valid.cpu().numpy()
    if not config.is_order_free:
        edges = find_coded_edges(cloud, config, limit, chunk_size=chunk_size)
        late = config.promotes_late
        return grow_first_in_first_out(edges, order, valid, promotes_late=late)
    seeds = spreading(order, cloud.curvature, limit)
    edges, others = find_edges(cloud, config, limit, spare=2 * len(seeds), chunk_size=chunk_size)
    heads = first_to_reach(edges, seeds, len(valid))
    if leaves_enough(cloud.neighbors.indices.shape[1], config):
        heads = grow_rest(heads, others, order)
    return heads


def growing_order(
    curvature: Tensor, valid: Tensor, config: GrowingConfig
) -> tuple[NDArray[np.int32], Tensor]:
    """Return the rows of valid points ``(N,)`` by ascending curvature, and its limit, a scalar."""
    order = np.argsort(curvature.cpu().numpy(), kind="stable").astype(np.int32)
    limit = curvature_limit(curvature[valid], config.curvature_quantile)
    return order[valid.cpu().numpy()[order]], limit


def spreading(order: NDArray[np.int32], curvature: Tensor, limit: Tensor) -> NDArray[np.int32]:
    """Return those of the rows in growing order whose curvature is within the limit."""
    return order[curvature.cpu().numpy()[order] <= limit.cpu().numpy()]


def leaves_enough(k: int, config: GrowingConfig) -> bool:
    """Tell whether points that no seed reaches may make regions: of at most k neighbours."""
    return config.min_size <= k


def grow_rest(
    heads: NDArray[np.int32], others: EdgeLists, order: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Let free points that no seed reaches claim free neighbours by the edges of their own."""
    free = heads < 0
    left = grow_first_in_first_out(others, order[free[order]], free)
    return np.where(free, left, heads)


def curvature_limit(curvature: Tensor, quantile: float) -> Tensor:
    """Return the lower quantile of curvatures ``(n,)``, one of the values; 0 where n is 0."""
    if len(curvature) == 0:
        return curvature.new_zeros(())
    return curvature.kthvalue(int(quantile * (len(curvature) - 1)) + 1).values


def first_to_reach(
    edges: EdgeLists, seeds: NDArray[np.int32], num_points: int
) -> NDArray[np.int32]:
    """Return for each point the first of the seeds that reaches it along edges, -1 for none.

    This is what growing one region after the other, from each seed that is still free, comes to,
    if every point spreads alike whoever claimed it: the first seed that reaches a point finds all
    of its way free. One depth-first search does it, through a chain of extra nodes that each lead
    to one seed and then to the next node; its edges are written into the room behind the others.
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


def grow_first_in_first_out(
    edges: EdgeLists,
    order: NDArray[np.int32],
    valid: NDArray[np.bool_],
    *,
    promotes_late: bool = False,
) -> NDArray[np.int32]:
    """Grow one region after the other, each from a first-in-first-out queue of seeds (Algorithm 2).

    A point belongs to the first seed in the queue that has an edge to it. Whether it becomes a seed
    itself is a property of that edge: targets are ``2 * row + (whether it does)``. With late
    promotion it becomes one by the first edge of its region that says so; the region is then the
    same in whatever order its seeds are taken.

    Long queues are taken a level at a time: all edges of the waiting seeds in their order. This is
    the order of the queue, exactly.

    Returns the head of each point's region, -1 where not valid.
    """
    codes = edges.targets
    starts = memoryview(edges.starts.data)
    # Points that an edge may still claim or, once they are claimed, make a seed of their region.
    pending = bytearray(valid.tobytes())
    heads = array("i", bytes(4 * len(valid)))
    pending_view = np.frombuffer(pending, dtype=np.bool_)
    heads_view = np.frombuffer(heads, dtype=np.int32)
    heads_view[:] = -1
    slots = np.empty(len(valid), dtype=np.int32)
    shared = (pending_view, heads_view, slots, promotes_late)
    for head in order.tolist():
        if heads[head] >= 0:
            continue
        pending[head] = False
        heads[head] = head
        queue = [head]
        done = 0
        while done < len(queue):
            if len(queue) - done >= _LONG_QUEUE:
                level = np.array(queue[done:], dtype=np.int32)
                while len(level) >= _LONG_QUEUE:
                    level = _claim_level(edges, level, head, *shared)
                queue, done = level.tolist(), 0
                continue
            seed = queue[done]
            done += 1
            for code in codes[starts[seed] : starts[seed + 1]].tolist():
                target = code >> 1
                if pending[target] and heads[target] in (-1, head):
                    heads[target] = head
                    if code & 1:
                        queue.append(target)
                    pending[target] = promotes_late and not code & 1
    return heads_view


def _claim_level(
    edges: EdgeLists,
    level: NDArray[np.int32],
    head: int,
    pending: NDArray[np.bool_],
    heads: NDArray[np.int32],
    slots: NDArray[np.int32],
    promotes_late: bool,
) -> NDArray[np.int32]:
    """Let a level of seeds claim points, and return the seeds among them in queue order."""
    starts = edges.starts[level]
    counts = edges.starts[level + 1] - starts
    ends = np.cumsum(counts)
    places = np.repeat(starts - ends + counts, counts)
    places += np.arange(len(places), dtype=places.dtype)
    codes = edges.targets[places]
    codes = codes[pending[codes >> 1]]
    targets = codes >> 1
    if promotes_late:
        owners = heads[targets]
        mine = (owners < 0) | (owners == head)
        heads[targets[mine]] = head
        makes_seed = mine & (codes & 1).astype(bool)
        codes, targets = codes[makes_seed], targets[makes_seed]
    numbers = np.arange(len(targets), dtype=np.int32)
    # Of several writes to one place the last one stays: in reverse, the first edge to a point.
    slots[targets[::-1]] = numbers[::-1]
    first = slots[targets] == numbers
    codes, targets = codes[first], targets[first]
    pending[targets] = False
    heads[targets] = head
    seeds: NDArray[np.int32] = targets[(codes & 1).astype(bool)]
    return seeds
