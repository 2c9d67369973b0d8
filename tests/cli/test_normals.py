"""``torchrg normals``: what it writes, its settings, and one line for every mistake."""

import functools
import json
import sys

import numpy as np
import pytest
from tqdm import tqdm

from torchrg.cli import loop
from torchrg.io import read_cloud
from torchrg.normals import estimate_normals


@pytest.fixture(scope="module")
def room_file(folder_of_clouds):
    return folder_of_clouds("room.npz", num_points=3000) / "room.npz"


@pytest.fixture
def normals(run):
    """``normals(...)``: the command."""
    return functools.partial(run, "normals")


def test_stages_are_shown_on_a_terminal_alone(room_file, tmp_path, monkeypatch, normals):
    shown = []

    class Bar(tqdm):
        def set_postfix_str(self, stage, **_):
            shown.append((stage, bool(self.disable)))

    monkeypatch.setattr(loop, "tqdm", Bar)
    flags = ("--method", "pca", "--orient", "consistent")
    for is_terminal in (True, False):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_terminal=is_terminal: is_terminal)
        assert normals(room_file, "--out", tmp_path / "normals.npz", *flags).code == 0
    expected = [(stage, off) for off in (False, True) for stage in ("normals", "orientation")]
    assert shown == expected


def test_result_holds_what_the_contract_says(room_file, tmp_path, normals):
    out = tmp_path / "normals.npz"
    done = normals(
        room_file, "--out", out, "--method", "paper", "--normals.k", 20, "--orient", "none"
    )
    assert "3,000 points" in done.out
    fit = estimate_normals(read_cloud(room_file).points, method="paper", k=20)
    with np.load(out, allow_pickle=False) as result, np.load(room_file) as source:
        names = {"points", "normals", "curvature", "sharp", "valid", "provenance"}
        assert set(result.files) == names
        assert np.array_equal(result["points"], source["points"])
        for name in ("normals", "curvature", "sharp", "valid"):
            assert np.array_equal(result[name], getattr(fit, name).numpy()), name
        provenance = json.loads(str(result["provenance"]))
    assert provenance["config"]["method"] == "paper"
    assert provenance["config"]["k"] == 20


def test_methods_of_one_stage_have_no_sharp_points(room_file, tmp_path, normals):
    out = tmp_path / "normals.npz"
    normals(room_file, "--out", out, "--method", "pca")
    with np.load(out) as result:
        assert result["sharp"].dtype == bool
        assert not result["sharp"].any()


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz", ".las"])
def test_other_formats_keep_the_fields_of_the_cloud(room_file, tmp_path, suffix, normals):
    out = tmp_path / f"normals{suffix}"
    assert normals(room_file, "--out", out, "--method", "pca").code == 0
    cloud = read_cloud(out)
    assert {"labels", "normals", "curvature"} <= set(cloud.fields)
    assert len(cloud) == 3000


def test_orientation_turns_the_normals(room_file, tmp_path, normals):
    out = tmp_path / "normals.npz"
    assert normals(room_file, "--out", out, "--method", "pca", "--orient", "+z").code == 0
    assert (np.load(out)["normals"][:, 2] >= 0).all()
    assert normals(room_file, "--out", out, "--method", "pca", "--orient", "interior").code == 0
    with np.load(out) as result, np.load(room_file) as truth:
        agreement = (result["normals"] * truth["normals"]).sum(axis=1)
    assert (agreement > 0)[np.abs(agreement) > 0.7].mean() > 0.9


def test_viewpoint_is_in_the_coordinates_of_the_input(room_file, tmp_path, normals):
    far = np.array([500_000.0, 4_000_000.0, 100.0])
    place = far + np.array([2.0, 2.0, 1.5])
    moved, out = tmp_path / "moved.npz", tmp_path / "normals.npz"
    np.savez(moved, points=np.load(room_file)["points"] + far)
    viewpoint = ["--orient", "viewpoint", "--viewpoint", *place]
    assert normals(moved, "--out", out, "--method", "pca", *viewpoint).code == 0
    with np.load(out) as result:
        towards = ((place - result["points"]) * result["normals"]).sum(axis=1)
    assert (towards > -1e-3).all()


def test_bad_points_stay_in_place(tmp_path, normals):
    points = np.random.default_rng(0).random((60, 3))
    points[:, 2] = 0
    points[7] = np.nan
    np.save(tmp_path / "points.npy", points)
    out = tmp_path / "normals.npz"
    done = normals(tmp_path / "points.npy", "--out", out, "--method", "pca")
    assert "1 of 60 points are not finite or beyond 1e+12; they have no normal" in done.err
    assert done.err.count("\n") == 1
    with np.load(out) as result:
        assert result["valid"].sum() == 59
        assert not result["valid"][7]
        assert not result["normals"][7].any()
        assert np.array_equal(result["points"], points, equal_nan=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "best"], "expected --method to be one of pca, jet"),
        (["--normals.k", "2"], "expected --normals.k >= 3, got 2"),
        (["--orient", "viewpoint"], "got none; pass the viewpoint (--viewpoint X Y Z), or use"),
        (["--viewpoint", "0", "0", "0"], "--viewpoint with --orient viewpoint"),
        (["--threads", "0"], "expected --threads from 1 to 1,024, got 0"),
        (["--chunk-size", "0"], "expected --chunk-size >= 1, got 0"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_two(room_file, tmp_path, normals, arguments, message):
    assert message in normals(room_file, "--out", tmp_path / "x.npz", *arguments).error
    assert not (tmp_path / "x.npz").exists()
