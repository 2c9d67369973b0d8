"""A sparse grid over a cloud: how dense it is, and small patches of surface, in linear time."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import eigh3
from torchrg.neighbors.order import gather_bits, spread_bits

BITS = 16
"""The longest side of a cloud is ``2**BITS`` voxels."""

_FEW = 12
"""Occupied voxels in a cube from which on they tell how dense a surface is."""
_FEWEST = 5
"""Occupied voxels in a cube from which on they tell a plane: two more than always lie on one."""
_COARSER = 2
"""Levels above that of the cells where normals of sparse cells are looked for."""
_FLAT = 0.1
"""Largest ratio of the two smallest eigenvalues of a cube that is flat."""
_MOSTLY = 0.6
"""Share of the voxels in flat cubes from which on a level is fine enough for the noise."""
_WELL_FILLED = 0.75
"""Share of the voxels that are in cubes with enough of them, in the levels that are looked at."""


class Level(NamedTuple):
    """The occupied cubes of one size, along a Morton curve.

    Attributes:
        codes: Morton codes, ascending, shape ``(C,)``, int64.
        parents: Row of the cube of twice the edge, shape ``(C,)``.
        counts: Occupied voxels in each, shape ``(C,)``.
        moments: Sums of their x, y, z, xx, yy, zz, xy, xz, yz in voxels, shape ``(9, C)``, int64:
            whole numbers add up exactly in any order.
        size: Edge, in the unit of the cloud.
    """

    codes: Tensor
    parents: Tensor
    counts: Tensor
    moments: Tensor
    size: float


class CloudGrid(NamedTuple):
    """The finite points of a cloud, sorted along a Morton curve through their bounding cube.

    Attributes:
        rows: Row of each point in the cloud, shape ``(n,)``, int64.
        points: Coordinates about ``origin``, shape ``(n, 3)``, float32.
        origin: Lowest corner of the bounding box, shape ``(3,)``, float64.
        voxel_size: Edge of a voxel; 0 if all points are in one place.
        cell_of: Row of each point's cube in the first level, shape ``(n,)``.
        levels: Cubes of about four occupied voxels, of twice their edge, and so on, up to a single
            one. They do not depend on the order of the points.
    """

    rows: Tensor
    points: Tensor
    origin: Tensor
    voxel_size: float
    cell_of: Tensor
    levels: tuple[Level, ...]


class Cells(NamedTuple):
    """Patches of surface: what is in the cubes of one level.

    Attributes:
        centers: Means of the occupied voxels, shape ``(C, 3)``, float32, about the grid's origin.
        normals: Unit normals of arbitrary sign, shape ``(C, 3)``; zero where there is no plane.
        cell_of: Row of each point's cell, shape ``(n,)``.
        size: Edge of a cell.
    """

    centers: Tensor
    normals: Tensor
    cell_of: Tensor
    size: float


def build_grid(points: Tensor) -> CloudGrid:
    """Sort the finite points of a cloud into voxels and cubes; without levels if there are none.

    Example:
        >>> grid = build_grid(torch.tensor([[8.0, 0, 0], [torch.nan, 0, 0], [4, 1, 0]]))
        >>> grid.rows.tolist(), grid.origin.tolist()
        ([2, 0], [4.0, 0.0, 0.0])
    """
    rows = points.isfinite().all(dim=-1).nonzero().squeeze(-1)
    finite = points[rows].detach()
    if len(rows) == 0:
        return CloudGrid(rows, finite.float(), finite.new_zeros(3).double(), 0.0, rows, ())
    low = finite.amin(dim=0)
    local = (finite - low).float()
    voxel_size = float(local.amax()) / 2**BITS
    codes = torch.zeros_like(rows)
    if voxel_size > 0:
        voxels = (local / voxel_size).int().clamp_(max=2**BITS - 1).long()
        for axis in range(3):
            codes |= spread_bits(voxels[:, axis]) << axis
    codes, order = codes.sort(stable=True)
    occupied, voxel_of = torch.unique_consecutive(codes, return_inverse=True)
    start = _first_level(occupied)
    cell_of, level = _join_voxels(occupied, start, voxel_size * 2**start)
    levels = [level]
    while len(levels[-1].codes) > 1:
        levels.append(_join_level(levels[-1]))
    return CloudGrid(
        rows[order], local[order], low.double(), voxel_size, cell_of[voxel_of], tuple(levels)
    )


def _first_level(occupied: Tensor) -> int:
    """Return the first level whose cubes hold about four voxels on average."""
    for level in range(BITS):
        num_cubes = 1 + int((occupied >> 3 * level).diff().count_nonzero())
        if 4 * num_cubes <= len(occupied):
            return level
    return BITS


def _join_voxels(occupied: Tensor, level: int, size: float) -> tuple[Tensor, Level]:
    """Return the cube of each voxel, and the cubes of the first level."""
    codes, cell_of, counts = torch.unique_consecutive(
        occupied >> 3 * level, return_inverse=True, return_counts=True
    )
    x, y, z = (gather_bits(occupied >> axis) for axis in range(3))
    moments = codes.new_zeros(9, len(codes))
    one = torch.ones_like(x)
    products = ((x, one), (y, one), (z, one), (x, x), (y, y), (z, z), (x, y), (x, z), (y, z))
    for row, (first, second) in zip(moments, products, strict=True):
        row.index_add_(0, cell_of, first * second)
    return cell_of, Level(codes, _parents(codes), counts, moments, size)


def _join_level(level: Level) -> Level:
    """Return the level of cubes of twice the edge."""
    codes = torch.unique_consecutive(level.codes >> 3)
    counts = level.counts.new_zeros(len(codes)).index_add_(0, level.parents, level.counts)
    moments = level.moments.new_zeros(9, len(codes)).index_add_(1, level.parents, level.moments)
    return Level(codes, _parents(codes), counts, moments, 2 * level.size)


def _parents(codes: Tensor) -> Tensor:
    parents: Tensor = torch.unique_consecutive(codes >> 3, return_inverse=True)[1]
    return parents


def _means_and_covariances(level: Level) -> tuple[Tensor, Tensor]:
    """Return mean ``(3, C)`` and covariance xx, yy, zz, xy, xz, yz ``(6, C)`` in voxels."""
    means = level.moments / level.counts.double()
    x, y, z = means[:3]
    return means[:3], means[3:] - torch.stack([x * x, y * y, z * z, x * y, x * z, y * z])


def local_spacing(grid: CloudGrid) -> Tensor:
    """Return about how far each point is from its neighbours on the surface, shape ``(n,)``.

    The smallest cube around a point with enough voxels tells it: n voxels whose covariance has the
    eigenvalues ``l1, l2`` cover about ``12 sqrt(l1 l2)``, on a line about ``sqrt(12 l2)``.
    Duplicates count once. 0 if all points are in one place.
    """
    spacing = grid.points.new_zeros(1)
    for level in reversed(grid.levels):
        _, (xx, yy, zz, xy, xz, yz) = _means_and_covariances(level)
        minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
        area = 12 * minors.clamp(min=0).sqrt()
        length = (12 * (xx + yy + zz)).clamp(min=0).sqrt()
        own = torch.maximum((area / level.counts).sqrt(), length / level.counts) * grid.voxel_size
        enough = level.counts >= _FEW
        if level is grid.levels[-1]:
            spacing = own
        else:
            spacing = torch.where(enough, own, spacing[level.parents])
    return spacing.float()[grid.cell_of] if grid.levels else grid.points[:, 0]


def surface_cells(grid: CloudGrid, *, max_cells: int = 60_000) -> Cells:
    """Fit a plane to the content of each cube of one level.

    A cube with too few voxels, as on a ceiling that is much sparser than the rest, has the normal
    of the smallest cube around it with enough of them, if that is flat. The level is the finest one
    of at most ``max_cells`` cubes whose voxels are mostly in cubes with enough of them; in noisy
    clouds, one of the next two, where more cubes are flat.
    """
    start = next(
        number
        for number, level in enumerate(grid.levels)
        if number == len(grid.levels) - 1
        or (
            len(level.codes) <= max_cells
            and level.counts[level.counts >= _FEW].sum() >= _WELL_FILLED * level.counts.sum()
        )
    )
    fits = []
    for number in range(start, min(start + 3, len(grid.levels))):
        centers, normals, flat_share = _fit_cells(grid.levels[number], grid.voxel_size)
        fits.append((flat_share, number, centers, normals))
        if flat_share >= _MOSTLY:
            break
    _, number, centers, normals = max(fits, key=lambda fit: fit[0])
    cell_of = grid.cell_of
    for level in grid.levels[:number]:
        cell_of = level.parents[cell_of]
    row = torch.arange(len(normals), device=normals.device)
    waiting = grid.levels[number].counts < _FEWEST
    for child, level in zip(
        grid.levels[number:], grid.levels[number + 1 : number + 1 + _COARSER], strict=False
    ):
        row = child.parents[row]
        _, of_level, _ = _fit_cells(level, grid.voxel_size)
        enough = waiting & (level.counts >= _FEWEST)[row]
        normals = torch.where(enough[:, None], of_level[row], normals)
        waiting &= ~enough
    return Cells(centers, normals, cell_of, grid.levels[number].size)


def _fit_cells(level: Level, voxel_size: float) -> tuple[Tensor, Tensor, float]:
    """Return centers and normals of cubes, and the share of their voxels that is in flat ones."""
    means, covariances = _means_and_covariances(level)
    values, vectors = eigh3(covariances[[0, 3, 4, 3, 1, 5, 4, 5, 2]].T.reshape(-1, 3, 3))
    flat = (level.counts >= _FEWEST) & (values[:, 0] < _FLAT * values[:, 1])
    normals = torch.where(flat[:, None], vectors[..., 0], 0.0)
    centers = (means.T + 0.5) * voxel_size
    return centers.float(), normals.float(), float(level.counts[flat].sum() / level.counts.sum())
