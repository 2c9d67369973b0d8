"""Rooms with places where a scanner may stand."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from torchrg.errors import ConfigError
from torchrg.scenes import RoomLayout, SceneModel
from torchrg.scenes.geometry import Doubles, Frame
from torchrg.scenes.parts import between
from torchrg.scenes.rooms import ROOM, furnish
from torchrg.scenes.scene import Part, is_occupied, seeded_generator

_CLEARANCES = (1.0, 0.6, 0.4, 0.2)
"""Free space around a scanner in meters, in order of preference."""
_POSITION_TRIES = 50
"""Maximum number of attempts to find a scanner position with each clearance."""


@dataclass(frozen=True, eq=False)
class ScannedModel(SceneModel):
    """A scene with scanner positions in free space, shape ``(V, 3)``, at least one."""

    viewpoints: Doubles


@dataclass(frozen=True)
class ScannedLayout(RoomLayout):
    """A room with scanners."""

    num_viewpoints: int = 1
    """Number of scanner positions, spread along the room."""


def build_scanned_room(seed: int = 0, *, layout: ScannedLayout | None = None) -> ScannedModel:
    """Build the room of :func:`torchrg.scenes.build_room`, with scanner positions."""
    layout = layout or ScannedLayout()
    rng, room = seeded_generator(seed, ROOM), Frame.upright(np.zeros(3), layout.heading_deg)
    parts = furnish(layout, room, rng)
    return ScannedModel(parts, scanner_positions(layout, room, parts, rng))


def scanner_positions(
    layout: ScannedLayout, room: Frame, parts: Sequence[Part], rng: np.random.Generator
) -> Doubles:
    """Return scanner positions, spread along a room, shape ``(num_viewpoints, 3)``.

    Raises:
        ConfigError: If there is no free space.
    """
    length, width, _ = layout.size
    positions: list[Doubles] = []
    for number, clearance in product(range(layout.num_viewpoints), _CLEARANCES):
        for _ in range(_POSITION_TRIES if len(positions) == number else 0):
            x = (number + between(rng, 0.25, 0.75)) / layout.num_viewpoints * length
            y = between(rng, 0.25, 0.75) * width
            position = room.moved(x, y, between(rng, 1.4, 1.7)).origin
            near = position + clearance * (2 * rng.random((64, 3)) - 1)
            if not is_occupied(parts, near).any():
                positions.append(position)
                break
    if len(positions) < layout.num_viewpoints:
        raise ConfigError("build_scanned_room: expected free space, got none; enlarge the room.")
    return np.stack(positions)
