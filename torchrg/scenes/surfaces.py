"""Flat surfaces, and bodies that hide what is inside them: what most of a scene is made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes.geometry import Array, Frame, Triple, box_around

Plane = tuple[Array, float]
Hole = tuple[float, float, float, float]
"""A rectangle left out of a surface: left, right, low and high end along its first two axes."""


class Surface(Protocol):
    """A surface that can be sampled evenly; a face of a scene."""

    @property
    def kind(self) -> str:
        """What it is part of, as in ``"table edge"``."""

    @property
    def plane(self) -> Plane | None:
        """Normal and offset of its plane, ``normal . x = offset``; None if it is curved."""

    @property
    def area(self) -> float:
        """Its area, covered parts included."""

    @property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normals at points on it, shape ``(N, 3)``."""


@dataclass(frozen=True, eq=False)
class Flat:
    """A union of parallelograms, or of triangles, in one plane; they do not overlap.

    Args:
        kind: What it is part of.
        frame: Its plane is that of the first two axes; the third is the outward normal.
        cells: A corner and the two edges that leave it, in the plane, shape ``(M, 3, 2)``.
        triangular: Whether the cells are triangles.
    """

    kind: str
    frame: Frame
    cells: Array
    triangular: bool = False

    @property
    def plane(self) -> Plane:
        """Normal and offset of its plane."""
        return plane_of(self.frame)

    @cached_property
    def _cell_areas(self) -> Array:
        first, second = self.cells[:, 1], self.cells[:, 2]
        areas = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        return areas / 2 if self.triangular else areas

    @cached_property
    def area(self) -> float:
        """Its area, covered parts included."""
        return float(self._cell_areas.sum())

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        corner, first, second = self.cells[:, 0], self.cells[:, 1], self.cells[:, 2]
        ends = np.concatenate([corner, corner + first, corner + second])
        if not self.triangular:
            ends = np.concatenate([ends, corner + first + second])
        return box_around(self.frame.to_world(np.column_stack([ends, np.zeros(len(ends))])))

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        counts = rng.multinomial(count, self._cell_areas / self._cell_areas.sum())
        first, second = rng.random((2, count))
        if self.triangular:
            beyond = first + second > 1
            first, second = np.where(beyond, 1 - first, first), np.where(beyond, 1 - second, second)
        corner, edge, other = self.cells[np.repeat(np.arange(len(counts)), counts)].swapaxes(0, 1)
        local = np.zeros((count, 3))
        local[:, :2] = corner + (first[:, None] * edge + second[:, None] * other)
        return self.frame.to_world(local)

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normal at each point, shape ``(N, 3)``."""
        return np.broadcast_to(self.frame.axes[2], points.shape)


def plane_of(frame: Frame) -> Plane:
    """Return normal and offset of the plane of a frame's first two axes."""
    normal = frame.axes[2]
    return normal, float(np.vecdot(normal, frame.origin))


def rectangle(
    kind: str, frame: Frame, width: float, height: float, holes: Sequence[Hole] = ()
) -> Flat:
    """Return a rectangle from the origin of a frame along its first two axes, with holes.

    The third axis is the outward normal; the holes do not overlap.

    Example:
        >>> rectangle("wall", Frame.upright(np.zeros(3)), 4, 3, holes=[(1, 2, 1, 2)]).area
        11.0
    """
    xs = np.unique([0, width, *(edge for hole in holes for edge in hole[:2])])
    ys = np.unique([0, height, *(edge for hole in holes for edge in hole[2:])])
    cells = [
        [(left, low), (right - left, 0), (0, high - low)]
        for left, right in pairwise(xs)
        for low, high in pairwise(ys)
        if not any(a <= left and right <= b and c <= low and high <= d for a, b, c, d in holes)
    ]
    return Flat(kind, frame, np.array(cells, dtype=np.float64))


class Solid(Protocol):
    """A body that hides whatever is inside it."""

    @property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points of shape ``(N, 3)`` are inside it, or on its surface."""


@dataclass(frozen=True, eq=False)
class Block:
    """A rectangular body that stands on the plane of its frame's first two axes.

    Args:
        frame: Its third axis is up; the origin is the middle of the base.
        size: Lengths along the three axes.

    Example:
        >>> block = Block(Frame.upright(np.zeros(3)), (2, 2, 1))
        >>> block.contains(np.array([[0.9, 0, 0.5], [1.1, 0, 0.5]])).tolist()
        [True, False]
    """

    frame: Frame
    size: Triple

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        x, y, z = self.size
        corners = list(product((-x / 2, x / 2), (-y / 2, y / 2), (0.0, z)))
        return box_around(self.frame.to_world(np.array(corners)))

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points of shape ``(N, 3)`` are inside it, or on its surface."""
        x, y, z = self.frame.to_local(points).T
        width, depth, height = self.size
        inside: NDArray[np.bool_] = (
            (np.abs(x) <= width / 2)
            & (np.abs(y) <= depth / 2)
            & (np.abs(z - height / 2) <= height / 2)
        )
        return inside


@dataclass(frozen=True, eq=False)
class Drum:
    """A cylindrical body that stands on the plane of its frame's first two axes.

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
        inside: NDArray[np.bool_] = (x * x + y * y <= self.radius**2) & (
            np.abs(z - self.height / 2) <= self.height / 2
        )
        return inside


@dataclass(frozen=True, eq=False)
class Ball:
    """A ball of a radius about a center of shape ``(3,)``.

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
        offsets = points - self.center
        inside: NDArray[np.bool_] = np.vecdot(offsets, offsets) <= self.radius**2
        return inside
