"""Angles between unsigned directions."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrg.errors import ConfigError, shown

_ASIN_DEGREE = 10


def unit_direction(caller: str, up: Sequence[float] | str) -> Tensor:
    """Convert an up direction, three numbers or the name of an axis, to a unit vector, float64.

    ``caller`` is the public function that starts the messages.

    Raises:
        ConfigError: If the direction is invalid.
    """
    numbers: Sequence[float] | str = up
    if isinstance(up, str):
        length, name = (-1.0 if up.startswith("-") else 1.0), up.removeprefix("-")
        numbers = [length * (name == axis) + 0.0 for axis in "xyz"]
    try:
        values = [float(number) for number in numbers]
    except (TypeError, ValueError, OverflowError):
        values = []
    direction = torch.tensor(values, dtype=torch.float64, device="cpu")
    if direction.shape != (3,) or not bool(direction.isfinite().all() and direction.any()):
        raise ConfigError(
            f"{caller}: expected up to be a direction (three numbers, not all zero, or the name of "
            f"an axis), got {shown(up)}."
        )
    direction /= direction.abs().amax()
    direction /= direction.norm()
    return direction


def unsigned_angle_deg(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle ``(*)`` between unsigned directions, in [0, 90] degrees, eq. (8).

    Computed from the chord as ``2 asin(min(|a - b|, |a + b|) / 2)``, accurate for small angles.
    There, the arc cosine of a float32 product is wrong by up to 0.02 degrees. Unit vectors ``a``
    and ``b``, ``(*, 3)``, are broadcast.

    Example:
        >>> a = torch.tensor([[1.0, 0, 0], [1, 0, 0]])
        >>> unsigned_angle_deg(a, torch.tensor([[0.0, 1, 0], [-1, 0, 0]])).tolist()
        [90.0, 0.0]
    """
    dot = (a * b).sum(dim=-1, keepdim=True)
    chord = a - torch.where(dot < 0, -b, b)
    return sq_chord_to_deg((chord * chord).sum(dim=-1))


def sq_chord_to_deg(sq_chord: Tensor) -> Tensor:
    """Convert squared chords of the unit sphere, in [0, 2], to angles.

    In [0, 90] degrees, accurate to 1e-7 (float32) or 1e-8 degrees (float64).
    """
    # asin(x) / x as a polynomial of x^2 on [0, 1/2], where x is half the chord.
    sq_half = (sq_chord / 4).clamp(max=0.5)
    result = torch.full_like(sq_half, _ASIN_SERIES[-1])
    for coefficient in _ASIN_SERIES[-2::-1]:
        result = result.mul_(sq_half).add_(coefficient)
    return result.mul_(sq_half.sqrt_()).mul_(math.degrees(2.0)).clamp_(max=90.0)


def deg_to_sq_chord(angle_deg: float) -> float:
    """Convert an angle to the squared chord ``(2 sin(a / 2))^2`` of the unit sphere."""
    return (2 * math.sin(math.radians(angle_deg) / 2)) ** 2


def sq_chords(
    normals: Sequence[Tensor], neighbor_normals: Sequence[Tensor], *, signed: bool = False
) -> Tensor:
    """Return the squared chords between normals and the normals of their neighbors.

    Uses only ``+ - *``, so it is bit-identical in every chunk. It is exact for equal normals, so
    that an angle limit of 0 accepts them. Without gradient. Three components of shape ``(n, 1)``
    and three of ``(n, K)`` give ``(n, K)``, in [0, 2]. With ``signed``, opposite normals are far
    apart, in [0, 4].
    """
    pairs = list(zip(normals, neighbor_normals, strict=True))
    if signed:
        first, second, third = (b - a for a, b in pairs)
    else:
        (a0, b0), (a1, b1), (a2, b2) = pairs
        dot = a0 * b0 + a1 * b1 + a2 * b2
        sign = signs(dot)
        first, second, third = (b - a * sign for a, b in pairs)
    result = first.mul_(first)
    result += second.mul_(second)
    result += third.mul_(third)
    return result


def _asin_series(degree: int) -> list[float]:
    """Return the Chebyshev approximation of asin(sqrt(s)) / sqrt(s) on [0, 1/2], lowest first."""
    nodes = 0.25 - 0.25 * np.cos((np.arange(200) + 0.5) * np.pi / 200)
    values = np.arcsin(np.sqrt(nodes)) / np.sqrt(nodes)
    fit = np.polynomial.Chebyshev.fit(nodes, values, degree, domain=[0, 0.5])
    coefficients = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1]).coef
    return [float(c) for c in coefficients]


_ASIN_SERIES = _asin_series(_ASIN_DEGREE)


def above(values: Tensor, bounds: Tensor | float) -> Tensor:
    """Return 1 where values exceed their bounds, else 0, in their dtype, without gradient."""
    return (values.detach() > bounds).to(values.dtype)


def at_most(values: Tensor, bounds: Tensor | float) -> Tensor:
    """Return 1 where values are at most their bounds, else 0; see :func:`above`."""
    return (values.detach() <= bounds).to(values.dtype)


def signs(values: Tensor) -> Tensor:
    """Return 1 or -1, by the sign of the values; either for zero."""
    return torch.copysign(values.new_ones(()), values.detach())
