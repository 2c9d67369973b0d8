"""Objects of random size: what stands in rooms and hangs on their walls."""

import numpy as np

from torchrg.scenes.frames import Frame
from torchrg.scenes.furniture import ball, block, board, column, lamp, round_table, table
from torchrg.scenes.scene import Part
from torchrg.scenes.shells import Hole, against

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
