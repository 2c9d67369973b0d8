"""Furniture: blocks, tables, boards, and round things."""

from collections.abc import Collection, Mapping

import numpy as np

from torchrg.scenes.geometry import Frame, Triple
from torchrg.scenes.round import Cone, Ring
from torchrg.scenes.scene import Part
from torchrg.scenes.shells import Hole, against
from torchrg.scenes.surfaces import Ball, Block, Drum, rectangle

SIDES = ("left", "right", "front", "back")
FACES = (*SIDES, "bottom", "top")


def block(
    kind: str,
    frame: Frame,
    size: Triple,
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
        rectangle((kinds or {}).get(name, kind), frame.placed(corner, u, v), width, height)
        for name, (corner, u, v, width, height) in corners.items()
        if name not in without
    )
    return Part(surfaces, (Block(frame, size),))


def table(frame: Frame, size: Triple, *, thickness: float, post: float) -> Part:
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


def board(kind: str, frame: Frame, size: Triple) -> Part:
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


def round_table(frame: Frame, radius: float, height: float, *, thickness: float) -> Part:
    """Return a round table: a disc with a curved edge on a round post.

    Args:
        frame: The third axis is up, the origin is on the floor under its middle.
        radius: Of the plate.
        height: Of the upper side.
        thickness: Of the plate.

    Returns:
        The table: two discs, the edge and the post.

    Example:
        >>> desk = round_table(Frame.upright(np.zeros(3)), 0.5, 0.75, thickness=0.04)
        >>> [surface.plane is None for surface in desk.surfaces]
        [False, False, True, True]
    """
    under, post = height - thickness, radius / 5
    surfaces = (
        Cone("table underside", frame, (0, under), (radius, under)),
        Cone("table top", frame, (radius, height), (0, height)),
        Cone("table edge", frame, (radius, under), (radius, height)),
        Cone("table post", frame, (post, 0), (post, under)),
    )
    plate = Drum(frame.moved(0, 0, under), radius, thickness)
    return Part(surfaces, (plate, Drum(frame, post, under)))


def column(frame: Frame, radius: float, height: float) -> Part:
    """Return a round column from the floor to the ceiling."""
    side = Cone("column", frame, (radius, 0), (radius, height))
    return Part((side,), (Drum(frame, radius, height),))


def ball(frame: Frame, radius: float) -> Part:
    """Return a ball on the floor."""
    middle = frame.moved(0, 0, radius)
    return Part((Ring("ball", middle, 0, radius),), (Ball(middle.origin, radius),))


def lamp(frame: Frame, radius: float, height: float) -> Part:
    """Return a lamp: a ball on a round post of the given height."""
    post, middle = radius / 5, frame.moved(0, 0, height + 0.9 * radius)
    surfaces = (
        Cone("lamp post", frame, (post, 0), (post, height)),
        Ring("lamp", middle, 0, radius),
    )
    return Part(surfaces, (Drum(frame, post, height), Ball(middle.origin, radius)))


_TABLE_HEIGHT = (0.62, 0.92)


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a random number between two others."""
    return float(low + (high - low) * rng.random())


def draw_door(rng: np.random.Generator, middle: float) -> Hole:
    """Return the hole of a door around a place of a wall, with a low sill."""
    half = between(rng, 0.42, 0.5)
    return middle - half, middle + half, between(rng, 0.01, 0.05), between(rng, 1.98, 2.15)


def draw_window(rng: np.random.Generator, middle: float, ceiling: float) -> Hole:
    """Return the hole of a window around a place of a wall."""
    half, top = between(rng, 0.5, 0.75), ceiling - between(rng, 0.4, 0.8)
    return middle - half, middle + half, between(rng, 0.8, 1.05), top


def draw_cabinet(rng: np.random.Generator, wall: Frame, along: float) -> Part:
    """Return a cabinet on the floor against a wall."""
    size = (between(rng, 0.8, 1.4), between(rng, 0.35, 0.6), between(rng, 0.8, 2.1))
    return block("cabinet", against(wall, along, 0, size[1]), size, without=("bottom", "back"))


def draw_shelf(rng: np.random.Generator, wall: Frame, along: float, thickness: float) -> Part:
    """Return a horizontal board on a wall."""
    size = (between(rng, 1, 1.5), between(rng, 0.38, 0.5), thickness)
    return board("shelf", against(wall, along, between(rng, 1.1, 1.9), size[1]), size)


def draw_panel(rng: np.random.Generator, wall: Frame, along: float, thickness: float) -> Part:
    """Return an upright board on a wall, up to twice as thick as asked for."""
    size = (between(rng, 1, 1.5), thickness * between(rng, 1, 2), between(rng, 0.8, 1.1))
    return board("panel", against(wall, along, between(rng, 0.8, 1.1), size[1]), size)


def draw_table(
    rng: np.random.Generator, frame: Frame, thickness: float, height: float | None
) -> Part:
    """Return a table, of random height unless one is given."""
    height = between(rng, *_TABLE_HEIGHT) if height is None else height
    size = (between(rng, 1.25, 1.5), between(rng, 0.65, 0.8), height)
    return table(frame, size, thickness=thickness, post=between(rng, 0.2, 0.35))


def draw_round_table(rng: np.random.Generator, frame: Frame, thickness: float) -> Part:
    """Return a round table."""
    radius, height = between(rng, 0.45, 0.6), between(rng, *_TABLE_HEIGHT)
    return round_table(frame, radius, height, thickness=thickness)


def draw_box(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a box that stands on the floor."""
    size = (between(rng, 0.35, 0.8), between(rng, 0.35, 0.6), between(rng, 0.3, 0.9))
    return block("box", frame, size, without=("bottom",))


def draw_small_box(rng: np.random.Generator, top: Frame) -> Part:
    """Return a box that stands on a table, given the middle of the table's upper side."""
    place = top.moved(between(rng, -0.08, 0.08), between(rng, -0.08, 0.08), 0)
    frame = Frame.upright(place.origin, between(rng, -90, 90))
    size = (between(rng, 0.2, 0.35), between(rng, 0.2, 0.3), between(rng, 0.15, 0.4))
    return block("box", frame, size, without=("bottom",))


def draw_pillar(rng: np.random.Generator, frame: Frame, ceiling: float) -> Part:
    """Return a square pillar."""
    width = between(rng, 0.3, 0.5)
    return block("pillar", frame, (width, width, ceiling), without=("bottom", "top"))


def draw_column(rng: np.random.Generator, frame: Frame, ceiling: float) -> Part:
    """Return a round pillar."""
    return column(frame, between(rng, 0.15, 0.3), ceiling)


def draw_ball(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a ball on the floor."""
    return ball(frame, between(rng, 0.2, 0.4))


def draw_lamp(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a lamp on the floor."""
    return lamp(frame, between(rng, 0.15, 0.25), between(rng, 1.2, 1.6))
