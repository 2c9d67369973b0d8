"""A tile of a cloud that lies on disk: its exact nearest neighbours, and the points around it.

A tile is a range of rows in canonical order. How far away neighbours can be is known from a few of
its points; among all points within that distance of its boxes the search is that of a whole cloud.
Candidates stay in canonical order, so ties come out as in memory.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, chunks_of
from torchrg.neighbors.knn import search_rows
from torchrg.neighbors.octree import Boxes, farthest_neighbor, near_boxes
from torchrg.structures import Neighbors

_LEAST_CANDIDATES = 65536
_CANDIDATES = 2
"""Rows searched at a time at most: as many as two tiles have, and so many that a small tile is not
searched in crumbs."""


def search_tile(
    points: NDArray[np.floating] | Tensor,
    boxes: Boxes,
    tile: slice,
    k: int,
    most: int | None = None,
) -> NDArray[np.int32]:
    """Return the rows of the ``k`` nearest points of those of a tile, shape ``(n, k)``.

    They are those of :func:`torchrg.search_knn` for the whole cloud, exactly.

    Args:
        points: All points in canonical order, shape ``(N, 3)``; only rows near the tile are read.
        boxes: The boxes about them.
        tile: Rows of the tile; it begins and ends where boxes do.
        k: Number of neighbours, at most N.
        most: Rows searched at a time.

    Example:
        >>> from torchrg.neighbors.octree import find_boxes
        >>> points = np.arange(8.0)[:, None] * [1, 0, 0]
        >>> search_tile(points, find_boxes(points, 1), slice(3, 5), 3).tolist()
        [[3, 2, 4], [4, 3, 5]]
    """
    first, last = np.searchsorted(boxes.starts, (tile.start, tile.stop))
    reach = _reach_of_boxes(np.asarray(points[tile]), boxes, slice(first, last), k)
    found = np.empty((tile.stop - tile.start, k), dtype=np.int32)
    most = max(_CANDIDATES * len(found), _LEAST_CANDIDATES) if most is None else most
    waiting = [slice(first, last)]
    while waiting:
        some = waiting.pop()
        numbers = np.arange(some.start, some.stop)
        rows = _rows_near(boxes, numbers, reach[numbers - first])
        if len(rows) > most and len(numbers) > 1:
            middle = (some.start + some.stop) // 2
            waiting += [slice(some.start, middle), slice(middle, some.stop)]
            continue
        if len(rows) > most:
            bound = np.minimum(reach[numbers - first], farthest_neighbor(boxes, some.start, k))
            rows = _rows_near(boxes, numbers, bound)
        asked = slice(boxes.starts[some.start], boxes.starts[some.stop])
        into = slice(asked.start - tile.start, asked.stop - tile.start)
        if len(rows) > most:
            found[into] = _search_each(points, rows, np.arange(asked.start, asked.stop), k)
            continue
        start = int(np.searchsorted(rows, asked.start))
        local = slice(start, start + asked.stop - asked.start)
        near = torch.from_numpy(search_rows(np.asarray(points[rows]), local, k))
        numbers_of = torch.from_numpy(rows.astype(np.int32))
        out = torch.from_numpy(found[into]).view(-1)
        torch.index_select(numbers_of, 0, near.view(-1), out=out)
    return found


def _reach_of_boxes(
    own: NDArray[np.floating], boxes: Boxes, numbers: slice, k: int
) -> NDArray[np.float64]:
    """Return distances within which all points of each box of a tile have ``k`` neighbours."""
    from scipy.spatial import cKDTree

    if len(own) < k:
        return np.array(
            [farthest_neighbor(boxes, i, k) for i in range(numbers.start, numbers.stop)]
        )
    firsts = own[boxes.starts[numbers] - boxes.starts[numbers.start]]
    tree = cKDTree(own, balanced_tree=False, compact_nodes=False)
    sides = boxes.high[numbers] - boxes.low[numbers]
    # Any other point of the box is at most its diagonal away from the first.
    reach: NDArray[np.float64] = tree.query(firsts, [k])[0][:, 0] + np.linalg.norm(sides, axis=1)
    return reach


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
    points: NDArray[np.floating] | Tensor,
    rows: NDArray[np.int64],
    asked: NDArray[np.int64],
    k: int,
) -> NDArray[np.int64]:
    """Return the nearest of many candidates for a few points, as far outliers have them."""
    places = np.asarray(points[asked]).astype(np.float64)
    nearest = [np.empty(0, dtype=np.int64)] * len(asked)
    keys = [np.empty(0)] * len(asked)
    for chunk in chunks_of(len(rows), ROWS_AT_ONCE):
        some = rows[chunk]
        candidates = np.asarray(points[some]).astype(np.float64)
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


class Part(NamedTuple):
    """Some points of a cloud, in its order.

    Attributes:
        rows: Their rows in the cloud, ascending, shape ``(n,)``, int64; a slice where it is all.
        own: Which of them are the tile; the others are around it.
        neighbors: Their neighbours among them. Where one is missing, which is at the rim alone, the
            point itself stands in its place.
    """

    rows: Tensor | slice
    own: slice
    neighbors: Neighbors

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The rows as an array."""
        rows = self.rows
        return np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows.numpy()


def cut_part(indices: Tensor, tile: slice, steps: int) -> Part:
    """Return a tile with all points that so many steps from neighbour to neighbour lead to.

    ``indices`` are those of the neighbours of the whole cloud, shape ``(N, K)``; only the rows of
    the part are read. What a function finds at points whose steps end within the part is what it
    finds in the whole cloud.

    Example:
        >>> chain = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4], [4, 3]])
        >>> part = cut_part(chain, slice(0, 2), 1)
        >>> part.rows.tolist()
        [0, 1, 2]
        >>> part.neighbors.indices.tolist()
        [[0, 1], [1, 2], [2, 2]]
    """
    rows = new = np.arange(tile.start, tile.stop)
    for _ in range(steps):
        new = _not_among(rows, indices[new].numpy().ravel())
        rows = np.sort(np.concatenate([rows, new]))
    first = int(np.searchsorted(rows, tile.start))
    own = slice(first, first + tile.stop - tile.start)
    # Neighbours before and behind all rows of the part are at the ends, which have no number.
    low, high = (int(end) for end in (rows[0] - 1, rows[-1] + 1))
    numbers = torch.full((high - low + 1,), -1, dtype=torch.int32)
    itself = torch.arange(len(rows), dtype=torch.int32)
    numbers[torch.from_numpy(rows - low)] = itself
    near = indices[rows].clamp_(low, high).sub_(low)
    near = numbers.index_select(0, near.view(-1)).view(near.shape)
    near = torch.where(near < 0, itself[:, None], near)
    return Part(torch.from_numpy(rows), own, Neighbors(near))


def _not_among(rows: NDArray[np.int64], near: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return those near that are not among ascending rows, ascending, each once.

    A mask over their range takes a tenth of the time of sorting.
    """
    low, high = (int(end) for end in (near.min(initial=rows[0]), near.max(initial=rows[-1])))
    reached = np.zeros(high - low + 1, dtype=bool)
    reached[near - np.int32(low)] = True
    reached[rows - low] = False
    return np.flatnonzero(reached) + low
