"""Where the rooms of a storey are."""

from dataclasses import dataclass, replace

import numpy as np

from torchrg.errors import ConfigError
from torchrg.scenes.frames import Frame, Triple
from torchrg.scenes.halls import HALL_LAYOUT
from torchrg.scenes.layout import RoomLayout
from torchrg.scenes.objects import between
from torchrg.scenes.shells import Hole

HALL_WALLS = (0, 2)  # the long walls of the hallway
_DOOR_HEIGHT = (1.98, 2.15)

_HALL = replace(HALL_LAYOUT, size=(24.0, 2.4, 2.5), num_doors=2, num_cabinets=1, num_panels=2)
_ROOM = RoomLayout(
    num_doors=0,
    num_windows=1,
    num_cabinets=1,
    num_shelves=1,
    num_tables=2,
    num_boxes=0,
    num_small_boxes=1,
    num_pillars=0,
)


@dataclass(frozen=True)
class StoreyLayout:
    """Rooms on both sides of a hallway, with open doors; lengths in metres."""

    rooms_per_side: int = 4
    room_width: tuple[float, float] = (4.6, 6.2)
    """Least and greatest width, along the hallway."""
    room_depth: tuple[float, float] = (4.3, 5.1)
    room_height: tuple[float, float] = (2.6, 2.9)
    wall_thickness: tuple[float, float] = (0.33, 0.42)
    hall: RoomLayout = _HALL
    """The hallway; its length is that of the rooms. A short one has place for less."""
    room: RoomLayout = _ROOM
    """What is in each room; its size is drawn."""

    def __post_init__(self) -> None:
        if self.rooms_per_side < 1:
            raise ConfigError(
                f"StoreyLayout: expected rooms_per_side >= 1, got {self.rooms_per_side}."
            )
        for name in ("room_width", "room_depth", "room_height", "wall_thickness"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ConfigError(
                    f"StoreyLayout: expected {name} as (least, greatest), got {(low, high)}."
                )


@dataclass(frozen=True)
class StoreyRoom:
    """A room along the hallway; lengths along it are those of the world's first axis."""

    size: Triple
    left: float
    hall_wall: int
    hall_width: float
    thickness: float
    door: tuple[float, float, float]  # left, right and upper end in the room's own axes

    @property
    def frame(self) -> Frame:
        """The room's own axes: the second leads away from the hallway."""
        if self.hall_wall == HALL_WALLS[0]:
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
        if self.hall_wall == HALL_WALLS[0]:
            left, right = length - right, length - left
        return left, right, 0.0, self.door[2]


def draw_rooms(
    layout: StoreyLayout, hall_width: float, rng: np.random.Generator
) -> list[StoreyRoom]:
    """Return the rooms on both sides, with walls, ceilings and doors in planes of their own."""
    count = 2 * layout.rooms_per_side
    depths = _spread(rng, count, layout.room_depth)
    heights = _spread(rng, count, layout.room_height)
    thicknesses = _spread(rng, count, layout.wall_thickness)
    tops = _spread(rng, count, _DOOR_HEIGHT)
    rooms: list[StoreyRoom] = []
    for number in range(count):
        side, first = HALL_WALLS[number % 2], number < 2
        left = between(rng, 0.1, 0.4) if first else rooms[-2].left + rooms[-2].size[0]
        left += 0 if first else between(rng, *layout.wall_thickness)
        width, door_width = between(rng, *layout.room_width), between(rng, 0.85, 1.0)
        door_left = between(rng, 0.35, 0.5)
        if rng.random() < 0.5:
            door_left = width - door_left - door_width
        rooms.append(
            StoreyRoom(
                size=(width, depths[number], heights[number]),
                left=left,
                hall_wall=side,
                hall_width=hall_width,
                thickness=thicknesses[number],
                door=(door_left, door_left + door_width, tops[number]),
            )
        )
    return rooms


def _spread(rng: np.random.Generator, count: int, ends: tuple[float, float]) -> list[float]:
    """Return random numbers in random order, one in the middle half of each of equal steps."""
    steps = rng.permutation(count) + 0.25 + rng.random(count) / 2
    low, high = ends
    return [float(value) for value in low + (high - low) * steps / count]
