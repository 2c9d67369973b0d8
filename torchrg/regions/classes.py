"""Plane classification: floors, ceilings and walls, from the surrounding room.

A cloud may contain several rooms and storeys, and points seen through windows.
:func:`classify_planes` therefore compares each plane with its surrounding room, not with the
complete cloud. It counts voxels, so density and duplicates do not matter. Unlabeled points, such as
outliers, are ignored.
"""

import math
from itertools import product

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from torchrg.structures import PLANE_KINDS, Planes

_MAX_TILT_DEG = 15.0
"""Maximum angle of floors and ceilings to horizontal, and of walls to vertical."""

_LEVEL_DEG = 5.0
"""Maximum angle to horizontal of planes that define up exactly: over 30 m an error of 2 degrees
changes the height by 1 m."""

_MAX_BEND = 0.02
"""Maximum RMS distance of the points to the plane of a flat region, as a fraction of its short
side: a bulging wall is flat, a pillar is not."""

_END_FRACTION = 0.15
"""A floor lies in this lowest fraction of its room's height, a ceiling in the highest."""

_MIN_AREA = 0.1
"""Minimum area of a floor or ceiling, in squares of the wall height: 0.7 m² in a room of 2.7 m."""

_MIN_WIDTH = 0.2
"""Minimum width of floors and ceilings in wall heights, and of walls as a fraction of the room
height: excludes beams and the sides of pillars."""

_MIN_HIGH_WALL = 1 / 3
"""Minimum height of a wall that reaches the top, as a fraction of its room's height: furniture and
openings hide the remaining part."""

_MIN_LOW_WALL = 0.5
"""Minimum height of a wall that ends below the top, as a fraction of its room's height."""

_MIN_LOW_WALL_AREA = 0.25
"""Minimum area of a wall that ends below the top, as a fraction of the largest vertical plane:
excludes doors and sides of cabinets."""

_TOP_FRACTION = 0.1
"""A plane in this highest fraction of its room's height reaches the top; a tall window does not."""

_MAX_POSITIONS = 2**20
"""Maximum number of sampling positions on all planes, by area; 1 to 2 cm wide in a room. Dense
points near a scanner count once, and a sparse facade outside counts little."""

_NUM_VOXELS = 48
"""Voxels per wall height: 6 cm in a room, less than the thickness of a slab."""

_COLUMN_WIDTH = 8
"""Voxels along the side of a column: 45 cm in a room."""

_REACH = 2
"""Columns on each side in the neighborhood of a column: 2.2 m in total, wider than a bed or table,
narrower than a room."""

_MAX_OUTSIDE_FRACTION = 0.02
"""Maximum fraction of a room's voxels below its floor or above its ceiling: reflections."""

_MIN_ROOM = 0.5
"""Minimum height of a room in wall heights; column neighborhoods grow until it is reached."""

_MAX_SLAB = 0.25
"""Maximum thickness of the slab between storeys, in wall heights."""

_MAX_WALLS_IN_SLAB = 0.25
"""Maximum ratio of walls in a slab to walls above and below it: only stairwells continue."""

_MAX_SLAB_GAP = 2
"""Maximum gap between a slab and the broad plane below or above it, in voxels."""

_BITS = 20
"""Voxels along each axis, as a power of two: 60 km with voxels of 6 cm; farther ones are merged."""


