"""Parts of rooms: walls with doors and windows, and furniture of random size."""

from collections.abc import Collection, Mapping

import numpy as np

from torchrg.scenes.geometry import Frame, Triple
from torchrg.scenes.scene import Part
from torchrg.scenes.surfaces import Hole, Solid, rectangle

SIDES = ("left", "right", "front", "back")
"""Sides of a solid: left and right across its first axis, front and back across the second."""
TABLE_HEIGHT = (0.62, 0.92)
"""Minimum and maximum height of a table top, in meters."""


def room_walls(room: Frame, size: Triple) -> list[Frame]:
    """Return the frames of the four walls: first axis along the wall, second up, third inward."""
    length, width, _ = size
    starts = ((length, 0, 0), (length, width, 0), (0, width, 0), (0, 0, 0))
    along = ((-1, 0, 0), (0, -1, 0), (1, 0, 0), (0, 1, 0))
    return [room.placed(*axes, (0, 0, 1)) for axes in zip(starts, along, strict=True)]


def recess(kind: str, wall: Frame, hole: Hole, depth: float) -> Part:
    """Return the recess behind a hole in a wall: a panel at ``depth``, and the four sides.

    The hole is given along the first two axes of the wall (along and up); the third is inward.
    """
    left, right, low, high = hole
    leaf = rectangle(kind, wall.moved(left, low, -depth), right - left, high - low)
    sill = wall.placed((left, low, -depth), (0, 0, 1), (1, 0, 0))
    under = rectangle(f"{kind} frame", sill, depth, right - left)
    return Part((leaf, under, *passage(f"{kind} frame", wall, hole, depth).surfaces))


def passage(kind: str, wall: Frame, hole: Hole, depth: float) -> Part:
    """Return the left, right and upper side of a hole through a wall of thickness ``depth``."""
    left, right, low, high = hole
    sides = (
        ((left, low, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), high - low),
        ((right, low, -depth), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), high - low),
        ((left, high, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), right - left),
    )
    return Part(
        tuple(rectangle(kind, wall.placed(*axes), depth, length) for *axes, length in sides)
    )


def block(
    kind: str,
    frame: Frame,
    size: Triple,
    *,
    without: Collection[str] = (),
    kinds: Mapping[str, str] | None = None,
) -> Part:
    """Return a box and its faces: :data:`SIDES`, "bottom" and "top".

    The third axis of the frame is up, the origin is the center of the base. ``without`` lists
    completely covered faces; ``kinds`` overrides ``kind`` for single faces.
    """
    x, y, z = size
    corners = {
        "left": ((-x / 2, y / 2, 0), (0, -1, 0), (0, 0, 1), y, z),
        "right": ((x / 2, -y / 2, 0), (0, 1, 0), (0, 0, 1), y, z),
        "front": ((-x / 2, -y / 2, 0), (1, 0, 0), (0, 0, 1), x, z),
        "back": ((x / 2, y / 2, 0), (-1, 0, 0), (0, 0, 1), x, z),
        "bottom": ((-x / 2, y / 2, 0), (1, 0, 0), (0, -1, 0), x, y),
        "top": ((-x / 2, -y / 2, z), (1, 0, 0), (0, 1, 0), x, y),
    }
    surfaces = tuple(
        rectangle((kinds or {}).get(name, kind), frame.placed(corner, u, v), width, height)
        for name, (corner, u, v, width, height) in corners.items()
        if name not in without
    )
    return Part(surfaces, (Solid(frame.moved(0, 0, z / 2), size),))


