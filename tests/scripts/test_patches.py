"""Patches are the planes inside parts, and bent or thick parts have none."""

import numpy as np
from benchmarks.patches import IGNORED, label_patches


def sheet(rng, count, low, high):
    return rng.uniform(low, high, (count, 3)) + 0.002 * rng.standard_normal((count, 3))


def test_planes_of_parts_are_patches_and_bent_parts_are_not():
    rng = np.random.default_rng(0)
    box = [sheet(rng, 900, (0, 0, 0), (0.4, 0.4, 0)), sheet(rng, 600, (0, 0, 0), (0, 0.4, 0.3))]
    # Two halves of one plane, 10 cm apart, are not connected.
    shelf = [sheet(rng, 800, (2, 0, 0), (2.5, 0.3, 0)), sheet(rng, 600, (2.6, 0, 0), (3, 0.3, 0))]
    ball = rng.standard_normal((3000, 3))
    ball = 0.15 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + 5
    slab = rng.uniform(0, (0.5, 0.5, 0.1), (3000, 3)) + 8
    few = sheet(rng, 400, (9, 0, 0), (9.3, 0.3, 0))
    clouds = [*box, *shelf, ball, slab, few]
    parts = np.repeat([0, 0, 1, 1, 2, 3, 4], [len(cloud) for cloud in clouds])
    points = np.concatenate([*clouds, sheet(rng, 700, (11, 0, 0), (12, 1, 0))])
    parts = np.concatenate([parts, np.full(700, -1)])
    labels = label_patches(points, parts, 0.015)
    faces = np.repeat(np.arange(8), [*map(len, clouds), 700])
    found = {int(label) for label in labels[faces < 4]} - {IGNORED}
    assert len(found) == 4
    for face in range(4):
        here = labels[faces == face]
        # The strip at the corner of the box, 15 mm of 30 cm on one side, is of both faces.
        assert (here == np.bincount(here[here >= 0]).argmax()).mean() > 0.85
    assert (labels[faces >= 4] == IGNORED).all()


def test_copies_of_points_define_no_plane():
    rng = np.random.default_rng(1)
    points = np.repeat(sheet(rng, 30, (0, 0, 0), (0.1, 0.1, 0)), 40, axis=0)
    assert label_patches(points, np.zeros(1200, dtype=np.int64), 0.01).max() == 0
    equal = np.ones((600, 3))
    assert (label_patches(equal, np.zeros(600, dtype=np.int64), 0.01) == IGNORED).all()
