"""Objects made of flat faces: blocks, tables, boards, recesses for doors and windows."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from torchrg.scenes.frames import Frame
from torchrg.scenes.scene import Part
from torchrg.scenes.solids import Block
from torchrg.scenes.surfaces import Flat, rectangle

SIDES = ("left", "right", "front", "back")
FACES = (*SIDES, "bottom", "top")

Hole = tuple[float, float, float, float]


def block(
    kind: str,
    frame: Frame,
    size: tuple[float, float, float],
    *,
    without: Collection[str] = (),
    kinds: Mapping[str, str] | None = None,
) -> Part:
    """Return a rectangular body standing on the origin of a frame.

    Args:
        kind: What it is.
        frame: The third axis is up, the origin is the middle of the base.
        size: Lengths along the three axes.
        without: Faces left out because something covers all of them, out of ``FACES``; left and
            right are across the first axis, front and back across the second.
        kinds: Names of faces that are not called ``kind``.

    Returns:
        The body and its faces.

    Example:
        >>> box = block("box", Frame.upright(np.zeros(3)), (1, 1, 1), without=["bottom"])
        >>> len(box.surfaces)
        5
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
        rectangle((kinds or {}).get(name, kind), _turned(frame, corner, u, v), width, height)
        for name, (corner, u, v, width, height) in corners.items()
        if name not in without
    )
    return Part(surfaces, (Block(frame, size),))


def table(frame: Frame, size: tuple[float, float, float], *, thickness: float, post: float) -> Part:
    """Return a table: a plate with all its faces on a square post.

    Args:
        frame: The third axis is up, the origin is on the floor under its middle.
        size: Length, width, and height of the upper side.
        thickness: Of the plate.
        post: Width of the post.

    Returns:
        The table, of ten faces.

    Example:
        >>> desk = table(Frame.upright(np.zeros(3)), (1.6, 0.8, 0.75), thickness=0.04, post=0.3)
        >>> len(desk.surfaces)
        10
    """
    length, width, height = size
    names = dict.fromkeys(SIDES, "table edge") | {"bottom": "table underside", "top": "table top"}
    under = height - thickness
    plate = block("table", frame.moved(0, 0, under), (length, width, thickness), kinds=names)
    stand = block("table post", frame, (post, post, under), without=("bottom", "top"))
    return Part(plate.surfaces + stand.surfaces, plate.solids + stand.solids)


def board(kind: str, frame: Frame, size: tuple[float, float, float]) -> Part:
    """Return a plate fixed to a wall by its back: a shelf, or a panel.

    Args:
        kind: What it is; its narrow faces are called ``kind`` and "edge".
        frame: The third axis is up; the origin is the middle of the base, the second axis points
            into the wall; see :func:`against`.
        size: Lengths along the three axes; the shortest is the thickness.

    Returns:
        The plate, of five faces.

    Example:
        >>> board("shelf", Frame.upright(np.zeros(3)), (1, 0.3, 0.04)).surfaces[0].kind
        'shelf edge'
    """
    shortest = int(np.argmin(size))
    pairs = (("left", "right"), ("front", "back"), ("bottom", "top"))
    narrow = [face for axis, pair in enumerate(pairs) if axis != shortest for face in pair]
    names = dict.fromkeys(narrow, f"{kind} edge")
    return block(kind, frame, size, without=["back"], kinds=names)


def recess(wall: Frame, hole: Hole, depth: float, kind: str) -> Part:
    """Return what is behind a hole in a wall: a leaf, or a pane, and the four sides to it.

    Args:
        wall: First axis along the wall, second up, third into the room.
        hole: Left, right, low and high end of the hole along the first two axes.
        depth: How far behind the wall the leaf is.
        kind: What the leaf is; the sides are called ``kind`` and "frame".

    Returns:
        Five faces.

    Example:
        >>> wall = Frame.spanned(np.zeros(3), np.array([1.0, 0, 0]), np.array([0.0, 0, 1]))
        >>> recess(wall, (1, 2, 0.02, 2), 0.1, "door").surfaces[0].frame.origin.tolist()
        [1.0, 0.1, 0.02]
    """
    left, right, low, high = hole
    width, height = right - left, high - low
    sides = (
        ((left, low, 0), (0, 0, -1), (0, 1, 0), depth, height),
        ((right, low, -depth), (0, 0, 1), (0, 1, 0), depth, height),
        ((left, low, -depth), (0, 0, 1), (1, 0, 0), depth, width),
        ((left, high, 0), (0, 0, -1), (1, 0, 0), depth, width),
    )
    leaf = rectangle(kind, wall.moved(left, low, -depth), width, height)
    frames: list[Flat] = [
        rectangle(f"{kind} frame", _turned(wall, corner, u, v), a, b)
        for corner, u, v, a, b in sides
    ]
    return Part((leaf, *frames))


def room_walls(room: Frame, size: tuple[float, float, float]) -> list[Frame]:
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
        _turned(room, (*start, 0), (*axis, 0), (0, 0, 1))
        for start, axis in zip(starts, along, strict=True)
    ]


def shell(room: Frame, size: tuple[float, float, float], holes: Sequence[Sequence[Hole]]) -> Part:
    """Return floor, ceiling and four walls with holes in them.

    Example:
        >>> walls = shell(Frame.upright(np.zeros(3)), (4, 3, 2.5), [[]] * 4).surfaces
        >>> [wall.area for wall in walls]
        [12.0, 12.0, 10.0, 7.5, 10.0, 7.5]
    """
    length, width, height = size
    floor = rectangle("floor", room, length, width)
    above = _turned(room, (0, width, height), (1, 0, 0), (0, -1, 0))
    ceiling = rectangle("ceiling", above, length, width)
    lengths = (length, width, length, width)
    walls = (
        rectangle("wall", frame, along, height, openings)
        for frame, along, openings in zip(room_walls(room, size), lengths, holes, strict=True)
    )
    return Part((floor, ceiling, *walls))


def against(wall: Frame, along: float, height: float, depth: float) -> Frame:
    """Return the frame of an object with its back against a wall.

    Args:
        wall: See :func:`room_walls`.
        along: Distance of the object's middle from the start of the wall.
        height: Of the object's base.
        depth: Of the object.

    Returns:
        First axis along the wall, second into it, third up; the origin is the middle of the base.

    Example:
        >>> wall = room_walls(Frame.upright(np.zeros(3)), (4, 3, 2.5))[0]
        >>> against(wall, 1, 0.5, 0.4).origin.tolist()
        [3.0, 0.2, 0.5]
    """
    along_axis, up, inwards = wall.axes
    return Frame(wall.moved(along, height, depth / 2).origin, np.stack([along_axis, -inwards, up]))


def _turned(
    outer: Frame,
    origin: tuple[float, float, float],
    first: tuple[float, float, float],
    second: tuple[float, float, float],
) -> Frame:
    """Return the frame of a face, given by its origin and first two axes in another frame."""
    local = Frame.spanned(
        np.array(origin, dtype=np.float64),
        np.array(first, dtype=np.float64),
        np.array(second, dtype=np.float64),
    )
    return local.inside(outer)
