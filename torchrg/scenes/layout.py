"""What a room contains, and where in it things fit."""

from dataclasses import dataclass, fields

from torchrg.errors import ConfigError
from torchrg.scenes.frames import Triple

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
