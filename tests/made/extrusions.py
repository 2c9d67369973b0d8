"""Bodies with the same outline at every height."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes import Array, Cone, Frame, Surface, rectangle


@dataclass(frozen=True, eq=False)
class Outline:
    """A polygon whose corners may be rounded, with round holes.

    Args:
        corners: Counterclockwise, shape ``(M, 2)``.
        radii: Radius at each corner, 0 for a sharp one, shape ``(M,)``; inward corners are rounded
            by fillets.
        holes: Each as (x, y, radius); they meet neither each other nor the edge.

    Example:
        >>> Outline(np.array([[0.0, 0], [2, 0], [2, 1], [0, 1]]), np.zeros(4)).area
        2.0
    """

    corners: Array
    radii: Array
    holes: Sequence[tuple[float, float, float]] = ()

    @cached_property
    def ways(self) -> tuple[Array, Array]:
        """Unit vectors along the edge into and out of each corner, shape ``(M, 2)`` each."""
        edges = np.roll(self.corners, -1, axis=0) - self.corners
        out = edges / np.sqrt((edges * edges).sum(axis=1))[:, None]
        into: Array = np.roll(out, 1, axis=0)
        return into, out

    @cached_property
    def corner_sines(self) -> Array:
        """Sine of the turn at each corner, positive to the left, shape ``(M,)``."""
        into, out = self.ways
        sines: Array = into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0]
        return sines

    @cached_property
    def tangents(self) -> Array:
        """Distance from each corner to where its rounding starts, shape ``(M,)``."""
        into, out = self.ways
        # tan(turn / 2) = sin / (1 + cos)
        reach: Array = self.radii * np.abs(self.corner_sines) / (1 + (into * out).sum(axis=1))
        return reach

    @cached_property
    def centers(self) -> Array:
        """Middle of each rounding, shape ``(M, 2)``."""
        into, _ = self.ways
        left = np.stack([-into[:, 1], into[:, 0]], axis=1)
        shift = (np.sign(self.corner_sines) * self.radii)[:, None] * left
        middles: Array = self.corners - self.tangents[:, None] * into + shift
        return middles

    @cached_property
    def angles(self) -> Array:
        """Unsigned turn at each corner in radians, shape ``(M,)``."""
        into, out = self.ways
        angles: Array = np.arctan2(np.abs(self.corner_sines), (into * out).sum(axis=1))
        return angles

    @cached_property
    def area(self) -> float:
        """Area inside."""
        x, y = self.corners.T
        whole = ((x * np.roll(y, -1)) - np.roll(x, -1) * y).sum() / 2
        # Between a corner and its arc: a kite less a sector.
        cut = self.radii * self.tangents - self.radii**2 * self.angles / 2
        holes = sum(np.pi * radius**2 for _, _, radius in self.holes)
        return float(whole - (np.sign(self.corner_sines) * cut).sum() - holes)

    def contains(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Return which places, of shape ``(N,)``, are inside."""
        inside = _in_polygon(x, y, self.corners)
        into, out = self.ways
        for corner, radius in enumerate(self.radii):
            if radius == 0:
                continue
            point, reach = self.corners[corner], self.tangents[corner]
            before, after = point - reach * into[corner], point + reach * out[corner]
            kite = np.stack([before, point, after, self.centers[corner]])
            dx, dy = x - self.centers[corner, 0], y - self.centers[corner, 1]
            between = _in_polygon(x, y, kite) & (dx * dx + dy * dy > radius * radius)
            inside = np.where(between, self.corner_sines[corner] < 0, inside)
        for middle_x, middle_y, radius in self.holes:
            dx, dy = x - middle_x, y - middle_y
            inside &= dx * dx + dy * dy >= radius * radius
        return inside


