"""Local coordinate frames of scene parts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Triple = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Frame:
    """An origin and three orthonormal axes.

    Args:
        origin: Shape ``(3,)``.
        axes: The axes as rows, shape ``(3, 3)``, right-handed.
    """

    origin: Doubles
    axes: Doubles

    @classmethod
    def upright(cls, origin: Doubles, heading_deg: float = 0.0) -> "Frame":
        """Return a frame with its third axis up, rotated about it by ``heading_deg``."""
        heading = np.deg2rad(heading_deg)
        cosine, sine = np.cos(heading), np.sin(heading)
        return cls(origin, np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1.0]]))

    @classmethod
    def spanned(cls, origin: Doubles, first: Doubles, second: Doubles) -> "Frame":
        """Return a frame with its first axis along ``first``, and ``second`` in its first plane."""
        axis0 = unit(first)
        axis1 = unit(second - np.vecdot(second, axis0) * axis0)
        return cls(origin, np.stack([axis0, axis1, np.cross(axis0, axis1)]))

    def placed(self, origin: Triple, first: Triple, second: Triple) -> "Frame":
        """Return another frame, defined in this one by its origin and two directions."""
        local = Frame.spanned(*(np.array(v, dtype=np.float64) for v in (origin, first, second)))
        return local.inside(self)

    def moved(self, x: float, y: float = 0, z: float = 0) -> "Frame":
        """Return this frame translated by local coordinates."""
        return Frame(self.to_world(np.array((x, y, z), dtype=np.float64)), self.axes)

    def inside(self, outer: "Frame") -> "Frame":
        """Transform this frame from ``outer`` to the world coordinates of ``outer``."""
        return Frame(outer.to_world(self.origin), outer.vectors_to_world(self.axes))

    def to_world(self, local: Doubles) -> Doubles:
        """Transform points of shape ``(*, 3)`` from this frame to world coordinates."""
        return self.origin + self.vectors_to_world(local)

    def to_local(self, world: Doubles) -> Doubles:
        """Transform points of shape ``(*, 3)`` from world coordinates to this frame."""
        return self.vectors_to_local(world - self.origin)

    def vectors_to_world(self, local: Doubles) -> Doubles:
        """Rotate vectors of shape ``(*, 3)`` from this frame to world axes."""
        # The rounding of a matrix product would depend on the number of rows.
        world: Doubles = np.einsum("...i,ij->...j", local, self.axes)
        return world

    def vectors_to_local(self, world: Doubles) -> Doubles:
        """Rotate vectors of shape ``(*, 3)`` from world axes to this frame."""
        local: Doubles = np.vecdot(world[..., None, :], self.axes)
        return local


def unit(vectors: Doubles) -> Doubles:
    """Normalize vectors of shape ``(*, 3)``."""
    result: Doubles = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result


def box_around(points: Doubles) -> Doubles:
    """Return the bounding box of points of shape ``(N, 3)``, shape ``(2, 3)``."""
    return np.stack([points.min(axis=0), points.max(axis=0)])
