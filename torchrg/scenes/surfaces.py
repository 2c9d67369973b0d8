"""Surfaces for uniform sampling, and occluding solids."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes.geometry import Doubles, Frame, Triple, box_around

PlaneEquation = tuple[Doubles, float]
Hole = tuple[float, float, float, float]
"""Rectangular hole in a surface: left, right, low and high end along its first two axes."""


@dataclass(frozen=True, eq=False)
class Surface(ABC):
    """A surface that can be sampled uniformly; a face of a scene.

    Args:
        kind: Kind of the face, such as ``"table edge"``.
        frame: Local coordinate frame.
    """

    kind: str
    frame: Frame

    @property
    def plane(self) -> PlaneEquation | None:
        """Normal and offset of its plane, ``normal . x = offset``; None if curved."""
        return None

    @property
    @abstractmethod
    def area(self) -> float:
        """Area including covered parts."""

    @cached_property
    def bounds(self) -> Doubles:
        """Bounding box, shape ``(2, 3)``."""
        return box_around(self.frame.to_world(self._corners()))

    def sample(self, rng: np.random.Generator, count: int) -> Doubles:
        """Return uniformly distributed points, shape ``(count, 3)``."""
        return self.frame.to_world(self._draw(rng, count))

    @abstractmethod
    def normals_at(self, points: Doubles) -> Doubles:
        """Return the outward unit normals at points of the surface, shape ``(N, 3)``."""

    @abstractmethod
    def _corners(self) -> Doubles:
        """Return local points whose bounding box contains the surface, shape ``(K, 3)``."""

    @abstractmethod
    def _draw(self, rng: np.random.Generator, count: int) -> Doubles:
        """Implement :meth:`sample` in local coordinates."""


@dataclass(frozen=True, eq=False)
class Flat(Surface):
    """A union of disjoint coplanar rectangles or parallelograms.

    Args:
        kind: Kind of the face.
        frame: Local frame: the first two axes span the plane, the third is the outward normal.
        cells: Corner and two edges of each cell, in the plane, shape ``(M, 3, 2)``.
    """

    cells: Doubles

    @property
    def plane(self) -> PlaneEquation:
        """Normal and offset of its plane."""
        normal = self.frame.axes[2]
        return normal, float(np.vecdot(normal, self.frame.origin))

    @cached_property
    def _cell_areas(self) -> Doubles:
        first, second = self.cells[:, 1], self.cells[:, 2]
        areas: Doubles = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        return areas

    @property
    def area(self) -> float:
        """Area including covered parts."""
        return float(self._cell_areas.sum())

    def normals_at(self, points: Doubles) -> Doubles:
        """Return the outward unit normal at each point, shape ``(N, 3)``."""
        return np.broadcast_to(self.frame.axes[2], points.shape)

    def _corners(self) -> Doubles:
        corner, first, second = self.cells[:, 0], self.cells[:, 1], self.cells[:, 2]
        ends = [corner, corner + first, corner + second, corner + first + second]
        return append_zero(np.concatenate(ends))

    def _draw(self, rng: np.random.Generator, count: int) -> Doubles:
        counts = rng.multinomial(count, self._cell_areas / self._cell_areas.sum())
        first, second = rng.random((2, count))
        corner, edge, other = self.cells[np.repeat(np.arange(len(counts)), counts)].swapaxes(0, 1)
        return append_zero(corner + (first[:, None] * edge + second[:, None] * other))


def append_zero(positions: Doubles) -> Doubles:
    """Append a zero coordinate to plane coordinates of shape ``(N, 2)``."""
    return np.column_stack([positions, np.zeros(len(positions))])


def rectangle(
    kind: str, frame: Frame, width: float, height: float, holes: Sequence[Hole] = ()
) -> Flat:
    """Return a rectangle from the origin of a frame along its first two axes, with holes.

    The third axis is the outward normal; the holes are disjoint.
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
class Solid:
    """An occluding box.

    Args:
        frame: Local coordinate frame at the center.
        size: Lengths along the three axes.
    """

    frame: Frame
    size: Triple

    @cached_property
    def bounds(self) -> Doubles:
        """Bounding box, shape ``(2, 3)``."""
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * self.size
        return box_around(self.frame.to_world(corners))

    def contains(self, points: Doubles) -> NDArray[np.bool_]:
        """Return the mask of points of shape ``(N, 3)`` inside or on the solid."""
        farthest: Doubles = (2 * np.abs(self.frame.to_local(points)) / self.size).max(axis=1)
        return farthest <= 1
