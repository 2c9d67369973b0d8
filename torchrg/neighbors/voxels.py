"""Voxel sampling with the inverse map to all points."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg import scratch
from torchrg._checks import as_tensor, check_points, is_positive
from torchrg.errors import CloudWarning, ConfigError, shown, warn
from torchrg.neighbors.order import mark_distinct
from torchrg.structures import UNLABELED, AnyCloud
from torchrg.structures.points import short_repr

_MAX_VOXELS = 2**53
"""Maximum number of voxels along one axis: float64 counts no further."""
_MIN_VOXELS = 3
"""Minimum number of voxels with a plane."""
_MAX_KEYS = 2**62
"""Maximum number of cells with distinct int64 keys; above the squared number of points."""


@short_repr
class Voxels(NamedTuple):
    """Representative points of the voxels of a cloud.

    Attributes:
        rows: Row of one point per voxel, ascending, shape ``(V,)``, int64.
        inverse: Index in ``rows`` of each point's voxel, shape ``(N,)``, int64; -1 if not finite.
    """

    rows: Tensor
    inverse: Tensor


def sample_voxels(points: AnyCloud, size: float) -> Voxels:
    """Select one point of each occupied cell of a cubic grid with cell width ``size``.

    The point nearest to the center of its cell is selected. The result consists of points of the
    cloud ``(N, 3)`` and does not depend on their order. The grid begins at the minimum coordinates.

    Raises:
        ShapeError: If ``points`` has another shape or dtype.
        ConfigError: If ``size`` is not positive, or too small for the extent of the cloud.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [0.04, 0, 0], [0.11, 0, 0]])
        >>> [column.tolist() for column in sample_voxels(points, 0.1)]
        [[1, 2], [0, 0, 1]]
    """
    tensor = as_tensor("sample_voxels", "points", points)
    check_points("sample_voxels", tensor)
    if not is_positive(size):
        raise ConfigError(f"sample_voxels: expected size > 0, got {shown(size)}.")
    inverse = torch.full((len(tensor),), UNLABELED, device=tensor.device)
    finite = tensor.isfinite().all(dim=-1).nonzero().squeeze(-1)
    if len(finite) == 0:
        return Voxels(finite, inverse)
    columns, cells = tensor.detach().unbind(dim=-1), list[Tensor]()
    sq_distance = tensor.new_zeros((), dtype=torch.float64)
    for column in columns:
        scaled = column[finite].double()
        scaled = scaled.sub_(scaled.min()).div_(size)
        cell = scaled.floor()
        sq_distance = scratch.store(scaled.sub_(cell).sub_(0.5).square_().add_(sq_distance))
        cells.append(scratch.store(cell))
    if max(float(cell.max()) for cell in cells) >= _MAX_VOXELS:
        raise ConfigError(
            f"sample_voxels: expected size to divide the extent of the cloud into fewer than 2^53 "
            f"cells, got {shown(size)}. Choose a larger size."
        )
    keys, order = map(scratch.store, cell_keys(cells).sort(stable=True))
    voxel, counts = torch.unique_consecutive(keys, return_inverse=True, return_counts=True)[1:]
    order, voxel, sq_distance = finite[order], scratch.store(voxel), sq_distance[order]
    minimum = torch.segment_reduce(sq_distance, "min", lengths=counts)
    nearest = (sq_distance == minimum[voxel]).nonzero().squeeze(1)
    if len(nearest) > len(counts):
        nearest = _first_by_coordinates(nearest, voxel, [c[order] for c in columns])
    rows = order[nearest]
    ranks = rows.argsort().argsort()
    inverse[order] = ranks[voxel]
    return Voxels(rows.sort().values, scratch.store(inverse))


def warn_about_voxel(caller: str, size: float, num_voxels: int, num_points: int) -> None:
    """Warn if a voxel size leaves all points, or too few for a plane: it may be in another unit."""
    is_all = num_voxels == num_points > 0
    if is_all or num_voxels < _MIN_VOXELS <= num_points:
        left = f"{'all' if is_all else f'{num_voxels:,} of'} {num_points:,} points"
        repair = "check that it is in units of the cloud"
        warn(f"{caller}: voxel {size:g} leaves {left}; {repair}.", CloudWarning)


def _first_by_coordinates(chosen: Tensor, voxel: Tensor, columns: Sequence[Tensor]) -> Tensor:
    """Return the chosen point of lowest x, then y, then z in each voxel, in voxel order."""
    x, y, z = (column[chosen].cpu().numpy() for column in columns)
    order = torch.from_numpy(np.lexsort((z, y, x, voxel[chosen].cpu().numpy()))).to(voxel.device)
    chosen = chosen[order]
    return chosen[mark_distinct(voxel[chosen])]


def cell_keys(cells: Sequence[Tensor]) -> Tensor:
    """Return an integer key per point, equal for points of the same grid cell only.

    ``cells`` are the cell indices along each axis, integers from 0, shape ``(N,)`` each.
    """
    keys = torch.zeros_like(cells[0], dtype=torch.int64)
    num_keys = 1
    for cell in cells:
        index, count = cell.long(), int(cell.max()) + 1
        if num_keys * count > _MAX_KEYS:
            values, index = torch.unique(index, return_inverse=True)
            used, keys = torch.unique(keys, return_inverse=True)
            num_keys, count = len(used), len(values)
        keys = keys.mul(count).add_(index)
        num_keys *= count
    return keys
