"""Furnished rooms, generated from a seed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import count, islice, product
from typing import TypeVar

import numpy as np

from torchrg.config import check_values, expect
from torchrg.errors import ConfigError
from torchrg.scenes import parts as draw
from torchrg.scenes.geometry import Doubles, Frame, Triple
from torchrg.scenes.parts import between, recess, room_walls
from torchrg.scenes.scene import (
    Part,
    Scene,
    SceneModel,
    plane_equations,
    sample_scene,
    seeded_generator,
)
from torchrg.scenes.surfaces import Hole, rectangle

T = TypeVar("T")
Furniture = Callable[[np.random.Generator, Frame], Part]
"""Function that creates an object at a position on the floor."""
ROOM = 100
"""Purpose of the random numbers: sizes and positions in a room."""
_FLOOR_CELL = (1.85, 1.35)
"""Size of a floor cell in meters: a table with space to walk around it."""
_WALL_CELL = 1.75
"""Length of a wall cell in meters: a window or cabinet with wall on both sides."""
_CORNER = 0.6
"""Free length at both ends of a wall in meters, for a cabinet on the next wall."""
_AISLE = 0.75
"""Free width along the walls in meters, for doors and cabinets."""
_DOORWAY_AISLE = 1.6
"""Minimum distance from the center of a doorway to objects on walls, in meters."""
_DOORWAY_SPACE = 1.9
"""Minimum distance from a doorway's center to objects on the floor, in meters, for a door."""
_TRIES = 1000
"""Maximum number of attempts to create an object without a face in the plane of another."""
_PARALLEL = 1 - 0.02**2 / 2
"""Minimum cosine between parallel faces (about one degree)."""
_MAX_SIDE, _MAX_COUNT = 1000, 1000
"""Maximum side of a room in meters, and number of objects of a kind; bounds the list of cells."""


@dataclass(frozen=True)
class RoomLayout:
    """Contents of a room; lengths in meters. The default has 153 faces, 35 of them 4 cm wide."""

    size: Triple = (9.0, 7.0, 2.8)
    """Length, width, height."""
    num_doors: int = 2
    num_windows: int = 3
    num_cabinets: int = 2
    num_shelves: int = 1
    """Horizontal boards on walls."""
    num_panels: int = 0
    """Vertical boards on walls."""
    num_tables: int = 8
    num_boxes: int = 3
    """On the floor."""
    num_small_boxes: int = 2
    """On tables, at most one per table."""
    num_pillars: int = 1
    plate_thickness: float = 0.04
    """Thickness of table tops and shelves."""
    panel_thickness: float = 0.015
    """Minimum thickness of panels; they are up to twice as thick, so that no two are coplanar."""
    heading_deg: float = 0.0
    """Rotation of the room about the up axis, in degrees."""
    min_plane_gap: float = 0.005
    """Minimum distance between a face and the plane of a parallel face."""

    def __post_init__(self) -> None:
        check_values(self)
        for name in (field.name for field in fields(self) if field.name.startswith("num_")):
            is_number = 0 <= getattr(self, name) <= _MAX_COUNT
            expect(self, name, f">= 0 and at most {_MAX_COUNT:,}", is_number)
        num_tables = self.num_tables
        expect(self, "num_small_boxes", f"<= {num_tables}", self.num_small_boxes <= num_tables)
        for name in ("plate_thickness", "panel_thickness"):
            expect(self, name, "> 0", getattr(self, name) > 0)
        is_size = min(self.size[:2]) >= 1 and self.size[2] >= 2.3 and max(self.size) <= _MAX_SIDE
        expect(self, "size", f"of at least 1 x 1 x 2.3 and at most {_MAX_SIDE:,} meters", is_size)

    def draw_wall(self, number: int, wall: Frame, length: float, holes: Sequence[Hole]) -> Part:
        """Return a wall along the first axis of a frame; a subclass may bend one without holes."""
        return Part((rectangle("wall", wall, length, self.size[2], holes),))

    def furniture(self) -> list[tuple[int, Furniture]]:
        """Return the number and generator of each kind of object on the floor except tables."""
        pillar = partial(draw.draw_pillar, ceiling=self.size[2])
        return [(self.num_boxes, draw.draw_box), (self.num_pillars, pillar)]


