"""Surfaces and bodies of revolution, and rooms with round things and bent walls."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tests.made.scanners import ScannedLayout
from torchrg.scenes.geometry import Doubles, Frame, unit
from torchrg.scenes.parts import TABLE_HEIGHT
from torchrg.scenes.rooms import Furniture
from torchrg.scenes.scene import Part
from torchrg.scenes.surfaces import Hole, PlaneEquation, Solid, Surface

AngleRange = tuple[float, float]
"""First and last angle, in radians."""
FULL_CIRCLE = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Cone(Surface):
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

    start: tuple[float, float]
    end: tuple[float, float]
    sector: AngleRange = (0.0, FULL_CIRCLE)

    @property
    def plane(self) -> PlaneEquation | None:
        """Normal and offset of the plane of a disc or an annulus; None if it is curved."""
        if self.start[1] != self.end[1]:
            return None
        normal = (1 if self.start[0] > self.end[0] else -1) * self.frame.axes[2]
        return normal, float(np.vecdot(normal, self.frame.moved(0, 0, self.start[1]).origin))

    @property
    def _slant(self) -> float:
        """Length of the line."""
        return float(
            np.sqrt((self.end[0] - self.start[0]) ** 2 + (self.end[1] - self.start[1]) ** 2)
        )

    @property
    def area(self) -> float:
        """Its area, covered parts included."""
        turn = self.sector[1] - self.sector[0]
        return turn * (self.start[0] + self.end[0]) / 2 * self._slant

    def _corners(self) -> Doubles:
        radii, heights = zip(self.start, self.end, strict=True)
        return _around_circles(radii, heights, self.sector)

    def _draw(self, rng: np.random.Generator, count: int) -> Doubles:
        (r0, z0), (r1, z1) = self.start, self.end
        fraction = rng.random(count)
        # The further from the axis, the longer the circle.
        radius = np.sqrt(r0 * r0 + fraction * (r1 * r1 - r0 * r0))
        step = fraction if r0 == r1 else (radius - r0) / (r1 - r0)
        angles = _draw_angles(rng, count, self.sector)
        sides = (radius * np.cos(angles), radius * np.sin(angles), z0 + step * (z1 - z0))
        return np.stack(sides, axis=1)

    def normals_at(self, points: Doubles) -> Doubles:
        """Return the outward unit normals at points on it, shape ``(N, 3)``."""
        local = self.frame.to_local(points)
        (r0, z0), (r1, z1) = self.start, self.end
        outwards, upwards = (z1 - z0) / self._slant, (r0 - r1) / self._slant
        radius = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
        away = outwards / np.where(radius > 0, radius, 1)
        sides = (local[:, 0] * away, local[:, 1] * away, np.full_like(away, upwards))
        return self.frame.vectors_to_world(np.stack(sides, axis=1))


@dataclass(frozen=True, eq=False)
class Ring(Surface):
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

    center: float
    radius: float
    arc: AngleRange = (-np.pi / 2, np.pi / 2)
    sector: AngleRange = (0.0, FULL_CIRCLE)

    @property
    def area(self) -> float:
        """Its area, covered parts included."""
        low, high = self.arc
        profile = self.center * (high - low) + self.radius * float(np.sin(high) - np.sin(low))
        return (self.sector[1] - self.sector[0]) * self.radius * profile

    def _corners(self) -> Doubles:
        angles = _extreme_angles(self.arc)
        radii, heights = self.center + self.radius * np.cos(angles), self.radius * np.sin(angles)
        return _around_circles(radii, heights, self.sector)

    def _draw(self, rng: np.random.Generator, count: int) -> Doubles:
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
        return np.stack([*local, self.radius * np.sin(on_arc)], axis=1)

    def normals_at(self, points: Doubles) -> Doubles:
        """Return the outward unit normals at points on it, shape ``(N, 3)``."""
        local = self.frame.to_local(points)
        if self.center:
            distances = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
            local[:, :2] *= 1 - self.center / distances[:, None]
        return self.frame.vectors_to_world(unit(local))


def _draw_angles(rng: np.random.Generator, count: int, angles: AngleRange) -> Doubles:
    """Return random angles within a range, shape ``(count,)``."""
    return angles[0] + (angles[1] - angles[0]) * rng.random(count)


def _extreme_angles(angles: AngleRange) -> Doubles:
    """Return both ends of a range and the right angles between them."""
    right = np.arange(-8, 9) * (np.pi / 2)
    return np.concatenate([angles, right[(right > angles[0]) & (right < angles[1])]])


def _around_circles(radii: ArrayLike, heights: ArrayLike, sector: AngleRange) -> Doubles:
    """Return the corners of a box around arcs of radii at heights, shape ``(8, 3)``."""
    distances, angles = np.asarray(radii)[:, None], _extreme_angles(sector)
    sides = (distances * np.cos(angles), distances * np.sin(angles), np.asarray(heights))
    ends = ((side.min(), side.max()) for side in sides)
    return np.array(list(product(*ends)))


@dataclass(frozen=True, eq=False)
class RoundSolid(Solid):
    """A cylinder or a ball.

    Args:
        frame: Local coordinate frame at the center.
        size: Lengths along the three axes.
        num_round: Number of round axes: 2 (cylinder, the first two) or 3 (ball).

    Example:
        >>> drum = RoundSolid(Frame.upright(np.zeros(3)), (2, 2, 1), num_round=2)
        >>> drum.contains(np.array([[0.7, 0.7, 0.5], [0.8, 0.8, 0.5]])).tolist()
        [True, False]
    """

    num_round: int = 3

    def contains(self, points: Doubles) -> NDArray[np.bool_]:
        """Return the mask of points of shape ``(N, 3)`` inside or on it."""
        fractions = 2 * np.abs(self.frame.to_local(points)) / self.size
        curved, straight = fractions[:, : self.num_round], fractions[:, self.num_round :]
        inside: NDArray[np.bool_] = np.vecdot(curved, curved) <= 1
        return inside & (straight <= 1).all(axis=1)


def _drum(base: Frame, radius: float, height: float) -> Solid:
    """Return a cylindrical body on the plane of its frame's first two axes."""
    size = (2 * radius, 2 * radius, height)
    return RoundSolid(base.moved(0, 0, height / 2), size, num_round=2)


