"""Tukey's bisquare: weights, loss, and the tuning constants for a dimension."""

from collections.abc import Callable
from functools import lru_cache
from math import exp, lgamma, log
from typing import Literal

from torch import Tensor

Target = Literal["shape", "location"]
"""What the efficiency of 95 % at the normal distribution refers to."""

BREAKDOWN = 0.5
EFFICIENCY = 0.95


def bisquare_weights(sq_ratios: Tensor) -> Tensor:
    """Weights ``(1 - t)^2`` of squared distances in units of the cut-off, 0 beyond it."""
    inside = 1 - sq_ratios.clamp(max=1)
    return inside * inside


def bisquare_loss(sq_ratios: Tensor) -> Tensor:
    """Loss ``1 - (1 - t)^3`` of squared distances in units of the cut-off, 1 beyond it."""
    inside = 1 - sq_ratios.clamp(max=1)
    return 1 - inside * inside * inside


@lru_cache(maxsize=64)
def breakdown_constant(num_coordinates: int) -> float:
    """Cut-off at which half of the points may be arbitrary, for unit scale at the normal.

    Example:
        >>> round(breakdown_constant(3), 6)
        3.452882
    """

    def excess(cutoff: float) -> float:
        moments = [_moment(m, num_coordinates, cutoff) / cutoff**m for m in (0, 2, 4, 6)]
        inside = 3 * moments[1] - 3 * moments[2] + moments[3]
        return inside + 1 - moments[0] - BREAKDOWN

    return _root(excess)


@lru_cache(maxsize=64)
def efficiency_constant(num_coordinates: int, target: Target) -> float:
    """Cut-off with 95 % efficiency at the normal distribution.

    For the shape of the scatter (Tyler 1983) or for the location (Lopuhaä 1989).

    Example:
        >>> round(efficiency_constant(3, "shape"), 5), round(efficiency_constant(3, "location"), 5)
        (6.09627, 5.49025)
    """
    p = num_coordinates

    def excess(cutoff: float) -> float:
        def mean(coefficients: dict[int, float]) -> float:
            """Mean of a polynomial in d / cutoff over d < cutoff."""
            return sum(a * _moment(m, p, cutoff) / cutoff**m for m, a in coefficients.items())

        # With u = d / cutoff: psi(d) = d (1 - u^2)^2 and psi'(d) = (1 - u^2) (1 - 5 u^2).
        if target == "location":
            spread = cutoff**2 * mean({2: 1, 4: -4, 6: 6, 8: -4, 10: 1}) / p
            slope = mean({0: 1, 2: -2 - 4 / p, 4: 1 + 4 / p})
        else:
            spread = p * (p + 2) * cutoff**4 * mean({4: 1, 6: -4, 8: 6, 10: -4, 12: 1})
            slope = cutoff**2 * mean({2: p + 2, 4: -2 * (p + 4), 6: p + 6})
        return slope**2 / spread - EFFICIENCY

    return _root(excess)


def _moment(power: int, num_coordinates: int, cutoff: float) -> float:
    """Mean of d^power where d, the length of a standard normal vector, is below the cut-off."""
    from scipy.special import gammainc

    half = num_coordinates / 2
    factor = exp(lgamma(half + power / 2) - lgamma(half) + power / 2 * log(2))
    return factor * float(gammainc(half + power / 2, cutoff * cutoff / 2))


def _root(excess: Callable[[float], float]) -> float:
    from scipy.optimize import brentq

    return float(brentq(excess, 0.1, 100.0, xtol=1e-13))
