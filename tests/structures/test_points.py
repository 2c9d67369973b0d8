"""Origins of far clouds, and arrays of integers."""

import numpy as np
import pytest

from torchrg.structures.points import are_integers, bounding_box, local_origin


@pytest.mark.parametrize(
    ("low", "high", "origin"),
    [
        ((0, 0, 0), (8, 6, 3), (0, 0, 0)),
        ((500_000, 4_000_000, 1), (500_010, 4_000_020, 3), (500_005, 4_000_010, 2)),
        ((-np.inf, 0, 0), (1, 1, 1), (0, 0, 0)),
    ],
)
def test_only_a_far_cloud_gets_another_origin(low, high, origin):
    assert local_origin(np.array(low, float), np.array(high, float)).tolist() == list(origin)


def test_the_box_of_points_is_that_of_their_columns():
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    low, high = bounding_box(points)
    assert (low == points.min(axis=0)).all()
    assert (high == points.max(axis=0)).all()


def test_integers_stored_as_floats_are_integers():
    assert are_integers(np.array([1.0, -2.0]))
    assert are_integers(np.array([True]))
    assert not are_integers(np.array([1.5, 2]))
    assert not are_integers(np.array([np.nan, 2]))
