"""Free-space vote: the side of a surface with more free space."""

import math
from functools import reduce
from itertools import product

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, map_chunks, map_tasks
from torchrg.linalg.moments import dot, kth_smallest, project, sq_lengths
from torchrg.neighbors.knn import gather_columns
from torchrg.neighbors.order import sort_integers
from torchrg.normals.faces import gather_lists
from torchrg.structures import Neighbors
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
_STRIDES = [math.sqrt(sum(map(abs, steps))) for steps in _HALF_DIRECTIONS]
"""Their lengths, in cells."""
_ENDS = [
    [[(i if d == sign else i + 3) if d else 6 for i, d in enumerate(s)] for s in _HALF_DIRECTIONS]
    for sign in (1, -1)
]
"""Ends of the bounding box along each axis: upper ones from 0, lower ones from 3, 6 for none."""


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

    def find_free(steps: tuple[int, ...]) -> Tensor:
        return torch.stack([gaps[cell] for gaps in _free_gaps(at, steps)])

    free = torch.stack(map_tasks(find_free, _HALF_DIRECTIONS, points.device), dim=1)
    high = at.amax(dim=1, keepdim=True)
    directions = normals.new_tensor(_HALF_DIRECTIONS)
    strides = normals.new_tensor(_STRIDES)[:, None]

    def vote(chunk: slice) -> Tensor:
        front, back = _find_obstacles(points, normals, near, rows[chunk], width)
        here = at[:, cell[chunk]]
        ahead, behind = _weigh_paths(free[:, :, chunk], here, high - here).to(normals).unbind()
        cosine = dot(normals[rows[chunk]], directions[:, None]) / strides
        is_front = cosine > 0
        ahead = torch.minimum(ahead, torch.where(is_front, front, back))
        behind = torch.minimum(behind, torch.where(is_front, back, front))
        return reduce(torch.add, (cosine * cosine.abs() * (ahead - behind)).unbind())

    return torch.cat(map_chunks(vote, len(rows), ROWS_IN_CACHE, points.device))


def _mark_cells(points: Tensor, rows: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """Return the occupied cells ``(3, C)`` of a grid, int32, and the cell of some points."""
    low = torch.from_numpy(bounding_box(points.numpy())[0]).to(points)

    def encode(positions: Tensor) -> Tensor:
        x, y, z = ((positions - low) / width).long().unbind(dim=1)
        return (x * _MAX_CELLS + y) * _MAX_CELLS + z

    parts = [torch.unique_consecutive(encode(part)) for part in torch.split(points, ROWS_AT_ONCE)]
    cells = torch.unique_consecutive(sort_integers(torch.cat(parts))[1])
    x_and_y = cells // _MAX_CELLS
    at = torch.stack([x_and_y // _MAX_CELLS, x_and_y % _MAX_CELLS, cells % _MAX_CELLS]).int()
    return at, torch.searchsorted(cells, encode(points[rows]))


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
    ends = near[:, :_NUM_OBSTACLES].index_select(0, rows)
    scratch.release()
    offsets, normal = gather_columns(points, ends), normals[rows]
    x, y, z = (Neighbors(ends).gather(column) for column in normals.unbind(dim=1))
    height = project(offsets, normal)
    is_face = project((x, y, z), normal).abs() > _MIN_PARALLEL_COSINE
    is_face &= height * height > _MIN_ELEVATION_SINE * _MIN_ELEVATION_SINE * sq_lengths(offsets)
    nearest = (
        torch.where(is_face & (above > 0), above, torch.inf).amin(dim=1)
        for above in (height, -height)
    )
    return [1 / (1 + _HALF_PATH * width / path) for path in nearest]


def _weigh_paths(free: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return the weights of paths in each direction and its opposite, ``(2, 13, n)``, float32.

    Paths have ``free`` cells up to an obstacle, or -1. The bounding box ends ``lower`` cells before
    their start along each axis, and ``upper`` cells after it, ``(3, n)``.
    """
    ends = torch.cat([upper, lower, torch.full_like(upper[:1], _MAX_CELLS)])
    to_ends, is_open = ends[torch.tensor(_ENDS)].amin(dim=2), free < 0
    strides = torch.tensor(_STRIDES, dtype=torch.float32)[:, None]
    path = strides * torch.where(is_open, to_ends, free)
    weight = path / (path + _HALF_PATH)
    return torch.where(is_open, _OPEN_WEIGHT * weight, weight)


def _free_gaps(at: Tensor, steps: tuple[int, ...]) -> tuple[Tensor, ...]:
    """Return the number of free cells ahead of cells ``(3, C)`` and behind, -1 without an end.

    Gaps between the cells of a line are paths, without a grid of empty cells.
    """
    if kernels.serve():
        size = 2 ** (2 * at.shape[1] + 8).bit_length()
        table = torch.empty(size, dtype=torch.int64), torch.empty(size, dtype=torch.int32)
        return kernels.call("free_gaps", at, *steps, *table)
    a = next(axis for axis in range(3) if steps[axis])
    b, c = (axis for axis in range(3) if axis != a)
    first, second = (at[axis] - steps[axis] * at[a] for axis in (b, c))
    # Cells are ascending, and the sort is stable: the cells of a line remain ascending.
    order = torch.from_numpy(np.lexsort((second.numpy(), first.numpy())))
    first, second, along = first[order], second[order], at[a][order]
    is_same = (first[1:] == first[:-1]) & (second[1:] == second[:-1])
    gaps, none = torch.where(is_same, along.diff() - 1, -1), along.new_tensor([-1])
    ahead, behind = torch.empty_like(along), torch.empty_like(along)
    ahead[order], behind[order] = torch.cat([gaps, none]), torch.cat([none, gaps])
    return ahead, behind
