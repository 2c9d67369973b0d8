"""Rooms without furniture: floor, ceiling, walls straight or bent, and holes in walls."""

from collections.abc import Sequence

import numpy as np

from torchrg.scenes.geometry import Frame, Triple
from torchrg.scenes.scene import Part
from torchrg.scenes.surfaces import Cone, Drum, Hole, Surface, rectangle


def shell(
    room: Frame,
    size: Triple,
    holes: Sequence[Sequence[Hole]],
    *,
    bends: Sequence[float] = (0, 0, 0, 0),
    with_floor: bool = True,
) -> Part:
    """Return floor, which is the first face, ceiling and four walls with holes in them.

    The origin of ``room`` is a corner of the floor; ``holes`` are those of each wall of
    :func:`room_walls`, in its first two axes; ``bends`` say how far the middle of each wall bulges
    into the room, 0 for a flat wall. Bent walls have no holes.
    """
    length, width, height = size
    above = room.placed((0, width, height), (1, 0, 0), (0, -1, 0))
    surfaces: list[Surface] = [rectangle("floor", room, length, width)] if with_floor else []
    surfaces.append(rectangle("ceiling", above, length, width))
    solids: list[Drum] = []
    walls = zip(room_walls(room, size), (length, width) * 2, holes, bends, strict=True)
    for frame, along, openings, bend in walls:
        if bend > 0:
            surface, body = _bent_wall(frame, along, height, bend)
            surfaces.append(surface)
            solids.append(body)
        else:
            surfaces.append(rectangle("wall", frame, along, height, openings))
    return Part(tuple(surfaces), tuple(solids))


def room_walls(room: Frame, size: Triple) -> list[Frame]:
    """Return the frames of the four walls: first axis along the wall, second up, third inwards.

    Example:
        >>> walls = room_walls(Frame.upright(np.zeros(3)), (4, 3, 2.5))
        >>> [wall.axes[2].tolist()[:2] for wall in walls]
        [[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]]
    """
    length, width, _ = size
    starts = ((length, 0), (length, width), (0, width), (0, 0))
    along = ((-1, 0), (0, -1), (1, 0), (0, 1))
    return [
        room.placed((*start, 0), (*axis, 0), (0, 0, 1))
        for start, axis in zip(starts, along, strict=True)
    ]


def _bent_wall(wall: Frame, length: float, height: float, bend: float) -> tuple[Cone, Drum]:
    """Return an arc of a large cylinder through both ends of a wall, and what is behind it."""
    radius = length * length / (8 * bend) + bend / 2
    axis = wall.placed((length / 2, 0, bend - radius), (0, 0, 1), (1, 0, 0))
    half = float(np.arcsin(length / 2 / radius))
    surface = Cone("wall", axis, (radius, 0), (radius, height), (-half, half))
    return surface, Drum(axis, radius, height)


def recess(kind: str, wall: Frame, hole: Hole, depth: float) -> Part:
    """Return what is behind a hole in a wall: a leaf ``depth`` behind it, and the four sides to it.

    The hole is in the first two axes of the wall, along it and up; the third is into the room.
    """
    left, right, low, high = hole
    leaf = rectangle(kind, wall.moved(left, low, -depth), right - left, high - low)
    sill = wall.placed((left, low, -depth), (0, 0, 1), (1, 0, 0))
    under = rectangle(f"{kind} frame", sill, depth, right - left)
    return Part((leaf, under, *passage(f"{kind} frame", wall, hole, depth).surfaces))


def passage(kind: str, wall: Frame, hole: Hole, depth: float) -> Part:
    """Return the left, right and upper side of a hole through a wall of a thickness ``depth``."""
    left, right, low, high = hole
    sides = (
        ((left, low, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), high - low),
        ((right, low, -depth), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), high - low),
        ((left, high, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), right - left),
    )
    return Part(
        tuple(rectangle(kind, wall.placed(*axes), depth, length) for *axes, length in sides)
    )


def against(wall: Frame, along: float, height: float, depth: float) -> Frame:
    """Return the frame of an object of a depth with its back against a wall.

    Its first axis is along the wall, the second into it, the third up; its origin is the middle
    of its base, ``along`` from the start of the wall and ``height`` above the floor.
    """
    along_axis, up, inwards = wall.axes
    return Frame(wall.moved(along, height, depth / 2).origin, np.stack([along_axis, -inwards, up]))
