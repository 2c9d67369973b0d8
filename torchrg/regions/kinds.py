"""Floors, ceilings and walls, told apart by direction and height."""

import math

import torch
from torch import Tensor

from torchrg.structures import PLANE_KINDS, Planes

_MAX_TILT_DEG = 15.0
_END_SHARE = 0.15
"""A floor lies in this lowest share of the cloud's height, a ceiling in the highest."""

_LEAST_AREA_SHARE = 0.1
"""A floor or ceiling has at least this share of the largest horizontal plane's area."""

_LEAST_WALL_SHARE = 0.5
"""A wall reaches over at least this share of the cloud's height."""


def classify_planes(planes: Planes, up: Tensor) -> Tensor:
    """Return a simple class for each plane.

    A plane within 15 degrees of horizontal is a floor in the lowest 15 % of the height that all
    planes take up, a ceiling in the highest, if it is not small beside the largest horizontal one.
    A plane within 15 degrees of vertical is a wall if it takes up half of that height. What is
    left, and what is curved, is "other". A single horizontal plane is a floor.

    Args:
        planes: The plane table.
        up: The upward direction, shape ``(3,)``.

    Returns:
        Places in :data:`torchrg.structures.PLANE_KINDS`, shape ``(M,)``, int64.

    Example:
        >>> from torchrg.regions.planes import summarize_planes
        >>> grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
        >>> cloud = torch.cat([grid, grid[:, [2, 1, 0]], grid + torch.tensor([0.0, 0, 19])])
        >>> normals = torch.eye(3)[[2, 0, 2]].repeat_interleave(400, dim=0)
        >>> planes = summarize_planes(cloud, normals, torch.arange(3).repeat_interleave(400))
        >>> [PLANE_KINDS[kind] for kind in classify_planes(planes, torch.tensor([0.0, 0, 1]))]
        ['floor', 'wall', 'ceiling']
    """
    other, floor, ceiling, wall = (
        PLANE_KINDS.index(name) for name in ("other", "floor", "ceiling", "wall")
    )
    kind = torch.full_like(planes.count, other)
    if len(kind) == 0:
        return kind
    up = up.to(planes.normal.dtype) / up.to(planes.normal.dtype).norm()
    steepness = (planes.normal * up).sum(dim=1).abs()
    height = (planes.center * up).sum(dim=1)
    reach = ((planes.axes * up).sum(dim=2).abs() * planes.extent).sum(dim=1) / 2
    low, high = (height - reach).amin(), (height + reach).amax()
    level = ~planes.curved & (steepness >= math.cos(math.radians(_MAX_TILT_DEG)))
    largest = torch.where(level, planes.area, 0).amax()
    broad = level & (planes.area >= _LEAST_AREA_SHARE * largest)
    upright = ~planes.curved & (steepness <= math.sin(math.radians(_MAX_TILT_DEG)))
    kind[upright & (2 * reach >= _LEAST_WALL_SHARE * (high - low))] = wall
    kind[broad & (height >= high - _END_SHARE * (high - low))] = ceiling
    kind[broad & (height <= low + _END_SHARE * (high - low))] = floor
    return kind
