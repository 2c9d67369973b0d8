"""One point of each voxel, and the way back to every point."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ConfigError
from torchrg.neighbors.order import finite_rows
from torchrg.structures import UNLABELED

_MOST_VOXELS = 2**53
"""Along one axis: float64 counts no further."""


class Voxels(NamedTuple):
    """The points that stand for the voxels of a cloud.

    Attributes:
        rows: Row of one point of each voxel, ascending, shape ``(V,)``, int64.
        inverse: Place in ``rows`` of the voxel of each point, shape ``(N,)``, int64; -1 for a point
            that is not finite.
    """

    rows: Tensor
    inverse: Tensor


def sample_voxels(points: Tensor | NDArray[np.floating], size: float) -> Voxels:
    """Choose one point of each occupied cell of a cubic grid.

    The point nearest to the middle of its cell is chosen, so the result is made of points of the
    cloud and does not depend on their order. The grid begins at the least coordinates.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        size: Side of a cell, in the unit of the cloud.

    Returns:
        The chosen points, and the voxel of each point.

    Raises:
        ShapeError: If ``points`` has another shape or dtype.
        ConfigError: If ``size`` is not positive, or too small for the extent of the cloud.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [0.04, 0, 0], [0.11, 0, 0]])
        >>> sample_voxels(points, 0.1)
        Voxels(rows=tensor([1, 2]), inverse=tensor([0, 0, 1]))
    """
    tensor = as_tensor("sample_voxels", "points", points)
    check_shapes("sample_voxels", points=(tensor, "N 3"))
    check_floating("sample_voxels", points=tensor)
    if not 0 < size < float("inf"):
        raise ConfigError(f"sample_voxels: expected size > 0, got {size!r}.")
    inverse = torch.full((len(tensor),), UNLABELED, device=tensor.device)
    # In canonical order ties are broken by the coordinates.
    order = finite_rows(tensor.detach())
    if len(order) == 0:
        return Voxels(order, inverse)
    scaled = (tensor.detach()[order].double() - tensor[order].double().amin(dim=0)) / size
    if float(scaled.max()) >= _MOST_VOXELS:
        raise ConfigError(
            f"sample_voxels: expected size to divide the cloud's extent into less than 2^53 "
            f"cells, got {size!r}; choose a larger one."
        )
    cell = scaled.floor()
    x, y, z = (scaled - cell - 0.5).square().unbind(dim=-1)
    nearest = (x + y + z).argsort(stable=True)
    group = _group_ids(cell.long())
    chosen = nearest[group[nearest].argsort(stable=True)]
    first = torch.ones_like(chosen, dtype=torch.bool)
    first[1:] = group[chosen[1:]] != group[chosen[:-1]]
    # Groups are numbered without gaps, so the chosen points are in the order of the groups.
    rows = order[chosen[first]]
    places = rows.argsort().argsort()
    inverse[order] = places[group]
    return Voxels(rows.sort().values, inverse)


def restore_points(values: Tensor, inverse: Tensor, *, fill: int = 0) -> Tensor:
    """Give each point the value of its voxel.

    Args:
        values: A row for each voxel, shape ``(V, ...)``.
        inverse: Voxel of each point, shape ``(N,)``; negative for none.
        fill: Value of the points without a voxel; for labels :data:`torchrg.UNLABELED`.

    Returns:
        Shape ``(N, ...)``.

    Example:
        >>> restore_points(torch.tensor([7, 8]), torch.tensor([1, -1, 0, 1]), fill=-1).tolist()
        [8, -1, 7, 8]
    """
    result = values.new_full((len(inverse), *values.shape[1:]), fill)
    has_voxel = inverse >= 0
    result[has_voxel] = values[inverse[has_voxel]]
    return result


def _group_ids(cells: Tensor) -> Tensor:
    """Number the different rows of ``(N, 3)`` whole numbers without gaps, shape ``(N,)``."""
    group = torch.zeros(len(cells), dtype=torch.int64, device=cells.device)
    for axis in range(3):
        values, rank = torch.unique(cells[:, axis], return_inverse=True)
        group = torch.unique(group * len(values) + rank, return_inverse=True)[1]
    return group