def classify_planes(planes: Planes, points: Tensor, labels: Tensor, up: Tensor) -> Tensor:
    """Return the class of each plane, as an index into :data:`torchrg.structures.PLANE_KINDS`.

    The constants above are the thresholds. A horizontal plane is a floor or ceiling if it is broad
    and most of it is low or high in the surrounding room, otherwise "horizontal". A vertical plane
    is a wall if it is wide and tall, and reaches the top of its room or is large, otherwise
    "vertical". Other planes are "oblique", curved ones "other". A low and high plane is a floor.

    Args:
        planes: The plane table; its ``kind`` is ignored.
        points: Points, shape ``(N, 3)``.
        labels: Plane ID of each point, shape ``(N,)``, negative if unlabeled.
        up: Upward direction, shape ``(3,)``.
    """
    kinds = {name: index for index, name in enumerate(PLANE_KINDS)}
    kind = torch.full_like(planes.count, kinds["other"])
    up = functional.normalize(up.to(planes.normal.device).double(), dim=0)
    steepness = _along(planes.normal.double(), up).abs()
    flat = ~planes.curved | (planes.rms <= _MAX_BEND * planes.extent[:, 1])
    horizontal = flat & (steepness >= math.cos(math.radians(_MAX_TILT_DEG)))
    vertical = flat & (steepness <= math.sin(math.radians(_MAX_TILT_DEG)))
    kind[flat] = kinds["oblique"]
    kind[horizontal] = kinds["horizontal"]
    kind[vertical] = kinds["vertical"]
    rows = ((labels >= 0) & points.isfinite().all(dim=1)).nonzero().squeeze(1)
    if len(rows) == 0:
        return kind

    is_level = horizontal & (steepness >= math.cos(math.radians(_LEVEL_DEG)))
    owner, up = labels[rows], _refine_up(planes, is_level, up)
    bottom, top, width, area, positions = _voxelize(planes, points[rows], owner, up, vertical)
    broad = horizontal & (area >= _MIN_AREA * _NUM_VOXELS**2) & (width >= _MIN_WIDTH * _NUM_VOXELS)
    plane, x, y, z = _distinct_voxels(owner, *positions)
    length = area / (top - bottom).clamp(min=1)
    levels, walls = ((bottom + top) / 2)[broad], (bottom[vertical], top[vertical])
    storey = torch.bucketize(z, _find_slabs(*walls, length[vertical], levels))
    keys = (storey << 2 * _BITS) | (x // _COLUMN_WIDTH << _BITS) | (y // _COLUMN_WIDTH)
    columns, column = torch.unique(keys, return_inverse=True)
    low, high = _room_heights(columns, column, z)
    counts = torch.bincount(plane, minlength=len(kind)).clamp(min=1)

    def mostly(holds: Tensor) -> Tensor:
        """Return the planes for which a condition holds in at least half of the voxels."""
        return 2 * torch.bincount(plane[holds], minlength=len(kind)) >= counts

    room = (high - low)[column].clamp(_MIN_ROOM * _NUM_VOXELS, _NUM_VOXELS)
    floor = broad & mostly(z <= low[column] + _END_FRACTION * room)
    ceiling = broad & ~floor & mostly(z >= high[column] - _END_FRACTION * room)
    # Next to a higher or lower room, walls end at their own ceiling and floor.
    on_floor, on_ceiling = floor[plane], ceiling[plane]
    low = low.scatter_reduce(0, column[on_floor], z[on_floor], "amax", include_self=False)
    high = high.scatter_reduce(0, column[on_ceiling], z[on_ceiling], "amin", include_self=False)
    room = (high - low)[column].clamp(min=_MIN_ROOM * _NUM_VOXELS)
    reach = (top - bottom)[plane]
    is_wide = vertical & mostly(width[plane] >= _MIN_WIDTH * room)
    is_high = mostly(top[plane] >= high[column] - _TOP_FRACTION * room)
    is_high &= mostly(reach >= _MIN_HIGH_WALL * room)
    is_large = area >= _MIN_LOW_WALL_AREA * torch.where(vertical, area, 0).amax()
    is_large &= mostly(reach >= _MIN_LOW_WALL * room)
    kind[floor], kind[ceiling] = kinds["floor"], kinds["ceiling"]
    kind[is_wide & (is_high | is_large)] = kinds["wall"]
    return kind


def _refine_up(planes: Planes, is_level: Tensor, up: Tensor) -> Tensor:
    """Return the area-weighted mean normal of level planes on the side of ``up``, or ``up``."""
    normal = planes.normal.double()
    weighted = normal * (planes.area.double() * _along(normal, up).sign())[:, None]
    mean = weighted[is_level].sum(dim=0)
    return functional.normalize(mean, dim=0) if mean.any() else up


def _voxelize(
    planes: Planes, points: Tensor, owner: Tensor, up: Tensor, vertical: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, list[Tensor]]:
    """Return the lowest and highest point, width and area of planes, and the voxel of each point.

    Lengths are in voxels. Voxel coordinates are integers from 0 to ``2**_BITS - 1`` along three
    axes, the last of them upwards.
    """
    middle = planes.center.double().median(dim=0).values
    coords = [_along(points.double() - middle, axis) for axis in _upright_axes(up)]
    area, counts = planes.area.double(), torch.bincount(owner, minlength=len(planes))
    bottom, top = (
        area.new_zeros(len(planes)).scatter_reduce(0, owner, coords[2], end, include_self=False)
        for end in ("amin", "amax")
    )
    positions = torch.minimum(area / area.sum() * _MAX_POSITIONS, counts) * vertical
    height = _weighted_median(top - bottom, positions)
    size = (height or float(top.amax() - bottom.amin()) or 1.0) / _NUM_VOXELS
    half = 1 << (_BITS - 1)

    def to_voxels(lengths: Tensor) -> Tensor:
        return (lengths / size + half).clamp(0, 2 * half - 1)

    width, voxels = planes.extent[:, 1].double() / size, [to_voxels(x).long() for x in coords]
    return to_voxels(bottom), to_voxels(top), width, area / size**2, voxels


def _distinct_voxels(owner: Tensor, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
    """Return the distinct voxels of each plane: the plane ID, and the three coordinates."""
    voxels, voxel = torch.unique((x << 2 * _BITS) | (y << _BITS) | z, return_inverse=True)
    plane, voxel = _divmod(torch.unique(owner * len(voxels) + voxel), len(voxels))
    across, z = _divmod(voxels[voxel], 1 << _BITS)
    return plane, *_divmod(across, 1 << _BITS), z


def _upright_axes(up: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return two horizontal unit vectors and the upward one."""
    first = torch.zeros_like(up)
    first[up.abs().argmin()] = 1
    first = first - (first * up).sum() * up
    first = first / first.norm()
    return first, torch.linalg.cross(up, first), up


def _along(vectors: Tensor, axis: Tensor) -> Tensor:
    """Return the coordinates of vectors ``(N, 3)`` along an axis."""
    x, y, z = vectors.unbind(dim=1)
    return x * axis[0] + y * axis[1] + z * axis[2]


def _divmod(values: Tensor, divisor: int) -> tuple[Tensor, Tensor]:
    """Return quotients and remainders."""
    return values // divisor, values % divisor


def _weighted_median(values: Tensor, weights: Tensor) -> float:
    """Return the weighted median; 0 if all weights are 0."""
    values, order = values.sort(stable=True)
    totals = weights[order].cumsum(0)
    return float(values[int((2 * totals < totals[-1]).sum())]) if totals[-1] > 0 else 0.0


def _find_slabs(bottom: Tensor, top: Tensor, length: Tensor, levels: Tensor) -> Tensor:
    """Return the heights that separate storeys, ascending.

    At these heights walls are interrupted by a slab's thickness, next to a broad plane.

    Args:
        bottom: Lowest point of each vertical plane, shape ``(V,)``.
        top: Highest point of each.
        length: Horizontal length of each.
        levels: Heights of broad horizontal planes.
    """
    if len(bottom) == 0:
        return levels[:0]
    first, half = int(bottom.amin()), _NUM_VOXELS // 2
    starts, ends = ((end.long() - first).cpu().numpy() for end in (bottom, top))
    weights = length.cpu().numpy()
    steps = np.bincount(starts, weights, ends.max() + 2) - np.bincount(ends + 1, weights)
    cover = steps.cumsum()
    totals = np.pad(np.concatenate([np.zeros(half + 1), cover.cumsum()]), (0, half), mode="edge")
    below = totals[half : -half - 1] - totals[: -2 * half - 1]
    above = totals[2 * half + 1 :] - totals[half + 1 : -half]
    in_slab = cover * half < _MAX_WALLS_IN_SLAB * np.minimum(below, above)
    slabs = np.flatnonzero(np.diff(np.pad(in_slab, 1).astype(np.int8))).reshape(-1, 2)
    distance = np.abs(levels.cpu().numpy()[:, None, None] - first - slabs)
    is_bounded = (distance <= _MAX_SLAB_GAP).any(axis=(0, 2))
    is_thin = slabs[:, 1] - slabs[:, 0] <= _MAX_SLAB * _NUM_VOXELS
    return levels.new_tensor(slabs[is_bounded & is_thin].mean(axis=1) + first)


def _room_heights(columns: Tensor, column: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest voxel of the room around each column, shape ``(C,)``.

    Args:
        columns: Storey and position of each column, packed into one integer, ascending, shape
            ``(C,)``.
        column: Column of each voxel, shape ``(V,)``.
        z: Height of each voxel, shape ``(V,)``.
    """
    levels, level = torch.unique(z, return_inverse=True)
    held, counts = torch.unique(column * len(levels) + level, return_counts=True)
    column, level = _divmod(held, len(levels))
    across, y = _divmod(columns, 1 << _BITS)
    storey, x = _divmod(across, 1 << _BITS)
    low = high = torch.zeros_like(columns)
    known, num_storeys = torch.zeros_like(columns, dtype=torch.bool), len(set(storey.tolist()))
    while True:
        keys = (storey << 2 * _BITS) | ((x + _REACH) << _BITS) | (y + _REACH)
        wide, index = torch.unique(keys, return_inverse=True)
        held = index[column] * len(levels) + level
        below = torch.bincount(held, counts.double(), minlength=len(wide) * len(levels))
        below = below.view(len(wide), -1).cumsum(dim=1)
        neighborhood = torch.zeros_like(below)
        for right, ahead in product(range(-_REACH, _REACH + 1), repeat=2):
            target = wide + (right << _BITS) + ahead
            near = torch.searchsorted(wide, target).clamp(max=len(wide) - 1)
            neighborhood += below[near] * (wide[near] == target)[:, None]
        outside = _MAX_OUTSIDE_FRACTION * neighborhood[:, -1:]
        first = levels[(neighborhood <= outside).sum(dim=1)][index]
        last = levels[(neighborhood < neighborhood[:, -1:] - outside).sum(dim=1)][index]
        low, high = torch.where(known, low, first), torch.where(known, high, last)
        known |= high - low >= _MIN_ROOM * _NUM_VOXELS
        if bool(known.all()) or len(wide) == num_storeys:
            return low, high
        x, y = x // 2, y // 2
