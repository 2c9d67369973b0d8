"""Precision of a dtype: tolerances, correctly rounded square roots, and float64 points as float32.

Other modules use multiples of these tolerances. Float32 is the precision of the kernels.
"""

import numpy as np
import torch
from torch import Tensor

from torchrg.structures.points import FARTHEST, bounding_box, local_origin
from torchrg.structures.precision import is_fine_step

_ROUNDED_STEPS = 8
"""Number of accumulated rounding errors in a distance to a plane, relative to the patch extent."""


def machine_epsilon(dtype: torch.dtype) -> float:
    """Return the spacing of numbers at 1: twice the relative rounding error of a dtype."""
    return torch.finfo(dtype).eps


def smallest_normal(dtype: torch.dtype) -> float:
    """Return the smallest positive normal number of a dtype."""
    return torch.finfo(dtype).tiny


def rank_tolerance(num_values: int, dtype: torch.dtype) -> float:
    """Return ``max(num_values, 3) * eps``, the rank tolerance for ``num_values`` points.

    It is the ratio to the largest singular value below which a direction counts as flat.
    """
    return max(num_values, 3) * machine_epsilon(dtype)


def coordinate_resolution(points: Tensor) -> Tensor:
    """Return the rounding error of differences of coordinates ``(*, P)``, per point ``(*)``."""
    return points.abs().amax(dim=-1) * (4 * machine_epsilon(points.dtype))


def flatness_tolerance(patches: Tensor, extent: Tensor) -> Tensor:
    """Return how far from its plane rounding alone can move a point, shape ``(B,)``.

    The points ``(B, K, P)`` are input coordinates, whose rounding depends on their distance from
    the origin. ``extent`` is the largest coordinate relative to the center of the patch.
    """
    coordinates = 2 * patches.abs().amax(dim=(1, 2))
    return machine_epsilon(patches.dtype) * (coordinates + _ROUNDED_STEPS * extent)


def rounded_sqrt(values: Tensor) -> Tensor:
    """Return square roots of float32 with correct IEEE 754 rounding, as in kernels.

    torch uses a vector library, in which every fifth result is an adjacent float.
    """
    return values.double().sqrt().to(values.dtype)


def safe_sqrt(squares: Tensor) -> Tensor:
    """Return square roots with zero gradient at zero."""
    positive = squares > 0
    return rounded_sqrt(torch.where(positive, squares, 1.0)) * positive


def to_single(points: Tensor) -> Tensor:
    """Return finite float64 points ``(N, 3)`` as float32, if its steps are fine for their spacing.

    Estimators and region growing depend only on differences of coordinates, so the result is
    relative to a local origin, like :attr:`torchrg.Cloud.points`. Points of another dtype or
    device, and points with gradients, are unchanged.
    """
    is_plain = points.device.type == "cpu" and not points.requires_grad
    if points.dtype != torch.float64 or not is_plain or len(points) == 0:
        return points
    coordinates = points.numpy()
    low, high = bounding_box(coordinates)
    origin = local_origin(low, high)
    reach = float(np.abs([low - origin, high - origin]).max())
    if not 1 / FARTHEST < reach < FARTHEST:
        return points
    if not is_fine_step(float(np.spacing(np.float32(reach))), coordinates):
        return points
    return torch.from_numpy((coordinates - origin).astype(np.float32))


def is_single(values: Tensor) -> bool:
    """Return whether values of any dtype are float32 numbers, as those computed by kernels."""
    if values.dtype == torch.float32:
        return True
    same = values.float().to(values.dtype) == values
    return bool((same | values.isnan()).all())
