"""Walls, furniture and the places where they go."""

import numpy as np

from torchrg.scenes.furniture import (
    block,
    draw_panel,
    draw_round_table,
    draw_shelf,
    draw_table,
)
from torchrg.scenes.geometry import Frame
from torchrg.scenes.rooms import _floor_places, _wall_places
from torchrg.scenes.shells import against, recess, room_walls, shell
from torchrg.scenes.surfaces import plane_of

HERE = Frame.upright(np.zeros(3))


def test_things_fit_on_walls_and_floor_in_equal_steps():
    assert _wall_places((5.2, 3.2, 3.0)) == [
        *((0, 1.6), (0, 3.6), (1, 1.6)),
        *((2, 1.6), (2, 3.6), (3, 1.6)),
    ]
    assert _floor_places((6.0, 3.2, 3.0)) == [(1.875, 1.6), (4.125, 1.6)]


def test_shell_has_floor_ceiling_and_walls():
    surfaces = shell(HERE, (4, 3, 2.5), [[]] * 4).surfaces
    assert [surface.area for surface in surfaces] == [12.0, 12.0, 10.0, 7.5, 10.0, 7.5]
    assert len(shell(HERE, (4, 3, 2.5), [[]] * 4, with_floor=False).surfaces) == 5


def test_object_stands_with_its_back_against_the_wall():
    frame = against(room_walls(HERE, (4, 3, 2.5))[0], 1, 0.5, 0.4)
    assert frame.origin.tolist() == [3.0, 0.2, 0.5]
    assert frame.axes.tolist() == [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]


def test_leaf_of_a_door_is_behind_the_wall():
    wall = Frame.spanned(np.zeros(3), np.array([1.0, 0, 0]), np.array([0.0, 0, 1]))
    leaf, *frame = recess("door", wall, (1, 2, 0.02, 2), 0.1).surfaces
    assert leaf.frame.origin.tolist() == [1.0, 0.1, 0.02]
    assert [surface.kind for surface in frame] == ["door frame"] * 4


def test_faces_of_furniture():
    rng = np.random.default_rng(0)
    assert len(block("box", HERE, (1, 1, 1), without=["bottom"]).surfaces) == 5
    assert len(draw_table(rng, HERE, 0.04).surfaces) == 10
    round_table = draw_round_table(rng, HERE, 0.04).surfaces
    assert [surface.plane is None for surface in round_table] == [False, False, True, True]
    wall = room_walls(HERE, (4, 3, 2.5))[0]
    kinds = [surface.kind for surface in draw_shelf(rng, wall, 1.0, 0.04).surfaces]
    assert kinds == ["shelf edge", "shelf edge", "shelf edge", "shelf", "shelf"]
    kinds = [surface.kind for surface in draw_panel(rng, wall, 1.0, 0.04).surfaces]
    assert kinds == ["panel edge", "panel edge", "panel", "panel edge", "panel edge"]


def test_plane_of_a_frame_is_that_of_its_first_two_axes():
    normal, offset = plane_of(Frame.upright(np.array([1.0, 2, 3])))
    assert (normal.tolist(), offset) == ([0, 0, 1], 3.0)
