"""Points sampled from the faces of scenes."""

import numpy as np
import pytest
from scipy.stats import chisquare

from torchrg.errors import ConfigError
from torchrg.scenes import RoomLayout, build_room, make_room, sample_scene

BARE_WALLS = RoomLayout(num_cabinets=0, num_shelves=0, num_boxes=7)


@pytest.fixture(scope="module")
def bare(room):
    return room(200_000, 0.0, 2, BARE_WALLS)


def test_what_is_covered_is_left_out_and_only_that(bare):
    covered = sum(
        solid.size[0] * solid.size[1]
        for part in build_room(2, layout=BARE_WALLS).parts
        for solid in part.solids
        if abs(solid.frame.origin[2] - solid.size[2] / 2) < 1e-9
    )
    counts = bare.labels.bincount(minlength=len(bare.kinds)).double()
    expected = (bare.face_areas[0] - covered) * counts[2:6].sum() / bare.face_areas[2:6].sum()
    assert abs(counts[0] - expected) < 4 * (2 * expected).sqrt()
    # The test would see it if they were sampled too.
    assert covered * counts[0] / bare.face_areas[0] > 5 * (2 * expected).sqrt()


def test_numbers_of_points_are_proportional_to_areas(bare):
    free = ["wall", "door", "window", "door frame", "window frame", "table edge", "pillar"]
    rows = [row for row, kind in enumerate(bare.kinds) if kind in free]
    counts = bare.labels.bincount(minlength=len(bare.kinds))[rows].numpy()
    areas = bare.face_areas[rows].numpy()
    assert chisquare(counts, areas / areas.sum() * counts.sum()).pvalue > 1e-4


def test_points_are_spread_evenly_over_walls_with_holes(bare):
    for face, surface in enumerate(build_room(2, layout=BARE_WALLS).surfaces[2:6], start=2):
        local = surface.frame.to_local(bare.points[bare.labels == face].double().numpy())
        counts = [
            ((local[:, :2] >= corner) & (local[:, :2] < corner + edge + other)).all(axis=1).sum()
            for corner, edge, other in surface.cells
        ]
        areas = np.array([edge[0] * other[1] for _, edge, other in surface.cells])
        assert abs(sum(counts) - len(local)) < 5  # rounding at the edges
        assert chisquare(counts, areas / areas.sum() * sum(counts)).pvalue > 1e-4


def test_points_are_in_random_order():
    random = make_room(5000, seed=1).labels
    same = (random[1:] == random[:-1]).double().mean()
    fractions = random.bincount().double() / 5000
    assert abs(same - (fractions**2).sum()) < 0.02


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_points": 0}, "sample_scene: expected num_points from 1 to 2,147,483,647, got 0"),
        ({"num_points": 10**23}, "expected num_points from 1 to 2,147,483,647, got 1000"),
        ({"noise": -1}, r"sample_scene: expected noise from 0 to 1e\+12 m, got -1"),
        ({"noise": float("nan")}, "expected noise .* got nan"),
        ({"noise": 1e300}, r"expected noise .* got 1e\+300"),
        ({"seed": -1}, "expected seed >= 0, got -1"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        make_room(**{"num_points": 100, **settings})
    with pytest.raises(ConfigError, match="noise_direction to be one of normal, isotropic, got"):
        sample_scene(build_room(), 100, noise_direction="up")
