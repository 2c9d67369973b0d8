"""Exact nearest neighbours, by cells or a tree, and the patches they make."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._checks import as_tensor, check_floating, check_shapes, is_tensor, of_clouds
from torchrg._parallel import (
    ROWS_AT_ONCE,
    ROWS_IN_CACHE,
    allowed_threads,
    chunks_of,
    map_chunks,
    map_tasks,
    sequential_operations,
)
from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors.blocks import search_blocks
from torchrg.neighbors.order import canonical_order, distinct_rows, mark_first
from torchrg.structures import MAX_POINTS, Neighbors, Rows, bounding_box

_SAMPLE_SIZE = 400
"""Points that tell how far the k-th neighbour is."""

SomeNeighbors = Callable[[NDArray[np.integer]], NDArray[np.integer]]
"""Function from rows ``(n,)`` to their neighbors ``(n, k)``, each first its own."""

_MIN_FOR_CELLS = 2000
"""Points below which a tree is as fast as cells."""

_SIZE_STEP = 1.5
"""Cells of one size answer for points whose k-th neighbour is from 1 / 1.75 to 1 size away."""

_MIN_FRACTION = 0.03
"""Share of the points for which another size of cells is worth its sort."""

_CELLS_A_POINT = 8
"""Cells of the box about a cloud, empty ones too, that are worth their memory, 4 bytes each."""


@of_clouds
@sequential_operations()
def search_knn(
    points: Tensor | NDArray[np.floating],
    k: int,
    *,
    max_distance: float | None = None,
    offset: Tensor | None = None,
    canonical: bool = False,
) -> Neighbors:
    """Find the ``k`` nearest points of every point, exactly.

    Convention:
        ``k`` counts the point itself, which always stands first, duplicates or not. The others are
        sorted by distance; equal distances by :func:`canonical_order`, never by the input order.
        The search runs on the CPU with as many threads as torch uses.

    Args:
        points: Points, shape ``(N, 3)``, finite.
        k: Number of neighbours, the point itself included.
        max_distance: Neighbours farther than this do not count (``valid`` False, index: the point
            itself): a hybrid search. In the unit of the cloud. Default: no limit.
        offset: Ends of the clouds of a ragged batch, shape ``(B,)``, ascending, the last one ``N``
            (Pointcept's convention); no neighbour crosses clouds. Default: one cloud.
        canonical: Whether the points already are in canonical order; saves two passes.

    Returns:
        Indices of shape ``(N, k)``, int32, on the device of the points.

    Raises:
        ShapeError: If a shape or dtype is wrong, a point is not finite, or a cloud has fewer than
            ``k`` points.

    Example:
        >>> search_knn(torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), 2).indices.tolist()
        [[0, 1], [1, 0], [2, 1]]
    """
    tensor = as_tensor("search_knn", "points", points)
    check_shapes("search_knn", points=(tensor, "N 3"))
    check_floating("search_knn", points=tensor)
    if len(tensor) > MAX_POINTS:
        raise ShapeError(
            f"search_knn: expected at most {MAX_POINTS:,} points, got {len(tensor):,}; cut the "
            "cloud into parts."
        )
    if max_distance is not None and not max_distance >= 0:
        raise ConfigError(f"search_knn: expected max_distance >= 0, got {max_distance!r}.")
    coordinates = tensor.detach().cpu().numpy()
    if not np.isfinite(coordinates).all():
        num_bad = int((~np.isfinite(coordinates)).any(axis=1).sum())
        raise ShapeError(
            f"search_knn: expected finite points, got {num_bad:,} of {len(coordinates):,} with NaN "
            "or Inf; leave them out first."
        )
    bounds = _cloud_bounds(offset, len(coordinates))
    least = min((stop - start for start, stop in bounds), default=MAX_POINTS)
    if not 1 <= k <= least:
        raise ShapeError(
            f"search_knn: expected k from 1 to the number of points ({least:,}), got {k}; lower k "
            "or pass a larger cloud."
        )
    indices = scratch.empty((len(coordinates), k), np.int32)
    outside = None if max_distance is None else np.empty(indices.shape, dtype=bool)
    for start, stop in bounds:
        cloud = coordinates[start:stop]
        order = None if canonical else canonical_order(cloud).numpy()
        cloud = cloud if order is None else cloud[order]
        if scratch.is_active() and max_distance is None:
            for rows, near in search_blocks(cloud, k, search_rows):
                into = rows if order is None else order[rows]
                indices[start:stop][into] = (near if order is None else order[near]) + start
            continue
        _search_cloud(
            cloud,
            slice(0, len(cloud)),
            order,
            start,
            math.inf if max_distance is None else max_distance,
            indices[start:stop],
            None if outside is None else outside[start:stop],
        )
    valid = None if outside is None else torch.from_numpy(~outside).to(tensor.device)
    return Neighbors(torch.from_numpy(indices).to(tensor.device), valid)


def check_neighbors(caller: str, neighbors: Neighbors, points: Tensor) -> None:
    """Check the lists that a user passes: one for each point, itself first, of rows of the points.

    Raises:
        ShapeError: If they are not as :class:`torchrg.structures.Neighbors` says.
    """
    indices: object = getattr(neighbors, "indices", None)
    if not is_tensor(indices):
        raise ShapeError(
            f"{caller}: expected neighbors as torchrg.structures.Neighbors of a tensor, got "
            f"{type(neighbors).__name__}; pass Neighbors(torch.as_tensor(rows))."
        )
    num_points = len(points)
    check_shapes(
        caller,
        points=(points, "N 3"),
        neighbors=(indices, "N K"),
        neighbors_valid=(neighbors.valid, "N K"),
    )
    if indices.dtype not in (torch.int32, torch.int64):
        raise ShapeError(
            f"{caller}: expected neighbors of int32 or int64, got {indices.dtype}; convert them."
        )
    if indices.device != points.device:
        raise ShapeError(
            f"{caller}: expected points and neighbors on one device, got {points.device} and "
            f"{indices.device}."
        )
    if num_points == 0:
        return
    if indices.shape[1] == 0:
        raise ShapeError(f"{caller}: expected neighbors of each point, got none; pass k of them.")
    low, high = (int(end) for end in torch.aminmax(indices))
    if not 0 <= low <= high < num_points:
        raise ShapeError(
            f"{caller}: expected neighbors to be rows of {num_points:,} points, got {low:,} to "
            f"{high:,}; search them among these points."
        )
    is_own = indices[:, 0] == torch.arange(num_points, device=points.device)
    if not bool(is_own.all()):
        raise ShapeError(
            f"{caller}: expected each point to be the first of its own neighbors, got others for "
            f"{num_points - int(torch.count_nonzero(is_own)):,} of {num_points:,} points; put the "
            "row of the point before its neighbors, as search_knn does."
        )


def keep_within(
    neighbors: Neighbors, groups: Tensor, chunk_size: int, places: Rows = slice(None)
) -> Neighbors:
    """Return those neighbors of each point that are of its group, the nearest first.

    Points of several groups may share a place. They are ascending by place, then by group.

    Args:
        neighbors: Neighbors of each place.
        groups: Group of each point, shape ``(N,)``, from 0 where places are passed.
        chunk_size: Points handled at a time.
        places: Place of each point, shape ``(N,)``. Default: each has one point.

    Example:
        >>> near = Neighbors(torch.tensor([[0, 1, 2], [1, 0, 2], [2, 1, 0]]))
        >>> kept = keep_within(near, torch.tensor([4, 7, 4]), 3)
        >>> kept.indices.tolist(), kept.valid.sum(dim=1).tolist()
        ([[0, 2, 0], [1, 1, 1], [2, 0, 2]], [2, 1, 2])
        >>> kept = keep_within(near, torch.tensor([0, 0, 1, 1]), 4, torch.tensor([0, 1, 1, 2]))
        >>> kept.indices.tolist(), kept.valid.sum(dim=1).tolist()
        ([[0, 1, 0], [1, 0, 1], [2, 3, 2], [3, 2, 3]], [2, 2, 2, 2])
    """
    shape, device = (len(groups), neighbors.indices.shape[1]), groups.device
    indices, valid = (scratch.empty(shape, kind) for kind in (np.int32, np.bool_))
    width = int(groups.max()) + 1 if len(groups) else 0
    keys = None if isinstance(places, slice) else places * width + groups

    def work(rows: slice) -> None:
        if isinstance(places, slice) or keys is None:
            near = neighbors.indices[rows]
            same = neighbors.of(groups, rows) == groups[rows, None]
            same &= neighbors.counted(rows)
        else:
            at = places[rows]
            wanted = neighbors.indices[at].long() * width + groups[rows, None]
            near = torch.searchsorted(keys, wanted).clamp(max=len(keys) - 1)
            same = (keys[near] == wanted) & neighbors.counted(at)
        order = same.byte().argsort(dim=1, descending=True, stable=True)
        near, same = near.gather(1, order), same.gather(1, order)
        indices[rows] = torch.where(same, near, near[:, :1]).numpy(force=True)
        valid[rows] = same.numpy(force=True)

    map_chunks(work, shape[0], chunk_size, device)
    return Neighbors(*(torch.from_numpy(column).to(device) for column in (indices, valid)))


@sequential_operations()
def search_nearest(
    points: NDArray[np.floating], queries: NDArray[np.floating], max_distance: float
) -> NDArray[np.int64]:
    """Return the row of the nearest point of each query ``(M,)``, -1 where none is near enough.

    Points and queries are finite, ``(N, 3)`` and ``(M, 3)`` in the same coordinates. Of points at
    equal distances the first in :func:`canonical_order` is taken.

    Example:
        >>> points = np.array([[0.0, 0, 0], [1, 0, 0]])
        >>> search_nearest(points, np.array([[0.9, 0, 0], [3, 0, 0]]), 0.2).tolist()
        [1, -1]
    """
    from scipy.spatial import cKDTree

    nearest = np.full(len(queries), -1)
    if len(points) == 0 or len(queries) == 0:
        return nearest
    first = distinct_rows(as_tensor("search_nearest", "points", points)).numpy()
    tree = cKDTree(points[first], balanced_tree=False, compact_nodes=False)
    # Those close to each other find the same parts of the tree in the cache.
    asked = canonical_order(queries).numpy()
    for chunk in chunks_of(len(asked), ROWS_AT_ONCE):
        distances, places = _query(tree, queries[asked[chunk]], 1)
        nearest[asked[chunk]] = np.where(distances <= max_distance, first[places], -1)[:, 0]
    return nearest


def _cloud_bounds(offset: Tensor | None, num_points: int) -> list[tuple[int, int]]:
    """Return first and last row of each cloud of a ragged batch."""
    if offset is None:
        return [(0, num_points)]
    ends = [int(end) for end in offset]
    bounds = list(itertools.pairwise([0, *ends]))
    if not ends or ends[-1] != num_points or any(stop < start for start, stop in bounds):
        raise ShapeError(
            f"search_knn: expected offset to ascend to the number of points ({num_points}), got "
            f"{ends}."
        )
    return [(start, stop) for start, stop in bounds if stop > start]


def prepare_search(points: NDArray[np.floating], k: int) -> SomeNeighbors:
    """Return a function that finds the neighbors of some rows only, as :func:`search_knn` does.

    ``points`` ``(N, 3)`` are distinct and in canonical order, at least ``k``.

    Example:
        >>> search = prepare_search(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]), 2)
        >>> search(np.array([2, 0])).tolist()
        [[2, 1], [0, 1]]
    """
    from scipy.spatial import cKDTree

    places = points.astype(np.float64, copy=False)
    tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
    return lambda rows: _query(tree, places[rows], k)[1]


@sequential_operations()
def search_rows(points: NDArray[np.floating], rows: slice, k: int) -> NDArray[np.int32]:
    """Do as :func:`search_knn` for some rows of points in canonical order, at least ``k``."""
    indices = np.empty((len(points), k), dtype=np.int32)
    _search_cloud(points, rows, None, 0, math.inf, indices, None)
    return indices[rows]


def _search_cloud(
    points: NDArray[np.floating],
    asked: slice,
    order: NDArray[np.int64] | None,
    first_row: int,
    max_distance: float,
    indices: NDArray[np.int32],
    outside: NDArray[np.bool_] | None,
) -> None:
    """Search one cloud in canonical order and write results in the caller's order.

    Rows that are not ``asked`` may be answered or not. The tree holds each distinct place once, so
    that a place with many points costs no more than a place with one.
    """
    from scipy.spatial import cKDTree

    k = indices.shape[1]
    columns = as_tensor("search_knn", "points", points).unbind(dim=1)
    starts = np.flatnonzero(mark_first(*columns).numpy())
    counts = np.diff(starts, append=len(points))
    places = points[starts].astype(np.float64)

    def store(
        queried: NDArray[np.integer], distances: NDArray[np.float64], nearest: NDArray[np.integer]
    ) -> None:
        rows = queried
        if len(places) < len(points):
            rows, distances, nearest = _restore_duplicates(
                queried, distances, nearest, starts, counts, k
            )
        if outside is not None:
            too_far = distances > max_distance
            nearest = np.where(too_far, rows[:, None], nearest)
        into = rows if order is None else order[rows]
        indices[into] = (nearest if order is None else order[nearest]) + first_row
        if outside is not None:
            outside[into] = too_far

    width = min(k, len(places))
    tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
    first, last = np.searchsorted(starts, (asked.start, asked.stop - 1), side="right") - 1
    left = np.arange(first, last + 1)
    if len(places) >= _MIN_FOR_CELLS and kernels.serve(k=k):
        sample = places[left[:: -(-len(left) // _SAMPLE_SIZE)]]
        reach = tree.query(sample, [k])[0][:, 0]
        if len(places) == len(points) and outside is None:
            left = search_cells(places, left, reach, indices, order, first_row)
        else:
            found, wanted = np.empty((len(places), k), dtype=np.int32), left
            left = search_cells(places, wanted, reach, found)
            answered = np.setdiff1d(wanted, left, assume_unique=True)
            for chunk in chunks_of(len(answered), ROWS_IN_CACHE):
                rows = answered[chunk]
                near = found[rows]
                distances = np.broadcast_to(0.0, near.shape)
                if outside is not None:
                    distances = np.linalg.norm(places[near] - places[rows, None], axis=2)
                store(rows, distances, near)
    for chunk in chunks_of(len(left), ROWS_AT_ONCE):
        store(left[chunk], *_query(tree, places[left[chunk]], width))


def search_cells(
    points: NDArray[np.float64],
    rows: NDArray[np.int64],
    reach: NDArray[np.float64],
    found: NDArray[np.int32],
    order: NDArray[np.int64] | None = None,
    first_row: int = 0,
) -> NDArray[np.int64]:
    """Find the k nearest of distinct points ``(N, 3)`` for rows that cells of some size answer for.

    A cell and the 26 around it hold a few hundred points, whose distances a kernel takes. A result
    counts only if no point outside the cells can be nearer. The grid is that of the box about the
    cloud, empty cells too. The point itself counts. This is for where kernels serve.

    Args:
        points: Distinct points.
        rows: Those that are asked for, ascending.
        reach: Distances of the k-th neighbour of a sample of the points.
        found: Where the neighbours of each point go, ``(N, k)``, sorted by distance, then by row.
        order: Row of ``found`` for each point, and its number there. Default: its own.
        first_row: What is added to each number.

    Returns:
        The rows that are left, ascending. What is in ``found`` for them means nothing.
    """
    low, high = bounding_box(points)
    extent = high - low
    places = torch.from_numpy(np.ascontiguousarray(points))
    into, by_row = torch.from_numpy(found), None if order is None else torch.from_numpy(order)
    certain = torch.zeros(len(points), dtype=torch.bool, device="cpu")
    asked = torch.zeros_like(certain)
    for size in _cell_sizes(reach):
        if len(rows) < _MIN_FOR_CELLS:
            break
        counts = extent / size + 4
        if counts.prod() > min(max(_CELLS_A_POINT * len(points), 2**20), MAX_POINTS - 1):
            continue
        _, width, height = (int(count) for count in counts)
        starts = torch.empty(int(counts[0]) * width * height + 1, dtype=torch.int32, device="cpu")
        shape = width, height, *low.tolist(), size
        of_place, _, sorted_places = kernels.call("fill_cells", places, starts, *shape)
        asked.zero_()[torch.from_numpy(rows)] = True
        # Tasks of about so many points each.
        ends = np.arange(ROWS_IN_CACHE, len(points), ROWS_IN_CACHE)
        bounds = [1, *np.searchsorted(starts.numpy(), ends, side="right").tolist(), len(starts) - 1]

        def work(
            cells: tuple[int, int],
            shape: tuple[float, ...] = shape,
            grid: tuple[Tensor, ...] = (sorted_places, of_place, starts),
        ) -> None:
            numbers = *cells, *shape[:2], first_row, *shape[2:]
            kernels.call("search_cells", *grid, asked, by_row, into, certain, *numbers)

        map_tasks(work, list(itertools.pairwise(bounds)), torch.device("cpu"))
        rows = rows[~certain.numpy()[rows]]
    return rows


def _cell_sizes(reach: NDArray[np.float64]) -> list[float]:
    """Return ascending sizes of cells that together answer for nearly all of a sample."""
    sizes: list[float] = []
    reach = np.sort(reach[reach > 0])
    few = int(_MIN_FRACTION * len(reach))
    while len(reach) > few:
        sizes.append(_SIZE_STEP * float(reach[few]))
        reach = reach[reach > sizes[-1]]
    return sizes


def _query(
    tree: Any,  # noqa: ANN401
    queries: NDArray[np.floating],
    k: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the k nearest of distinct points by (distance, row), ties at the last place too."""
    distances = np.empty((len(queries), k))
    rows = np.empty((len(queries), k), dtype=np.int64)
    left, width = np.arange(len(queries)), k + 1
    while len(left):
        ranks = np.arange(1, min(width, tree.n) + 1)
        near, rows_near = tree.query(queries[left], ranks, workers=allowed_threads())
        tied = np.flatnonzero((near[:, 1:] == near[:, :-1]).any(axis=1))
        by_both = np.lexsort((rows_near[tied], near[tied]))
        rows_near[tied] = np.take_along_axis(rows_near[tied], by_both, axis=1)
        distances[left], rows[left] = near[:, :k], rows_near[:, :k]
        is_open = (near[:, k - 1] == near[:, -1]) & (width < tree.n)
        left, width = left[is_open], 2 * width
    return distances, rows


