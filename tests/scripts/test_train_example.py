"""The training example runs, and its variants differ in their inputs only."""

import re

import numpy as np
import pytest
import torch
import train_example
from train_example import CLASSES, VARIANTS


@pytest.fixture(scope="module")
def room():
    return train_example.draw_room(0, 2500)


@pytest.fixture(scope="module")
def sample(room):
    return train_example.prepare(room)


def test_a_short_run_prints_a_table(capsys):
    rooms = ["--train-rooms", "2", "--test-rooms", "1", "--num-points", "1500"]
    train_example.main([*rooms, "--steps", "1", "--seeds", "0"])
    _, _, head, rule, *rows = capsys.readouterr().out.splitlines()
    assert [line.count("|") for line in (head, rule, *rows)] == [len(CLASSES) + 3] * (2 + len(rows))
    assert [row.split(" | ")[0].strip("| ") for row in rows[:-1]] == list(VARIANTS)
    values = [float(text) for row in rows for text in re.findall(r"\d+(?:\.\d)?", row)]
    assert max(values) <= 100


def test_every_room_has_every_class():
    for seed in (1, train_example.TEST_SEED):
        classes = train_example.classes_of(train_example.draw_room(seed, 2000))
        assert classes.unique().tolist() == list(range(len(CLASSES)))


def test_the_points_of_the_model_are_those_of_the_scan(room, sample):
    assert sample.ground_truth.tolist() == train_example.classes_of(room).tolist()
    finest = sample.levels[0]
    assert len(sample.inverse) == len(room.points)
    assert len(sample.target) == len(sample.normal) == len(finest.coord) < len(room.points)
    gaps = room.points.diff(dim=0) - finest.coord[sample.inverse].diff(dim=0)
    assert gaps.abs().max() < 2 * train_example.VOXELS[0] + 1e-5
    for level, coarser in zip(sample.levels, sample.levels[1:], strict=False):
        assert level.coarser.unique().tolist() == list(range(len(coarser.coord)))


def test_points_without_a_plane_are_superpoints_of_their_own(room, sample):
    rows = train_example.sample_voxels(room.points, train_example.VOXELS[0]).rows
    planes = train_example.segment_planes(room.points).labels[rows]
    lone = sample.superpoint[planes < 0]
    sizes = sample.superpoint.bincount()
    assert len(lone) > 0
    assert (sizes[lone] == 1).all()
    for plane in planes[planes >= 0].unique():
        assert len(sample.superpoint[planes == plane].unique()) == 1


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_sees_what_its_name_says(sample, name):
    torch.manual_seed(0)
    model, turn = train_example.PointUNet(), torch.eye(3)
    variant = VARIANTS[name]

    def scores(**changed):
        return train_example.predict(model, sample._replace(**changed), variant, turn)

    without_normals = scores(normal=-sample.normal, curvature=1 - sample.curvature)
    without_planes = scores(superpoint=torch.zeros_like(sample.superpoint))
    assert torch.equal(without_normals, scores()) != variant.normals
    assert torch.equal(without_planes, scores()) != variant.planes


def test_a_turn_keeps_angles_and_the_upward_axis():
    for seed in range(20):
        turn = train_example.draw_turn(np.random.default_rng(seed))
        scale = turn[2, 2]
        assert 0.9 <= scale <= 1.1
        assert torch.allclose(turn @ turn.T, scale**2 * torch.eye(3), atol=1e-6)
        assert turn[2, :2].tolist() == turn[:2, 2].tolist() == [0, 0]


def test_ious_are_those_of_counting_sets(rng):
    size = len(CLASSES) - 1
    truth, predicted = torch.randint(0, size, (2, 3, 40), generator=rng)
    found = train_example.class_ious(list(predicted), list(truth))
    for number in range(size):
        mine = {i for i, label in enumerate(predicted.flatten()) if label == number}
        true = {i for i, label in enumerate(truth.flatten()) if label == number}
        assert found[number] == pytest.approx(100 * len(mine & true) / len(mine | true))
    assert found[size] == 0
