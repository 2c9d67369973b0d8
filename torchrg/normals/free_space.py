"""Free-space vote: the side of a surface with more free space."""

import math
from functools import reduce
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, map_tasks
from torchrg.linalg.moments import dot, kth_smallest
from torchrg.neighbors.order import sort_integers
from torchrg.normals.faces import gather_lists
from torchrg.structures.points import bounding_box

_SPACINGS_PER_CELL = 1.5
_SPACING_QUANTILE = 0.9
"""Quantile of the point spacing that defines the cell width, so that sparse walls are closed."""
_MAX_CELLS = 2**19
"""Maximum number of cells along an axis; a line index and a cell index then fit into int64."""
_NUM_OBSTACLES = 12
"""Nearest neighbors that can be an obstacle."""
_MIN_PARALLEL_COSINE, _MIN_ELEVATION_SINE = 0.99, 0.5
"""Minimum cosine (8 degrees) between parallel normals, and minimum sine (30 degrees) of the
elevation of such a neighbor on another face. On one smooth surface the elevation is at most half
the angle between the normals."""
_OPEN_WEIGHT = 0.5
"""Weight of a free path that leaves the bounding box of the cloud."""
_HALF_PATH = 8
"""Free cells at which a path gets half of the maximum weight. A gap thus counts less than a room,
and a hall no more than a room."""
_HALF_DIRECTIONS = [steps for steps in product((-1, 0, 1), repeat=3) if steps > (0, 0, 0)]
"""Thirteen of the 26 directions to neighboring cells, without their opposites."""


def vote_free_side(
    points: Tensor, normals: Tensor, near: Tensor, rows: Tensor, width: float
) -> Tensor:
    """Return the excess of free space in front of points over free space behind them.

    1. The points mark the cells of a grid.
    2. From each point, the free path to the next marked cell is measured in each of the 26
       directions to neighboring cells. A path that leaves the bounding box counts half.
    3. A neighbor with a parallel normal that lies above the surface by more than 30 degrees ends
       paths to the front; the same to the back. Faces of thin plates are closer than cells.
    4. The vote is the sum of ``sign(n . d) (n . d)^2 f(path)`` over the directions ``d``, where
       ``f`` rises from 0 to 1 and is half at 8 cells.

    Points ``(N, 3)`` are in canonical order, ``near`` ``(N, K)`` are rows of their neighbors, and
    ``rows`` ``(n,)`` vote. Votes ``(n,)`` are positive if the normal points to the freer side.
    """
    at, cell = _mark_cells(points, rows, width)
    normal = normals[rows]
    obstacles = map_tasks(
        lambda chunk: _find_obstacles(points, normals, near, chunk, width),
        torch.split(rows, ROWS_IN_CACHE),
        points.device,
    )
    front, back = (torch.cat(side) for side in zip(*obstacles, strict=True))

    def vote(steps: tuple[int, ...]) -> Tensor:
        stride = math.sqrt(sum(step * step for step in steps))
        cosine = dot(normal, normal.new_tensor(steps)) / stride
        ahead, behind = (
            torch.from_numpy(score).to(normal) for score in _free_paths(at, cell, steps, stride)
        )
        is_front = cosine > 0
        ahead = torch.minimum(ahead, torch.where(is_front, front, back))
        behind = torch.minimum(behind, torch.where(is_front, back, front))
        return cosine * cosine.abs() * (ahead - behind)

    return reduce(torch.add, map_tasks(vote, _HALF_DIRECTIONS, points.device))


