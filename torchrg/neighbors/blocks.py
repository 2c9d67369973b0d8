"""Block-wise nearest neighbors of large clouds with little memory.

A block is a range of rows in canonical order. A few of its points bound the neighbor distance; the
search then runs among all points within that distance of its boxes. Candidates stay in canonical
order, so ties are resolved as in a search of the complete cloud.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg._parallel import ROWS_AT_ONCE, limit_rows, split_rows
from torchrg.neighbors.order import MORTON_BITS, morton_codes

BLOCK_SIZE = 300_000
"""Points per block. Smaller blocks search more surrounding points in vain, larger ones take more
memory."""
_MIN_CANDIDATES = 65536
_NUM_BLOCKS = 2
"""Maximum number of rows searched at a time: those of two blocks, but at least ``_MIN_CANDIDATES``,
so that a small block is not fragmented."""
SearchRows = Callable[[NDArray[np.floating], slice, NDArray[np.int64], NDArray[np.int32]], None]
"""Writes the neighbors of query rows of points, numbered as in a larger cloud, to its lists."""
POINTS_PER_BOX = 256
"""Points per box, a surface patch about two neighborhoods of 50 wide. Few rows are read in vain,
and boxes take a hundredth of the memory of the points."""
_ROUNDING = 1 + 1e-9
"""Factor by which distances are enlarged, so that rounding excludes no point."""
_BOXES_AT_ONCE = 64
"""Consecutive boxes whose common bounding box leaves few candidates to compare with each."""


class Boxes(NamedTuple):
    """Octree cells with few points each; in canonical order each is one run of rows.

    First row of each, followed by the number of points, ``(B + 1,)``; lower and upper corners of
    the points, ``(B, 3)``, float64.
    """

    starts: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def find_boxes(points: NDArray[np.floating], max_points: int = POINTS_PER_BOX) -> Boxes:
    """Return boxes of at most ``max_points`` points ``(N, 3)`` in canonical order.

    Only a cell of the finest level may hold more: nearly equal points.
    """
    codes = morton_codes(points)
    is_start = np.zeros(len(points) + 1, dtype=bool)
    is_start[[0, -1]] = True
    for level in range(MORTON_BITS - 1, -1, -1):
        starts = np.flatnonzero(is_start)
        counts = np.diff(starts)
        full = counts > max_points
        if not full.any():
            break
        changes = codes >> (3 * level)
        is_start[1:-1] |= (changes[1:] != changes[:-1]) & np.repeat(full, counts)[1:]
    starts = np.flatnonzero(is_start)
    low, high = (ufunc.reduceat(points, starts[:-1], axis=0) for ufunc in (np.minimum, np.maximum))
    return Boxes(starts, low.astype(np.float64), high.astype(np.float64))


def near_boxes(
    boxes: Boxes, chosen: NDArray[np.int64], reach: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return a mask of boxes within ``reach`` ``(n,)`` of one of the chosen boxes ``(n,)``."""
    is_near = np.zeros(len(boxes.low), dtype=bool)
    nearby = _near_bounding_box(boxes.low, boxes.high, boxes.low[chosen], boxes.high[chosen], reach)
    all_low, all_high = boxes.low[nearby], boxes.high[nearby]
    for chunk in split_rows(len(chosen), _BOXES_AT_ONCE):
        low, high = boxes.low[chosen[chunk]], boxes.high[chosen[chunk]]
        near = _near_bounding_box(all_low, all_high, low, high, reach[chunk])
        gap = np.maximum(all_low[near] - high[:, None], low[:, None] - all_high[near]).clip(min=0)
        within = np.sqrt((gap * gap).sum(axis=2)) <= reach[chunk, None] * _ROUNDING
        is_near[nearby[near[within.any(axis=0)]]] = True
    return is_near