def draw_round_table(rng: np.random.Generator, frame: Frame, thickness: float) -> Part:
    """Return a disc with a curved edge on a round post."""
    radius, height = rng.uniform(0.45, 0.6), rng.uniform(*TABLE_HEIGHT)
    under, post = height - thickness, radius / 5
    surfaces = (
        Cone("table underside", frame, (0, under), (radius, under)),
        Cone("table top", frame, (radius, height), (0, height)),
        Cone("table edge", frame, (radius, under), (radius, height)),
        Cone("table post", frame, (post, 0), (post, under)),
    )
    plate = _drum(frame.moved(0, 0, under), radius, thickness)
    return Part(surfaces, (plate, _drum(frame, post, under)))


def draw_column(rng: np.random.Generator, frame: Frame, ceiling: float) -> Part:
    """Return a round pillar."""
    return _post("column", frame, rng.uniform(0.15, 0.3), ceiling)


def draw_ball(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a ball on the floor."""
    radius = rng.uniform(0.2, 0.4)
    return _ball("ball", frame.moved(0, 0, radius), radius)


def draw_lamp(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a ball that sits on a round post, a little into it."""
    radius, height = rng.uniform(0.15, 0.25), rng.uniform(1.2, 1.6)
    post = _post("lamp post", frame, radius / 5, height)
    shade = _ball("lamp", frame.moved(0, 0, height + 0.9 * radius), radius)
    return Part(post.surfaces + shade.surfaces, post.solids + shade.solids)


def _post(kind: str, frame: Frame, radius: float, height: float) -> Part:
    """Return an upright cylinder without ends."""
    side = Cone(kind, frame, (radius, 0), (radius, height))
    return Part((side,), (_drum(frame, radius, height),))


def _ball(kind: str, middle: Frame, radius: float) -> Part:
    """Return a ball about the origin of a frame."""
    size = (2 * radius, 2 * radius, 2 * radius)
    return Part((Ring(kind, middle, 0, radius),), (RoundSolid(middle, size),))


@dataclass(frozen=True)
class CurvedLayout(ScannedLayout):
    """A room with round things on its floor and bent walls, with nothing on them."""

    num_columns: int = 0
    num_round_tables: int = 0
    num_balls: int = 0
    num_lamps: int = 0
    num_bent_walls: int = 0
    """Up to 4."""
    wall_bend: float = 0.04
    """How far the middle of a bent wall bulges into the room, meters."""

    def draw_wall(self, number: int, wall: Frame, length: float, holes: Sequence[Hole]) -> Part:
        """Return an arc of a large cylinder through both ends of a bent wall, or a flat one."""
        if number >= self.num_bent_walls:
            return super().draw_wall(number, wall, length, holes)
        radius = length * length / (8 * self.wall_bend) + self.wall_bend / 2
        half = float(np.arcsin(length / 2 / radius))
        axis = wall.placed((length / 2, 0, self.wall_bend - radius), (0, 0, 1), (1, 0, 0))
        ends = (radius, 0.0), (radius, self.size[2])
        return Part((Cone("wall", axis, *ends, (-half, half)),), (_drum(axis, *ends[1]),))

    def furniture(self) -> list[tuple[int, Furniture]]:
        """Return the number of each kind on the floor but tables, and what draws one of them."""
        return [
            *super().furniture(),
            (self.num_columns, partial(draw_column, ceiling=self.size[2])),
            (self.num_round_tables, partial(draw_round_table, thickness=self.plate_thickness)),
            (self.num_balls, draw_ball),
            (self.num_lamps, draw_lamp),
        ]


CURVED_LAYOUT = CurvedLayout(
    size=(8.0, 6.0, 2.6),
    num_doors=1,
    num_windows=0,
    num_cabinets=0,
    num_shelves=0,
    num_tables=0,
    num_boxes=0,
    num_small_boxes=0,
    num_pillars=0,
    num_columns=3,
    num_round_tables=1,
    num_balls=3,
    num_lamps=1,
    num_bent_walls=2,
)
"""A small room in which most is round."""
