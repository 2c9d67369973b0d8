"""Furnished rooms: the sizes and places of all that is in them, drawn from a seed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import product
from typing import TypeVar

import numpy as np

from torchrg.errors import ConfigError
from torchrg.scenes import furniture
from torchrg.scenes.furniture import between
from torchrg.scenes.geometry import Array, Frame, Triple
from torchrg.scenes.scene import (
    Part,
    Scene,
    SceneModel,
    is_occupied,
    plane_table,
    sample_scene,
    seeded_generator,
)
from torchrg.scenes.shells import recess, room_walls, shell
from torchrg.scenes.surfaces import Hole

T = TypeVar("T")

_ROOM = 100
"""Purpose of the random numbers: sizes and places in a room."""

_FLOOR_CELL = (1.85, 1.35)
"""Metres along and across a place on the floor: a table with room to pass around it."""
_WALL_CELL = 1.75
"""Metres along a place on a wall: a window or a cabinet with wall on both sides."""
_CORNER = 0.6
"""Metres that are free at both ends of a wall, for a cabinet on the next wall."""
_AISLE = 0.75
"""Metres that are free along the walls, for doors and cabinets."""
_DOORWAY_AISLE = 1.6
"""Metres from the middle of a doorway to whatever is on a wall."""
_DOORWAY_SPACE = 1.9
"""Metres from the middle of a doorway to whatever stands on the floor, for an open door."""
_TRIES = 1000
"""Times that an object is drawn until none of its faces lies in the plane of another."""
_PARALLEL = 1 - 0.02**2 / 2
"""Least cosine between faces that count as parallel, of about one degree."""
_CLEARANCES = (1.0, 0.6, 0.4, 0.2)
"""Metres of free space around a scanner, the first that there is."""
_PLACE_TRIES = 50
"""Times that a place for a scanner is drawn with each clearance."""


@dataclass(frozen=True)
class RoomLayout:
    """What is in a room; lengths in metres. The defaults make 153 faces, 35 of them 4 cm wide."""

    size: Triple = (9.0, 7.0, 2.8)
    """Length, width, height."""
    num_doors: int = 2
    num_windows: int = 3
    num_cabinets: int = 2
    num_shelves: int = 1
    """Horizontal boards on walls."""
    num_panels: int = 0
    """Upright boards on walls."""
    num_tables: int = 8
    num_boxes: int = 3
    """On the floor."""
    num_small_boxes: int = 2
    """On tables, at most one on each."""
    num_pillars: int = 1
    num_columns: int = 0
    """Round pillars."""
    num_round_tables: int = 0
    num_balls: int = 0
    num_lamps: int = 0
    num_bent_walls: int = 0
    """Walls that are arcs of large cylinders, without anything on them; up to 4."""
    wall_bend: float = 0.04
    """How far the middle of a bent wall bulges into the room."""
    plate_thickness: float = 0.04
    """Thickness of table tops and shelves."""
    panel_thickness: float = 0.015
    """Least thickness of panels; each is up to twice as thick, so that no two are in one plane."""
    heading_deg: float = 0.0
    """How far the room is turned about the upward axis."""
    min_plane_gap: float = 0.005
    """Least distance of any face to the plane of another face that is parallel to it."""
    num_viewpoints: int = 1
    """Places where a scanner may stand, spread along the room."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.startswith("num_") and value < 0:
                raise ConfigError(f"RoomLayout: expected {field.name} >= 0, got {value}.")
        for name, (value, limit) in {
            "num_small_boxes": (self.num_small_boxes, self.num_tables),
            "num_bent_walls": (self.num_bent_walls, 4),
            "wall_bend": (self.wall_bend, min(self.size[:2]) / 8),
        }.items():
            if value > limit:
                raise ConfigError(f"RoomLayout: expected {name} <= {limit}, got {value}.")
        for name in ("wall_bend", "plate_thickness", "panel_thickness", "num_viewpoints"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"RoomLayout: expected {name} > 0, got {getattr(self, name)}.")
        if min(self.size[:2]) < 1 or self.size[2] < 2.3:
            raise ConfigError(
                f"RoomLayout: expected size of at least 1 x 1 x 2.3 metres, got {self.size}."
            )


def make_room(
    num_points: int = 1_000_000,
    noise: float = 0.003,
    seed: int = 0,
    *,
    layout: RoomLayout | None = None,
) -> Scene:
    """Make a cloud of a furnished room with exact truth.

    Convention:
        Metres, z up, the floor at z = 0 and one of its corners at the origin. The room depends on
        ``seed`` and ``layout`` alone: other settings give other samples of the same room.

    Args:
        num_points: Number of points.
        noise: Standard deviation of the noise along the normals, in metres.
        seed: Two calls with equal arguments give equal clouds; see :func:`sample_scene`.
        layout: What is in the room. Default: ``RoomLayout()``.

    Returns:
        The cloud and its truth.

    Raises:
        ConfigError: If a setting is not allowed, or the room too small for its furniture.

    Example:
        >>> room = make_room(5000, noise=0.002, seed=1)
        >>> room.points.shape, len(room.kinds)
        (torch.Size([5000, 3]), 153)
    """
    return sample_scene(build_room(seed, layout=layout), num_points, noise=noise, seed=seed)


