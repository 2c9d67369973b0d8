"""``torchrg normals``: what it writes, its settings, and one line for every mistake."""

import json
import sys

import numpy as np
import pytest
from tqdm import tqdm

from torchrg.cli import loop, main
from torchrg.io import read_cloud
from torchrg.normals import estimate_normals


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    path = tmp_path_factory.mktemp("normals") / "room.npz"
    assert main(["sample", str(path), "--num-points", "3000"]) == 0
    return path


def run(*arguments):
    return main(["normals", *map(str, arguments)])


def error_line(capsys):
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


def test_stages_are_shown_on_a_terminal_and_not_in_a_pipe(room, tmp_path, monkeypatch, capsys):
    shown = []

    class Bar(tqdm):
        def set_postfix_str(self, stage, **_):
            shown.append((stage, bool(self.disable)))

    monkeypatch.setattr(loop, "tqdm", Bar)
    flags = ("--method", "pca", "--orient", "consistent")
    for is_terminal in (True, False):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_terminal=is_terminal: is_terminal)
        assert run(room, "--out", tmp_path / "normals.npz", *flags) == 0
    expected = [(stage, off) for off in (False, True) for stage in ("normals", "orientation")]
    assert shown == expected


def test_result_holds_what_the_contract_says(room, tmp_path, capsys):
    out = tmp_path / "normals.npz"
    assert run(room, "--out", out, "--method", "paper", "--normals.k", 20) == 0
    assert "3,000 points" in capsys.readouterr().out
    fit = estimate_normals(read_cloud(room).points, method="paper", k=20)
    with np.load(out, allow_pickle=False) as result, np.load(room) as source:
        names = {"points", "normals", "curvature", "sharp", "valid", "provenance"}
        assert set(result.files) == names
        assert np.array_equal(result["points"], source["points"])
        for name in ("normals", "curvature", "sharp", "valid"):
            assert np.array_equal(result[name], getattr(fit, name).numpy()), name
        provenance = json.loads(str(result["provenance"]))
    assert provenance["config"]["method"] == "paper"
    assert provenance["config"]["k"] == 20


def test_methods_of_one_stage_have_no_sharp_points(room, tmp_path):
    out = tmp_path / "normals.npz"
    run(room, "--out", out, "--method", "pca")
    with np.load(out) as result:
        assert result["sharp"].dtype == bool
        assert not result["sharp"].any()


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz", ".las"])
def test_other_formats_keep_the_fields_of_the_cloud(room, tmp_path, suffix):
    out = tmp_path / f"normals{suffix}"
    assert run(room, "--out", out, "--method", "pca") == 0
    cloud = read_cloud(out)
    assert {"labels", "normals", "curvature"} <= set(cloud.fields)
    assert len(cloud) == 3000


def test_orientation_turns_the_normals(room, tmp_path):
    out = tmp_path / "normals.npz"
    assert run(room, "--out", out, "--method", "pca", "--orient", "+z") == 0
    assert (np.load(out)["normals"][:, 2] >= 0).all()
    assert run(room, "--out", out, "--method", "pca", "--orient", "interior") == 0
    with np.load(out) as result, np.load(room) as truth:
        agreement = (result["normals"] * truth["normals"]).sum(axis=1)
    assert (agreement > 0)[np.abs(agreement) > 0.7].mean() > 0.9


def test_viewpoint_is_in_the_coordinates_of_the_input(room, tmp_path):
    far = np.array([500_000.0, 4_000_000.0, 100.0])
    place = far + np.array([2.0, 2.0, 1.5])
    moved, out = tmp_path / "moved.npz", tmp_path / "normals.npz"
    np.savez(moved, points=np.load(room)["points"] + far)
    viewpoint = ["--orient", "viewpoint", "--viewpoint", *place]
    assert run(moved, "--out", out, "--method", "pca", *viewpoint) == 0
    with np.load(out) as result:
        towards = ((place - result["points"]) * result["normals"]).sum(axis=1)
    assert (towards > -1e-3).all()


def test_several_inputs_go_into_a_directory(room, tmp_path, capsys):
    bad = tmp_path / "bad.npz"
    np.savez(bad, other=np.zeros(3))
    assert run(room, bad, "--out", tmp_path / "out", "--method", "pca") == 3
    assert "1 of 2 inputs failed" in capsys.readouterr().err
    assert (tmp_path / "out" / "room.npz").exists()


def test_bad_points_stay_in_place(tmp_path, capsys):
    points = np.random.default_rng(0).random((60, 3))
    points[:, 2] = 0
    points[7] = np.nan
    np.save(tmp_path / "points.npy", points)
    out = tmp_path / "normals.npz"
    assert run(tmp_path / "points.npy", "--out", out, "--method", "pca") == 0
    assert "1 of 60 points have no normal" in error_line(capsys)
    with np.load(out) as result:
        assert result["valid"].sum() == 59
        assert not result["valid"][7]
        assert not result["normals"][7].any()
        assert np.array_equal(result["points"], points, equal_nan=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--method", "best"],
            "consensus, got 'best'",
        ),
        (["--normals.k", "2"], "expected k >= 3, got 2"),
        (
            ["--orient", "viewpoint"],
            "by viewpoint, got none; pass --viewpoint X Y Z, or --orient interior",
        ),
        (["--viewpoint", "0", "0", "0"], "--viewpoint X Y Z together with --orient viewpoint"),
        (["--threads", "0"], "expected --threads from 1 to 1,024, got 0"),
        (["--chunk-size", "0"], "expected --chunk-size >= 1, got 0"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_two(room, tmp_path, capsys, arguments, message):
    assert run(room, "--out", tmp_path / "x.npz", *arguments) == 2
    assert message in error_line(capsys)
    assert not (tmp_path / "x.npz").exists()


def test_a_cloud_without_finite_points_is_refused(tmp_path, capsys):
    np.save(tmp_path / "points.npy", np.full((5, 3), np.nan))
    assert run(tmp_path / "points.npy", "--out", tmp_path / "x.npz") == 2
    assert "expected finite points" in error_line(capsys)
