"""What stands where in a room: settings, free places, and the rule that planes are distinct."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchrg.scenes.frames import Array, dot
from torchrg.scenes.scene import Part, plane_table

_FLOOR_CELL = (1.85, 1.35)  # a table with room to turn, metres
_WALL_CELL = 1.9  # a window or a cabinet with wall on both sides
_AISLE = 0.75  # along the walls, for doors and cabinets
_PARALLEL = 1 - 0.02**2 / 2  # cosine of about one degree

Place = tuple[float, float]


@dataclass(frozen=True)
class RoomLayout:
    """What is in a room; lengths in metres. The defaults make 153 faces, 35 of them 4 cm wide."""

    size: tuple[float, float, float] = (9.0, 7.0, 2.8)
    """Length, width, height."""
    num_doors: int = 2
    num_windows: int = 3
    num_cabinets: int = 2
    num_shelves: int = 1
    """Horizontal boards on walls."""
    num_panels: int = 0
    """Upright boards on walls."""
    num_tables: int = 8
    num_boxes: int = 3
    """On the floor."""
    num_small_boxes: int = 2
    """On tables, at most one on each."""
    num_pillars: int = 1
    plate_thickness: float = 0.04
    """Of tables and shelves."""
    panel_thickness: float = 0.02
    heading_deg: float = 0.0
    """How far the room is turned about the upward axis."""
    equal_tables: bool = False
    """Whether all table tops lie in one plane."""
    min_plane_gap: float = 0.005
    """Least distance of any face to the plane of another face that is parallel to it."""


def wall_places(size: tuple[float, float, float]) -> list[tuple[int, float]]:
    """Return where things fit on the four walls: wall, and distance from its start.

    Example:
        >>> wall_places((4.0, 2.0, 3.0))
        [(0, 1.0), (0, 3.0), (1, 1.0), (2, 1.0), (2, 3.0), (3, 1.0)]
    """
    lengths = (size[0], size[1], size[0], size[1])
    return [
        (wall, middle)
        for wall, length in enumerate(lengths)
        for middle in _middles(length, _WALL_CELL)
    ]


def floor_places(size: tuple[float, float, float]) -> list[Place]:
    """Return where things fit on the floor, away from the walls.

    Example:
        >>> floor_places((6.0, 3.2, 3.0))
        [(1.875, 1.6), (4.125, 1.6)]
    """
    xs, ys = (
        _middles(length - 2 * _AISLE, cell)
        for length, cell in zip(size[:2], _FLOOR_CELL, strict=True)
    )
    return [(_AISLE + x, _AISLE + y) for x in xs for y in ys]


def _middles(length: float, cell: float) -> list[float]:
    """Return the middles of as many equal cells of at least ``cell`` as fit into a length."""
    count = max(int(length / cell), 0)
    return [length * (number + 0.5) / count for number in range(count)]


def shares_plane(part: Part, others: Sequence[Part], min_gap: float) -> bool:
    """Return whether a face of a part is closer than ``min_gap`` to the plane of a parallel one.

    Args:
        part: The new object.
        others: The objects that are there.
        min_gap: In metres; zero allows everything.
    """
    mine = [surface for surface in part.surfaces if surface.planar]
    theirs = [surface for other in others for surface in other.surfaces if surface.planar]
    if not mine or not theirs:
        return False
    middles = np.stack([surface.bounds.mean(axis=0) for surface in mine])
    normals, _ = plane_table(mine)
    planes, offsets = plane_table(theirs)
    parallel = np.abs(_products(normals, planes)) > _PARALLEL
    near = np.abs(_products(middles, planes) - offsets) < min_gap
    return bool((parallel & near).any())


def _products(left: Array, right: Array) -> Array:
    """Return the scalar products of all pairs of rows, shape ``(M, N)``."""
    return dot(left[:, None], right[None])
