"""Storeys: a hallway and furnished rooms along it, joined by open doors."""

from dataclasses import replace

import numpy as np

from torchrg.scenes.frames import Frame
from torchrg.scenes.furnishing import furnish
from torchrg.scenes.furniture import SIDES, block
from torchrg.scenes.objects import between
from torchrg.scenes.sampling import Density, NoiseDirection, Order, sample_scene
from torchrg.scenes.scene import Part, Scene, SceneModel
from torchrg.scenes.shells import passage, room_walls
from torchrg.scenes.spacing import free_places
from torchrg.scenes.storey_layout import HALL_WALLS, StoreyLayout, StoreyRoom, draw_rooms
from torchrg.scenes.streams import random_stream
from torchrg.scenes.surfaces import Flat

_STOREY_STREAM = 500
_DOOR_LEAF = 0.04  # thickness, metres
_FIRST_WALL = 0  # of a room: the one along the hallway


def make_storey(
    num_points: int = 1_097_901,
    noise: float = 0.003,
    seed: int = 0,
    *,
    layout: StoreyLayout | None = None,
    noise_direction: NoiseDirection = "normal",
    density: Density = "uniform",
    order: Order = "random",
) -> Scene:
    """Make a cloud of a hallway and the furnished rooms along it.

    The floor runs through the open doors and is one face; every ceiling is at a height of its own.
    Within each room no face lies in the plane of another.

    Args:
        num_points: Number of points.
        noise: Standard deviation of the noise, in metres.
        seed: Two calls with equal arguments give equal clouds, on every platform.
        layout: Number and sizes of the rooms, and what is in them. Default: ``StoreyLayout()``.
        noise_direction: See :func:`sample_scene`.
        density: See :func:`sample_scene`.
        order: See :func:`sample_scene`.

    Returns:
        The cloud and its truth.

    Raises:
        ConfigError: If a setting is not allowed, or a room too small for its furniture.

    Example:
        >>> make_storey(1000).kinds.count("ceiling")
        9
    """
    return sample_scene(
        build_storey(seed, layout=layout),
        num_points,
        noise=noise,
        seed=seed,
        noise_direction=noise_direction,
        density=density,
        order=order,
    )


def build_storey(seed: int = 0, *, layout: StoreyLayout | None = None) -> SceneModel:
    """Build the description of a hallway and the rooms along it.

    Args:
        seed: Of sizes and places.
        layout: Number and sizes of the rooms, and what is in them. Default: ``StoreyLayout()``.

    Returns:
        The scene. Its first face is the floor.

    Raises:
        ConfigError: If a room is too small for its furniture.

    Example:
        >>> build_storey().surfaces[0].kind
        'floor'
    """
    layout, rng = layout or StoreyLayout(), random_stream(seed, _STOREY_STREAM)
    width = layout.hall.size[1]
    rooms = draw_rooms(layout, width, rng)
    length = max(room.left + room.size[0] for room in rooms) + between(rng, 0.2, 0.5)
    hall_layout = replace(layout.hall, size=(length, width, layout.hall.size[2]))
    hall = Frame.upright(np.zeros(3))
    walls = room_walls(hall, hall_layout.size)
    doorways = [(room.hall_wall, room.hall_doorway(length)) for room in rooms]
    hall_parts = furnish(hall_layout, hall, rng, doorways=doorways, with_floor=False)
    parts: list[Part] = [Part((_floor(rooms, length, width),)), *hall_parts]
    viewpoints = [free_places(hall_layout, hall, hall_parts, rng)]
    for room, (wall, doorway) in zip(rooms, doorways, strict=True):
        room_layout = replace(layout.room, size=room.size)
        contents = furnish(
            room_layout, room.frame, rng, doorways=[(_FIRST_WALL, room.doorway)], with_floor=False
        )
        parts += [passage("door frame", walls[wall], doorway, room.thickness), *contents]
        parts.append(_open_door(room, rng))
        viewpoints.append(free_places(room_layout, room.frame, parts, rng))
    return SceneModel(tuple(parts), np.concatenate(viewpoints))


def _floor(rooms: list[StoreyRoom], length: float, width: float) -> Flat:
    """Return the floor of the hallway, the rooms and the doorways between them."""
    pieces = [[(0.0, 0.0), (length, 0.0), (0.0, width)]]
    for room in rooms:
        corners = np.array([(0, 0, 0), (room.size[0], room.size[1], 0)])
        (left, low), (right, high) = np.sort(room.frame.to_world(corners)[:, :2], axis=0)
        pieces.append([(left, low), (right - left, 0), (0, high - low)])
        start, end = room.span()
        below = -room.thickness if room.hall_wall == HALL_WALLS[0] else width
        pieces.append([(start, below), (end - start, 0), (0, room.thickness)])
    return Flat("floor", Frame.upright(np.zeros(3)), np.array(pieces))


def _open_door(room: StoreyRoom, rng: np.random.Generator) -> Part:
    """Return the leaf of an open door, inside the room beside the doorway."""
    left, right, top = room.door
    hinge = left - 0.1 if left < room.size[0] / 2 else right + 0.1
    frame = room.frame.moved(hinge, 0.05 + (right - left) / 2, between(rng, 0.01, 0.03))
    turned = Frame.upright(np.zeros(3), between(rng, -6, 6)).inside(frame)
    size = (_DOOR_LEAF, right - left, top - 0.04)
    names = dict.fromkeys((*SIDES[2:], "bottom", "top"), "door edge")
    return block("door", turned, size, kinds=names)