def _restore_duplicates(
    queried: NDArray[np.integer],
    distances: NDArray[np.float64],
    nearest: NDArray[np.integer],
    starts: NDArray[np.int64],
    counts: NDArray[np.int64],
    k: int,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Replace places by all their points: their rows, and the nearest k, the point itself first."""
    before = np.minimum(np.cumsum(counts[nearest], axis=1), k)
    taken = np.diff(before, axis=1, prepend=0).ravel()
    position = np.arange(len(nearest) * k) - np.repeat(np.cumsum(taken) - taken, taken)
    points = (np.repeat(starts[nearest.ravel()], taken) + position).reshape(len(nearest), k)
    far = np.repeat(distances.ravel(), taken).reshape(len(nearest), k)
    place = np.repeat(np.arange(len(queried)), counts[queried])
    rank = np.arange(len(place)) - np.searchsorted(place, place)
    rows = starts[queried][place] + rank
    points, far = points[place], far[place]
    later = np.flatnonzero(rank)
    if len(later):
        shift = np.arange(k) <= rank[later, None]
        points[later] = np.where(shift, np.roll(points[later], 1, axis=1), points[later])
        points[later, 0] = rows[later]
    return rows, far, points


def gather_patches(points: Tensor, indices: Tensor) -> Tensor:
    """Return the coordinates of neighbours about the point itself, shape ``(n, K, 3)``.

    ``indices`` ``(n, K)`` are rows of the points ``(N, 3)``, the point itself first. In memory each
    coordinate is contiguous, so that ``patches.unbind(-1)`` gives fast columns.

    Example:
        >>> points = torch.tensor([[5.0, 0, 0], [7, 1, 0]])
        >>> gather_patches(points, torch.tensor([[0, 1]])).tolist()
        [[[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]]]
    """
    flat = indices.reshape(-1)
    if points.requires_grad and torch.is_grad_enabled():
        gathered = points.index_select(0, flat).view(*indices.shape, 3)
        return gathered - gathered[:, :1]
    patches = points.new_empty((3, *indices.shape))
    for axis in range(3):
        column = points[:, axis].index_select(0, flat).view(indices.shape)
        torch.sub(column, column[:, :1], out=patches[axis])
    return patches.movedim(0, -1)


def gather_columns(points: Tensor, indices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns of :func:`gather_patches`, each ``(n, K)`` and contiguous.

    Example:
        >>> points = torch.tensor([[5.0, 0, 0], [7, 1, 0]])
        >>> gather_columns(points, torch.tensor([[0, 1]]))[0].tolist()
        [[0.0, 2.0]]
    """
    flat = indices.reshape(-1)
    x, y, z = (points[:, axis].index_select(0, flat).view(indices.shape) for axis in range(3))
    return x - x[:, :1], y - y[:, :1], z - z[:, :1]
