"""Cones, cylinders, discs, balls, tori and parts of them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchrg.scenes.geometry import (
    FULL_TURN,
    SLACK,
    Array,
    Frame,
    Turn,
    cos_sin,
    dot,
    draw_angles,
    extremes,
    solve_quadratic,
    turned_box,
    unit,
    within_turn,
)
from torchrg.scenes.surfaces import Plane


@dataclass(frozen=True, eq=False)
class Cone:
    """A straight line turned about an axis: a cylinder, a cone, a disc or a ring.

    Args:
        kind: What it is part of.
        frame: The third axis is the axis of the turn.
        start: Distance from the axis and height of one end of the line.
        end: The same of the other end. The normal points to the right of the way from start to
            end, seen with the axis up and on the left: a cylinder whose end is above its start
            has its normals outwards.
        turn: First and last angle about the axis, from the first axis, in radians.

    Example:
        >>> pipe = Cone("pipe", Frame.upright(np.zeros(3)), (0.5, 0), (0.5, 2))
        >>> pipe.normals_at(np.array([[0, 0.5, 1.0]])).tolist()
        [[0.0, 1.0, 0.0]]
    """

    kind: str
    frame: Frame
    start: tuple[float, float]
    end: tuple[float, float]
    turn: Turn = (0.0, FULL_TURN)

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
        return normal, float(dot(normal, self.frame.moved(0, 0, self.start[1]).origin))

    @cached_property
    def area(self) -> float:
        """Its area, covered parts included."""
        (r0, z0), (r1, z1) = self.start, self.end
        slant = float(np.sqrt((r1 - r0) ** 2 + (z1 - z0) ** 2))
        return (self.turn[1] - self.turn[0]) * (r0 + r1) / 2 * slant

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        heights = sorted((self.start[1], self.end[1]))
        radii = sorted((self.start[0], self.end[0]))
        return turned_box(self.frame, radii, heights, self.turn)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        (r0, z0), (r1, z1) = self.start, self.end
        share = rng.random(count)
        # The further from the axis, the longer the circle.
        radius = np.sqrt(r0 * r0 + share * (r1 * r1 - r0 * r0))
        step = share if r0 == r1 else (radius - r0) / (r1 - r0)
        cosine, sine = cos_sin(draw_angles(rng, count, self.turn))
        local = np.stack([radius * cosine, radius * sine, z0 + step * (z1 - z0)], axis=1)
        return self.frame.to_world(local)

    def normals_at(self, points: Array) -> Array:
        """Return the unit normals at points on it, shape ``(N, 3)``."""
        (r0, z0), (r1, z1) = self.start, self.end
        local = self.frame.to_local(points)
        slant = np.sqrt((r1 - r0) ** 2 + (z1 - z0) ** 2)
        outwards, upwards = (z1 - z0) / slant, (r0 - r1) / slant
        radius = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
        away = outwards / np.where(radius > 0, radius, 1)
        axial = np.full_like(away, upwards)
        return self.frame.turned(np.stack([local[:, 0] * away, local[:, 1] * away, axial], axis=1))

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return how far along each ray it is first met, shape ``(N,)``; infinite where never."""
        start = self.frame.to_local(origins)
        step = self.frame.turned_back(directions)
        (r0, z0), (r1, z1) = self.start, self.end
        if self.planar:
            distance = (z0 - start[:, 2]) / np.where(step[:, 2] == 0, np.nan, step[:, 2])
            return self._nearest(start, step, [distance])
        # On the cone the radius is r0 + slope (z - z0).
        slope = (r1 - r0) / (z1 - z0)
        radius = r0 + slope * (start[:, 2] - z0)
        rise = slope * step[:, 2]
        a = step[:, 0] ** 2 + step[:, 1] ** 2 - rise**2
        b = start[:, 0] * step[:, 0] + start[:, 1] * step[:, 1] - radius * rise
        c = start[:, 0] ** 2 + start[:, 1] ** 2 - radius**2
        return self._nearest(start, step, solve_quadratic(a, b, c))

    def _nearest(self, start: Array, step: Array, distances: list[Array]) -> Array:
        """Return the least of the distances that lies on the piece."""
        (r0, z0), (r1, z1) = self.start, self.end
        nearest = np.full(len(step), np.inf)
        for distance in distances:
            x, y, z = (start + distance[:, None] * step).T
            rise = np.sqrt(x * x + y * y) - r0 if self.planar else z - z0
            along = rise / (r1 - r0 if self.planar else z1 - z0)
            on_line = (along >= -SLACK) & (along <= 1 + SLACK)
            hit = on_line & within_turn(x, y, self.turn) & (distance > 0)
            nearest = np.where(hit, np.fmin(nearest, distance), nearest)
        return nearest


