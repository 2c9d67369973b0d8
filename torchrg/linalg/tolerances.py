"""Numerical tolerances of a dtype, and correctly rounded square roots.

Other modules use multiples of these tolerances.
"""

import torch
from torch import Tensor

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
    """Return the rounding error of differences of coordinates ``(*, P)`` per point, shape ``(*)``.

    Example:
        >>> coordinate_resolution(torch.tensor([[0.0, -2.0, 1.0]])) < 1e-6
        tensor([True])
    """
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
