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
def folder(folder_of_clouds):
    """A room, and its superpoints of all points and of voxels."""
    place = folder_of_clouds("room.npz", num_points=6000)
    command = ["segment", str(place / "room.npz"), "--superpoints"]
    command += ["--partition.strengths", "0.3", "3", "--out"]
    assert main([*command, str(place / "all.npz")]) == 0
    assert main([*command, str(place / "voxel.ply"), "--voxel", "0.3"]) == 0
    return place


def test_the_result_holds_every_level(folder):
    cloud = read_cloud(folder / "room.npz")
    config = SuperpointsConfig(strengths=(0.3, 3.0))
    expected = make_superpoints(cloud.points, segment_planes(cloud.points), config)
    with np.load(folder / "all.npz", allow_pickle=False) as result:
        assert np.array_equal(result["superpoint"], expected.labels)
        assert np.array_equal(result["superpoint_1"], expected.levels[0])
        assert np.array_equal(result["plane_of_superpoint"], expected.plane)
        provenance = json.loads(str(result["provenance"]))
    assert provenance["superpoints"]["strengths"] == [0.3, 3.0]


@pytest.mark.parametrize(
    "flags", [["--superpoints", "300,40"], ["--superpoints=300,40"], ["--superpoint", "300,40"]]
)
def test_numbers_of_superpoints_are_asked_for_in_a_word(folder, tmp_path, run, flags):
    path = tmp_path / "parts.npz"
    assert run("segment", folder / "room.npz", "--out", path, *flags).code == 0
    with np.load(path, allow_pickle=False) as result:
        numbers = [len(np.unique(result[name])) for name in ("superpoint", "superpoint_1")]
        provenance = json.loads(str(result["provenance"]))
    assert numbers == [300, 40]
    assert provenance["superpoints"]["counts"] == [300, 40]


def test_every_point_has_the_superpoint_of_its_voxel(folder):
    cloud = read_cloud(folder / "room.npz")
    inverse = sample_voxels(cloud.points, 0.3).inverse.numpy()
    superpoints = read_cloud(folder / "voxel.ply").fields["superpoint"]
    assert superpoints.min() == 0
    pairs = np.unique(np.stack([inverse, superpoints]), axis=1)
    assert pairs.shape[1] == inverse.max() + 1


def test_superpoints_are_scored_when_asked(folder, run):
    result, truth = folder / "all.npz", folder / "room.npz"
    flags = ["--superpoints", "--ignore", "0", "--boundary-distance", "0.2", "--json"]
    scores = json.loads(run("score", result, truth, *flags).out)
    ours, theirs = read_cloud(result), read_cloud(truth)
    arrays = ours.fields["superpoint"], theirs.fields["labels"], ours.points
    expected = score_partition(*arrays, ignore=0, boundary_distance=0.2)
    assert scores["superpoints"] == expected._asdict()
    assert set(json.loads(run("score", result, truth, "--json").out)) == {"labels", "normals"}
    error = run("score", truth, result, "--superpoints").error
    assert "missing superpoint, required by --superpoints" in error


def test_superpoints_are_drawn(folder, tmp_path, run):
    picture = ("--out", tmp_path / "parts.png", "--width", "200")
    assert run("view", folder / "all.npz", *picture, "--color", "superpoint").code == 0
    assert (tmp_path / "parts.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--superpoints", "--partition.strengths", "3", "1"], "strengths"),
        (["--superpoints", "40,300"], "expected --partition.counts one or more integers"),
        (["--partition.min-size", "3"], "expected --superpoints"),
    ],
)
def test_a_wrong_setting_is_told_in_one_line(folder, tmp_path, run, flags, message):
    done = run("segment", folder / "room.npz", "--out", tmp_path / "x.npz", *flags)
    assert done.code == 2
    assert message in done.error
