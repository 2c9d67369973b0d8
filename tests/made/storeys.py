"""Hallways, and storeys: a hallway and furnished rooms along it, joined by open doors."""

from dataclasses import dataclass, replace

import numpy as np

from tests.made.scanners import ScannedLayout, ScannedModel, scanner_positions
from torchrg.scenes import Scene, sample_scene
from torchrg.scenes.geometry import Frame
from torchrg.scenes.parts import block, passage, room_walls
from torchrg.scenes.rooms import furnish
from torchrg.scenes.scene import Part
from torchrg.scenes.surfaces import Flat, Hole

HALL_LAYOUT = ScannedLayout(
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

_HALL = replace(HALL_LAYOUT, size=(24.0, 2.4, 2.5), num_doors=2, num_cabinets=1, num_panels=2)
"""The hallway of a storey; its length is that of the rooms."""
_ROOM = ScannedLayout(
    num_doors=0,
    num_windows=1,
    num_cabinets=1,
    num_shelves=1,
    num_tables=2,
    num_boxes=0,
    num_small_boxes=1,
    num_pillars=0,
)
"""What is in each room of a storey; its size is drawn."""
_WIDTHS, _DEPTHS, _HEIGHTS = (4.6, 6.2), (4.3, 5.1), (2.6, 2.9)
"""Least and greatest extents of rooms, meters; the width is along the hallway."""
_WALLS = (0.33, 0.42)
"""Least and greatest thickness of walls, meters."""
_DOOR_HEIGHTS = (1.98, 2.15)
"""Meters."""
_DOOR_LEAF = 0.04
"""Thickness, meters."""

_HALL_WALLS = (0, 2)
"""The long walls of the hallway."""
_FIRST_WALL = 0
"""Of a room: the one along the hallway."""
_STOREY = 500
"""Purpose of the random numbers: rooms and what is in them."""


def make_storey(
    num_points: int, noise: float = 0.003, seed: int = 0, *, rooms_per_side: int = 4
) -> Scene:
    """Make a cloud of a hallway and the furnished rooms along it; see :func:`build_storey`.

    Example:
        >>> make_storey(1000).kinds.count("ceiling")
        9
    """
    model = build_storey(seed, rooms_per_side=rooms_per_side)
    return sample_scene(model, num_points, noise=noise, seed=seed)


def build_storey(seed: int = 0, *, rooms_per_side: int = 4) -> ScannedModel:
    """Build the description of a hallway and the rooms on both sides of it.

    The floor, which is the first face, runs through the open doors; every ceiling is at a height of
    its own. Within each room no face lies in the plane of another.
    """
    rng, width = np.random.default_rng([seed, _STOREY]), _HALL.size[1]
    rooms = _draw_rooms(2 * rooms_per_side, width, rng)
    length = max(room.left + room.size[0] for room in rooms) + rng.uniform(0.2, 0.5)
    hall_layout = replace(_HALL, size=(length, width, _HALL.size[2]))
    hall = Frame.upright(np.zeros(3))
    walls = room_walls(hall, hall_layout.size)
    doorways = [(room.hall_wall, room.hall_doorway(length)) for room in rooms]
    hall_parts = _without_floor(furnish(hall_layout, hall, rng, doorways=doorways))
    parts: list[Part] = [Part((_floor(rooms, length, width),)), *hall_parts]
    viewpoints = [scanner_positions(hall_layout, hall, hall_parts, rng)]
    for room, (wall, doorway) in zip(rooms, doorways, strict=True):
        layout, holes = replace(_ROOM, size=room.size), [(_FIRST_WALL, room.doorway)]
        contents = _without_floor(furnish(layout, room.frame, rng, doorways=holes))
        parts += [passage("door frame", walls[wall], doorway, room.thickness), *contents]
        parts.append(_open_door(room, rng))
        viewpoints.append(scanner_positions(layout, room.frame, parts, rng))
    return ScannedModel(tuple(parts), np.concatenate(viewpoints))


@dataclass(frozen=True)
class _Room:
    """A room along the hallway; lengths along it are those of the world's first axis."""

    size: tuple[float, float, float]
    left: float
    hall_wall: int
    hall_width: float
    thickness: float
    door: tuple[float, float, float]  # left, right and upper end in the room's own axes

    @property
    def frame(self) -> Frame:
        """The room's own axes: the second leads away from the hallway."""
        if self.hall_wall == _HALL_WALLS[0]:
            corner = (self.left + self.size[0], -self.thickness, 0)
            return Frame.upright(np.array(corner), heading_deg=180)
        return Frame.upright(np.array([self.left, self.hall_width + self.thickness, 0]))

    @property
    def doorway(self) -> Hole:
        """Hole in the room's first wall, which starts at its right end."""
        left, right, top = self.door
        return self.size[0] - right, self.size[0] - left, 0.0, top

    def span(self) -> tuple[float, float]:
        """Return left and right end of the doorway in the world."""
        ends = self.frame.to_world(np.array([(x, 0, 0) for x in self.door[:2]]))[:, 0]
        return float(ends.min()), float(ends.max())

    def hall_doorway(self, length: float) -> Hole:
        """Return the hole in the hallway's wall; its first wall starts at the far end."""
        left, right = self.span()
        if self.hall_wall == _HALL_WALLS[0]:
            left, right = length - right, length - left
        return left, right, 0.0, self.door[2]


def _draw_rooms(count: int, hall_width: float, rng: np.random.Generator) -> list[_Room]:
    """Return the rooms on both sides, with walls, ceilings and doors in planes of their own."""
    depths, heights = _spread(rng, count, _DEPTHS), _spread(rng, count, _HEIGHTS)
    thicknesses, tops = _spread(rng, count, _WALLS), _spread(rng, count, _DOOR_HEIGHTS)
    rooms: list[_Room] = []
    for number in range(count):
        first = number < 2
        left = rng.uniform(0.1, 0.4) if first else rooms[-2].left + rooms[-2].size[0]
        left += 0 if first else rng.uniform(*_WALLS)
        width, door_width = rng.uniform(*_WIDTHS), rng.uniform(0.85, 1.0)
        door_left = rng.uniform(0.35, 0.5)
        if rng.random() < 0.5:
            door_left = width - door_left - door_width
        door = (door_left, door_left + door_width, tops[number])
        size, wall = (width, depths[number], heights[number]), _HALL_WALLS[number % 2]
        rooms.append(_Room(size, left, wall, hall_width, thicknesses[number], door))
    return rooms


def _spread(rng: np.random.Generator, count: int, ends: tuple[float, float]) -> list[float]:
    """Return random numbers in random order, one in the middle half of each of equal steps."""
    steps = rng.permutation(count) + 0.25 + rng.random(count) / 2
    low, high = ends
    return [float(value) for value in low + (high - low) * steps / count]


def _without_floor(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    """Return the parts of a room without its first face, the floor."""
    shell, *others = parts
    return Part(shell.surfaces[1:], shell.solids), *others


def _floor(rooms: list[_Room], length: float, width: float) -> Flat:
    """Return the floor of the hallway, the rooms and the doorways between them."""
    cells = [[(0.0, 0.0), (length, 0.0), (0.0, width)]]
    for room in rooms:
        corners = np.array([(0, 0, 0), (room.size[0], room.size[1], 0)])
        (left, low), (right, high) = np.sort(room.frame.to_world(corners)[:, :2], axis=0)
        cells.append([(left, low), (right - left, 0), (0, high - low)])
        start, end = room.span()
        below = -room.thickness if room.hall_wall == _HALL_WALLS[0] else width
        cells.append([(start, below), (end - start, 0), (0, room.thickness)])
    return Flat("floor", Frame.upright(np.zeros(3)), np.array(cells))


def _open_door(room: _Room, rng: np.random.Generator) -> Part:
    """Return the leaf of an open door, inside the room next to the doorway."""
    left, right, top = room.door
    hinge = left - 0.1 if left < room.size[0] / 2 else right + 0.1
    frame = room.frame.moved(hinge, 0.05 + (right - left) / 2, rng.uniform(0.01, 0.03))
    ajar = Frame.upright(np.zeros(3), rng.uniform(-6, 6)).inside(frame)
    size = (_DOOR_LEAF, right - left, top - 0.04)
    names = dict.fromkeys(("front", "back", "bottom", "top"), "door edge")
    return block("door", ajar, size, kinds=names)
