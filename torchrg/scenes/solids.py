"""Solid bodies: what is inside them is hidden."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes.frames import Array, Frame


class Solid(Protocol):
    """A body that hides whatever is inside it."""

    @property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points of shape ``(N, 3)`` are inside it, or on its surface."""


@dataclass(frozen=True, eq=False)
class Block:
    """A rectangular body standing on the plane of its frame's first two axes, about its origin.

    Args:
        frame: Its third axis is up; the origin is the middle of the base.
        size: Lengths along the three axes.

    Example:
        >>> block = Block(Frame.upright(np.zeros(3)), (2, 2, 1))
        >>> block.contains(np.array([[0.9, 0, 0.5], [1.1, 0, 0.5]])).tolist()
        [True, False]
    """

    frame: Frame
    size: tuple[float, float, float]

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        x, y, z = self.size
        corners = [(a * x / 2, b * y / 2, c * z) for a in (-1, 1) for b in (-1, 1) for c in (0, 1)]
        world = self.frame.to_world(np.array(corners))
        return np.stack([world.min(axis=0), world.max(axis=0)])

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points of shape ``(N, 3)`` are inside it, or on its surface."""
        x, y, z = self.frame.to_local(points).T
        width, depth, height = self.size
        beside = np.maximum(np.abs(x) - width / 2, np.abs(y) - depth / 2)
        return _at_most(np.maximum(beside, np.abs(z - height / 2) - height / 2), 0)


@dataclass(frozen=True, eq=False)
class Drum:
    """A cylindrical body standing on the plane of its frame's first two axes, about its origin.

    Args:
        frame: Its third axis is the axis of the cylinder; the origin is the middle of the base.
        radius: Of the cylinder.
        height: Along the third axis.

    Example:
        >>> Drum(Frame.upright(np.zeros(3)), 1, 2).contains(np.array([[0.8, 0.8, 1]])).tolist()
        [False]
    """

    frame: Frame
    radius: float
    height: float

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        side = 2 * self.radius
        return Block(self.frame, (side, side, self.height)).bounds

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points of shape ``(N, 3)`` are inside it, or on its surface."""
        x, y, z = self.frame.to_local(points).T
        beside = x * x + y * y - self.radius * self.radius
        return _at_most(np.maximum(beside, np.abs(z - self.height / 2) - self.height / 2), 0)


@dataclass(frozen=True, eq=False)
class Ball:
    """A ball.

    Args:
        center: Shape ``(3,)``.
        radius: Of the ball.

    Example:
        >>> Ball(np.zeros(3), 1).contains(np.array([[0.5, 0.5, 0.5], [1, 1, 1]])).tolist()
        [True, False]
    """

    center: Array
    radius: float

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        return np.stack([self.center - self.radius, self.center + self.radius])

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points of shape ``(N, 3)`` are inside it, or on its surface."""
        x, y, z = (points - self.center).T
        return _at_most(x * x + y * y + z * z, self.radius * self.radius)


def _at_most(values: Array, limit: float) -> NDArray[np.bool_]:
    """Return where values are at most ``limit``."""
    inside: NDArray[np.bool_] = values <= limit
    return inside
