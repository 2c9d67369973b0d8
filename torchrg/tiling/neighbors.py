"""Exact nearest neighbours of one tile of a cloud that lies on disk.

A tile is a range of rows in canonical order. A search among its own points bounds how far away the
neighbours can be; boxes that reach across the border are searched again, among all points within
that bound. Candidates stay in canonical order, so ties come out as in memory.
"""

import numpy as np
from numpy.typing import NDArray

from torchrg._parallel import ROWS_AT_ONCE, chunks_of
from torchrg.neighbors import search_knn
from torchrg.tiling.boxes import Boxes, farthest_neighbor, near_boxes

_LEAST_CANDIDATES = 65536
_CANDIDATES = 2
"""Rows searched at a time at most: as many as two tiles have, and so many that a small tile is not
searched in crumbs."""


def search_tile(
    points: NDArray[np.floating], boxes: Boxes, tile: slice, k: int, most: int | None = None
) -> NDArray[np.int32]:
    """Return the rows of the ``k`` nearest points of those of a tile, shape ``(n, k)``.

    They are those of :func:`torchrg.search_knn` for the whole cloud, exactly.

    Args:
        points: All points in canonical order, shape ``(N, 3)``; may be a map of a file.
        boxes: The boxes about them.
        tile: Rows of the tile; it begins and ends where boxes do.
        k: Number of neighbours, at most N.
        most: Rows searched at a time.

    Example:
        >>> from torchrg.tiling.boxes import find_boxes
        >>> points = np.arange(8.0)[:, None] * [1, 0, 0]
        >>> search_tile(points, find_boxes(points, 1), slice(3, 5), 3).tolist()
        [[3, 2, 4], [4, 3, 5]]
    """
    own = np.array(points[tile])
    first = int(np.searchsorted(boxes.starts, tile.start))
    numbers = np.arange(first, int(np.searchsorted(boxes.starts, tile.stop)))
    if len(own) < k:
        found = np.empty((len(own), k), dtype=np.int32)
        reach = np.array([farthest_neighbor(boxes, box, k) for box in numbers])
    else:
        local = search_knn(own, k, canonical=True).indices.numpy()
        far = own[local[:, -1]].astype(np.float64) - own
        starts = boxes.starts[numbers] - tile.start
        reach = np.maximum.reduceat(np.sqrt((far * far).sum(axis=1)), starts)
        found = local + np.int32(tile.start)
    is_open = np.full(len(numbers), len(own) < k)
    for some, near, within in near_boxes(boxes, numbers, reach):
        is_outside = (near < numbers[0]) | (near > numbers[-1])
        is_open[some] |= within[:, is_outside].any(axis=1)
    waiting = [np.flatnonzero(is_open)] if is_open.any() else []
    most = max(_CANDIDATES * len(own), _LEAST_CANDIDATES) if most is None else most
    while waiting:
        some = waiting.pop()
        rows = _rows_near(boxes, numbers[some], reach[some])
        if len(rows) > most and len(some) > 1:
            waiting += np.array_split(some, 2)
            continue
        asked = _rows_of(boxes, numbers[some])
        if len(rows) > most:
            bound = np.array([farthest_neighbor(boxes, int(numbers[some[0]]), k)])
            rows = _rows_near(boxes, numbers[some], np.minimum(reach[some], bound))
        if len(rows) > most:
            found[asked - tile.start] = _search_each(points, rows, asked, k)
            continue
        local = search_knn(points[rows], k, canonical=True).indices.numpy()
        found[asked - tile.start] = rows[local[np.searchsorted(rows, asked)]]
    return found


def _rows_of(boxes: Boxes, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows of some boxes."""
    starts, counts = boxes.starts[numbers], np.diff(boxes.starts)[numbers]
    ends = np.cumsum(counts)
    return np.repeat(starts - ends + counts, counts) + np.arange(ends[-1])


def _rows_near(
    boxes: Boxes, numbers: NDArray[np.int64], reach: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the rows of all boxes within reach of some."""
    found = np.zeros(len(boxes.low), dtype=bool)
    for _, near, within in near_boxes(boxes, numbers, reach):
        found[near[within.any(axis=0)]] = True
    return _rows_of(boxes, np.flatnonzero(found))


def _search_each(
    points: NDArray[np.floating], rows: NDArray[np.int64], asked: NDArray[np.int64], k: int
) -> NDArray[np.int64]:
    """Return the nearest of many candidates for a few points, as far outliers have them."""
    places = points[asked].astype(np.float64)
    nearest = [np.empty(0, dtype=np.int64)] * len(asked)
    keys = [np.empty(0)] * len(asked)
    for chunk in chunks_of(len(rows), ROWS_AT_ONCE):
        some = rows[chunk]
        candidates = points[some].astype(np.float64)
        for i, (own, place) in enumerate(zip(asked, places, strict=True)):
            away = candidates - place
            sq_distances = away[:, 0] ** 2 + away[:, 1] ** 2 + away[:, 2] ** 2
            # The point itself stands first.
            distances = np.where(some == own, -1.0, np.sqrt(sq_distances))
            limit = keys[i][-1] if len(keys[i]) == k else np.inf
            kept = distances <= limit
            joined = np.append(nearest[i], some[kept])
            distances = np.append(keys[i], distances[kept])
            order = np.lexsort((joined, distances))[:k]
            nearest[i], keys[i] = joined[order], distances[order]
    return np.stack(nearest)