def _in_polygon(x: Array, y: Array, corners: Array) -> NDArray[np.bool_]:
    """Return which places are inside a polygon: a line to the right crosses it an odd number."""
    inside = np.zeros(len(x), dtype=bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
    return inside


@dataclass(frozen=True, eq=False)
class Sheet:
    """The flat inside of an outline.

    Args:
        kind: What it is part of.
        frame: The outline is in the plane of the first two axes; the third is the normal.
        outline: Its edge.
    """

    kind: str
    frame: Frame
    outline: Outline

    @property
    def plane(self) -> tuple[Array, float]:
        """Normal and offset of its plane."""
        normal = self.frame.axes[2]
        return normal, float(np.vecdot(normal, self.frame.origin))

    @property
    def area(self) -> float:
        """Its area."""
        return self.outline.area

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        (left, low), (right, high) = (
            self.outline.corners.min(axis=0),
            self.outline.corners.max(axis=0),
        )
        box = np.array([(x, y, 0) for x in (left, right) for y in (low, high)])
        corners = self.frame.to_world(box)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        low, high = self.outline.corners.min(axis=0), self.outline.corners.max(axis=0)
        drawn, missing = [np.zeros((0, 2))], count
        while missing > 0:
            tried = low + (high - low) * rng.random((2 * missing + 16, 2))
            drawn.append(tried[self.outline.contains(*tried.T)][:missing])
            missing -= len(drawn[-1])
        return self.frame.to_world(np.column_stack([np.concatenate(drawn), np.zeros(count)]))

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normal at each point, shape ``(N, 3)``."""
        return np.broadcast_to(self.frame.axes[2], points.shape)

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return how far along each ray it is first met, shape ``(N,)``; infinite where never."""
        start, step = self.frame.to_local(origins), self.frame.vectors_to_local(directions)
        distance = -start[:, 2] / np.where(step[:, 2] == 0, np.nan, step[:, 2])
        x, y = start[:, 0] + distance * step[:, 0], start[:, 1] + distance * step[:, 1]
        return np.where(self.outline.contains(x, y) & (distance > 0), distance, np.inf)


def extrude(kind: str, frame: Frame, outline: Outline, height: float) -> tuple[Surface, ...]:
    """Return the faces of a body with the same outline at every height.

    Args:
        kind: What it is.
        frame: The outline is in the plane of the first two axes.
        outline: Its edge and holes.
        height: Along the third axis.

    Returns:
        Bottom, top, the straight sides, the roundings, the holes.

    Example:
        >>> square = Outline(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), np.array([0.2, 0, 0, 0]))
        >>> len(extrude("part", Frame.upright(np.zeros(3)), square, 1.0))
        7
    """
    top = Sheet(kind, frame.moved(0, 0, height), outline)
    mirrored = Outline(
        (outline.corners * [1, -1])[::-1],
        outline.radii[::-1],
        [(x, -y, radius) for x, y, radius in outline.holes],
    )
    upside_down = Frame(frame.origin, frame.axes * np.array([[1], [-1], [-1]]))
    sides: list[Surface] = [Sheet(kind, upside_down, mirrored), top]
    into, out = outline.ways
    for corner, following in enumerate(np.roll(np.arange(len(into)), -1)):
        start = outline.corners[corner] + outline.tangents[corner] * out[corner]
        end = outline.corners[following] - outline.tangents[following] * into[following]
        edge = end - start
        span = Frame.spanned(np.array([*start, 0]), np.array([*edge, 0]), np.array([0, 0, 1.0]))
        width = float(np.sqrt((edge * edge).sum()))
        sides.append(rectangle(kind, span.inside(frame), width, height))
    rounded = (int(corner) for corner in np.flatnonzero(outline.radii * outline.corner_sines))
    roundings = (_rounding(kind, frame, outline, corner, height) for corner in rounded)
    holes = (
        Cone(kind, frame.moved(x, y, 0), (radius, height), (radius, 0))
        for x, y, radius in outline.holes
    )
    return (*sides, *roundings, *holes)


def _rounding(kind: str, frame: Frame, outline: Outline, corner: int, height: float) -> Cone:
    """Return the side along a rounded corner: part of a cylinder, inside out for a fillet."""
    convex = outline.corner_sines[corner] > 0
    tangent = outline.corners[corner] - outline.tangents[corner] * outline.ways[0][corner]
    first = np.array([*(tangent - outline.centers[corner]), 0])
    # From the first point of the arc the turn is to the left, or for a fillet to the right.
    second = np.array([-first[1], first[0], 0]) * (1 if convex else -1)
    middle = np.array([*outline.centers[corner], 0])
    radius, turn = float(outline.radii[corner]), (0.0, float(outline.angles[corner]))
    span = Frame.spanned(middle, first, second).inside(frame)
    if convex:
        return Cone(kind, span, (radius, 0), (radius, height), turn)
    # The third axis points down here, so up is towards negative heights.
    return Cone(kind, span, (radius, 0), (radius, -height), turn)
