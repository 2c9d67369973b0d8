"""Placing: each object has a place of its own, and no two faces lie in one plane."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from torchrg.errors import ConfigError
from torchrg.scenes import objects
from torchrg.scenes.frames import Array, Frame, dot
from torchrg.scenes.layout import Place, RoomLayout, floor_places, wall_places
from torchrg.scenes.objects import between
from torchrg.scenes.scene import Part
from torchrg.scenes.shells import Hole, recess, room_walls, shell
from torchrg.scenes.spacing import shares_plane

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
            self._open_wall("door", partial(objects.draw_door, rng))
        for _ in range(layout.num_windows):
            self._open_wall("window", partial(objects.draw_window, rng, ceiling=ceiling))
        self.parts[0] = self._shell()
        draw_shelf = partial(objects.draw_shelf, thickness=layout.plate_thickness)
        draw_panel = partial(objects.draw_panel, thickness=layout.panel_thickness)
        for draw_at, count in (
            (objects.draw_cabinet, layout.num_cabinets),
            (draw_shelf, layout.num_shelves),
            (draw_panel, layout.num_panels),
        ):
            for _ in range(count):
                self._place_at_wall(draw_at)
        for number in range(layout.num_tables):
            self._place_table(with_box=number < layout.num_small_boxes)
        draw_round_table = partial(objects.draw_round_table, thickness=layout.plate_thickness)
        for draw_on, count in (
            (objects.draw_box, layout.num_boxes),
            (partial(objects.draw_pillar, ceiling=ceiling), layout.num_pillars),
            (partial(objects.draw_column, ceiling=ceiling), layout.num_columns),
            (draw_round_table, layout.num_round_tables),
            (objects.draw_ball, layout.num_balls),
            (objects.draw_lamp, layout.num_lamps),
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
            lambda: objects.draw_table(
                self.rng, self._standing(middle, turn_deg=12), layout.plate_thickness, height
            ),
            min_gap=0.0 if layout.equal_tables else None,
        )
        if with_box:
            self._place(lambda: objects.draw_small_box(self.rng, _table_top(desk)))


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