def against(wall: Frame, along: float, height: float, depth: float) -> Frame:
    """Return the frame of an object with its back against a wall.

    Its first axis is along the wall, the second into the wall, the third up. Its origin is the
    center of its base, ``along`` from the start of the wall and ``height`` above the floor.
    """
    along_axis, up, inwards = wall.axes
    return Frame(wall.moved(along, height, depth / 2).origin, np.stack([along_axis, -inwards, up]))


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a random number in an interval."""
    return float(low + (high - low) * rng.random())


def draw_door(rng: np.random.Generator, middle: float) -> Hole:
    """Return the hole of a door centered at a position along a wall, with a low sill."""
    half = between(rng, 0.42, 0.5)
    return middle - half, middle + half, between(rng, 0.01, 0.05), between(rng, 1.98, 2.15)


def draw_window(rng: np.random.Generator, middle: float, ceiling: float) -> Hole:
    """Return the hole of a window centered at a position along a wall."""
    half, top = between(rng, 0.5, 0.75), ceiling - between(rng, 0.4, 0.8)
    return middle - half, middle + half, between(rng, 0.8, 1.05), top


def draw_cabinet(rng: np.random.Generator, wall: Frame, along: float) -> Part:
    """Return a cabinet on the floor against a wall."""
    size = (between(rng, 0.8, 1.4), between(rng, 0.35, 0.6), between(rng, 0.8, 2.1))
    return block("cabinet", against(wall, along, 0, size[1]), size, without=("bottom", "back"))


def draw_shelf(rng: np.random.Generator, wall: Frame, along: float, thickness: float) -> Part:
    """Return a horizontal board on a wall."""
    size = (between(rng, 1, 1.5), between(rng, 0.38, 0.5), thickness)
    return _board("shelf", against(wall, along, between(rng, 1.1, 1.9), size[1]), size)


def draw_panel(rng: np.random.Generator, wall: Frame, along: float, thickness: float) -> Part:
    """Return a vertical board on a wall, of up to twice the thickness."""
    size = (between(rng, 1, 1.5), thickness * between(rng, 1, 2), between(rng, 0.8, 1.1))
    return _board("panel", against(wall, along, between(rng, 0.8, 1.1), size[1]), size)


def _board(kind: str, frame: Frame, size: Triple) -> Part:
    """Return a board fixed to a wall by its back; its narrow faces are its edge."""
    shortest = int(np.argmin(size))
    pairs = (("left", "right"), ("front", "back"), ("bottom", "top"))
    narrow = [face for axis, pair in enumerate(pairs) if axis != shortest for face in pair]
    names = dict.fromkeys(narrow, f"{kind} edge")
    return block(kind, frame, size, without=["back"], kinds=names)


def draw_table(rng: np.random.Generator, frame: Frame, thickness: float) -> Part:
    """Return a board with all its faces on a square post."""
    height = between(rng, *TABLE_HEIGHT)
    length, width, post = between(rng, 1.25, 1.5), between(rng, 0.65, 0.8), between(rng, 0.2, 0.35)
    names = dict.fromkeys(SIDES, "table edge") | {"bottom": "table underside", "top": "table top"}
    under = height - thickness
    plate = block("table", frame.moved(0, 0, under), (length, width, thickness), kinds=names)
    stand = block("table post", frame, (post, post, under), without=("bottom", "top"))
    return Part(plate.surfaces + stand.surfaces, plate.solids + stand.solids)


def draw_box(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a box on the floor."""
    size = (between(rng, 0.35, 0.8), between(rng, 0.35, 0.6), between(rng, 0.3, 0.9))
    return block("box", frame, size, without=("bottom",))


def draw_small_box(rng: np.random.Generator, top: Frame) -> Part:
    """Return a box on a table, placed near the center of the table top."""
    position = top.moved(between(rng, -0.08, 0.08), between(rng, -0.08, 0.08), 0)
    frame = Frame.upright(position.origin, between(rng, -90, 90))
    size = (between(rng, 0.2, 0.35), between(rng, 0.2, 0.3), between(rng, 0.15, 0.4))
    return block("box", frame, size, without=("bottom",))


def draw_pillar(rng: np.random.Generator, frame: Frame, ceiling: float) -> Part:
    """Return a square pillar."""
    width = between(rng, 0.3, 0.5)
    return block("pillar", frame, (width, width, ceiling), without=("bottom", "top"))
