"""Surfaces, flat or of revolution, and bodies that hide what is in them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrg.scenes.geometry import Array, Frame, Triple, box_around, unit

Plane = tuple[Array, float]
Hole = tuple[float, float, float, float]
"""A rectangle left out of a surface: left, right, low and high end along its first two axes."""
AngleRange = tuple[float, float]
"""First and last angle, in radians."""
FULL_CIRCLE = 2 * np.pi


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


@dataclass(frozen=True, eq=False)
class Cone:
    """A straight line rotated about an axis: a cylinder, a cone, a disc or an annulus.

    Args:
        kind: What it is part of.
        frame: The third axis is the axis of rotation.
        start: Distance from the axis and height of one end of the line.
        end: The same of the other end. The normal points to the right of the way from start to
            end, seen with the axis up and on the left: a cylinder whose end is above its start
            has its normals outwards.
        sector: Angles about the axis, from the first axis.

    Example:
        >>> pipe = Cone("pipe", Frame.upright(np.zeros(3)), (0.5, 0), (0.5, 2))
        >>> pipe.normals_at(np.array([[0, 0.5, 1.0]])).tolist()
        [[0.0, 1.0, 0.0]]
    """

    kind: str
    frame: Frame
    start: tuple[float, float]
    end: tuple[float, float]
    sector: AngleRange = (0.0, FULL_CIRCLE)

    @property
    def planar(self) -> bool:
        """Whether it lies in a plane, as a disc does."""
        return self.start[1] == self.end[1]

    @property
    def plane(self) -> Plane | None:
        """Normal and offset of its plane; None if it is curved."""
        if not self.planar:
            return None
        side = 1 if self.start[0] > self.end[0] else -1
        normal = side * self.frame.axes[2]
        return normal, float(np.vecdot(normal, self.frame.moved(0, 0, self.start[1]).origin))

    @cached_property
    def area(self) -> float:
        """Its area, covered parts included."""
        (r0, z0), (r1, z1) = self.start, self.end
        slant = float(np.sqrt((r1 - r0) ** 2 + (z1 - z0) ** 2))
        return (self.sector[1] - self.sector[0]) * (r0 + r1) / 2 * slant

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        (r0, z0), (r1, z1) = self.start, self.end
        return _box_around_rotated(self.frame, (r0, r1), (z0, z1), self.sector)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        (r0, z0), (r1, z1) = self.start, self.end
        share = rng.random(count)
        # The further from the axis, the longer the circle.
        radius = np.sqrt(r0 * r0 + share * (r1 * r1 - r0 * r0))
        step = share if r0 == r1 else (radius - r0) / (r1 - r0)
        angles = _draw_angles(rng, count, self.sector)
        local = np.stack(
            [radius * np.cos(angles), radius * np.sin(angles), z0 + step * (z1 - z0)], axis=1
        )
        return self.frame.to_world(local)

    def normals_at(self, points: Array) -> Array:
        """Return the unit normals at points on it, shape ``(N, 3)``."""
        (r0, z0), (r1, z1) = self.start, self.end
        local = self.frame.to_local(points)
        slant = np.sqrt((r1 - r0) ** 2 + (z1 - z0) ** 2)
        outwards, upwards = (z1 - z0) / slant, (r0 - r1) / slant
        radius = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
        away = outwards / np.where(radius > 0, radius, 1)
        normals = np.stack(
            [local[:, 0] * away, local[:, 1] * away, np.full_like(away, upwards)], axis=1
        )
        return self.frame.vectors_to_world(normals)


@dataclass(frozen=True, eq=False)
class Ring:
    """A circular arc rotated about an axis: a ball, part of one, or of a torus.

    Args:
        kind: What it is part of.
        frame: The third axis is the axis of rotation; the middle of the arc is at height zero.
        center: Distance of the middle of the arc from the axis; 0 for a ball.
        radius: Radius of the arc.
        arc: Angles of the arc, from outwards to upwards.
        sector: Angles about the axis, from the first axis.

    Example:
        >>> ball = Ring("ball", Frame.upright(np.zeros(3)), 0, 0.5)
        >>> round(ball.area / np.pi, 12)
        1.0
    """

    kind: str
    frame: Frame
    center: float
    radius: float
    arc: AngleRange = (-np.pi / 2, np.pi / 2)
    sector: AngleRange = (0.0, FULL_CIRCLE)

    plane = None

    @cached_property
    def area(self) -> float:
        """Its area, covered parts included."""
        low, high = self.arc
        profile = self.center * (high - low) + self.radius * float(np.sin(high) - np.sin(low))
        return (self.sector[1] - self.sector[0]) * self.radius * profile

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        angles = _extreme_angles(self.arc)
        radii, heights = self.center + self.radius * np.cos(angles), self.radius * np.sin(angles)
        return _box_around_rotated(self.frame, radii, heights, self.sector)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        drawn, missing = [np.zeros(0)], count
        widest = self.center + self.radius
        while missing > 0:
            angles = _draw_angles(rng, 2 * missing + 16, self.arc)
            # The further from the axis, the longer the circle.
            distances = self.center + self.radius * np.cos(angles)
            drawn.append(angles[rng.random(len(angles)) * widest < distances][:missing])
            missing -= len(drawn[-1])
        on_arc, around = np.concatenate(drawn), _draw_angles(rng, count, self.sector)
        distances = self.center + self.radius * np.cos(on_arc)
        local = [distances * np.cos(around), distances * np.sin(around)]
        return self.frame.to_world(np.stack([*local, self.radius * np.sin(on_arc)], axis=1))

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normals at points on it, shape ``(N, 3)``."""
        local = self.frame.to_local(points)
        if self.center:
            distances = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
            local[:, :2] *= 1 - self.center / distances[:, None]
        return self.frame.vectors_to_world(unit(local))


def _draw_angles(rng: np.random.Generator, count: int, angles: AngleRange) -> Array:
    """Return random angles within a range, shape ``(count,)``."""
    return angles[0] + (angles[1] - angles[0]) * rng.random(count)


def _extreme_angles(angles: AngleRange) -> Array:
    """Return both ends of a range and the right angles between them."""
    right = np.arange(-8, 9) * (np.pi / 2)
    return np.concatenate([angles, right[(right > angles[0]) & (right < angles[1])]])


def _box_around_rotated(
    frame: Frame, radii: ArrayLike, heights: ArrayLike, sector: AngleRange
) -> Array:
    """Return a box around what circles of some radii at some heights sweep, shape ``(2, 3)``."""
    distances, angles = np.asarray(radii)[:, None], _extreme_angles(sector)
    sides = (distances * np.cos(angles), distances * np.sin(angles), np.asarray(heights))
    corners = np.stack(np.meshgrid(*((side.min(), side.max()) for side in sides)), axis=-1)
    return box_around(frame.to_world(corners.reshape(-1, 3)))


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
        radius: Radius of the cylinder.
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
