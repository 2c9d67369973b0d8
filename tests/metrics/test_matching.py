"""Points of two files are those of the same rows, or the nearest within a distance."""

import numpy as np
import pytest

from torchrg import Cloud, read_cloud, write_cloud
from torchrg.metrics import differing_rows, match_points
from torchrg.scenes import make_room

CORNER = np.array([500_000.25, 4_000_000.5, 100.0])
"""Where a surveyed room is."""


@pytest.fixture(scope="module")
def points():
    """A room in float64; ten points are there twice, and two are not finite."""
    room = make_room(3000, noise=0.003, seed=1).points.numpy().astype(np.float64)
    room[100:110] = room[:10]
    room[[7, 50], [0, 2]] = np.nan, np.inf
    return room


def test_the_narrower_type_is_no_difference_and_another_place_is_one(points):
    for ours in (points, points.astype(np.float32)):
        assert differing_rows(Cloud(ours), Cloud(points)).tolist() == []
        assert differing_rows(Cloud(points), Cloud(ours)).tolist() == []
        moved = ours.copy()
        moved[5, 1] += 0.02
        moved[50] = 0
        assert differing_rows(Cloud(moved), Cloud(points)).tolist() == [5, 50]
        assert differing_rows(Cloud(points), Cloud(moved)).tolist() == [5, 50]


def test_numbers_beyond_the_narrower_type_are_compared_too():
    wild = np.array([[1e300, 1e-300, 5e-324], [-9e11, 0, 0], [0, -0.0, 0]])
    assert differing_rows(Cloud(wild), Cloud(wild)).tolist() == []
    narrow = Cloud(np.ones((3, 3), np.float32))
    assert differing_rows(narrow, Cloud(wild)).tolist() == [0, 1, 2]


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".ply", ".pcd", ".xyz"])
@pytest.mark.parametrize("place", [np.zeros(3), CORNER], ids=["near", "far"])
def test_what_a_format_without_rounding_holds_is_the_same_cloud(tmp_path, points, suffix, place):
    finite = Cloud(points[np.isfinite(points).all(axis=1)] + place)
    write_cloud(tmp_path / f"a{suffix}", finite)
    assert len(differing_rows(read_cloud(tmp_path / f"a{suffix}"), finite)) == 0


def test_rounded_files_match_within_the_rounding_in_any_order(points):
    millimeters = (points + CORNER).round(3)
    assert len(differing_rows(Cloud(millimeters), Cloud(points + CORNER))) > 0.99 * len(points)
    rows = np.random.default_rng(0).permutation(len(points))
    found = match_points(Cloud(millimeters[rows]), Cloud(points + CORNER), 0.001)
    assert np.flatnonzero(found < 0).tolist() == [7, 50]
    apart = np.abs(millimeters[rows][found] - points - CORNER)
    assert apart[found >= 0].max() < 0.00051


def test_the_nearest_within_a_distance_is_taken_whatever_the_order(points):
    rng = np.random.default_rng(0)
    ours = rng.choice(points[np.isfinite(points).all(axis=1)], 500, replace=False)
    ours[3] = np.nan
    theirs = points[::3]
    apart = np.linalg.norm(theirs[:, None] - ours[None], axis=2)
    apart[np.isnan(apart)] = np.inf
    for limit in (0.01, 0.2, 50.0):
        found = match_points(Cloud(ours), Cloud(theirs), limit)
        near = found >= 0
        assert ((apart.min(axis=1) <= limit) == near).all()
        assert (apart[near, found[near]] == apart[near].min(axis=1)).all()
        order = rng.permutation(len(ours))
        again = match_points(Cloud(ours[order]), Cloud(theirs), limit)
        assert np.array_equal(ours[order][again[near]], ours[found[near]])


def test_ties_do_not_depend_on_the_order():
    ours = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    middle = Cloud(np.zeros((1, 3)))
    taken = set()
    for seed in range(20):
        rows = np.random.default_rng(seed).permutation(5)
        (found,) = match_points(Cloud(ours[rows]), middle, 2.0)
        taken.add(tuple(ours[rows[found]]))
    assert len(taken) == 1


def test_clouds_without_a_finite_point_match_nothing():
    nothing, one = Cloud(np.full((2, 3), np.nan)), Cloud(np.zeros((1, 3)))
    assert match_points(nothing, one, 1.0).tolist() == [-1]
    assert match_points(one, nothing, 5.0).tolist() == [-1, -1]
    assert differing_rows(nothing, nothing).tolist() == []
