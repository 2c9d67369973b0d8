"""Directions of rooms: horizontal and vertical planes, the heading of walls, and up.

Classes of planes, alignment and images share these definitions.
"""

import math
import sys

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.linalg.moments import dot

MAX_TILT = math.radians(15.0)
"""Maximum angle of floors and ceilings to horizontal, and of walls to vertical, in radians."""
MAX_ANGLE = math.radians(3.0)
"""Maximum angle between planes of one direction, in radians: walls are built to within one degree
and scanned to within two."""
NUM_FITS = 5
"""Reweighted fits until a direction has converged."""
MIN_FRACTION = 0.02
"""Minimum fraction of the plane area per direction: smaller ones are furniture, not a room."""
_QUANTILES = (0.01, 0.99)
"""Quantiles that bound the span of a coordinate, robust to outliers."""
_MIN_WALLS = 0.1
"""Minimum ratio of walls to floor and ceiling: the faces of a single wall have none around them."""
END_FRACTION = 0.15
"""Fraction of the height of a room at its bottom and top that contains floor and ceiling."""
_MIN_PAIR = 2.0
"""Minimum ratio of the floor and ceiling of another axis to everything that faces up, and to what
faces the third axis. The walls of corridors and streets reach 1.5."""


def are_horizontal(normals: Tensor, up: Tensor, max_tilt: float = MAX_TILT) -> Tensor:
    """Return which unit normals ``(M, 3)`` are of horizontal planes, shape ``(M,)``."""
    return dot(normals.double(), up).abs() >= math.cos(max_tilt)


def are_vertical(normals: Tensor, up: Tensor, max_tilt: float = MAX_TILT) -> Tensor:
    """Return which unit normals ``(M, 3)`` are of vertical planes, shape ``(M,)``."""
    return dot(normals.double(), up).abs() <= math.sin(max_tilt)


def horizontal_toward(direction: Tensor, up: Tensor) -> Tensor:
    """Return the horizontal unit vector closest to a direction; any one if that is up."""
    across = direction - (direction @ up) * up
    if bool(across.norm() < math.sin(MAX_ANGLE)):
        across = torch.linalg.cross(up, unit_axis(up))
    unit: Tensor = across / across.norm()
    return unit


def unit_axis(up: Tensor) -> Tensor:
    """Return the coordinate axis that is most horizontal."""
    axis = torch.zeros_like(up)
    axis[up.abs().argmin()] = 1
    return axis


def find_heading(normals: Tensor, areas: Tensor, up: Tensor) -> Tensor | None:
    """Return the main horizontal direction of walls closest to x, or None without walls.

    It is the direction of vertical planes, modulo 90 degrees, with most area. Planes have unit
    ``normals`` ``(M, 3)`` and ``areas`` ``(M,)``; ``up`` is a unit vector.
    """
    weights = areas * bisquare((normals @ up).abs().clamp(max=1).asin())
    if not bool(weights.sum() > MIN_FRACTION * areas.sum()):
        return None
    first = horizontal_toward(up.new_tensor([1.0, 0.0, 0.0]), up)
    second = torch.linalg.cross(up, first)
    angles = torch.atan2(normals @ second, normals @ first)
    candidates = angles[weights > 0]
    agreeing = [(weights * bisquare(_modulo_90(angles - angle))).sum() for angle in candidates]
    angle = candidates[int(torch.stack(agreeing).argmax())]
    for _ in range(NUM_FITS):
        off = _modulo_90(angles - angle)
        agreement = weights * bisquare(off)
        angle = angle + (agreement * off).sum() / agreement.sum()
    angle = _modulo_90(angle)
    heading: Tensor = angle.cos() * first + angle.sin() * second
    return heading


def bisquare(angles: Tensor) -> Tensor:
    """Return Tukey weights of angles in radians, 0 beyond the same-direction limit."""
    return (1 - (angles / MAX_ANGLE) ** 2).clamp(min=0) ** 2


def _modulo_90(angles: Tensor) -> Tensor:
    """Return angles in radians modulo 90 degrees, within 45 degrees of 0."""
    return angles - (angles / (math.pi / 2)).round() * (math.pi / 2)


def likely_up(
    normals: NDArray[np.floating],
    positions: NDArray[np.floating],
    areas: NDArray[np.floating],
    up: NDArray[np.floating],
) -> str:
    """Return the axis whose floor and ceiling exceed all that faces up or another axis, or "".

    Planes or points have unit ``normals`` and ``positions``, both ``(M, 3)``, and ``areas``
    ``(M,)``; ``up`` is the assumed upward direction, ``(3,)``.
    """
    if len(normals) == 0:
        return ""
    low, high = np.quantile(positions, _QUANTILES, axis=0)
    heights = (positions - low) / np.maximum(high - low, sys.float_info.min)
    faces = np.abs(normals @ np.column_stack([np.eye(3), up])) >= math.cos(MAX_TILT)
    for i, axis in enumerate("xyz"):
        low_end, high_end = heights[:, i] <= END_FRACTION, heights[:, i] >= 1 - END_FRACTION
        pair = 2 * min(areas[faces[:, i] & end].sum() for end in (low_end, high_end))
        others = [areas[faces[:, j]].sum() for j in range(4) if j != i]
        walls = areas[np.abs(normals[:, i]) <= math.sin(MAX_TILT)].sum()
        if pair > _MIN_PAIR * max(others) and walls > _MIN_WALLS * pair:
            return axis
    return ""
