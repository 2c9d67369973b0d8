"""``torchrg score`` of folders: the right pairs, their mean, and JSON."""

import json

import numpy as np
import pytest

from torchrg import Cloud, read_cloud, write_cloud
from torchrg.cli import main
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


def run_score(*arguments):
    return main(["score", *map(str, arguments)])


def test_each_scan_is_scored_against_its_counterpart_in_natural_order(folders, capsys):
    assert run_score(*folders, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["scans", "mean"]
    assert list(found["scans"]) == ["hall/scan1", "scan9", "scan10"]
    for name in NAMES:
        ours, truth = (read_scan(folder, name) for folder in folders)
        expected = score_labels(ours["labels"], truth["labels"])
        assert found["scans"][name]["labels"] == expected._asdict()
        if name == "scan9":
            assert "normals" not in found["scans"][name]
        else:
            errors = score_normals(ours["normals"], truth["normals"])
            assert found["scans"][name]["normals"]["msae"] == errors.msae


def test_mean_is_over_the_scans_that_have_the_part(folders, capsys):
    run_score(*folders, "--json")
    found = json.loads(capsys.readouterr().out)
    scans, mean = found["scans"], found["mean"]
    assert (mean["labels"]["scans"], mean["normals"]["scans"]) == (3, 2)
    for part, index in (("labels", "f1"), ("labels", "regions"), ("normals", "rms")):
        values = [scores[part][index] for scores in scans.values() if part in scores]
        assert mean[part][index] == pytest.approx(sum(values) / len(values), rel=1e-12)


def test_the_mean_is_printed_with_what_a_scan_leaves_undefined(folders, capsys):
    assert run_score(*folders) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:3] == ["mean of 3 scans", "labels", "  scans                 3"]
    assert "normals" in lines


@pytest.mark.parametrize("side", [0, 1])
def test_missing_counterparts_are_named(folders, capsys, side):
    for name in ("scan9.npz", "hall/scan1.npz"):
        (folders[side] / name).unlink()
    assert run_score(*folders) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert line.startswith(f"torchrg: {folders[side]}: expected a counterpart of every scan")
    assert line.endswith("got none of hall/scan1, scan9.\n")


def test_many_missing_counterparts_are_counted(folders, capsys):
    for number in range(100, 109):
        (folders[0] / f"scan{number}.npz").touch()
    assert run_score(*folders) == 2
    assert "scan100, scan101, scan102, scan103, scan104 and 4 more." in capsys.readouterr().err


def test_mistakes_are_one_line(folders, tmp_path, capsys):
    ours, truth = folders
    (tmp_path / "empty").mkdir()
    (ours / "notes.md").write_text("not a scan")
    (ours / ".hidden.npz").write_text("not a scan")
    assert run_score(ours, truth) == 0
    (truth / "scan9.pcd").touch()
    cases = {
        (ours, tmp_path / "empty"): "empty: expected files that end in one of",
        (ours, truth / "scan9.npz"): "scan9.npz: expected a folder",
        (truth / "scan9.npz", ours): "scan9.npz: expected a folder",
        (ours, truth): "got scan9.npz and scan9.pcd",
    }
    capsys.readouterr()
    for arguments, message in cases.items():
        assert run_score(*arguments) == 2
        captured = capsys.readouterr()
        assert message in captured.err
        assert (captured.err.count("\n"), captured.out) == (1, "")