def build_room(seed: int = 0, *, layout: RoomLayout | None = None) -> SceneModel:
    """Build the description of a furnished room, to be sampled or rendered.

    Args:
        seed: Seed of sizes and places.
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
    rng = seeded_generator(seed, _ROOM)
    room = Frame.upright(np.zeros(3), layout.heading_deg)
    parts = furnish(layout, room, rng)
    return SceneModel(parts, free_places(layout, room, parts, rng))


def furnish(
    layout: RoomLayout,
    room: Frame,
    rng: np.random.Generator,
    *,
    doorways: Sequence[tuple[int, Hole]] = (),
    with_floor: bool = True,
) -> tuple[Part, ...]:
    """Return the parts of a room, whose origin is a corner of the floor: its shell, then the rest.

    ``doorways`` are holes in walls that are there already, each with its wall.

    Raises:
        ConfigError: If the room is too small for its furniture.
    """
    furnisher, ceiling = _Furnisher(layout, room, rng, doorways, with_floor), layout.size[2]
    for _ in range(layout.num_doors):
        furnisher.open_wall("door", furniture.draw_door)
    for _ in range(layout.num_windows):
        furnisher.open_wall("window", partial(furniture.draw_window, ceiling=ceiling))
    furnisher.parts[0] = furnisher.shell()
    for draw_at, count in (
        (furniture.draw_cabinet, layout.num_cabinets),
        (partial(furniture.draw_shelf, thickness=layout.plate_thickness), layout.num_shelves),
        (partial(furniture.draw_panel, thickness=layout.panel_thickness), layout.num_panels),
    ):
        for _ in range(count):
            furnisher.place_at_wall(draw_at)
    for number in range(layout.num_tables):
        furnisher.place_table(with_box=number < layout.num_small_boxes)
    draw_round_table = partial(furniture.draw_round_table, thickness=layout.plate_thickness)
    for draw_on, count in (
        (furniture.draw_box, layout.num_boxes),
        (partial(furniture.draw_pillar, ceiling=ceiling), layout.num_pillars),
        (partial(furniture.draw_column, ceiling=ceiling), layout.num_columns),
        (draw_round_table, layout.num_round_tables),
        (furniture.draw_ball, layout.num_balls),
        (furniture.draw_lamp, layout.num_lamps),
    ):
        for _ in range(count):
            furnisher.place_on_floor(draw_on)
    return tuple(furnisher.parts)


class _Furnisher:
    """The free places of a room, and the objects that are in it so far."""

    def __init__(
        self,
        layout: RoomLayout,
        room: Frame,
        rng: np.random.Generator,
        doorways: Sequence[tuple[int, Hole]],
        with_floor: bool,
    ) -> None:
        self.layout, self.room, self.rng, self.with_floor = layout, room, rng, with_floor
        self.walls = room_walls(room, layout.size)
        self.bends = [layout.wall_bend * (wall < layout.num_bent_walls) for wall in range(4)]
        self.holes: list[list[Hole]] = [[] for _ in self.walls]
        for wall, hole in doorways:
            self.holes[wall].append(hole)
        self.wall_places = self._shuffled(
            [
                (wall, middle)
                for wall, middle in _wall_places(layout.size)
                if self.bends[wall] == 0
                and self._is_away(self.walls[wall].moved(middle, 0, 0).origin, _DOORWAY_AISLE)
            ]
        )
        self.floor_places = self._shuffled(
            [
                (x, y)
                for x, y in _floor_places(layout.size)
                if self._is_away(room.moved(x, y, 0).origin, _DOORWAY_SPACE)
            ]
        )
        self.parts = [self.shell()]

    def shell(self) -> Part:
        """Return floor, ceiling and walls with the holes that are there so far."""
        return shell(
            self.room, self.layout.size, self.holes, bends=self.bends, with_floor=self.with_floor
        )

    def open_wall(self, kind: str, draw_hole: Callable[[np.random.Generator, float], Hole]) -> None:
        """Put a door or a window into a free place of a wall."""
        wall, middle = _take(self.wall_places, "walls")
        holes: list[Hole] = []

        def draw() -> Part:
            holes.append(draw_hole(self.rng, middle))
            return recess(kind, self.walls[wall], holes[-1], between(self.rng, 0.06, 0.16))

        self._place(draw)
        self.holes[wall].append(holes[-1])

    def place_at_wall(self, draw: Callable[[np.random.Generator, Frame, float], Part]) -> None:
        """Put an object against a free place of a wall."""
        wall, middle = _take(self.wall_places, "walls")
        self._place(lambda: draw(self.rng, self.walls[wall], middle + between(self.rng, -0.1, 0.1)))

    def place_on_floor(self, draw: Callable[[np.random.Generator, Frame], Part]) -> None:
        """Put an object on a free place of the floor."""
        middle = _take(self.floor_places, "floor")
        self._place(lambda: draw(self.rng, self._standing(middle, max_heading_deg=90)))

    def place_table(self, *, with_box: bool) -> None:
        """Put a table on a free place of the floor, and on it perhaps a box."""
        middle, thickness = _take(self.floor_places, "floor"), self.layout.plate_thickness
        desk = self._place(
            lambda: furniture.draw_table(
                self.rng, self._standing(middle, max_heading_deg=12), thickness
            )
        )
        if with_box:
            [top] = [surface for surface in desk.surfaces if surface.kind == "table top"]
            middle_of_top = Frame.upright(top.bounds.mean(axis=0))
            self._place(lambda: furniture.draw_small_box(self.rng, middle_of_top))

    def _place(self, draw: Callable[[], Part]) -> Part:
        """Add the first of several drawn objects that has no face in the plane of another."""
        gap = self.layout.min_plane_gap
        for _ in range(_TRIES):
            part = draw()
            if not _shares_plane(part, self.parts, gap):
                self.parts.append(part)
                return part
        raise ConfigError(
            f"build_room: expected no face within min_plane_gap={gap} of the plane of another, "
            "got too many objects for that; lower it."
        )

    def _standing(self, middle: tuple[float, float], *, max_heading_deg: float) -> Frame:
        """Return an upright frame of random heading on the floor near a place."""
        x, y = (value + between(self.rng, -0.1, 0.1) for value in middle)
        heading = between(self.rng, -max_heading_deg, max_heading_deg)
        return Frame.upright(np.zeros(3), heading).inside(self.room.moved(x, y, 0))

    def _is_away(self, place: Array, distance: float) -> bool:
        """Return whether a place on the floor is away from all doorways."""
        for wall, holes in zip(self.walls, self.holes, strict=True):
            for left, right, _, _ in holes:
                gap = wall.moved((left + right) / 2, 0, 0).origin - place
                if np.vecdot(gap, gap) < distance * distance:
                    return False
        return True

    def _shuffled(self, places: list[T]) -> list[T]:
        return [places[row] for row in self.rng.permutation(len(places))]


def _take(places: list[T], where: str) -> T:
    """Take the next free place."""
    if not places:
        raise ConfigError(
            f"build_room: expected a place on the {where} for each object, got too many objects; "
            "enlarge the room."
        )
    return places.pop()


def _wall_places(size: Triple) -> list[tuple[int, float]]:
    """Return where things fit on the four walls: wall, and distance from its start."""
    return [
        (wall, _CORNER + middle)
        for wall, length in enumerate((size[0], size[1]) * 2)
        for middle in _middles(length - 2 * _CORNER, _WALL_CELL)
    ]


def _floor_places(size: Triple) -> list[tuple[float, float]]:
    """Return where things fit on the floor, away from the walls."""
    xs, ys = (
        [_AISLE + middle for middle in _middles(length - 2 * _AISLE, cell)]
        for length, cell in zip(size[:2], _FLOOR_CELL, strict=True)
    )
    return list(product(xs, ys))


def _middles(length: float, cell: float) -> list[float]:
    """Return the middles of as many equal cells of at least ``cell`` as fit into a length."""
    count = max(int(length / cell), 0)
    return [length * (number + 0.5) / count for number in range(count)]


def _shares_plane(part: Part, others: Sequence[Part], min_gap: float) -> bool:
    """Return whether a face of a part is closer than ``min_gap`` to the plane of a parallel one."""
    mine = [surface for surface in part.surfaces if surface.plane is not None]
    theirs = [surface for other in others for surface in other.surfaces if surface.plane]
    if not mine or not theirs:
        return False
    middles = np.stack([surface.bounds.mean(axis=0) for surface in mine])
    normals, _ = plane_table(mine)
    planes, offsets = plane_table(theirs)
    parallel = np.abs(np.vecdot(normals[:, None], planes)) > _PARALLEL
    near = np.abs(np.vecdot(middles[:, None], planes) - offsets) < min_gap
    return bool((parallel & near).any())


def free_places(
    layout: RoomLayout, room: Frame, parts: Sequence[Part], rng: np.random.Generator
) -> Array:
    """Return places for a scanner, spread along a room, shape ``(num_viewpoints, 3)``.

    Raises:
        ConfigError: If there is no free space.
    """
    length, width, _ = layout.size
    found: list[Array] = []
    for number, clearance in product(range(layout.num_viewpoints), _CLEARANCES):
        for _ in range(_PLACE_TRIES if len(found) == number else 0):
            x = (number + between(rng, 0.25, 0.75)) / layout.num_viewpoints * length
            place = room.moved(x, between(rng, 0.25, 0.75) * width, between(rng, 1.4, 1.7)).origin
            near = place + clearance * (2 * rng.random((64, 3)) - 1)
            if not is_occupied(parts, near).any():
                found.append(place)
                break
    if len(found) < layout.num_viewpoints:
        raise ConfigError(
            "build_room: expected free space for a scanner in the room, got none; enlarge it."
        )
    return np.stack(found)
