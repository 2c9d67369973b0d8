"""Points of two files are the same but for rounding, in their order or in another."""

import numpy as np
import pytest

from torchrg import Cloud, read_cloud, write_cloud
from torchrg.metrics import differing_rows, match_points
from torchrg.scenes import make_room


@pytest.fixture(scope="module")
def points():
    """A room far away, in float64; some points are there twice, and two are not finite."""
    room = make_room(3000, noise=0.003, seed=1).points.numpy().astype(np.float64)
    room += CORNER
    room[100:110] = room[:10]
    room[[7, 50], [0, 2]] = np.nan, np.inf
    return room


def as_float32_about(origin):
    return lambda points: (points - origin).astype(np.float32) + origin


CORNER = np.array([500_000.25, 4_000_000.5, 100.0])
"""Where the room is."""
ROUNDINGS = {
    "same": lambda points: points,
    "float32": lambda points: points.astype(np.float32),
    "float32 about its corner": as_float32_about(CORNER),
    "float32 about its middle": as_float32_about(CORNER + np.array([4.5, 3.5, 1.5])),
    "millimetres": lambda points: points.round(3),
    "centimetres": lambda points: points.round(2),
    "integers with scale and offset": lambda points: (
        np.rint((points - CORNER.round()) / 0.001) * 0.001 + CORNER.round()
    ),
    "nine digits": lambda points: np.array(
        [[float(f"{value:.9g}") for value in row] for row in points]
    ),
}


@pytest.mark.parametrize("one", ROUNDINGS)
@pytest.mark.parametrize("other", ["same", "millimetres"])
def test_rounding_is_no_difference_and_another_place_is_one(points, one, other):
    if one == "float32":
        points = points - CORNER.round()
    ours, theirs = (Cloud(ROUNDINGS[name](points)) for name in (one, other))
    assert differing_rows(ours, theirs).tolist() == []
    assert differing_rows(theirs, ours).tolist() == []
    moved = ROUNDINGS[one](points).copy()
    moved[5, 1] += 0.02
    moved[50] = 0
    assert differing_rows(Cloud(moved), theirs).tolist() == [5, 50]
    rows = np.random.default_rng(0).permutation(len(points))
    shuffled = Cloud(ours.coordinates[rows])
    assert len(differing_rows(shuffled, theirs)) > 0.99 * len(points)
    found = match_points(shuffled, theirs)
    assert np.flatnonzero(found < 0).tolist() == [7, 50]
    found[[7, 50]] = 0
    same = differing_rows(Cloud(shuffled.coordinates[found]), theirs)
    assert same.tolist() == [7, 50]


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".ply", ".pcd", ".las", ".laz", ".xyz"])
@pytest.mark.parametrize("place", [np.zeros(3), CORNER], ids=["near", "far"])
def test_what_another_format_holds_is_the_same_cloud(tmp_path, points, suffix, place):
    extra = {".las": "laspy", ".laz": "laspy"}
    pytest.importorskip(extra[suffix]) if suffix in extra else None
    finite = points[np.isfinite(points).all(axis=1)] - CORNER + place
    write_cloud(tmp_path / f"a{suffix}", Cloud(finite))
    assert len(differing_rows(read_cloud(tmp_path / f"a{suffix}"), Cloud(finite))) == 0


def test_digits_of_text_by_other_programs_are_seen(tmp_path, points):
    finite = points[np.isfinite(points).all(axis=1)]
    local = finite - [500_000.0, 4_000_000.0, 0.0]
    # As the streams of C++ write numbers, and as people round them.
    for form, cloud in (("%.6g", local), ("%.8f", finite), ("%.3f", finite), ("%.1f", finite)):
        np.savetxt(tmp_path / "a.xyz", cloud, fmt=form)
        written = read_cloud(tmp_path / "a.xyz")
        assert len(differing_rows(written, Cloud(cloud))) == 0, form
        if form != "%.1f":
            assert len(differing_rows(written, Cloud(cloud + 0.002))) == len(cloud), form


def test_a_coarse_file_never_takes_two_of_its_places_for_one():
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3)
    for scale in (1.0, 0.1, 0.05, 1000.0, 1 / 3):
        for dtype in (np.float32, np.float64):
            points = (grid * scale).astype(dtype)
            neighbors = np.roll(points, 1, axis=0)
            moved = differing_rows(Cloud(points), Cloud(neighbors))
            assert len(moved) == len(points), (scale, dtype)


def test_numbers_that_no_scanner_gives_are_compared_as_they_are():
    wild = np.array([[1e12, 1e-300, 5e-324], [-9e11, 0, 0], [9e11, 1, 1], [0, -0.0, 0]])
    for points in (wild, wild[1:].astype(np.float32)):
        assert len(differing_rows(Cloud(points), Cloud(points))) == 0
        assert (match_points(Cloud(points[::-1]), Cloud(points)) >= 0).all()
    assert differing_rows(Cloud(wild[[1, 0, 2, 3]]), Cloud(wild)).tolist() == [0, 1]
    outlier = np.concatenate([np.random.default_rng(0).normal(size=(50, 3)), [[9e11, 0, 0]]])
    for dtype in (np.float32, np.float64):
        ours = outlier.astype(dtype)
        other = np.concatenate([ours[-2::-1], ours[-1:]])
        assert len(differing_rows(Cloud(other), Cloud(ours))) == 50


def test_the_nearest_within_a_distance_is_taken_whatever_the_order(points):
    rng = np.random.default_rng(0)
    ours = rng.choice(points[np.isfinite(points).all(axis=1)], 500, replace=False)
    ours[3] = np.nan
    theirs = points[::3]
    apart = np.linalg.norm(theirs[:, None] - ours[None], axis=2)
    apart[np.isnan(apart)] = np.inf
    for limit in (0.01, 0.2, 50.0):
        found = match_points(Cloud(ours), Cloud(theirs), limit)
        assert ((apart.min(axis=1) <= limit) == (found >= 0)).all()
        near = found >= 0
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
    assert match_points(nothing, one).tolist() == [-1]
    assert match_points(one, nothing, 5.0).tolist() == [-1, -1]
    assert differing_rows(nothing, nothing).tolist() == []