def _near_bounding_box(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    query_low: NDArray[np.float64],
    query_high: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Return the boxes within the maximum reach of the bounding box of the query boxes."""
    far = reach.max() * _ROUNDING
    inside = (low <= query_high.max(axis=0) + far) & (high >= query_low.min(axis=0) - far)
    return np.flatnonzero(inside.all(axis=1))


def farthest_neighbor(boxes: Boxes, box: int, k: int) -> float:
    """Return a distance within which each point of a box has k points, itself included."""
    low, high = boxes.low[box], boxes.high[box]
    far = np.maximum(high - boxes.low, boxes.high - low)
    distances = np.sqrt((far * far).sum(axis=1))
    order = np.argsort(distances)
    enough = np.searchsorted(np.cumsum(np.diff(boxes.starts)[order]), k)
    return float(distances[order[enough]])


def search_blocks(
    points: NDArray[np.floating], search: SearchRows, nearest: NDArray[np.int32]
) -> None:
    """Write the neighbors of points ``(N, 3)`` to ``nearest`` ``(N, k)``, block by block.

    As in :func:`torchrg.search_knn`, for points in canonical order and k of at most N. ``search``
    writes them for some rows of a smaller cloud.
    """
    boxes = find_boxes(points)
    firsts = np.arange(0, len(points), limit_rows(BLOCK_SIZE, nearest.shape[1]))
    ends = boxes.starts[np.searchsorted(boxes.starts, firsts)]
    for start, stop in itertools.pairwise(np.unique(np.append(ends, len(points))).tolist()):
        search_block(points, boxes, slice(start, stop), search, nearest)


def search_block(
    points: NDArray[np.floating],
    boxes: Boxes,
    block: slice,
    search: SearchRows,
    nearest: NDArray[np.int32],
    max_rows: int | None = None,
) -> None:
    """Write the rows of the nearest points of each point of a block to ``nearest`` ``(N, k)``.

    The block begins and ends at the boundaries of ``boxes``; at most ``max_rows`` rows are searched
    at a time.
    """
    k, num_queries = nearest.shape[1], block.stop - block.start
    first, last = np.searchsorted(boxes.starts, (block.start, block.stop))
    reach = _reach_of_boxes(points[block], boxes, slice(first, last), k)
    max_rows = max(_NUM_BLOCKS * num_queries, _MIN_CANDIDATES) if max_rows is None else max_rows
    pending = [slice(first, last)]
    while pending:
        run = pending.pop()
        indices = np.arange(run.start, run.stop)
        rows = _rows_near(boxes, indices, reach[indices - first])
        if len(rows) > max_rows and len(indices) > 1:
            middle = (run.start + run.stop) // 2
            pending += [slice(run.start, middle), slice(middle, run.stop)]
            continue
        if len(rows) > max_rows:
            bound = np.minimum(reach[indices - first], farthest_neighbor(boxes, run.start, k))
            rows = _rows_near(boxes, indices, bound)
        queries = slice(boxes.starts[run.start], boxes.starts[run.stop])
        if len(rows) > max_rows:
            nearest[queries] = _search_each(points, rows, np.arange(queries.start, queries.stop), k)
            continue
        start = int(np.searchsorted(rows, queries.start))
        search(points[rows], slice(start, start + queries.stop - queries.start), rows, nearest)


def _reach_of_boxes(
    inside: NDArray[np.floating], boxes: Boxes, indices: slice, k: int
) -> NDArray[np.float64]:
    """Return distances within which all points of each box of a block have ``k`` neighbors."""
    if len(inside) < k:
        return np.array(
            [farthest_neighbor(boxes, i, k) for i in range(indices.start, indices.stop)]
        )
    firsts = inside[boxes.starts[indices] - boxes.starts[indices.start]]
    # Each other point of the box is at most its diagonal away from the first.
    reach: NDArray[np.float64] = build_tree(inside).query(firsts, [k])[0][:, 0]
    reach += np.linalg.norm(boxes.high[indices] - boxes.low[indices], axis=1)
    return reach


def build_tree(points: NDArray[np.floating]) -> Any:  # noqa: ANN401
    """Return a k-d tree of points ``(N, 3)``, unbalanced: it is built faster."""
    from scipy.spatial import cKDTree

    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _rows_near(
    boxes: Boxes, chosen: NDArray[np.int64], reach: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the rows of all boxes within reach of one of the chosen boxes."""
    indices = np.flatnonzero(near_boxes(boxes, chosen, reach))
    starts, counts = boxes.starts[indices], np.diff(boxes.starts)[indices]
    ends = np.cumsum(counts)
    return np.repeat(starts - ends + counts, counts) + np.arange(ends[-1])


def _search_each(
    points: NDArray[np.floating], rows: NDArray[np.int64], queries: NDArray[np.int64], k: int
) -> NDArray[np.int64]:
    """Return the nearest of many candidates for a few points, such as far outliers."""
    positions = points[queries].astype(np.float64)
    nearest = [np.empty(0, dtype=np.int64)] * len(queries)
    keys = [np.empty(0)] * len(queries)
    for chunk in split_rows(len(rows), ROWS_AT_ONCE):
        indices = rows[chunk]
        candidates = points[indices].astype(np.float64)
        for i, (index, position) in enumerate(zip(queries, positions, strict=True)):
            offset = candidates - position
            sq_distances = offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2
            # The point itself comes first.
            distances = np.where(indices == index, -1.0, np.sqrt(sq_distances))
            limit = keys[i][-1] if len(keys[i]) == k else np.inf
            near = distances <= limit
            merged = np.append(nearest[i], indices[near])
            distances = np.append(keys[i], distances[near])
            order = np.lexsort((merged, distances))[:k]
            nearest[i], keys[i] = merged[order], distances[order]
    return np.stack(nearest)
