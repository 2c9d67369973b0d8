"""Boxes in headers, against the points of the file."""

import numpy as np
import pytest

from torchrg.io.headers import distance_outside

LOW, HIGH = np.array([10.0, 20, 30]), np.array([14.0, 22, 31])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("end", [0, 1])
def test_points_may_leave_the_box_by_a_hundredth_of_their_extent(axis, end):
    extent = (HIGH - LOW)[axis]
    for fraction, is_outside in ((0.0099, False), (0.0101, True)):
        box = np.array([LOW, HIGH])
        box[end, axis] += (1 - 2 * end) * fraction * extent
        expected = fraction * extent if is_outside else 0.0
        assert distance_outside(LOW, HIGH, box) == pytest.approx(expected)


def test_steps_of_coordinates_are_rounding():
    box = np.array([LOW, HIGH - [0.5, 0, 0]])
    assert distance_outside(LOW, HIGH, box) == 0.5
    assert distance_outside(LOW, HIGH, box, step=0.25) == 0.0
    assert distance_outside(LOW, HIGH, box, step=0.24) == 0.5


@pytest.mark.parametrize("box", [np.zeros((2, 3)), np.full((2, 3), np.nan)])
def test_headers_without_a_box_say_nothing(box):
    assert distance_outside(LOW, HIGH, box) == 0.0
