"""Flat outlines with sharp and rounded corners and round holes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes.frames import Array


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
    def turns(self) -> Array:
        """Sine of the turn at each corner, positive to the left, shape ``(M,)``."""
        into, out = self.ways
        sines: Array = into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0]
        return sines

    @cached_property
    def tangents(self) -> Array:
        """Distance from each corner to where its rounding starts, shape ``(M,)``."""
        into, out = self.ways
        # tan(turn / 2) = sin / (1 + cos)
        reach: Array = self.radii * np.abs(self.turns) / (1 + (into * out).sum(axis=1))
        return reach

    @cached_property
    def centers(self) -> Array:
        """Middle of each rounding, shape ``(M, 2)``."""
        into, _ = self.ways
        left = np.stack([-into[:, 1], into[:, 0]], axis=1)
        shift = (np.sign(self.turns) * self.radii)[:, None] * left
        middles: Array = self.corners - self.tangents[:, None] * into + shift
        return middles

    @cached_property
    def angles(self) -> Array:
        """Unsigned turn at each corner in radians, shape ``(M,)``."""
        into, out = self.ways
        angles: Array = np.arctan2(np.abs(self.turns), (into * out).sum(axis=1))
        return angles

    @cached_property
    def area(self) -> float:
        """Area inside."""
        x, y = self.corners.T
        whole = ((x * np.roll(y, -1)) - np.roll(x, -1) * y).sum() / 2
        # Between a corner and its arc: a kite less a sector.
        cut = self.radii * self.tangents - self.radii**2 * self.angles / 2
        holes = sum(np.pi * radius**2 for _, _, radius in self.holes)
        return float(whole - (np.sign(self.turns) * cut).sum() - holes)

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
            inside = np.where(between, self.turns[corner] < 0, inside)
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
