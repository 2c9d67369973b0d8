"""Which side of a surface is free space, from the cloud alone."""

import math
from itertools import product

import torch
from torch import Tensor

from torchrg.neighbors import gather_patches
from torchrg.structures import Neighbors

_SPACINGS_PER_CELL = 1.5
_CELLS_PER_POINT = 16
_SPACING_QUANTILE = 0.9
_STEEP = 0.87
_OPEN_WEIGHT = 0.5
_HALF_WORTH = 8
_OPEN = 1 << 24


def vote_free_side(
    points: Tensor, normals: Tensor, neighbors: Neighbors, *, chunk_size: int = 16384
) -> Tensor:
    r"""Return how much more free space lies in front of each point than behind it.

    1. The cloud marks the cells of a grid, 1.5 point spacings wide (the 90th percentile of them,
       so that sparse walls have no holes).
    2. From each point, in each of the 26 directions to neighbouring cells, the free path is
       measured to the next marked cell. A path that leaves the cloud's box without meeting anything
       counts half.
    3. If a neighbour lies straight in front, within 30 degrees of the normal, paths to the front
       are no longer than that: thin plates, whose faces are closer than cells; so for behind.
    4. The vote is the sum of ``sign(n . d) (n . d)^2 f(path)`` over the directions ``d``, where
       ``f`` rises from 0 to 1 and is half at 8 cells: a gap counts less than a room, but a hall no
       more than a room.

    Args:
        points: Finite points, shape ``(N, 3)``.
        normals: Unit normals of any sign, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        chunk_size: Points handled at a time in step 3.

    Returns:
        Votes, shape ``(N,)``, float64; positive where the normal points to the freer side.

    Example:
        >>> wall = torch.cartesian_prod(torch.zeros(1), torch.arange(20.0), torch.arange(20.0))
        >>> walls = torch.cat([wall, wall + torch.tensor([9.0, 0, 0])])
        >>> from torchrg.neighbors import search_knn
        >>> outwards = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]]).repeat_interleave(400, dim=0)
        >>> bool((vote_free_side(walls, outwards, search_knn(walls, 9)) < 0).all())
        True
    """
    front, back = _near_obstacles(points, normals, neighbors, chunk_size)
    width = _cell_width(points, neighbors)
    votes = torch.zeros(len(points), dtype=torch.float64, device=points.device)
    if len(points) == 0 or width == 0:
        return votes
    cells = ((points - points.amin(dim=0)) / width).floor().long()
    occupied = torch.zeros((cells.amax(dim=0) + 1).tolist(), dtype=torch.bool, device=points.device)
    occupied[cells.unbind(dim=-1)] = True
    for steps in product((-1, 0, 1), repeat=3):
        if any(steps):
            stride = width * math.sqrt(sum(step * step for step in steps))
            free = _free_cells(occupied, steps)
            direction = torch.tensor(steps, dtype=points.dtype, device=points.device)
            count = free[cells.unbind(dim=-1)]
            is_open = count >= _OPEN
            length = torch.where(is_open, count - _OPEN, count) * stride
            cosine = (normals * direction).sum(dim=-1) / (stride / width)
            limit = torch.where(cosine > 0, front, back)
            is_open = is_open & (limit > length)
            path = torch.minimum(length.to(points.dtype), limit)
            worth = path / (path + _HALF_WORTH * width)
            votes += cosine * cosine.abs() * torch.where(is_open, _OPEN_WEIGHT, 1.0) * worth
    return votes


def _near_obstacles(
    points: Tensor, normals: Tensor, neighbors: Neighbors, chunk_size: int
) -> tuple[Tensor, Tensor]:
    """Return distances to the nearest neighbour straight ahead and straight behind, or inf."""
    blocks = []
    for start in range(0, max(len(points), 1), chunk_size):
        block = slice(start, start + chunk_size)
        patches = gather_patches(points, neighbors.indices[block])
        height = (patches * normals[block, None]).sum(dim=-1)
        sq_distance = (patches * patches).sum(dim=-1)
        steep = height * height > _STEEP * _STEEP * sq_distance
        if neighbors.valid is not None:
            steep &= neighbors.valid[block]
        ahead = torch.where(steep & (height > 0), height, torch.inf).amin(dim=-1)
        behind = torch.where(steep & (height < 0), -height, torch.inf).amin(dim=-1)
        blocks.append((ahead, behind))
    front, back = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    return front, back


def _cell_width(points: Tensor, neighbors: Neighbors) -> float:
    """Return the width of the grid's cells; wider than asked for if there would be too many."""
    if len(points) == 0:
        return 0.0
    rank = (neighbors.indices.shape[1] - 1) // 2
    if rank == 0:
        return 0.0
    offsets = points[neighbors.indices[:, rank].long()] - points
    # A disk of that radius holds ``rank`` points, one for each square of the spacing.
    spacing = (offsets * offsets).sum(dim=-1).sqrt() * math.sqrt(math.pi / rank)
    at = max(math.ceil(_SPACING_QUANTILE * len(points)), 1)
    width: float = _SPACINGS_PER_CELL * float(spacing.kthvalue(at).values)
    extent: list[float] = (points.amax(dim=0) - points.amin(dim=0)).tolist()
    if width == 0:
        return float(max(extent)) / len(points)
    most = _CELLS_PER_POINT * len(points) + 1000
    while math.prod(side / width + 1 for side in extent) > most:
        width *= 1.25
    return width


def _free_cells(occupied: Tensor, steps: tuple[int, ...]) -> Tensor:
    """Return how many free cells follow each cell in a direction, plus ``_OPEN`` if no end."""
    axis = next(a for a in range(3) if steps[a])
    u, v = (steps[a] for a in range(3) if a != axis)
    layers = occupied.movedim(axis, 0)
    counts = torch.full(layers.shape, _OPEN, dtype=torch.int32, device=occupied.device)
    depth, rows, columns = layers.shape
    order = range(depth - 2, -1, -1) if steps[axis] > 0 else range(1, depth)
    beyond = counts.new_full((rows + 2, columns + 2), _OPEN)
    for layer in order:
        following = layer + steps[axis]
        beyond[1:-1, 1:-1] = torch.where(layers[following], 0, counts[following] + 1)
        counts[layer] = beyond[1 + u : 1 + u + rows, 1 + v : 1 + v + columns]
    return counts.movedim(0, axis)
