"""Flat pieces of surface: what rooms and CAD parts are made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes.geometry import Array, Frame, dot

_SLACK = 1e-9  # rays through the seam of two pieces must not slip between them; metres


Plane = tuple[Array, float]


class Surface(Protocol):
    """A piece of surface that can be sampled evenly and hit by rays."""

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

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return how far along each ray it is first met, shape ``(N,)``; infinite where never.

        ``origins`` have shape ``(N, 3)`` or ``(1, 3)``, ``directions`` ``(N, 3)``; distances are
        in lengths of the directions, and only positive ones count.
        """


@dataclass(frozen=True, eq=False)
class Flat:
    """A union of parallelograms, or of triangles, in one plane; they do not overlap.

    Args:
        kind: What it is part of.
        frame: Its plane is that of the first two axes; the third is the outward normal.
        pieces: A corner and the two edges that leave it, in the plane, shape ``(M, 3, 2)``.
        triangular: Whether the pieces are triangles.

    Example:
        >>> floor = rectangle("floor", Frame.upright(np.zeros(3)), 4, 3, holes=[(1, 2, 1, 2)])
        >>> floor.area
        11.0
    """

    kind: str
    frame: Frame
    pieces: Array
    triangular: bool = False

    @property
    def plane(self) -> Plane:
        """Normal and offset of its plane."""
        return plane_of(self.frame)

    @cached_property
    def _piece_areas(self) -> Array:
        first, second = self.pieces[:, 1], self.pieces[:, 2]
        areas = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        return areas / 2 if self.triangular else areas

    @cached_property
    def area(self) -> float:
        """Its area, covered parts included."""
        return float(self._piece_areas.sum())

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        corner, first, second = self.pieces[:, 0], self.pieces[:, 1], self.pieces[:, 2]
        ends = np.concatenate([corner, corner + first, corner + second])
        if not self.triangular:
            ends = np.concatenate([ends, corner + first + second])
        world = self.frame.to_world(np.column_stack([ends, np.zeros(len(ends))]))
        return np.stack([world.min(axis=0), world.max(axis=0)])

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        counts = rng.multinomial(count, self._piece_areas / self._piece_areas.sum())
        first, second = rng.random((2, count))
        if self.triangular:
            beyond = first + second > 1
            first, second = np.where(beyond, 1 - first, first), np.where(beyond, 1 - second, second)
        local = np.zeros((count, 3))
        pieces = np.split(np.arange(count), np.cumsum(counts)[:-1])
        for (corner, edge, other), rows in zip(self.pieces, pieces, strict=True):
            span = slice(rows[0], rows[-1] + 1) if len(rows) else slice(0)
            for axis in range(2):
                steps = first[span] * edge[axis] + second[span] * other[axis]
                local[span, axis] = corner[axis] + steps
        return self.frame.to_world(local)

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normal at each point, shape ``(N, 3)``."""
        return np.broadcast_to(self.frame.axes[2], points.shape)

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return how far along each ray it is first met, shape ``(N,)``; infinite where never."""
        start, step = self.frame.to_local(origins), self.frame.turned_back(directions)
        slope = np.where(step[:, 2] == 0, np.nan, step[:, 2])
        distance = -start[:, 2] / slope
        u, v = start[:, 0] + distance * step[:, 0], start[:, 1] + distance * step[:, 1]
        hit = np.zeros(len(distance), dtype=bool)
        for corner, edge, other in self.pieces:
            hit |= self._covers(u - corner[0], v - corner[1], edge, other)
        return np.where(hit & (distance > 0), distance, np.inf)

    def _covers(self, u: Array, v: Array, edge: Array, other: Array) -> NDArray[np.bool_]:
        """Return whether places relative to a piece's corner are in it; False for NaN."""
        cross = edge[0] * other[1] - edge[1] * other[0]
        a, b = (u * other[1] - v * other[0]) / cross, (v * edge[0] - u * edge[1]) / cross
        slack = _SLACK / np.sqrt(np.abs(cross))
        beyond = a + b if self.triangular else np.maximum(a, b)
        inside: NDArray[np.bool_] = (np.minimum(a, b) >= -slack) & (beyond <= 1 + slack)
        return inside


def plane_of(frame: Frame) -> Plane:
    """Return normal and offset of the plane of a frame's first two axes.

    Example:
        >>> plane_of(Frame.upright(np.array([1.0, 2, 3])))[1]
        3.0
    """
    normal = frame.axes[2]
    return normal, float(dot(normal, frame.origin))


def rectangle(
    kind: str,
    frame: Frame,
    width: float,
    height: float,
    holes: Sequence[tuple[float, float, float, float]] = (),
) -> Flat:
    """Return a rectangle from the origin of a frame along its first two axes, with holes.

    Args:
        kind: What it is part of.
        frame: Corner, axes and, as third axis, the outward normal.
        width: Length along the first axis.
        height: Length along the second axis.
        holes: Rectangles left out, each as (left, right, low, high); they do not overlap.

    Returns:
        The surface.

    Example:
        >>> rectangle("wall", Frame.upright(np.zeros(3)), 4, 3).area
        12.0
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


def polygon(kind: str, corners: Array) -> Flat:
    """Return a convex polygon.

    Args:
        kind: What it is part of.
        corners: In one plane, counterclockwise seen from outside, shape ``(M, 3)``.

    Returns:
        The surface.

    Example:
        >>> polygon("roof", np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])).area
        2.0
    """
    frame = Frame.spanned(corners[0], corners[1] - corners[0], corners[2] - corners[0])
    flat = frame.to_local(corners)[:, :2]
    fan = [[(0.0, 0.0), tuple(left), tuple(right)] for left, right in pairwise(flat[1:])]
    return Flat(kind, frame, np.array(fan), triangular=True)


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
