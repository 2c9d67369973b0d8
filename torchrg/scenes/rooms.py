"""Furnished rooms."""

import numpy as np

from torchrg.scenes.frames import Frame
from torchrg.scenes.furnishing import furnish
from torchrg.scenes.layout import RoomLayout
from torchrg.scenes.sampling import Density, NoiseDirection, Order, sample_scene
from torchrg.scenes.scene import Scene, SceneModel
from torchrg.scenes.spacing import free_places
from torchrg.scenes.streams import random_stream

_ROOM_STREAM = 100


def make_room(
    num_points: int = 1_000_000,
    noise: float = 0.003,
    seed: int = 0,
    *,
    layout: RoomLayout | None = None,
    noise_direction: NoiseDirection = "normal",
    density: Density = "uniform",
    outlier_fraction: float = 0.0,
    order: Order = "random",
    colors: bool = False,
) -> Scene:
    """Make a cloud of a furnished room with exact truth.

    Convention:
        Metres, z up, the floor at z = 0 and one of its corners at the origin. The room depends on
        ``seed`` and ``layout`` alone: other settings give other samples of the same room.

    Args:
        num_points: Number of points.
        noise: Standard deviation of the noise, in metres.
        seed: Two calls with equal arguments give equal clouds, on every platform.
        layout: What is in the room. Default: ``RoomLayout()``.
        noise_direction: See :func:`sample_scene`.
        density: See :func:`sample_scene`.
        outlier_fraction: Share of points that belong to no face.
        order: See :func:`sample_scene`.
        colors: Whether to colour the points by object.

    Returns:
        The cloud and its truth.

    Raises:
        ConfigError: If a setting is not allowed, or the room too small for its furniture.

    Example:
        >>> room = make_room(5000, noise=0.002, seed=1)
        >>> room.points.shape, len(room.kinds)
        (torch.Size([5000, 3]), 153)
    """
    return sample_scene(
        build_room(seed, layout=layout),
        num_points,
        noise=noise,
        seed=seed,
        noise_direction=noise_direction,
        density=density,
        outlier_fraction=outlier_fraction,
        order=order,
        colors=colors,
    )


def build_room(seed: int = 0, *, layout: RoomLayout | None = None) -> SceneModel:
    """Build the description of a furnished room, to be sampled or rendered.

    Args:
        seed: Of sizes and places.
        layout: What is in the room. Default: ``RoomLayout()``.

    Returns:
        The scene. Its first six faces are floor, ceiling and walls.

    Raises:
        ConfigError: If the room is too small for its furniture.

    Example:
        >>> [surface.kind for surface in build_room().surfaces[:3]]
        ['floor', 'ceiling', 'wall']
    """
    layout = layout or RoomLayout()
    rng = random_stream(seed, _ROOM_STREAM)
    room = Frame.upright(np.zeros(3), layout.heading_deg)
    parts = furnish(layout, room, rng)
    return SceneModel(parts, free_places(layout, room, parts, rng))
