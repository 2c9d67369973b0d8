"""``torchrg score`` of folders: the right pairs, their mean, and JSON."""

import json

import numpy as np
import pytest

from torchrg import Cloud, read_cloud, write_cloud
from torchrg.metrics import score_labels, score_normals

NAMES = ("scan10", "scan9", "hall/scan1")


@pytest.fixture
def folders(tmp_path):
    """Two folders of scans of the same points with labels; two of the three have normals too."""
    rng = np.random.default_rng(0)
    points = [rng.normal(size=(60 + n, 3)).astype(np.float32) for n in range(len(NAMES))]
    for kind, suffix in (("ours", ".npz"), ("truth", ".ply")):
        for number, name in enumerate(NAMES):
            fields = {"labels": rng.integers(0, 4, 60 + number)}
            if name != "scan9":
                fields["normals"] = rng.normal(size=(60 + number, 3)).astype(np.float32)
            path = tmp_path / kind / f"{name}{suffix if number == 0 else '.npz'}"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_cloud(path, Cloud(points[number], fields))
    return tmp_path / "ours", tmp_path / "truth"


def read_scan(folder, name):
    (path,) = (folder / name).parent.glob(f"{(folder / name).name}.*")
    return read_cloud(path).fields


def test_each_scan_is_scored_against_its_counterpart_in_natural_order(folders, run):
    scores = json.loads(run("score", *folders, "--json").out)
    assert list(scores) == ["scans", "mean"]
    assert list(scores["scans"]) == ["hall/scan1", "scan9", "scan10"]
    for name in NAMES:
        ours, truth = (read_scan(folder, name) for folder in folders)
        expected = score_labels(ours["labels"], truth["labels"])
        assert scores["scans"][name]["labels"] == expected._asdict()
        assert ("normals" in scores["scans"][name]) == (name != "scan9")
        if name != "scan9":
            errors = score_normals(ours["normals"], truth["normals"])
            assert scores["scans"][name]["normals"]["msae"] == errors.msae


def test_mean_is_over_the_scans_that_have_the_part(folders, run):
    scores = json.loads(run("score", *folders, "--json").out)
    scans, mean = scores["scans"], scores["mean"]
    assert (mean["labels"]["scans"], mean["normals"]["scans"]) == (3, 2)
    for part, index in (("labels", "f1"), ("labels", "regions"), ("normals", "rms")):
        values = [scores[part][index] for scores in scans.values() if part in scores]
        assert mean[part][index] == pytest.approx(sum(values) / len(values), rel=1e-12)
    lines = run("score", *folders).out.splitlines()
    assert lines[:3] == ["mean of 3 scans", "labels", "  scans                 3"]
    assert "normals" in lines


@pytest.mark.parametrize("side", [0, 1])
def test_missing_counterparts_are_named(folders, run, side):
    for name in ("scan9.npz", "hall/scan1.npz"):
        (folders[side] / name).unlink()
    line = run("score", *folders).error
    assert line.startswith(f"torchrg: {folders[side]}: no scan found for")
    assert line.endswith("for hall/scan1, scan9.\n")


def test_many_missing_counterparts_are_counted(folders, run):
    for number in range(100, 109):
        (folders[0] / f"scan{number}.npz").touch()
    error = run("score", *folders).error
    assert "scan100, scan101, scan102, scan103, scan104 and 4 more." in error


def test_mistakes_are_one_line(folders, tmp_path, run):
    ours, truth = folders
    (tmp_path / "empty").mkdir()
    (ours / "notes.md").write_text("not a scan")
    (ours / ".hidden.npz").write_text("not a scan")
    assert run("score", ours, truth).code == 0
    (truth / "scan9.pcd").touch()
    for arguments, message in {
        (ours, tmp_path / "empty"): "empty: expected files ending in",
        (ours, tmp_path / "none"): "none: file not found.",
        (tmp_path / "none", truth): "none: file not found.",
        (ours, truth / "scan9.npz"): "scan9.npz: expected a folder",
        (truth / "scan9.npz", ours): "scan9.npz: expected a folder",
        (ours, truth): "got scan9.npz and scan9.pcd",
    }.items():
        done = run("score", *arguments)
        assert (done.code, done.out) == (2, "")
        assert message in done.error
