"""Furnished rooms."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from torchrg.errors import ConfigError
from torchrg.scenes.frames import Array, Frame
from torchrg.scenes.furniture import Hole, against, block, board, recess, room_walls, shell, table
from torchrg.scenes.layout import Place, RoomLayout, floor_places, shares_plane, wall_places
from torchrg.scenes.sampling import Density, NoiseDirection, Order, random_stream, sample_scene
from torchrg.scenes.scene import Part, Scene, SceneModel

T = TypeVar("T")
_TRIES = 1000
_CLEARANCE = 0.3  # around a scanner, metres


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
    return _Builder(layout or RoomLayout(), random_stream(seed, 100)).build()


class _Builder:
    """Places objects one after the other, so that no two faces share a plane."""

    def __init__(self, layout: RoomLayout, rng: np.random.Generator) -> None:
        self.layout, self.rng = layout, rng
        self.room = Frame.upright(np.zeros(3), layout.heading_deg)
        self.walls = room_walls(self.room, layout.size)
        self.holes: list[list[Hole]] = [[] for _ in self.walls]
        self.parts = [shell(self.room, layout.size, self.holes)]
        at_walls, on_floor = wall_places(layout.size), floor_places(layout.size)
        self.wall_places = [at_walls[row] for row in rng.permutation(len(at_walls))]
        self.floor_places = [on_floor[row] for row in rng.permutation(len(on_floor))]

    def build(self) -> SceneModel:
        """Return the finished room."""
        layout = self.layout
        for kind, count in (("door", layout.num_doors), ("window", layout.num_windows)):
            for _ in range(count):
                self._open_wall(kind)
        self.parts[0] = shell(self.room, layout.size, self.holes)
        for draw_at, count in (
            (self._draw_cabinet, layout.num_cabinets),
            (self._draw_shelf, layout.num_shelves),
            (self._draw_panel, layout.num_panels),
        ):
            for _ in range(count):
                self._place_at_wall(draw_at)
        for number in range(layout.num_tables):
            self._place_table(with_box=number < layout.num_small_boxes)
        for draw_on, count in (
            (self._draw_box, layout.num_boxes),
            (self._draw_pillar, layout.num_pillars),
        ):
            for _ in range(count):
                self._place_on_floor(draw_on)
        model = SceneModel(tuple(self.parts), np.zeros((0, 3)))
        return replace(model, viewpoints=self._free_places(model))

    def _place(self, draw: Callable[[], Part], *, min_gap: float | None = None) -> None:
        """Add the first of several drawn objects that has no face in the plane of another."""
        gap = self.layout.min_plane_gap if min_gap is None else min_gap
        for _ in range(_TRIES):
            part = draw()
            if not shares_plane(part, self.parts, gap):
                self.parts.append(part)
                return
        raise ConfigError(
            f"build_room: expected no face within min_plane_gap={gap} of the plane of another, "
            f"got too many objects for that; lower it."
        )

    def _between(self, low: float, high: float) -> float:
        return float(low + (high - low) * self.rng.random())

    def _standing(self, middle: Place, *, turn_deg: float = 90, play: float = 0.1) -> Frame:
        """Return an upright frame on the floor near a place, turned by up to ``turn_deg``."""
        x, y = (value + self._between(-play, play) for value in middle)
        heading = self.layout.heading_deg + self._between(-turn_deg, turn_deg)
        return Frame.upright(self.room.moved(x, y, 0).origin, heading)

    def _open_wall(self, kind: str) -> None:
        """Put a door or a window into a free place of a wall."""
        wall, middle = _take(self.wall_places, "walls")
        holes: list[Hole] = []

        def draw() -> Part:
            holes.append(self._draw_door(middle) if kind == "door" else self._draw_window(middle))
            return recess(self.walls[wall], holes[-1], self._between(0.06, 0.16), kind)

        self._place(draw)
        self.holes[wall].append(holes[-1])

    def _draw_door(self, middle: float) -> Hole:
        half = self._between(0.42, 0.5)
        return middle - half, middle + half, self._between(0.01, 0.05), self._between(1.98, 2.15)

    def _draw_window(self, middle: float) -> Hole:
        half, top = self._between(0.5, 0.75), self.layout.size[2] - self._between(0.4, 0.8)
        return middle - half, middle + half, self._between(0.8, 1.05), top

    def _place_at_wall(self, draw: Callable[[Frame, float], Part]) -> None:
        wall, middle = _take(self.wall_places, "walls")
        self._place(lambda: draw(self.walls[wall], middle + self._between(-0.1, 0.1)))

    def _draw_cabinet(self, wall: Frame, along: float) -> Part:
        size = (self._between(0.8, 1.4), self._between(0.35, 0.6), self._between(0.8, 2.1))
        return block("cabinet", against(wall, along, 0, size[1]), size, without=("bottom", "back"))

    def _draw_shelf(self, wall: Frame, along: float) -> Part:
        size = (self._between(1, 1.5), self._between(0.25, 0.4), self.layout.plate_thickness)
        return board("shelf", against(wall, along, self._between(1.1, 1.9), size[1]), size)

    def _draw_panel(self, wall: Frame, along: float) -> Part:
        size = (self._between(1, 1.5), self.layout.panel_thickness, self._between(0.8, 1.1))
        return board("panel", against(wall, along, self._between(0.8, 1.1), size[1]), size)

    def _place_table(self, *, with_box: bool) -> None:
        """Put a table on the floor, and on it perhaps a box."""
        middle = _take(self.floor_places, "floor")
        drawn: list[tuple[Frame, float]] = []

        def draw() -> Part:
            height = 0.74 if self.layout.equal_tables else self._between(0.66, 0.84)
            size = (self._between(1.25, 1.5), self._between(0.65, 0.8), height)
            drawn.append((self._standing(middle, turn_deg=12), height))
            thickness, post = self.layout.plate_thickness, self._between(0.2, 0.35)
            return table(drawn[-1][0], size, thickness=thickness, post=post)

        self._place(draw, min_gap=0.0 if self.layout.equal_tables else None)
        if with_box:
            self._place(lambda: self._draw_small_box(*drawn[-1]))

    def _draw_small_box(self, table_frame: Frame, height: float) -> Part:
        place = table_frame.moved(self._between(-0.35, 0.35), self._between(-0.08, 0.08), height)
        frame = Frame.upright(place.origin, self._between(-90, 90))
        size = (self._between(0.2, 0.35), self._between(0.2, 0.3), self._between(0.15, 0.4))
        return block("box", frame, size, without=("bottom",))

    def _place_on_floor(self, draw: Callable[[Frame], Part]) -> None:
        middle = _take(self.floor_places, "floor")
        self._place(lambda: draw(self._standing(middle)))

    def _draw_box(self, frame: Frame) -> Part:
        size = (self._between(0.35, 0.8), self._between(0.35, 0.6), self._between(0.3, 0.9))
        return block("box", frame, size, without=("bottom",))

    def _draw_pillar(self, frame: Frame) -> Part:
        width = self._between(0.3, 0.5)
        size = (width, width, self.layout.size[2])
        return block("pillar", frame, size, without=("bottom", "top"))

    def _free_places(self, model: SceneModel) -> Array:
        """Return a place for a scanner, with free space around it, shape ``(1, 3)``."""
        length, width, _ = self.layout.size
        for _ in range(_TRIES):
            x, y = self._between(0.3, 0.7) * length, self._between(0.3, 0.7) * width
            place = self.room.moved(x, y, self._between(1.4, 1.7)).origin
            around = place + _CLEARANCE * (2 * self.rng.random((64, 3)) - 1)
            if not model.occupied(around).any():
                return place[None]
        raise ConfigError("build_room: expected free space in the room, got none; enlarge it.")


def _take(places: list[T], where: str) -> T:
    """Take the next free place."""
    if not places:
        raise ConfigError(
            f"build_room: expected a place on the {where} for each object, got too many objects; "
            "enlarge the room."
        )
    return places.pop()
