"""Room around things: no two faces in one plane, free space for a scanner."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from torchrg.errors import ConfigError
from torchrg.scenes.frames import Array, Frame, dot
from torchrg.scenes.layout import RoomLayout
from torchrg.scenes.objects import between
from torchrg.scenes.scene import Part, plane_table

_PARALLEL = 1 - 0.02**2 / 2  # cosine of about one degree
_CLEARANCES = (1.0, 0.6, 0.4, 0.2)  # around a scanner, as much as there is, metres
_TRIES = 50  # with each clearance


def shares_plane(part: Part, others: Sequence[Part], min_gap: float) -> bool:
    """Return whether a face of a part is closer than ``min_gap`` to the plane of a parallel one.

    Args:
        part: The new object.
        others: The objects that are there.
        min_gap: In metres; zero allows everything.

    Returns:
        Whether there is such a face.
    """
    mine = [surface for surface in part.surfaces if surface.plane is not None]
    theirs = [surface for other in others for surface in other.surfaces if surface.plane]
    if not mine or not theirs:
        return False
    middles = np.stack([surface.bounds.mean(axis=0) for surface in mine])
    normals, _ = plane_table(mine)
    planes, offsets = plane_table(theirs)
    parallel = np.abs(dot(normals[:, None], planes[None])) > _PARALLEL
    near = np.abs(dot(middles[:, None], planes[None]) - offsets) < min_gap
    return bool((parallel & near).any())


def free_places(
    layout: RoomLayout, room: Frame, parts: Sequence[Part], rng: np.random.Generator
) -> Array:
    """Return places for a scanner, spread along a room, shape ``(num_viewpoints, 3)``.

    Raises:
        ConfigError: If there is no free space.
    """
    solids = [solid for part in parts for solid in part.solids]
    length, width, _ = layout.size
    found: list[Array] = []
    for number, clearance in product(range(layout.num_viewpoints), _CLEARANCES):
        for _ in range(_TRIES if len(found) == number else 0):
            x = (number + between(rng, 0.25, 0.75)) / layout.num_viewpoints * length
            place = room.moved(x, between(rng, 0.25, 0.75) * width, between(rng, 1.4, 1.7)).origin
            near = place + clearance * (2 * rng.random((64, 3)) - 1)
            if not any(solid.contains(near).any() for solid in solids):
                found.append(place)
                break
    if len(found) < layout.num_viewpoints:
        raise ConfigError(
            "build_room: expected free space for a scanner in the room, got none; enlarge it."
        )
    return np.stack(found)
