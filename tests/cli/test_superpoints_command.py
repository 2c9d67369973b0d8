"""Superpoints on the command line: written, read, scored, drawn."""

import json

import numpy as np
import pytest

from torchrg.cli import main
from torchrg.config import SuperpointsConfig
from torchrg.io import read_cloud
from torchrg.metrics import score_partition
from torchrg.neighbors import sample_voxels
from torchrg.pipeline import make_superpoints, segment_planes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A room, and its superpoints of all points and of voxels."""
    place = tmp_path_factory.mktemp("superpoints")
    room, flags = str(place / "room.npz"), ["--superpoints", "--partition.strengths", "0.3", "3"]
    assert main(["sample", room, "--num-points", "6000", "--seed", "2"]) == 0
    assert main(["segment", room, "--out", str(place / "all.npz"), *flags]) == 0
    assert main(["segment", room, "--out", str(place / "voxel.ply"), *flags, "--voxel", "0.3"]) == 0
    return place


def test_the_result_holds_every_level(folder):
    cloud = read_cloud(folder / "room.npz")
    config = SuperpointsConfig(strengths=(0.3, 3.0))
    found = make_superpoints(cloud.points, segment_planes(cloud.points), config)
    with np.load(folder / "all.npz", allow_pickle=False) as result:
        assert np.array_equal(result["superpoints"], found.labels)
        assert np.array_equal(result["superpoints_1"], found.levels[0])
        assert np.array_equal(result["plane_of_superpoint"], found.plane)
        provenance = json.loads(str(result["provenance"]))
    assert provenance["superpoints"]["strengths"] == [0.3, 3.0]


def test_every_point_has_the_superpoint_of_its_voxel(folder):
    cloud = read_cloud(folder / "room.npz")
    inverse = sample_voxels(cloud.points, 0.3).inverse.numpy()
    superpoints = read_cloud(folder / "voxel.ply").fields["superpoints"]
    assert superpoints.min() == 0
    pairs = np.unique(np.stack([inverse, superpoints]), axis=1)
    assert pairs.shape[1] == inverse.max() + 1


def test_superpoints_are_scored_when_asked(folder, capsys):
    result, truth = folder / "all.npz", folder / "room.npz"
    capsys.readouterr()
    flags = ["--superpoints", "--ignore", "0", "--boundary-distance", "0.2", "--json"]
    assert main(["score", str(result), str(truth), *flags]) == 0
    scores = json.loads(capsys.readouterr().out)
    ours, theirs = read_cloud(result), read_cloud(truth)
    arrays = ours.fields["superpoints"], theirs.fields["labels"], ours.points
    expected = score_partition(*arrays, ignore=0, boundary_distance=0.2)
    assert scores["superpoints"] == expected._asdict()
    assert main(["score", str(result), str(truth), "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == {"labels", "normals"}
    assert main(["score", str(truth), str(result), "--superpoints"]) == 2
    assert "expected superpoints for --superpoints" in capsys.readouterr().err


def test_superpoints_are_drawn(folder, tmp_path):
    picture = tmp_path / "parts.png"
    command = ["view", str(folder / "all.npz"), "--out", str(picture), "--width", "200"]
    assert main([*command, "--color", "superpoint"]) == 0
    assert picture.stat().st_size > 1000


def test_a_wrong_setting_is_told_in_one_line(folder, tmp_path, capsys):
    command = ["segment", str(folder / "room.npz"), "--out", str(tmp_path / "x.npz")]
    assert main([*command, "--superpoints", "--partition.strengths", "3", "1"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "strengths" in error
    assert main([*command, "--partition.min-size", "3"]) == 2
    assert "expected --superpoints" in capsys.readouterr().err
