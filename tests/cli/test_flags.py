"""Flags of settings, names of columns and cameras."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.test_cli import CLASSIC, config_of
from tests.cli.test_depth import INTRINSICS
from torchrg.cli import segment
from torchrg.cli.arguments import parse
from torchrg.cli.flags import (
    describe_sampling,
    parse_intrinsics,
    reason_for_no_plane,
    split_columns,
)
from torchrg.config import SelectionConfig
from torchrg.depth.camera import Pinhole
from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.structures import Cloud
from torchrg.structures.points import Sampling


def test_flags_win_over_the_file_and_the_file_over_the_defaults(room_file, tmp_path, run):
    config, out = tmp_path / "my.yaml", tmp_path / "seg.npz"
    config.write_text(
        "normals: {method: pca, k: 30}\ngrowing: {min_size: 77, merge_tolerance: 1.5}\n"
    )
    flags = ("--growing.min-size", "10", "--growing.max-angle-deg=7")
    assert run("segment", room_file, "--out", out, "--config", config, *flags).code == 0
    normals, growing = config_of(out)["normals"], config_of(out)["growing"]
    assert (normals["k"], normals["method"]) == (30, "pca")
    assert (growing["min_size"], growing["max_angle_deg"]) == (10, 7.0)
    # A setting that has no flag.
    assert growing["merge_tolerance"] == 1.5


@pytest.mark.parametrize(
    ("flags", "angles"),
    [
        (["--angle-deg", "8"], (8.0, 8.0)),
        (["--angle_deg=8", "--growing.max-angle-deg", "3"], (8.0, 3.0)),
        (["--normals.sharp-angle-deg", "2"], (2.0, 5.0)),
    ],
)
def test_one_flag_moves_both_angles(room_file, tmp_path, run, flags, angles):
    out = tmp_path / "seg.npz"
    assert run("segment", room_file, "--out", out, "--preset", "paper", *flags).code == 0
    used = config_of(out)
    assert (used["normals"]["sharp_angle_deg"], used["growing"]["max_angle_deg"]) == angles


@pytest.fixture
def leica(room_file, tmp_path):
    """Points, intensity, color and no names, and what the colors are."""
    cloud = read_cloud(room_file)
    values = np.random.default_rng(0).integers(0, 256, (len(cloud), 4))
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "leica.txt"
    np.savetxt(path, np.hstack([cloud.coordinates, values]), fmt="%.9g")
    return path, values


NAMES = ("--columns", "x,y,z,intensity,r,g,b")


def test_columns_are_named_by_a_rule_that_is_shown_or_by_a_flag(leica, tmp_path, run):
    path, values = leica
    taken = "its columns have no names and are taken as x y z column_4 column_5 column_6 column_7"
    note = f"note        {taken}; if they are others, name them with --columns"
    assert note in run("info", path).out
    shown = run("info", path, *NAMES).out
    assert "note" not in shown
    assert "color       3 uint8" in shown
    out = tmp_path / "out.ply"
    for command in (("segment", *CLASSIC), ("normals", "--method", "pca")):
        assert taken in run(*command, path, "--out", out).err
        assert "color" not in read_cloud(out).fields
        assert run(*command, path, "--out", out, *NAMES).err == ""
        fields = read_cloud(out).fields
        np.testing.assert_array_equal(fields["color"], values[:, 1:])
        np.testing.assert_array_equal(fields["intensity"], values[:, 0])


def test_names_of_columns_count_for_each_file_without_its_own(tmp_path, run):
    rng = np.random.default_rng(0)
    flat = np.hstack([rng.random((2_000, 2)), np.zeros((2_000, 1))])
    np.save(tmp_path / "a.npy", np.hstack([flat, rng.random((2_000, 1))]))
    write_cloud(tmp_path / "b.ply", Cloud(flat[:100] + np.eye(3)[2], {"d": flat[:100, 0]}))
    inputs, out = (tmp_path / "a.npy", tmp_path / "b.ply"), tmp_path / "r.npz"
    shown = run("segment", *inputs, "--merge", *CLASSIC, "--out", out, "--columns", "x,y,z,d")
    assert "(without the input fields d)" in shown.out
    assert shown.err == ""
    with np.load(out) as result:
        np.testing.assert_array_equal(result["points"][:2_000], flat)
        assert (result["labels"][:2_000] == 0).mean() > 0.9
        assert json.loads(str(result["provenance"]))["columns"] == "x,y,z,d"


def test_commands_that_read_truth_or_draw_take_names_too(leica, tmp_path, run):
    path, _ = leica
    assert "f1" in run("score", path, path, "--columns", "x,y,z,label,_,_,_").out
    assert "has neither labels nor normals in common" in run("score", path, path).err
    picture = ("--out", tmp_path / "a.png", "--width", "99")
    assert run("view", path, *picture, *NAMES, "--color", "color").code == 0
    convert = ("convert", "folder", path.parent, tmp_path / "out", *CLASSIC, "--workers", "1")
    note = "leica: its columns have no names and are taken as x y z column_4"
    assert note in run(*convert).out
    assert not (tmp_path / "out" / "leica" / "color.npy").exists()
    # Other names are other results.
    assert "options changed" in run(*convert, *NAMES, "--dry-run").out


def test_names_for_files_that_have_their_own_are_wrong_use(room_file, tmp_path, run):
    for command in (
        ("info", room_file),
        ("segment", room_file, "--out", tmp_path / "a.ply"),
        ("normals", room_file, "--out", tmp_path / "a.ply"),
        ("convert", "folder", room_file.parent, tmp_path / "out"),
    ):
        error = run(*command, "--columns", "x,y,z").error
        assert "expected text or .npy input for --columns, got files that" in error


def test_a_matrix_of_numpy_is_a_camera(tmp_path):
    for array in (INTRINSICS.numpy(), INTRINSICS.numpy().ravel(), np.array([50, 50, 39.5, 29.5])):
        np.save(tmp_path / "K.npy", array)
        assert parse_intrinsics(f"{tmp_path / 'K.npy'}") == Pinhole(50.0, 50.0, 39.5, 29.5)
    for array, message in (
        (np.zeros((60, 80)), r"a matrix of .*, got 4,800 numbers; pass --intrinsics fx,fy,cx,cy"),
        (np.array(["a"]), "an array of numbers, got: <U1"),
        (np.zeros(9, complex), "an array of numbers, got: complex128"),
        (np.ones(4, bool), "an array of numbers, got: bool"),
    ):
        np.save(tmp_path / "K.npy", array)
        with pytest.raises(FormatError, match=rf"K\.npy: expected {message}"):
            parse_intrinsics(f"{tmp_path / 'K.npy'}")


def test_describe_sampling_by_example():
    assert (
        describe_sampling(Sampling(0.06, 0.5, 0.6, 4000.0, 2.7), {"growing.min_size": 173})
        == "faces in facets or bent (whiteness 0.06): min_size 173"
    )


def test_reason_for_no_plane_by_example():
    assert (
        reason_for_no_plane(SelectionConfig(min_area=9.0))
        == "no plane passes --min-area and --kinds"
    )


def test_split_columns_by_example():
    assert split_columns("x, y,z,_") == ("x", "y", "z", "_")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("segment a.ply --out b.npz --nb-neighbors 30", "Did you mean --normals.k?"),
        ("segment a.ply --out b.npz --unit m", "--unit: lengths are in the unit of the cloud"),
        ("segment a.ply --out b.npz --crs 25832", "--crs: coordinates keep their reference system"),
        ("sample a.ply -n 5000", "option -n. Did you mean --num-points?"),
    ],
)
def test_words_of_other_programs_have_advice(words, message, run):
    assert message in run(*words.split()).error


@pytest.mark.parametrize("kinds", [("wall,floor",), ("wall", "floor"), ("wall", "--kinds=floor")])
def test_kinds_are_separated_by_commas_or_spaces(kinds):
    words = ["a.ply", "--out", "b.npz", "--kinds", *kinds]
    parsed = parse(segment.Arguments, words, prog="torchrg segment")
    assert parsed.settings.kinds == ("wall", "floor")
    assert parsed.inputs == (Path("a.ply"),)
