"""Directions of rooms are those of their walls, whatever the up axis is."""

import math

import numpy as np
import pytest
import torch

from torchrg.regions.directions import (
    MAX_TILT,
    are_horizontal,
    are_vertical,
    find_heading,
    horizontal_toward,
    likely_up,
    unit_axis,
)

Z = torch.tensor([0.0, 0, 1]).double()


@pytest.mark.parametrize("turn_deg", [-40, -10, 0, 3, 44])
def test_the_heading_is_the_direction_of_most_wall_area_nearest_to_x(turn_deg):
    angles = torch.deg2rad(torch.tensor([0.0, 90, 180, 91, 30]) + turn_deg).double()
    walls = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    heading = find_heading(walls, torch.tensor([5.0, 4, 3, 0.1, 6]).double(), Z)
    found = math.degrees(math.atan2(heading[1], heading[0]))
    assert found == pytest.approx(turn_deg, abs=0.05)


def test_without_walls_there_is_no_heading():
    assert find_heading(Z[None], torch.ones(1).double(), Z) is None
    assert horizontal_toward(unit_axis(Z), Z).tolist() == [1, 0, 0]


@pytest.mark.parametrize("off_deg", [-0.1, 0.1])
def test_planes_are_horizontal_or_vertical_to_within_fifteen_degrees(off_deg):
    tilt = MAX_TILT + math.radians(off_deg)
    floor = torch.tensor([[math.sin(tilt), 0, math.cos(tilt)]])
    wall = torch.tensor([[-math.cos(tilt), 0, math.sin(tilt)]])
    assert are_horizontal(floor, Z).tolist() == are_vertical(wall, Z).tolist() == [off_deg < 0]
    assert not are_horizontal(wall, Z)
    assert not are_vertical(floor, Z)


def test_likely_up_by_example():
    normals, positions = np.eye(3), np.array([[0, 1.0, 1], [2, 0, 1], [2, 1, 0]])
    both = np.concatenate([positions, [4, 2, 2] - positions])
    assert (
        likely_up(np.concatenate([normals] * 2), both, np.array([4, 40, 8] * 2), normals[2]) == "y"
    )