def _mark_cells(
    points: Tensor, rows: Tensor, width: float
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the occupied cells ``(3, C)`` of a grid, and the index of the cell of some points."""
    low = torch.from_numpy(bounding_box(points.numpy())[0]).to(points)

    def encode(positions: Tensor) -> Tensor:
        x, y, z = ((positions - low) / width).long().unbind(dim=1)
        return (x * _MAX_CELLS + y) * _MAX_CELLS + z

    parts = [torch.unique_consecutive(encode(part)) for part in torch.split(points, ROWS_AT_ONCE)]
    cells = sort_integers(torch.cat(parts))[1].numpy()
    cells = cells[np.append(True, cells[1:] != cells[:-1])]
    x_and_y, z_of_cell = np.divmod(cells, _MAX_CELLS)
    at = np.stack([*np.divmod(x_and_y, _MAX_CELLS), z_of_cell]).astype(np.int32)
    return at, np.searchsorted(cells, encode(points[rows]).numpy())


def cell_width(points: Tensor, near: Tensor) -> float:
    """Return the cell width from the point spacing; arbitrary if the spacing is zero."""
    rank = (near.shape[1] - 1) // 2
    if rank == 0:
        return 1.0
    rows = torch.arange(0, len(points), max(len(points) // ROWS_AT_ONCE, 1))
    ends = gather_lists(near, rows, [rank])[:, 0]
    offsets = points.index_select(0, ends) - points[rows]
    # A disk of that radius holds ``rank`` points, one per squared spacing.
    spacing = dot(offsets, offsets).sqrt() * math.sqrt(math.pi / rank)
    at = math.ceil(_SPACING_QUANTILE * len(rows)) - 1
    width = _SPACINGS_PER_CELL * float(kth_smallest(spacing, at))
    low, high = (torch.from_numpy(end).to(points) for end in bounding_box(points.numpy()))
    extent = float((high - low).max())
    return max(width, 2 * extent / _MAX_CELLS) or 1.0


def _find_obstacles(
    points: Tensor, normals: Tensor, near: Tensor, rows: Tensor, width: float
) -> list[Tensor]:
    """Return the weights of paths to the nearest neighboring faces ahead and behind."""
    ranks, normal = list(range(min(_NUM_OBSTACLES, near.shape[1]))), normals[rows, None]
    ends = gather_lists(near, rows, ranks)
    positions, others = (
        values.index_select(0, ends.view(-1)).view(*ends.shape, 3) for values in (points, normals)
    )
    offsets = positions - points[rows, None]
    height = dot(offsets, normal)
    is_face = dot(others, normal).abs() > _MIN_PARALLEL_COSINE
    is_face &= height * height > _MIN_ELEVATION_SINE * _MIN_ELEVATION_SINE * dot(offsets, offsets)
    nearest = (
        torch.where(is_face & (above > 0), above, torch.inf).amin(dim=1)
        for above in (height, -height)
    )
    return [1 / (1 + _HALF_PATH * width / path) for path in nearest]


def _free_paths(
    at: NDArray[np.int32], cell: NDArray[np.int64], steps: tuple[int, ...], stride: float
) -> list[NDArray[np.float32]]:
    """Return the weights of the free paths from some cells in a direction and its opposite.

    Of the occupied cells ``at`` ``(3, C)``, paths start at ``cell`` ``(n,)``. Each is ``(n,)``.
    """
    scores, here = [], at.take(cell, axis=1)
    to_ends = at.max(axis=1, keepdims=True) - here, here
    for gaps, sign in zip(_free_gaps(at, steps), (1, -1), strict=True):
        free = gaps[cell]
        ahead = [to_ends[step * sign < 0][axis] for axis, step in enumerate(steps) if step]
        path = stride * np.where(free < 0, np.minimum.reduce(ahead), free).astype(np.float32)
        weight = np.where(free < 0, np.float32(_OPEN_WEIGHT), np.float32(1))
        scores.append(weight * (path / (path + np.float32(_HALF_PATH))))
    return scores


def _free_gaps(at: NDArray[np.int32], steps: tuple[int, ...]) -> tuple[NDArray[np.int32], ...]:
    """Return the number of free cells ahead of cells ``(3, C)`` and behind, -1 without an end.

    Gaps between the cells of a line are paths, without a grid of empty cells.
    """
    if kernels.serve():
        size = 2 ** (2 * at.shape[1] + 8).bit_length()
        table = [torch.from_numpy(np.empty(size, kind)) for kind in (np.int64, np.int32)]
        found = kernels.call("free_gaps", torch.from_numpy(at), *steps, *table)
        return tuple(gaps.numpy() for gaps in found)
    a = next(axis for axis in range(3) if steps[axis])
    b, c = (axis for axis in range(3) if axis != a)
    first, second = (at[axis] - steps[axis] * at[a] for axis in (b, c))
    # Cells are ascending, and the sort is stable: the cells of a line remain ascending.
    order = np.lexsort((second, first))
    first, second, along = first[order], second[order], at[a][order]
    is_same = (first[1:] == first[:-1]) & (second[1:] == second[:-1])
    gaps = np.where(is_same, along[1:] - along[:-1] - 1, -1)
    ahead, behind = np.empty((2, len(order)), np.int32)
    ahead[order], behind[order] = np.append(gaps, -1), np.insert(gaps, 0, -1)
    return ahead, behind
