"""Voxel sampling with the inverse map to all points."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg import scratch
from torchrg._checks import as_tensor, check_points, is_positive
from torchrg._parallel import ROWS_AT_ONCE, nonzero_rows, split_rows
from torchrg.errors import CloudWarning, ConfigError, shown, warn
from torchrg.neighbors.order import mark_distinct
from torchrg.structures import UNLABELED, AnyCloud
from torchrg.structures.points import short_repr

_MAX_VOXELS = 2**53
"""Maximum number of voxels along one axis: float64 counts no further."""
_MIN_VOXELS = 3
"""Minimum number of voxels with a plane."""
_POINTS_AT_ONCE = 2**17
"""Number of points whose voxels are found at a time, in 15 MB."""
_SAMPLE_SIZE = 10_000
"""Number of points from which the borders of slabs of about equal size are found."""
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
    like = torch.empty(0, dtype=torch.int64, device=tensor.device)
    inverse = scratch.new_empty(like, tensor.shape[:1]).fill_(UNLABELED)
    chosen = [like]
    for rows, cells, sq_distance in _split_voxels(tensor.detach(), size):
        sample, voxel = _choose_points(tensor.detach()[rows], cells, sq_distance)
        chosen.append(rows[sample])
        inverse[rows] = chosen[-1][voxel]
    rows = torch.cat(chosen).sort().values
    ranks = scratch.new_empty(like, tensor.shape[:1])
    ranks[rows] = torch.arange(len(rows), device=tensor.device)
    for part in map(inverse.__getitem__, split_rows(len(inverse), ROWS_AT_ONCE)):
        part.copy_(torch.where(part < 0, part, ranks[part]))
    return Voxels(rows, inverse)


def _split_voxels(points: Tensor, size: float) -> Iterator[tuple[Tensor, list[Tensor], Tensor]]:
    """Yield slabs of whole voxels across the longest axis of finite points ``(N, 3)``.

    Yields:
        rows: Rows of the points of a slab, ascending, shape ``(n,)``, int64.
        cells: Their cells along each axis, integers from 0, shape ``(n,)`` each, float64.
        sq_distance: Squared distances to the centers of their cells, in cells, ``(n,)``, float64.
    """
    parts = split_rows(len(points), ROWS_AT_ONCE)
    is_finite = torch.cat([points[:0, 0].bool(), *(points[p].isfinite().all(dim=1) for p in parts)])
    ends = [points[part][is_finite[part]].aminmax(dim=0) for part in parts if is_finite[part].any()]
    if not ends:
        return
    low, high = (torch.stack(bounds).double() for bounds in zip(*ends, strict=True))
    low = low.amin(dim=0)
    num_cells = (high.amax(dim=0) - low).div_(size).floor_()
    if float(num_cells.max()) >= _MAX_VOXELS:
        raise ConfigError(
            f"sample_voxels: expected size to divide the extent of the cloud into fewer than 2^53 "
            f"cells, got {shown(size)}. Choose a larger size."
        )
    axis, num_slabs = int(num_cells.argmax()), -(-len(points) // _POINTS_AT_ONCE)
    some = slice(None, None, -(-len(points) // _SAMPLE_SIZE))
    ordered = points[some, axis][is_finite[some]].double().sort().values
    borders = ordered[:: -(-len(ordered) // num_slabs) or 1][1:].sub(low[axis]).div_(size)
    slab = torch.empty(len(points), dtype=torch.int16, device=points.device)
    for part in parts:
        cell = points[part, axis].double().sub(low[axis]).div_(size).floor_()
        slab[part] = torch.searchsorted(borders, cell, right=True).where(is_finite[part], -1)
    for number in range(num_slabs):
        rows = nonzero_rows(slab == number)
        cells, sq_distance = list[Tensor](), points.new_zeros((), dtype=torch.float64)
        for column, lowest in zip(points[rows].unbind(dim=1), low, strict=True):
            scaled = column.double().sub(lowest).div_(size)
            cells.append(scaled.floor())
            sq_distance = scaled.sub_(cells[-1]).sub_(0.5).square_().add_(sq_distance)
        if len(rows):
            yield rows, cells, sq_distance


def _choose_points(
    points: Tensor, cells: Sequence[Tensor], sq_distance: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the row of the point that represents each voxel, and the voxel of each point."""
    keys, order = cell_keys(cells).sort(stable=True)
    voxel, counts = torch.unique_consecutive(keys, return_inverse=True, return_counts=True)[1:]
    sq_distance = sq_distance[order]
    minimum = torch.segment_reduce(sq_distance, "min", lengths=counts)
    nearest = (sq_distance == minimum[voxel]).nonzero().squeeze(1)
    if len(nearest) > len(counts):
        nearest = _first_by_coordinates(nearest, voxel, points[order].unbind(dim=1))
    return order[nearest], torch.empty_like(voxel).index_copy_(0, order, voxel)


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
