"""Hallways and storeys."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.made import (
    HALL_LAYOUT,
    StoreyLayout,
    build_storey,
    cast_rays,
    make_storey,
)
from torchrg.errors import ConfigError
from torchrg.scenes import make_room
from torchrg.scenes.scene import is_occupied


def test_hall_has_doors_on_both_sides():
    hall = make_room(20_000, noise=0, layout=HALL_LAYOUT)
    doors = [row for row, kind in enumerate(hall.kinds) if kind == "door"]
    assert len(doors) == 14
    assert {tuple(normal) for normal in hall.face_normals[doors].round().tolist()} >= {
        (0, 1, 0),
        (0, -1, 0),
    }
    residuals = (hall.points.double() * hall.face_normals[hall.labels]).sum(dim=1)
    assert (residuals - hall.face_offsets[hall.labels]).abs().max() < 3e-6


def test_storey_has_one_floor_and_a_ceiling_for_each_room():
    storey = make_storey(30_000, noise=0)
    assert storey.kinds.count("floor") == 1
    ceilings = [row for row, kind in enumerate(storey.kinds) if kind == "ceiling"]
    assert len(ceilings) == 9
    heights = storey.face_offsets[ceilings].sort().values
    assert heights.diff().abs().min() > 0.005
    residuals = (storey.points.double() * storey.face_normals[storey.labels]).sum(dim=1)
    assert (residuals - storey.face_offsets[storey.labels]).abs().max() < 3e-6


@pytest.mark.parametrize("seed", range(4))
def test_every_room_is_reached_from_the_hall_through_its_door(seed):
    model = build_storey(seed)
    floor = model.surfaces[0]
    thresholds = list(floor.cells[2::2])
    assert len(thresholds) == 8
    for corner, edge, other in thresholds:
        middle = np.array([*(corner + edge / 2 + other / 2), 1.0])
        through = np.array([[[0, 1.0, 0], [0, -1.0, 0]]])
        distances = cast_rays(model, middle, through).distances[0]
        # One way lies the hallway of 2.4 m, the other way a room.
        assert distances.min() > 2
        assert distances.max() > 4
        assert not is_occupied(
            model.parts, middle + np.linspace(-1, 1, 9)[:, None] * [0, 1, 0]
        ).any()


def test_rooms_of_a_storey_do_not_overlap():
    cells = build_storey(1).surfaces[0].cells
    low, high = cells[:, 0], cells[:, 0] + cells[:, 1] + cells[:, 2]
    overlaps = (np.minimum(high[:, None], high) - np.maximum(low[:, None], low)).min(axis=2)
    np.fill_diagonal(overlaps, -1)
    # The hallway, doorways and rooms share edges and no more; rooms are apart by their walls.
    assert overlaps.max() < 1e-9
    assert overlaps[1::2, 1::2].max() < -0.3
    for doorway in range(2, len(cells), 2):
        assert (np.abs(overlaps[doorway]) < 1e-9).sum() == 2


def test_points_of_a_storey_are_not_inside_bodies():
    storey, model = make_storey(20_000, noise=0, seed=2), build_storey(2)
    in_front = storey.points.double() + 1e-4 * storey.normals.double()
    assert not is_occupied(model.parts, in_front.numpy()).any()


def test_number_of_rooms_is_a_setting():
    hall = replace(StoreyLayout().hall, num_doors=0, num_windows=0, num_cabinets=0, num_panels=0)
    layout = StoreyLayout(rooms_per_side=1, hall=hall)
    small = make_storey(1000, layout=layout)
    assert small.kinds.count("ceiling") == 3
    assert torch.equal(small.points, make_storey(1000, layout=layout).points)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rooms_per_side": 0}, "StoreyLayout: expected rooms_per_side >= 1, got 0"),
        ({"room_depth": (5, 4)}, r"expected room_depth as \(least, greatest\), got \(5, 4\)"),
    ],
)
def test_impossible_storeys_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        StoreyLayout(**settings)
