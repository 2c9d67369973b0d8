"""Codes for missing points in clouds."""

import numpy as np
import pytest
import torch

from tests.cli.test_cli import CLASSIC
from torchrg import load_config
from torchrg.config import SuperpointsConfig
from torchrg.errors import ConfigError
from torchrg.pipeline import clouds
from torchrg.pipeline.clouds import check_finite, describe_multipliers, find_objects, note_on_copies
from torchrg.structures import Cloud


def test_codes_for_missing_points_are_no_points(room, tmp_path, run):
    far = room(6000, seed=2).points.double().numpy() + np.array([5e5, 5.4e6, 300])
    np.save(tmp_path / "whole.npy", far)
    far[[3, 5]], far[[9, 11], 2] = [[np.nan], [1e30]], (-3.4028235e38, 1e200)
    np.save(tmp_path / "codes.npy", far)
    labels = []
    for name in ("whole", "codes"):
        out = tmp_path / f"{name}.npz"
        done = run("segment", tmp_path / f"{name}.npy", "--out", out, *CLASSIC)
        with np.load(out) as result:
            labels.append(result["labels"])
    assert np.array_equal(np.load(out)["points"], far, equal_nan=True)
    reported = "4 of 6,000 points are not finite or beyond 1e+12; they have no normal and no plane"
    assert reported in done.err
    assert (labels[1][[3, 5, 9, 11]] == -1).all()
    assert (labels[1] != labels[0]).sum() < 60
    assert labels[1].max() == labels[0].max() >= 3
    np.save(tmp_path / "huge.npy", far * 1e20)
    line = run("segment", tmp_path / "huge.npy", "--out", tmp_path / "a.npz").error
    assert (
        "huge.npy: expected finite points, got none in 6,000 points; coordinates beyond 1e+12"
        in line
    )


def test_objects_of_segment_are_those_of_segment20_where_only_these_exist():
    fields = {"segment20": np.array([3, 4, 4]), "instance": np.array([[1, 9], [2, 9], [3, 9]])}
    cloud = Cloud(np.zeros((3, 3)), fields)
    assert find_objects(cloud, "segment").tolist() == [3, 4, 4]
    # Of several labels of a point, the first.
    assert find_objects(cloud, "instance").tolist() == [1, 2, 3]
    both = Cloud(np.zeros((3, 3)), {**fields, "segment": np.array([7, 8, 9])})
    assert find_objects(both, "segment").tolist() == [7, 8, 9]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("can't allocate memory: 9 bytes")])
@pytest.mark.parametrize(
    ("changes", "partition", "message"),
    [
        ({"normals.k": 600}, None, "for 9 points with --normals.k 600; lower it"),
        (
            {"normals.adaptive_k": 300},
            SuperpointsConfig(counts=(9, 8, 7, 6, 5)),
            "with --normals.adaptive-k 300 and 5 levels of superpoints; lower it",
        ),
    ],
)
def test_too_little_memory_names_the_settings(monkeypatch, error, changes, partition, message):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(clouds, "segment_planes", fail)
    cloud = Cloud(np.eye(9, 3), source="a.ply")
    with pytest.raises(ConfigError, match=f"^a.ply: out of memory .*{message}"):
        clouds.segment_cloud(cloud, load_config(**changes), partition=partition)
    with pytest.raises(type(error)):
        clouds.segment_cloud(cloud, load_config(), partition=SuperpointsConfig())


def test_other_errors_stay(monkeypatch):
    monkeypatch.setattr(clouds, "segment_planes", lambda *_, **__: torch.zeros(2) + torch.zeros(3))
    with pytest.raises(RuntimeError, match="size of tensor"):
        clouds.segment_cloud(Cloud(np.eye(9, 3)), load_config(**{"normals.k": 600}))


def test_describe_multipliers_by_example():
    assert describe_multipliers(load_config({"normals.k": 600})) == " with --normals.k 600"


def test_check_finite_by_example():
    assert check_finite(Cloud(np.array([[0.0, 0, 0], [np.nan, 0, 0], [1e30, 0, 0]]))) == (
        "2 of 3 points are not finite or beyond 1e+12; they have no normal and no plane",
    )


def test_note_on_copies_by_example():
    assert note_on_copies(2, 3) == (
        "2 of 3 points are duplicates; duplicates count once and share one result",
    )


def test_find_objects_by_example():
    cloud = Cloud(np.zeros((2, 3)), {"instance": np.array([[3, 5], [4, -1]])})
    assert find_objects(cloud, "instance").tolist() == [3, 4]
