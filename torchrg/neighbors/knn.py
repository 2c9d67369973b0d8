"""Exact nearest-neighbor search, by grid cells or a tree, and patches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._checks import as_tensor, check_points, check_shapes, eager_only, is_tensor
from torchrg._parallel import (
    CHUNK_SIZE,
    ROWS_AT_ONCE,
    ROWS_IN_CACHE,
    allowed_threads,
    limit_rows,
    map_chunks,
    map_tasks,
    sequential_operations,
    split_rows,
)
from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors.blocks import build_tree, search_blocks
from torchrg.neighbors.order import canonical_order, distinct_rows, mark_distinct
from torchrg.structures import MAX_POINTS, AnyCloud, Neighbors
from torchrg.structures.points import Rows, bounding_box

_SAMPLE_SIZE = 200
"""Number of sampled points that estimate the distance of the k-th neighbor."""
_WINDOW = 8
"""Consecutive points in canonical order, as a multiple of k, among which the k-th nearest of a
sampled point is 1.05 times too far in the median, and 1.5 times in the worst tenth."""
SomeNeighbors = Callable[[NDArray[np.integer]], NDArray[np.integer]]
"""Function from rows ``(n,)`` to their neighbors ``(n, k)``, each first its own."""
_MIN_FOR_CELLS = 2000
"""Minimum number of points for which cells are faster than a tree."""
_SIZE_STEP = 1.4
"""Ratio of a cell size to the smallest remaining distance of a k-th neighbor. Cells of one size
serve points whose k-th neighbor is 1 / 1.75 to 1 size away."""
_MIN_FRACTION = 0.03
"""Minimum fraction of the points for which another cell size is worth its sort."""
_MAX_CELLS_PER_POINT = 8
"""Maximum number of cells per point in the bounding box, including empty ones, 4 bytes each."""


@eager_only
def search_knn(
    points: AnyCloud,
    k: int,
    *,
    max_distance: float | None = None,
    offset: Tensor | None = None,
    canonical: bool = False,
) -> Neighbors:
    """Find the exact ``k`` nearest neighbors of every point.

    Convention:
        ``k`` includes the point itself, which always comes first, even with duplicates. Other
        neighbors are sorted by distance, ties by :func:`canonical_order`, never by the input order.
        The search runs on the CPU with the number of threads of torch.

    Args:
        points: Points, shape ``(N, 3)``, finite.
        k: Number of neighbors, including the point itself.
        max_distance: Maximum distance of a neighbor, in coordinate units (hybrid search); farther
            ones have ``valid`` False and the index of the point itself. Default: no limit.
        offset: Ends of the clouds of a ragged batch, shape ``(B,)``, ascending, the last one ``N``
            (Pointcept's convention); neighbors are from the same cloud. Default: one cloud.
        canonical: Whether the points are already in canonical order; saves two passes.

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
    check_points("search_knn", tensor)
    if len(tensor) > MAX_POINTS:
        raise ShapeError(
            f"search_knn: expected at most {MAX_POINTS:,} points, got {len(tensor):,}. Split "
            "the cloud."
        )
    if max_distance is not None and not max_distance >= 0:
        raise ConfigError(f"search_knn: expected max_distance >= 0, got {max_distance!r}.")
    coordinates = tensor.detach().cpu().numpy()
    if not np.isfinite(coordinates).all():
        num_nonfinite = int((~np.isfinite(coordinates)).any(axis=1).sum())
        raise ShapeError(
            f"search_knn: expected finite points, got {num_nonfinite:,} of {len(coordinates):,} "
            "with NaN or Inf. Remove them first."
        )
    bounds = _cloud_bounds(offset, len(coordinates))
    min_points = min((stop - start for start, stop in bounds), default=MAX_POINTS)
    if not 1 <= k <= min_points:
        raise ShapeError(
            f"search_knn: expected k from 1 to the number of points ({min_points:,}), got {k}. "
            "Lower k or pass a larger cloud."
        )
    indices = scratch.empty((len(coordinates), k), np.int32)
    for start, stop in bounds:
        cloud = coordinates[start:stop]
        order = None if canonical else canonical_order(cloud).numpy()
        cloud = cloud if order is None else cloud[order]
        if scratch.is_active():
            lists = indices[start:stop]
            found = lists if order is None else scratch.empty(lists.shape, np.int32)
            search_blocks(cloud, search_rows, found)
            if order is not None:
                for rows in split_rows(len(cloud), ROWS_AT_ONCE):
                    lists[order[rows]] = order[found[rows]]
            if start:
                lists += start
            continue
        search_rows(cloud, slice(0, len(cloud)), order, indices[start:stop], start)
    valid: Tensor | None = None
    if max_distance is not None:
        is_near = _drop_far_neighbors(coordinates, indices, max_distance)
        valid = torch.from_numpy(is_near).to(tensor.device)
    return Neighbors(torch.from_numpy(indices).to(tensor.device), valid)


def _drop_far_neighbors(
    points: NDArray[np.floating], indices: NDArray[np.int32], max_distance: float
) -> NDArray[np.bool_]:
    """Replace far neighbors ``(N, k)`` by the point itself, and return a mask of the others."""
    is_near = np.empty(indices.shape, dtype=bool)
    for rows in split_rows(len(points), limit_rows(ROWS_IN_CACHE, indices.shape[1])):
        positions = points[indices[rows]].astype(np.float64)
        distances = np.linalg.norm(positions - positions[:, :1], axis=2)
        is_near[rows] = distances <= max_distance
        indices[rows] = np.where(is_near[rows], indices[rows], indices[rows, :1])
    return is_near


def check_num_neighbors(caller: str, num_points: int, **numbers: int | None) -> None:
    """Raise ConfigError if neighborhoods beyond the kernels hold over half of distinct points.

    Small clouds use all of their points up to the maximum of the kernels.
    """
    limit = max(num_points // 2, kernels.MAX_NEIGHBORS)
    for name, k in numbers.items():
        if k is not None and k > limit:
            raise ConfigError(
                f"{caller}: expected normals.{name} of at most {limit:,} for {num_points:,} "
                f"distinct points, got {k:,}; lower it, as 50 suits most clouds."
            )


def search_distinct(points: Tensor, k: int, *, max_distance: float | None = None) -> Neighbors:
    """Find up to ``k`` neighbors of distinct points in canonical order; none without points."""
    if len(points) == 0:
        return Neighbors(torch.empty(0, 1, dtype=torch.int32, device=points.device))
    return search_knn(points, min(k, len(points)), max_distance=max_distance, canonical=True)


def check_neighbors(caller: str, neighbors: Neighbors, points: Tensor) -> None:
    """Validate input neighbor lists: one per point, itself first, of rows of the points.

    Raises:
        ShapeError: If they do not match :class:`torchrg.structures.Neighbors`.
    """
    indices: object = getattr(neighbors, "indices", None)
    if not is_tensor(indices):
        raise ShapeError(
            f"{caller}: expected torchrg.structures.Neighbors with a tensor, got "
            f"{type(neighbors).__name__}. Pass Neighbors(torch.as_tensor(rows))."
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
            f"{caller}: expected neighbors of int32 or int64, got {indices.dtype}. Convert them."
        )
    if num_points == 0:
        return
    if indices.shape[1] == 0:
        raise ShapeError(f"{caller}: expected at least 1 neighbor per point, got 0.")
    low, high = (int(end) for end in torch.aminmax(indices))
    if not 0 <= low <= high < num_points:
        raise ShapeError(
            f"{caller}: expected neighbors to be rows of {num_points:,} points, got {low:,} to "
            f"{high:,}. Search them among these points."
        )
    is_self = indices[:, 0] == torch.arange(num_points, device=points.device)
    if not bool(is_self.all()):
        raise ShapeError(
            f"{caller}: expected each point as its own first neighbor, got other points in "
            f"{num_points - int(torch.count_nonzero(is_self)):,} of {num_points:,} rows. Put the "
            "row of the point first, as search_knn does."
        )


def restrict_to_groups(
    neighbors: Neighbors, groups: Tensor, chunk_size: int, position_rows: Rows = slice(None)
) -> Neighbors:
    """Restrict the neighbors of each point to its group, nearest first.

    Points of different groups may share a position. They are sorted by position, then by group.

    Args:
        neighbors: Neighbors of each position.
        groups: Group of each point, shape ``(N,)``, from 0 if ``position_rows`` are passed.
        chunk_size: Points processed at a time.
        position_rows: Index of each point's position, shape ``(N,)``. Default: the row.
    """
    shape, device = (len(groups), neighbors.indices.shape[1]), groups.device
    indices, valid = (scratch.empty(shape, kind) for kind in (np.int32, np.bool_))
    width = int(groups.max()) + 1 if len(groups) else 0
    keys = None if isinstance(position_rows, slice) else position_rows * width + groups

    def work(rows: slice) -> None:
        if isinstance(position_rows, slice) or keys is None:
            near = neighbors.indices[rows]
            same = neighbors.gather(groups, rows) == groups[rows, None]
            same &= neighbors.mask(rows)
        else:
            at = position_rows[rows]
            requested = neighbors.indices[at].long() * width + groups[rows, None]
            near = torch.searchsorted(keys, requested).clamp(max=len(keys) - 1)
            same = (keys[near] == requested) & neighbors.mask(at)
        order = same.byte().argsort(dim=1, descending=True, stable=True)
        near, same = near.gather(1, order), same.gather(1, order)
        indices[rows] = torch.where(same, near, near[:, :1]).numpy(force=True)
        valid[rows] = same.numpy(force=True)

    map_chunks(work, shape[0], limit_rows(chunk_size, shape[1]), device)
    return Neighbors(*(torch.from_numpy(column).to(device) for column in (indices, valid)))


@sequential_operations()
def search_nearest(
    points: NDArray[np.floating], queries: NDArray[np.floating], max_distance: float
) -> NDArray[np.int64]:
    """Return the row of the nearest point of each query ``(M,)``, -1 if none is within range.

    Points and queries are finite, ``(N, 3)`` and ``(M, 3)`` in the same coordinates. Ties go to the
    first point in :func:`canonical_order`.
    """
    nearest = np.full(len(queries), -1)
    if len(points) == 0 or len(queries) == 0:
        return nearest
    first = distinct_rows(as_tensor("search_nearest", "points", points)).numpy()
    tree = build_tree(points[first])
    # Consecutive close queries use the same cached parts of the tree.
    query_rows = canonical_order(queries).numpy()
    for chunk in split_rows(len(query_rows), ROWS_AT_ONCE):
        distances, found = _query(tree, queries[query_rows[chunk]], 1)
        nearest[query_rows[chunk]] = np.where(distances <= max_distance, first[found], -1)[:, 0]
    return nearest


def _cloud_bounds(offset: Tensor | None, num_points: int) -> list[tuple[int, int]]:
    """Return start and stop row of each cloud of a ragged batch."""
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
    """
    positions = points.astype(np.float64, copy=False)
    grids = list(build_grids(positions, np.arange(len(points)), k))
    # Usually not built: grids resolve all rows.
    tree = cache(lambda: build_tree(positions))

    @sequential_operations()
    def search(rows: NDArray[np.integer]) -> NDArray[np.integer]:
        requested, indices = np.unique(rows, return_inverse=True)
        found = np.empty((len(requested), k), dtype=np.int32)
        pending = search_grids(grids, requested, found, np.arange(len(requested)))
        if len(pending):
            at = np.searchsorted(requested, pending)
            found[at] = _query(tree(), positions[pending], k)[1]
        return found[indices]

    return search


@sequential_operations()
def search_rows(
    points: NDArray[np.floating],
    query_rows: slice,
    order: NDArray[np.int64] | None,
    indices: NDArray[np.int32],
    first_row: int = 0,
) -> None:
    """Write the neighbors of some rows of points in canonical order to lists ``(N, k)``.

    ``order`` ``(n,)`` are the rows of the points in the lists, default their own; ``first_row`` is
    added to each neighbor. Rows outside ``query_rows`` may be searched or not. The tree holds each
    distinct position once, so that duplicates cost nothing.
    """
    k = indices.shape[1]
    columns = as_tensor("search_knn", "points", points).unbind(dim=1)
    starts = np.flatnonzero(mark_distinct(*columns).numpy())
    positions = (points if len(starts) == len(points) else points[starts]).astype(np.float64)

    def store(rows: NDArray[np.integer], nearest: NDArray[np.integer]) -> None:
        if len(positions) < len(points):
            rows, nearest = _restore_duplicates(rows, nearest, np.append(starts, len(points)), k)
        target = rows if order is None else order[rows]
        indices[target] = (nearest if order is None else order[nearest]) + first_row

    first, last = np.searchsorted(starts, (query_rows.start, query_rows.stop - 1), side="right") - 1
    pending = np.arange(first, last + 1)
    grids = build_grids(positions, pending, k)
    if len(positions) == len(points):
        targets = pending if order is None else order[pending]
        pending = search_grids(grids, pending, indices, targets, order, first_row)
    else:
        found, requested = np.empty((len(positions), k), dtype=np.int32), pending
        pending = search_grids(grids, requested, found, requested)
        resolved = np.setdiff1d(requested, pending, assume_unique=True)
        for chunk in split_rows(len(resolved), limit_rows(ROWS_IN_CACHE, k)):
            store(resolved[chunk], found[resolved[chunk]])
    width = min(k, len(positions))
    tree = build_tree(positions) if len(pending) else None
    for chunk in split_rows(len(pending), limit_rows(CHUNK_SIZE, width)):
        store(pending[chunk], _query(tree, positions[pending[chunk]], width)[1])


class _Grid(NamedTuple):
    """Points in the cells of a grid around their bounding box.

    Coordinates of the points, and their rows sorted by cell. ``starts`` has the first index of each
    cell in ``rows``, then the number of points. ``shape`` is the number of cells along y and z,
    the lower corner x, y, z, and the cell size.
    """

    points: Tensor
    rows: Tensor
    starts: Tensor
    shape: tuple[int, int, float, float, float, float]


def build_grids(points: NDArray[np.float64], rows: NDArray[np.int64], k: int) -> Iterator[_Grid]:
    """Yield grids that together resolve nearly all k nearest of some rows, small cells first.

    ``points`` ``(N, 3)`` are distinct and in canonical order. Without kernels, and for few points,
    for which a tree is faster, there are none.
    """
    if len(points) < _MIN_FOR_CELLS or not kernels.serve(k=k):
        return
    low, high = bounding_box(points)
    max_cells = min(max(_MAX_CELLS_PER_POINT * len(points), 2**20), MAX_POINTS - 1)
    positions = torch.from_numpy(np.ascontiguousarray(points))
    for size in _cell_sizes(points, rows, k):
        counts = (high - low) / size + 4
        if counts.prod() > max_cells:
            continue
        length, width, height = (int(count) for count in counts)
        starts = torch.empty(length * width * height + 1, dtype=torch.int32, device="cpu")
        shape = (width, height, *low.tolist(), size)
        sorted_rows, _ = kernels.call("fill_cells", positions, starts, *shape)
        yield _Grid(positions, sorted_rows, starts, shape)


def search_grids(
    grids: Iterable[_Grid],
    rows: NDArray[np.int64],
    found: NDArray[np.int32],
    targets: NDArray[np.int64],
    order: NDArray[np.int64] | None = None,
    first_row: int = 0,
) -> NDArray[np.int64]:
    """Find the k nearest points for the rows that grids can resolve.

    A cell and its 26 neighbors hold a few hundred points, whose distances a kernel computes. A
    result counts only if no point outside these cells can be nearer. The grid covers the bounding
    box, including empty cells. The point itself counts.

    Args:
        grids: The result of :func:`build_grids`.
        rows: Query rows, ascending.
        found: Output neighbors, ``(M, k)``, sorted by distance, then by row.
        targets: Row of ``found`` for each query row.
        order: Index of each point in ``found``. Default: the point's row.
        first_row: Offset added to each index.

    Returns:
        The unresolved rows, ascending. Their values in ``found`` are undefined.
    """
    lists, by_row = torch.from_numpy(found), None if order is None else torch.from_numpy(order)
    pending = np.empty(0, dtype=np.int32)
    for grid in grids:
        if len(pending) == 0:
            pending = np.full(len(grid.rows), -1, dtype=np.int32)
            pending[rows] = targets
        requested = torch.from_numpy(pending)
        # Tasks of about this many points each.
        ends = np.arange(ROWS_IN_CACHE, len(pending), ROWS_IN_CACHE)
        cells = np.searchsorted(grid.starts.numpy(), ends, side="right").tolist()
        bounds = [1, *cells, len(grid.starts) - 1]

        def work(cells: tuple[int, int], grid: _Grid = grid, requested: Tensor = requested) -> None:
            numbers = *cells, *grid.shape[:2], first_row, *grid.shape[2:]
            kernels.call("search_cells", *grid[:3], requested, by_row, lists, *numbers)

        map_tasks(work, list(itertools.pairwise(bounds)), torch.device("cpu"))
        rows = rows[pending[rows] >= 0]
        if len(rows) == 0:
            break
    return rows


def _cell_sizes(points: NDArray[np.float64], rows: NDArray[np.int64], k: int) -> list[float]:
    """Return ascending cell sizes that together resolve nearly all of some rows."""
    sample, width = rows[:: -(-len(rows) // _SAMPLE_SIZE)], min(_WINDOW * k, len(points))
    starts = np.clip(sample - width // 2, 0, len(points) - width)
    window = starts[:, None] + np.arange(width)
    squares = sum(np.square(column[window] - column[sample, None]) for column in points.T)
    farthest = np.partition(squares, k - 1, axis=1)[:, k - 1]
    reach = np.sqrt(np.sort(farthest[farthest > 0]))
    sizes: list[float] = []
    min_count = int(_MIN_FRACTION * len(reach))
    while len(reach) > min_count:
        sizes.append(_SIZE_STEP * float(reach[min_count]))
        reach = reach[reach > sizes[-1]]
    return sizes


def _query(
    tree: Any,  # noqa: ANN401
    queries: NDArray[np.floating],
    k: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the k nearest distinct points by (distance, row), also for ties at the last rank."""
    distances = np.empty((len(queries), k))
    rows = np.empty((len(queries), k), dtype=np.int64)
    pending, width = np.arange(len(queries)), k + 1
    while len(pending):
        ranks = np.arange(1, min(width, tree.n) + 1)
        near, rows_near = tree.query(queries[pending], ranks, workers=allowed_threads())
        tied = np.flatnonzero((near[:, 1:] == near[:, :-1]).any(axis=1))
        order = np.lexsort((rows_near[tied], near[tied]))
        rows_near[tied] = np.take_along_axis(rows_near[tied], order, axis=1)
        distances[pending], rows[pending] = near[:, :k], rows_near[:, :k]
        is_tied = (near[:, k - 1] == near[:, -1]) & (width < tree.n)
        pending, width = pending[is_tied], 2 * width
    return distances, rows


def _restore_duplicates(
    queried: NDArray[np.integer],
    nearest: NDArray[np.integer],
    starts: NDArray[np.int64],
    k: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Expand positions to their points: query rows, and the k nearest, the point itself first.

    ``starts`` ``(P + 1,)`` are the first points of the positions, and the number of points.
    """
    counts = np.diff(starts)
    before = np.minimum(np.cumsum(counts[nearest], axis=1), k)
    taken = np.diff(before, axis=1, prepend=0).ravel()
    position = np.arange(len(nearest) * k) - np.repeat(np.cumsum(taken) - taken, taken)
    points = (np.repeat(starts[nearest.ravel()], taken) + position).reshape(len(nearest), k)
    owner = np.repeat(np.arange(len(queried)), counts[queried])
    rank = np.arange(len(owner)) - np.searchsorted(owner, owner)
    rows = starts[queried][owner] + rank
    points = points[owner]
    later = np.flatnonzero(rank)
    if len(later):
        shift = np.arange(k) <= rank[later, None]
        points[later] = np.where(shift, np.roll(points[later], 1, axis=1), points[later])
        points[later, 0] = rows[later]
    return rows, points


def gather_patches(points: Tensor, indices: Tensor) -> Tensor:
    """Return the coordinates of neighbors relative to the point itself, shape ``(n, K, 3)``.

    ``indices`` ``(n, K)`` are rows of the points ``(N, 3)``, the point itself first. Each
    coordinate is contiguous in memory, so that ``patches.unbind(-1)`` gives fast columns.
    """
    return torch.stack(gather_columns(points, indices)).movedim(0, -1)


def gather_columns(points: Tensor, indices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns of :func:`gather_patches`, each ``(n, K)`` and contiguous."""
    flat = indices.reshape(-1)
    x, y, z = (points[:, axis].index_select(0, flat).view(indices.shape) for axis in range(3))
    return x - x[:, :1], y - y[:, :1], z - z[:, :1]
