"""Hallways with doors."""

from torchrg.scenes.layout import RoomLayout
from torchrg.scenes.rooms import make_room
from torchrg.scenes.sampling import Density, NoiseDirection, Order
from torchrg.scenes.scene import Scene

HALL_LAYOUT = RoomLayout(
    size=(24.0, 2.4, 2.7),
    num_doors=14,
    num_windows=1,
    num_cabinets=2,
    num_shelves=0,
    num_panels=5,
    num_tables=0,
    num_boxes=0,
    num_small_boxes=0,
    num_pillars=0,
    min_plane_gap=0.001,
    num_viewpoints=3,
)
"""A hallway with doors on both sides."""


def make_hall(
    num_points: int = 579_313,
    noise: float = 0.003,
    seed: int = 0,
    *,
    noise_direction: NoiseDirection = "normal",
    density: Density = "uniform",
    order: Order = "random",
) -> Scene:
    """Make a cloud of a hallway with doors: :func:`make_room` with ``HALL_LAYOUT``.

    Args:
        num_points: Number of points.
        noise: Standard deviation of the noise, in metres.
        seed: Two calls with equal arguments give equal clouds, on every platform.
        noise_direction: See :func:`sample_scene`.
        density: See :func:`sample_scene`.
        order: See :func:`sample_scene`.

    Returns:
        The cloud and its truth.

    Raises:
        ConfigError: If a setting is not allowed.

    Example:
        >>> make_hall(1000).kinds.count("door")
        14
    """
    return make_room(
        num_points,
        noise,
        seed,
        layout=HALL_LAYOUT,
        noise_direction=noise_direction,
        density=density,
        order=order,
    )
