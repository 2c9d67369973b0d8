"""Surfaces of revolution: cylinders, cones, discs, balls, tori, and sectors of them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from torchrg.scenes.geometry import Array, Frame, box_around, unit
from torchrg.scenes.surfaces import Plane

FULL_CIRCLE = 2 * np.pi

AngleRange = tuple[float, float]
"""First and last angle, in radians."""


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
        radius: Of the arc.
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