def make_room(
    num_points: int = 1_000_000,
    noise: float = 0.003,
    seed: int = 0,
    *,
    layout: RoomLayout | None = None,
) -> Scene:
    """Generate a point cloud of a furnished room with exact ground truth.

    Convention:
        Units are meters, z is up, the floor is at z = 0 with a corner at the origin. The room
        depends only on ``seed`` and ``layout``; other settings give other samples of the same room.

    Args:
        num_points: Number of points.
        noise: Standard deviation of the noise along the normals, in meters.
        seed: Identical arguments give identical clouds; see :func:`sample_scene`.
        layout: Contents of the room. Default: ``RoomLayout()``.

    Returns:
        The cloud and its ground truth.

    Raises:
        ConfigError: If a setting is invalid, or the room is too small for its furniture.

    Example:
        >>> room = make_room(5000, noise=0.002, seed=1)
        >>> room.points.shape, len(room.kinds)
        (torch.Size([5000, 3]), 153)
    """
    return sample_scene(build_room(seed, layout=layout), num_points, noise=noise, seed=seed)


def build_room(seed: int = 0, *, layout: RoomLayout | None = None) -> SceneModel:
    """Generate the model of a furnished room; see :func:`make_room`.

    Returns:
        The model. Its first six faces are floor, ceiling and walls.

    Example:
        >>> [surface.kind for surface in build_room().surfaces[:3]]
        ['floor', 'ceiling', 'wall']
    """
    layout = layout or RoomLayout()
    rng = seeded_generator(seed, ROOM)
    return SceneModel(furnish(layout, Frame.upright(np.zeros(3), layout.heading_deg), rng))


def furnish(
    layout: RoomLayout,
    room: Frame,
    rng: np.random.Generator,
    *,
    doorways: Sequence[tuple[int, Hole]] = (),
) -> tuple[Part, ...]:
    """Return the parts of a room with a floor corner at its origin; the shell comes first.

    ``doorways`` are existing holes in walls, each with the index of its wall.

    Raises:
        ConfigError: If the room is too small for its furniture.
    """
    walls, ceiling, plate = room_walls(room, layout.size), layout.size[2], layout.plate_thickness
    holes = [[hole for wall, hole in doorways if wall == number] for number in range(4)]
    middles = [walls[wall].moved((a + b) / 2, 0, 0).origin for wall, (a, b, _, _) in doorways]
    parts = [_shell(layout, room, holes)]
    is_flat = [surface.plane is not None for surface in parts[0].surfaces[-len(walls) :]]
    wall_slots = [
        (wall, _CORNER + along)
        for wall, length in enumerate((*layout.size[:2], *layout.size[:2]))
        for along in _cell_centers(length - 2 * _CORNER, _WALL_CELL)
        if is_flat[wall] and _is_away(walls[wall].moved(_CORNER + along), middles, _DOORWAY_AISLE)
    ]
    wall_slots = [wall_slots[row] for row in rng.permutation(len(wall_slots))]
    sides = zip(layout.size[:2], _FLOOR_CELL, strict=True)
    xs, ys = (_cell_centers(length - 2 * _AISLE, cell) for length, cell in sides)
    floor_slots = [
        (_AISLE + x, _AISLE + y)
        for x, y in product(xs, ys)
        if _is_away(room.moved(_AISLE + x, _AISLE + y), middles, _DOORWAY_SPACE)
    ]
    floor_slots = [floor_slots[row] for row in rng.permutation(len(floor_slots))]

    def add(drawn: Iterator[Part]) -> None:
        parts.append(_first_separated(drawn, parts, layout.min_plane_gap))

    def open_wall(kind: str, draw_hole: Callable[[np.random.Generator, float], Hole]) -> None:
        wall, middle = _take(wall_slots, "walls")
        holes[wall].append((0, 0, 0, 0))

        def recesses() -> Iterator[Part]:
            while True:
                holes[wall][-1] = draw_hole(rng, middle)
                yield recess(kind, walls[wall], holes[wall][-1], between(rng, 0.06, 0.16))

        add(recesses())

    def standing(middle: tuple[float, float], max_heading_deg: float) -> Frame:
        x, y = (value + between(rng, -0.1, 0.1) for value in middle)
        heading = between(rng, -max_heading_deg, max_heading_deg)
        return Frame.upright(np.zeros(3), heading).inside(room.moved(x, y))

    for _ in range(layout.num_doors):
        open_wall("door", draw.draw_door)
    for _ in range(layout.num_windows):
        open_wall("window", partial(draw.draw_window, ceiling=ceiling))
    parts[0] = _shell(layout, room, holes)
    on_walls: list[tuple[int, Callable[[np.random.Generator, Frame, float], Part]]] = [
        (layout.num_cabinets, draw.draw_cabinet),
        (layout.num_shelves, partial(draw.draw_shelf, thickness=plate)),
        (layout.num_panels, partial(draw.draw_panel, thickness=layout.panel_thickness)),
    ]
    for draw_at in (draw_at for number, draw_at in on_walls for _ in range(number)):
        wall, along = _take(wall_slots, "walls")
        add(draw_at(rng, walls[wall], along + between(rng, -0.1, 0.1)) for _ in count())
    for number in range(layout.num_tables):
        middle = _take(floor_slots, "floor")
        add(draw.draw_table(rng, standing(middle, 12), plate) for _ in count())
        if number < layout.num_small_boxes:
            [top] = [surface for surface in parts[-1].surfaces if surface.kind == "table top"]
            middle_of_top = Frame.upright(top.bounds.mean(axis=0))
            add(draw.draw_small_box(rng, middle_of_top) for _ in count())
    for draw_on in (draw_on for number, draw_on in layout.furniture() for _ in range(number)):
        middle = _take(floor_slots, "floor")
        add(draw_on(rng, standing(middle, 90)) for _ in count())
    return tuple(parts)