_GRAZING = 1e-7  # a double root has an imaginary part of the root of the rounding error


@dataclass(frozen=True, eq=False)
class Ring:
    """A circular arc turned about an axis: a ball, part of one, or of a torus.

    Args:
        kind: What it is part of.
        frame: The third axis is the axis of the turn; the middle of the arc is at height zero.
        center: Distance of the middle of the arc from the axis; 0 for a ball.
        radius: Of the arc.
        arc: First and last angle of the arc, from outwards to upwards, in radians.
        turn: First and last angle about the axis, from the first axis, in radians.

    Example:
        >>> ball = Ring("ball", Frame.upright(np.zeros(3)), 0, 0.5)
        >>> round(ball.area / np.pi, 12)
        1.0
    """

    kind: str
    frame: Frame
    center: float
    radius: float
    arc: Turn = (-np.pi / 2, np.pi / 2)
    turn: Turn = (0.0, FULL_TURN)

    plane = None

    @cached_property
    def area(self) -> float:
        """Its area, covered parts included."""
        sines = cos_sin(self.arc)[1]
        length = self.center * (self.arc[1] - self.arc[0])
        profile = length + self.radius * float(sines[1] - sines[0])
        return (self.turn[1] - self.turn[0]) * self.radius * profile

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        cosines, sines = extremes(self.arc)
        radii = self.center + self.radius * cosines
        return turned_box(self.frame, radii, self.radius * sines, self.turn)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        drawn, missing = [np.zeros(0)], count
        widest = self.center + self.radius
        while missing > 0:
            angles = draw_angles(rng, 2 * missing + 16, self.arc)
            # The further from the axis, the longer the circle.
            distances = self.center + self.radius * cos_sin(angles)[0]
            drawn.append(angles[rng.random(len(angles)) * widest < distances][:missing])
            missing -= len(drawn[-1])
        outwards, upwards = cos_sin(np.concatenate(drawn))
        cosine, sine = cos_sin(draw_angles(rng, count, self.turn))
        distances = self.center + self.radius * outwards
        local = np.stack([distances * cosine, distances * sine, self.radius * upwards], axis=1)
        return self.frame.to_world(local)

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normals at points on it, shape ``(N, 3)``."""
        local = self.frame.to_local(points)
        if self.center:
            distances = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
            local[:, :2] *= 1 - self.center / distances[:, None]
        return self.frame.turned(unit(local))

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return how far along each ray it is first met, shape ``(N,)``; infinite where never."""
        start = self.frame.to_local(origins)
        step = self.frame.turned_back(directions)
        distances = self._crossings(start, step)
        nearest = np.full(len(step), np.inf)
        for distance in distances:
            x, y, z = (start + distance[:, None] * step).T
            outwards = np.sqrt(x * x + y * y) - self.center
            on_arc = within_turn(outwards, z, self.arc) & within_turn(x, y, self.turn)
            nearest = np.where(on_arc & (distance > 0), np.fmin(nearest, distance), nearest)
        return nearest

    def _crossings(self, start: Array, step: Array) -> list[Array]:
        """Return where rays meet the whole ball or torus; NaN where they do not."""
        if self.center == 0:
            a, b, c = dot(step, step), dot(start, step), dot(start, start) - self.radius**2
            return solve_quadratic(a, b, c)
        # From the point nearest to the middle, in lengths of the ring, all coefficients are small.
        size, length = self.center + self.radius, np.sqrt(dot(step, step))
        unit_step = step / length[:, None]
        shift = -dot(start, unit_step)
        near = (start + shift[:, None] * unit_step) / size
        roots = np.full((len(step), 4), np.nan)
        meets = dot(near, near) <= 1
        ring, tube = self.center / size, self.radius / size
        roots[meets] = _torus_crossings(near[meets], unit_step[meets], ring, tube)
        return list(((roots * size + shift[:, None]) / length[:, None]).T)


def _torus_crossings(start: Array, step: Array, ring: float, tube: float) -> Array:
    """Return where rays through the points nearest to a torus' middle meet it, ``(N, 4)``."""
    k = dot(start, start) + ring**2 - tube**2
    flat_start, flat_step = start[:, :2], step[:, :2]
    alpha = (flat_step * flat_step).sum(axis=1)
    beta = (flat_start * flat_step).sum(axis=1)
    gamma = (flat_start * flat_start).sum(axis=1)
    companion = np.zeros((len(start), 4, 4))
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1
    companion[:, 0, 3] = 4 * ring**2 * gamma - k * k
    companion[:, 1, 3] = 8 * ring**2 * beta
    companion[:, 2, 3] = 4 * ring**2 * alpha - 2 * k
    roots = np.linalg.eigvals(companion)
    return np.where(np.abs(roots.imag) < _GRAZING, roots.real, np.nan)
