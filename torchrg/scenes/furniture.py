"""Furniture of random sizes: doors and windows, cabinets, boards, tables, boxes, round things."""

from collections.abc import Collection, Mapping

import numpy as np

from torchrg.scenes.geometry import Frame, Triple
from torchrg.scenes.scene import Part
from torchrg.scenes.shells import against
from torchrg.scenes.surfaces import Ball, Block, Cone, Drum, Hole, Ring, rectangle

SIDES = ("left", "right", "front", "back")
"""Left and right are across the first axis of a body, front and back across the second."""

_TABLE_HEIGHT = (0.62, 0.92)
"""Least and greatest height of a table top, metres."""


def block(
    kind: str,
    frame: Frame,
    size: Triple,
    *,
    without: Collection[str] = (),
    kinds: Mapping[str, str] | None = None,
) -> Part:
    """Return a rectangular body, and its faces: :data:`SIDES`, "bottom" and "top".

    The third axis of the frame is up, the origin the middle of the base. Faces that something
    covers completely are left out by ``without``; ``kinds`` names those not called ``kind``.
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
    return _board("shelf", against(wall, along, between(rng, 1.1, 1.9), size[1]), size)


def draw_panel(rng: np.random.Generator, wall: Frame, along: float, thickness: float) -> Part:
    """Return an upright board on a wall, up to twice as thick as asked for."""
    size = (between(rng, 1, 1.5), thickness * between(rng, 1, 2), between(rng, 0.8, 1.1))
    return _board("panel", against(wall, along, between(rng, 0.8, 1.1), size[1]), size)


def _board(kind: str, frame: Frame, size: Triple) -> Part:
    """Return a plate fixed to a wall by its back; its narrow faces are called its edge."""
    shortest = int(np.argmin(size))
    pairs = (("left", "right"), ("front", "back"), ("bottom", "top"))
    narrow = [face for axis, pair in enumerate(pairs) if axis != shortest for face in pair]
    names = dict.fromkeys(narrow, f"{kind} edge")
    return block(kind, frame, size, without=["back"], kinds=names)


def draw_table(rng: np.random.Generator, frame: Frame, thickness: float) -> Part:
    """Return a plate with all its faces on a square post."""
    height = between(rng, *_TABLE_HEIGHT)
    length, width, post = between(rng, 1.25, 1.5), between(rng, 0.65, 0.8), between(rng, 0.2, 0.35)
    names = dict.fromkeys(SIDES, "table edge") | {"bottom": "table underside", "top": "table top"}
    under = height - thickness
    plate = block("table", frame.moved(0, 0, under), (length, width, thickness), kinds=names)
    stand = block("table post", frame, (post, post, under), without=("bottom", "top"))
    return Part(plate.surfaces + stand.surfaces, plate.solids + stand.solids)


def draw_round_table(rng: np.random.Generator, frame: Frame, thickness: float) -> Part:
    """Return a disc with a curved edge on a round post."""
    radius, height = between(rng, 0.45, 0.6), between(rng, *_TABLE_HEIGHT)
    under, post = height - thickness, radius / 5
    surfaces = (
        Cone("table underside", frame, (0, under), (radius, under)),
        Cone("table top", frame, (radius, height), (0, height)),
        Cone("table edge", frame, (radius, under), (radius, height)),
        Cone("table post", frame, (post, 0), (post, under)),
    )
    plate = Drum(frame.moved(0, 0, under), radius, thickness)
    return Part(surfaces, (plate, Drum(frame, post, under)))


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
    radius = between(rng, 0.15, 0.3)
    side = Cone("column", frame, (radius, 0), (radius, ceiling))
    return Part((side,), (Drum(frame, radius, ceiling),))


def draw_ball(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a ball on the floor."""
    radius = between(rng, 0.2, 0.4)
    return _ball("ball", frame.moved(0, 0, radius), radius)


def draw_lamp(rng: np.random.Generator, frame: Frame) -> Part:
    """Return a ball that sits on a round post, a little into it."""
    radius, height = between(rng, 0.15, 0.25), between(rng, 1.2, 1.6)
    post = Cone("lamp post", frame, (radius / 5, 0), (radius / 5, height))
    shade = _ball("lamp", frame.moved(0, 0, height + 0.9 * radius), radius)
    return Part((post, *shade.surfaces), (Drum(frame, radius / 5, height), *shade.solids))


def _ball(kind: str, middle: Frame, radius: float) -> Part:
    """Return a ball about the origin of a frame."""
    return Part((Ring(kind, middle, 0, radius),), (Ball(middle.origin, radius),))