def _shell(layout: RoomLayout, room: Frame, holes: Sequence[Sequence[Hole]]) -> Part:
    """Return floor, ceiling and four walls with their holes as one part."""
    length, width, height = layout.size
    above = room.placed((0, width, height), (1, 0, 0), (0, -1, 0))
    ends = [rectangle("floor", room, length, width), rectangle("ceiling", above, length, width)]
    walls = [
        layout.draw_wall(number, wall, layout.size[number % 2], holes[number])
        for number, wall in enumerate(room_walls(room, layout.size))
    ]
    surfaces = (surface for wall in walls for surface in wall.surfaces)
    return Part((*ends, *surfaces), tuple(body for wall in walls for body in wall.solids))


def _is_away(position: Frame, middles: Sequence[Doubles], distance: float) -> bool:
    """Return whether a position is at least ``distance`` from all doorways."""
    gaps = (middle - position.origin for middle in middles)
    return all(np.vecdot(gap, gap) >= distance * distance for gap in gaps)


def _first_separated(drawn: Iterator[Part], others: Sequence[Part], gap: float) -> Part:
    """Return the first generated object without a face in the plane of another."""
    for part in islice(drawn, _TRIES):
        if not _has_coplanar_face(part, others, gap):
            return part
    raise ConfigError(
        f"build_room: expected faces at least min_plane_gap={gap} from the planes of others, "
        "got too many objects; lower min_plane_gap."
    )


def _take(cells: list[T], where: str) -> T:
    """Take the next free position."""
    if not cells:
        raise ConfigError(
            f"build_room: expected enough space on the {where}, got too many objects; enlarge it."
        )
    return cells.pop()


def _cell_centers(length: float, cell: float) -> list[float]:
    """Split a length into equal cells of at least ``cell`` and return their centers."""
    count = max(int(length / cell), 0)
    return [length * (number + 0.5) / count for number in range(count)]


def _has_coplanar_face(part: Part, others: Sequence[Part], min_gap: float) -> bool:
    """Return whether a face is closer than ``min_gap`` to the plane of a parallel one."""
    mine = [surface for surface in part.surfaces if surface.plane is not None]
    theirs = [surface for other in others for surface in other.surfaces if surface.plane]
    if not mine or not theirs:
        return False
    middles = np.stack([surface.bounds.mean(axis=0) for surface in mine])
    normals, _ = plane_equations(mine)
    planes, offsets = plane_equations(theirs)
    parallel = np.abs(np.vecdot(normals[:, None], planes)) > _PARALLEL
    near = np.abs(np.vecdot(middles[:, None], planes) - offsets) < min_gap
    return bool((parallel & near).any())
