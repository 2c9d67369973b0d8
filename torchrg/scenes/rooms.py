"""Furnished rooms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import product
from typing import TypeVar

import numpy as np

from torchrg.errors import ConfigError
from torchrg.scenes import furniture
from torchrg.scenes.furniture import between
from torchrg.scenes.geometry import Array, Frame, Triple, dot
from torchrg.scenes.sampling import Density, NoiseDirection, Order, sample_scene
from torchrg.scenes.scene import Part, Scene, SceneModel, plane_table, random_stream
from torchrg.scenes.shells import Hole, recess, room_walls, shell

_FLOOR_CELL = (1.85, 1.35)  # a table with room to turn, metres
_WALL_CELL = 1.75  # a window or a cabinet with wall on both sides
_CORNER = 0.6  # free at both ends of a wall, for a cabinet on the next one
_AISLE = 0.75  # along the walls, for doors and cabinets

Place = tuple[float, float]
WallPlace = tuple[int, float]


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
    """Of tables and shelves."""
    panel_thickness: float = 0.015
    """Least thickness of panels; each is up to twice as thick, so that no two are in one plane."""
    heading_deg: float = 0.0
    """How far the room is turned about the upward axis."""
    equal_tables: bool = False
    """Whether all table tops lie in one plane."""
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


CURVED_LAYOUT = RoomLayout(
    num_windows=1,
    num_tables=4,
    num_columns=2,
    num_round_tables=2,
    num_balls=2,
    num_lamps=2,
    num_bent_walls=1,
)
"""A room with columns, balls, lamps, round tables and a bent wall."""

BENT_LAYOUT = RoomLayout(
    num_doors=0, num_windows=0, num_cabinets=0, num_shelves=0, num_bent_walls=4
)
"""A room whose walls are all slightly bent."""

THIN_LAYOUT = RoomLayout(
    num_windows=2, num_cabinets=1, num_shelves=4, num_panels=3, plate_thickness=0.02
)
"""A room with many thin plates: tables and shelves of 2 cm, panels of 1.5 to 3 cm."""


def wall_places(size: Triple) -> list[WallPlace]:
    """Return where things fit on the four walls: wall, and distance from its start.

    Example:
        >>> wall_places((5.2, 3.2, 3.0))
        [(0, 1.6), (0, 3.6), (1, 1.6), (2, 1.6), (2, 3.6), (3, 1.6)]
    """
    lengths = (size[0], size[1], size[0], size[1])
    return [
        (wall, _CORNER + middle)
        for wall, length in enumerate(lengths)
        for middle in _middles(length - 2 * _CORNER, _WALL_CELL)
    ]


def floor_places(size: Triple) -> list[Place]:
    """Return where things fit on the floor, away from the walls.

    Example:
        >>> floor_places((6.0, 3.2, 3.0))
        [(1.875, 1.6), (4.125, 1.6)]
    """
    xs, ys = (
        _middles(length - 2 * _AISLE, cell)
        for length, cell in zip(size[:2], _FLOOR_CELL, strict=True)
    )
    return [(_AISLE + x, _AISLE + y) for x in xs for y in ys]


def _middles(length: float, cell: float) -> list[float]:
    """Return the middles of as many equal cells of at least ``cell`` as fit into a length."""
    count = max(int(length / cell), 0)
    return [length * (number + 0.5) / count for number in range(count)]


_PARALLEL = 1 - 0.02**2 / 2  # cosine of about one degree
_CLEARANCES = (1.0, 0.6, 0.4, 0.2)  # around a scanner, as much as there is, metres
_PLACE_TRIES = 50  # with each clearance


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
        for _ in range(_PLACE_TRIES if len(found) == number else 0):
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


T = TypeVar("T")
_TRIES = 1000
_DOORWAY_AISLE = 1.6  # from the middle of a doorway to what is on walls, metres
_DOORWAY_SPACE = 1.9  # from there to what stands on the floor, for an open door


def furnish(
    layout: RoomLayout,
    room: Frame,
    rng: np.random.Generator,
    *,
    doorways: Sequence[tuple[int, Hole]] = (),
    with_floor: bool = True,
) -> tuple[Part, ...]:
    """Return the parts of a room: its shell, then what is in it.

    Args:
        layout: What there is to be.
        room: Its origin is a corner of the floor.
        rng: Source of sizes and places.
        doorways: Holes in walls that are there already, each with its wall.
        with_floor: Whether the room has a floor of its own.

    Returns:
        The parts, the shell first.

    Raises:
        ConfigError: If the room is too small for its furniture.
    """
    return _Furnisher(layout, room, rng, doorways, with_floor=with_floor).furnish()


class _Furnisher:
    """The free places of a room, and the objects that are in it so far."""

    def __init__(
        self,
        layout: RoomLayout,
        room: Frame,
        rng: np.random.Generator,
        doorways: Sequence[tuple[int, Hole]],
        *,
        with_floor: bool,
    ) -> None:
        self.layout, self.room, self.rng, self.with_floor = layout, room, rng, with_floor
        self.walls = room_walls(room, layout.size)
        self.bends = [layout.wall_bend * (wall < layout.num_bent_walls) for wall in range(4)]
        self.holes: list[list[Hole]] = [[] for _ in self.walls]
        for wall, hole in doorways:
            self.holes[wall].append(hole)
        self.wall_places = self._shuffled(
            [place for place in wall_places(layout.size) if self._is_free(*place)]
        )
        self.floor_places = self._shuffled(
            [
                (x, y)
                for x, y in floor_places(layout.size)
                if self._is_away(room.moved(x, y, 0).origin, _DOORWAY_SPACE)
            ]
        )
        self.parts = [self._shell()]

    def furnish(self) -> tuple[Part, ...]:
        """Return the parts of the room, the shell first."""
        layout, rng, ceiling = self.layout, self.rng, self.layout.size[2]
        for _ in range(layout.num_doors):
            self._open_wall("door", partial(furniture.draw_door, rng))
        for _ in range(layout.num_windows):
            self._open_wall("window", partial(furniture.draw_window, rng, ceiling=ceiling))
        self.parts[0] = self._shell()
        draw_shelf = partial(furniture.draw_shelf, thickness=layout.plate_thickness)
        draw_panel = partial(furniture.draw_panel, thickness=layout.panel_thickness)
        for draw_at, count in (
            (furniture.draw_cabinet, layout.num_cabinets),
            (draw_shelf, layout.num_shelves),
            (draw_panel, layout.num_panels),
        ):
            for _ in range(count):
                self._place_at_wall(draw_at)
        for number in range(layout.num_tables):
            self._place_table(with_box=number < layout.num_small_boxes)
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
                self._place_on_floor(draw_on)
        return tuple(self.parts)

    def _shell(self) -> Part:
        return shell(
            self.room, self.layout.size, self.holes, bends=self.bends, with_floor=self.with_floor
        )

    def _is_free(self, wall: int, middle: float) -> bool:
        """Return whether a place on a wall is neither bent nor near a doorway."""
        place = self.walls[wall].moved(middle, 0, 0).origin
        return self.bends[wall] == 0 and self._is_away(place, _DOORWAY_AISLE)

    def _is_away(self, place: Array, distance: float) -> bool:
        """Return whether a place on the floor is away from all doorways."""
        for wall, holes in zip(self.walls, self.holes, strict=True):
            for left, right, _, _ in holes:
                gap = wall.moved((left + right) / 2, 0, 0).origin - place
                if dot(gap, gap) < distance * distance:
                    return False
        return True

    def _shuffled(self, places: list[T]) -> list[T]:
        return [places[row] for row in self.rng.permutation(len(places))]

    def _place(self, draw: Callable[[], Part], *, min_gap: float | None = None) -> Part:
        """Add the first of several drawn objects that has no face in the plane of another."""
        gap = self.layout.min_plane_gap if min_gap is None else min_gap
        for _ in range(_TRIES):
            part = draw()
            if not shares_plane(part, self.parts, gap):
                self.parts.append(part)
                return part
        raise ConfigError(
            f"build_room: expected no face within min_plane_gap={gap} of the plane of another, "
            "got too many objects for that; lower it."
        )

    def _open_wall(self, kind: str, draw_hole: Callable[[float], Hole]) -> None:
        """Put a door or a window into a free place of a wall."""
        wall, middle = _take(self.wall_places, "walls")
        holes: list[Hole] = []

        def draw() -> Part:
            holes.append(draw_hole(middle))
            return recess(kind, self.walls[wall], holes[-1], between(self.rng, 0.06, 0.16))

        self._place(draw)
        self.holes[wall].append(holes[-1])

    def _place_at_wall(self, draw: Callable[[np.random.Generator, Frame, float], Part]) -> None:
        wall, middle = _take(self.wall_places, "walls")
        self._place(lambda: draw(self.rng, self.walls[wall], middle + between(self.rng, -0.1, 0.1)))

    def _standing(self, middle: Place, *, turn_deg: float) -> Frame:
        """Return an upright frame on the floor near a place, turned by up to ``turn_deg``."""
        x, y = (value + between(self.rng, -0.1, 0.1) for value in middle)
        turn = between(self.rng, -turn_deg, turn_deg)
        return Frame.upright(np.zeros(3), turn).inside(self.room.moved(x, y, 0))

    def _place_on_floor(self, draw: Callable[[np.random.Generator, Frame], Part]) -> None:
        middle = _take(self.floor_places, "floor")
        self._place(lambda: draw(self.rng, self._standing(middle, turn_deg=90)))

    def _place_table(self, *, with_box: bool) -> None:
        """Put a table on the floor, and on it perhaps a box."""
        layout, middle = self.layout, _take(self.floor_places, "floor")
        height = 0.74 if layout.equal_tables else None
        desk = self._place(
            lambda: furniture.draw_table(
                self.rng, self._standing(middle, turn_deg=12), layout.plate_thickness, height
            ),
            min_gap=0.0 if layout.equal_tables else None,
        )
        if with_box:
            self._place(lambda: furniture.draw_small_box(self.rng, _table_top(desk)))


def _table_top(desk: Part) -> Frame:
    """Return an upright frame on the middle of a table's upper side."""
    [top] = [surface for surface in desk.surfaces if surface.kind == "table top"]
    return Frame.upright(top.bounds.mean(axis=0))


def _take(places: list[T], where: str) -> T:
    """Take the next free place."""
    if not places:
        raise ConfigError(
            f"build_room: expected a place on the {where} for each object, got too many objects; "
            "enlarge the room."
        )
    return places.pop()


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
