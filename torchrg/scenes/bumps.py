"""Smooth bodies with bumps, for what is neither flat nor round."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes.frames import Array, Frame, cos_sin, dot, unit

_NODES = 96  # of the quadrature for the area
_STEPS = 512  # along a ray; a graze shorter than one of them is not seen
_HALVINGS = 48


@dataclass(frozen=True, eq=False)
class Bumpy:
    """A ball whose radius goes up and down with the direction.

    In the direction d from the middle the radius is ``radius (1 + sum_i a_i T_n(d . e_i))`` with
    Chebyshev polynomials of some degree n: ``T_n(cos t) = cos(n t)``, waves about the axes e_i.

    Args:
        kind: What it is part of.
        frame: The middle, and the axes of the directions.
        radius: Without bumps.
        axes: Unit vectors e_i, shape ``(B, 3)``.
        heights: Of the waves in radii, a_i, shape ``(B,)``; their sum is below one.
        degree: Number of waves along a great circle through their axis.

    Example:
        >>> ball = Bumpy("ball", Frame.upright(np.zeros(3)), 0.5, np.eye(3), np.zeros(3), 4)
        >>> abs(ball.area - np.pi) < 1e-12
        True
    """

    kind: str
    frame: Frame
    radius: float
    axes: Array
    heights: Array
    degree: int

    plane = None

    @cached_property
    def area(self) -> float:
        """Its area, by quadrature."""
        z, weights = np.polynomial.legendre.leggauss(_NODES)
        cosine, sine = cos_sin(np.arange(2 * _NODES) * (np.pi / _NODES))
        flat = np.sqrt(1 - z * z)[:, None]
        towards = np.stack(np.broadcast_arrays(flat * cosine, flat * sine, z[:, None]), axis=-1)
        elements = self._elements(towards.reshape(-1, 3)).reshape(_NODES, 2 * _NODES)
        return float((elements * weights[:, None]).sum() * np.pi / _NODES)

    @property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        reach = self.radius * (1 + np.abs(self.heights).sum())
        return np.stack([self.frame.origin - reach, self.frame.origin + reach])

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        total = np.abs(self.heights).sum()
        reach, slope = self.radius * (1 + total), self.radius * total * self.degree
        most = reach * np.sqrt(reach * reach + slope * slope)
        drawn, missing = [np.zeros((0, 3))], count
        while missing > 0:
            towards = unit(rng.standard_normal((2 * missing + 16, 3)))
            kept = rng.random(len(towards)) * most < self._elements(towards)
            drawn.append(towards[kept][:missing])
            missing -= len(drawn[-1])
        towards = np.concatenate(drawn)
        return self.frame.to_world(self._radius(towards)[0][:, None] * towards)

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normals at points on it, shape ``(N, 3)``."""
        towards = unit(self.frame.to_local(points))
        radius, slope = self._radius(towards)
        return self.frame.turned(unit(radius[:, None] * towards - slope))

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return how far along each ray it is first met, shape ``(N,)``; infinite where never.

        The ray is followed in small steps, so that it may miss what it only grazes.
        """
        start, step = self.frame.to_local(origins), self.frame.turned_back(directions)
        near, far = self._entry_and_exit(start, step)
        nearest = np.full(len(step), np.inf)
        rows = np.flatnonzero(far > near)
        start = np.broadcast_to(start, step.shape)[rows]
        step, near, far = step[rows], near[rows], far[rows]
        width = (far - near) / _STEPS
        first = np.full(len(rows), _STEPS)
        outside = self._is_outside(start, step, near)
        for number in range(1, _STEPS + 1):
            crossed = self._is_outside(start, step, near + number * width) != outside
            first = np.where(crossed, np.minimum(first, number - 1), first)
        before = near + first * width
        found = self._crossing(start, step, before, before + width, outside)
        nearest[rows] = np.where(first < _STEPS, found, np.inf)
        return nearest

    def _entry_and_exit(self, start: Array, step: Array) -> tuple[Array, Array]:
        """Return where rays are inside the ball around the body; exit before entry if never."""
        reach = self.radius * (1 + np.abs(self.heights).sum())
        a, b = dot(step, step), dot(start, step)
        discriminant = b * b - a * (dot(start, start) - reach * reach)
        half = np.sqrt(np.maximum(discriminant, 0))
        far = np.where(discriminant > 0, (half - b) / a, -np.inf)
        return np.maximum((-half - b) / a, 0), far

    def _is_outside(self, start: Array, step: Array, distance: Array) -> NDArray[np.bool_]:
        """Return whether places along rays are outside of the body."""
        places = start + distance[:, None] * step
        lengths = np.sqrt(dot(places, places))
        outside: NDArray[np.bool_] = lengths > self._radius(places / lengths[:, None])[0]
        return outside

    def _crossing(
        self, start: Array, step: Array, before: Array, after: Array, outside: NDArray[np.bool_]
    ) -> Array:
        """Return where rays cross the surface between two places, by halving."""
        for _ in range(_HALVINGS):
            middle = (before + after) / 2
            same = self._is_outside(start, step, middle) == outside
            before, after = np.where(same, middle, before), np.where(same, after, middle)
        return (before + after) / 2

    def _radius(self, towards: Array) -> tuple[Array, Array]:
        """Return radius ``(N,)`` and its slope on the unit sphere ``(N, 3)`` in directions."""
        radius, slope = np.ones(len(towards)), np.zeros(towards.shape)
        for axis, height in zip(self.axes, self.heights, strict=True):
            value, derivative = _chebyshev(dot(towards, axis), self.degree)
            radius += height * value
            across = axis - dot(towards, axis)[:, None] * towards
            slope += (height * derivative)[:, None] * across
        return self.radius * radius, self.radius * slope

    def _elements(self, towards: Array) -> Array:
        """Return the area of the surface by solid angle in directions, shape ``(N,)``."""
        radius, slope = self._radius(towards)
        elements: Array = radius * np.sqrt(radius * radius + dot(slope, slope))
        return elements


def _chebyshev(x: Array, degree: int) -> tuple[Array, Array]:
    """Return the Chebyshev polynomial of a degree and its derivative, by their recurrences."""
    lower, value = np.ones_like(x), x
    lower_derivative, derivative = np.zeros_like(x), np.ones_like(x)
    for _ in range(degree - 1):
        following = 2 * value + 2 * x * derivative - lower_derivative
        lower_derivative, derivative = derivative, following
        lower, value = value, 2 * x * value - lower
    return value, derivative
