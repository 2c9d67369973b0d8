"""The command line: the main job, and one line for every mistake."""

import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from torchrg import kernels
from torchrg.cli import COMMANDS, main
from torchrg.io import read_cloud, write_cloud
from torchrg.structures import Cloud

CLASSIC = ("--preset", "classic")


@pytest.fixture(scope="module")
def room_file(folder_of_clouds):
    return folder_of_clouds("room.npz", num_points=6000) / "room.npz"


@pytest.fixture(scope="module")
def result(room_file):
    path = room_file.with_name("seg.npz")
    assert main(["segment", str(room_file), "--out", str(path), *CLASSIC]) == 0
    return path


def config_of(path):
    with np.load(path) as result:
        return json.loads(str(result["provenance"]))["config"]


def test_score_of_a_result_has_the_keys_of_the_contract(room_file, result, run):
    scores = json.loads(run("score", result, room_file, "--json").out)
    external = {"precision", "recall", "f1", "pairs", "regions", "faces", "mean_best_iou", "ari"}
    assert external | {"precision_iou50", "recall_iou50"} <= set(scores["labels"])
    assert {"msae", "rms"} <= set(scores["normals"])


def test_result_holds_what_the_contract_says(room_file, result):
    with np.load(result, allow_pickle=False) as found, np.load(room_file) as source:
        expected = {"points", "labels", "normals", "curvature", "sharp", "valid", "provenance"}
        expected |= {f"plane_{name}" for name in ("normal", "offset", "centroid", "area", "count")}
        assert expected | {"plane_rms"} <= set(found.files)
        assert np.array_equal(found["points"], source["points"])
        provenance = json.loads(str(found["provenance"]))
        assert found["labels"].max() == len(found["plane_count"]) - 1
        on_plane = np.einsum("ij,ij->i", found["plane_normal"], found["plane_centroid"])
        assert (np.abs(on_plane - found["plane_offset"]) <= 2 * found["plane_rms"]).all()
    assert provenance["config"]["normals"]["method"] == "pca"
    assert set(provenance["versions"]) >= {"torchrg", "torch"}


def test_equal_runs_write_equal_bytes_and_say_how_many_points(room_file, result, tmp_path, run):
    again = tmp_path / "b.npz"
    assert "6,000 points" in run("segment", room_file, "--out", again, *CLASSIC).out
    assert again.read_bytes() == result.read_bytes()


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


@pytest.mark.parametrize("command", [("segment", *CLASSIC), ("normals", "--method", "pca")])
def test_several_inputs_go_to_a_directory_and_a_bad_one_stops_no_other(
    room_file, tmp_path, run, command
):
    bad, out = tmp_path / "bad.pcd", tmp_path / "out"
    bad.write_bytes(b"not a cloud")
    done = run(*command, bad, room_file, "--out", out)
    assert done.code == 3
    assert "1 of 2 inputs failed" in done.err
    assert sorted(path.name for path in out.iterdir()) == ["room.npz"]


@pytest.fixture
def mistakes(tmp_path, monkeypatch):
    """The folder of work: files that cannot be read, by name."""
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    header += "WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    for name, fields, promised, held in (
        ("short.pcd", "x y z", 100, 7),
        ("huge.pcd", "x y z", 10**12, 7),
        ("fields.pcd", "a b c", 7, 7),
        ("empty.pcd", "x y z", 0, 0),
    ):
        text = header.format(fields=fields, n=promised).encode()
        (tmp_path / name).write_bytes(text + bytes(12 * held))
    ply = "ply\nformat binary_little_endian 1.0\nelement vertex 100\n"
    ply += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "short.ply").write_bytes(ply.encode() + bytes(50))
    np.savez(tmp_path / "pickled.npz", points=np.array([{"a": 1}], dtype=object))
    np.save(tmp_path / "nan.npy", np.full((100, 3), np.nan, dtype=np.float32))
    (tmp_path / "wrong.yaml").write_text("growing: {max_angle: 3}\n")
    (tmp_path / "short.xlsx").write_text("x")
    (tmp_path / "folder.pcd").mkdir()
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("mistakes")
@pytest.mark.parametrize(
    ("file", "flags", "message"),
    [
        ("none.pcd", [], "none.pcd"),
        ("folder.pcd", [], "directory"),
        ("short.xlsx", [], "ends in one of"),
        ("short.pcd", [], "short.pcd"),
        ("short.ply", [], "short.ply"),
        ("huge.pcd", [], "huge.pcd"),
        ("fields.pcd", [], "x, y"),
        ("empty.pcd", [], "expected at least one point"),
        ("pickled.npz", [], "pickle"),
        ("nan.npy", [], "finite"),
        ("ROOM", ["--preset", "clasic"], "classic, classic_increment"),
        ("ROOM", ["--angle-deg", "91"], "expected angle_deg in [0, 90], got 91.0"),
        ("ROOM", ["--angle-deg", "five"], "--angle-deg"),
        ("ROOM", ["--config", "wrong.yaml"], "unknown setting 'max_angle'"),
        ("ROOM", ["--config", "none.yaml"], "No such file"),
        ("ROOM", ["--normals.k", "2"], "expected k >= 3, got 2"),
        ("ROOM", ["--normals.k", "many"], "--normals.k"),
        ("ROOM", ["--no-such-flag"], "no-such-flag"),
        ("ROOM", ["--growing.merge-tolerance", "2"], "unrecognized option --growing.merge-tol"),
        ("ROOM", ["--threads", "0"], "--threads from 1 to 1,024"),
        ("ROOM", ["--voxel", "nan"], "--voxel > 0"),
        ("ROOM", ["--out", "seg.docx"], "ends in one of"),
        ("ROOM", ["--out", "no/such/seg.npz"], "not found; create it first"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(room_file, run, file, flags, message):
    done = run("segment", room_file if file == "ROOM" else file, "--out", "seg.npz", *flags)
    assert done.code == 2
    assert message in done.error
    assert "Traceback" not in done.error
    assert not os.path.lexists("seg.npz")


@pytest.mark.usefixtures("mistakes")
def test_a_folder_is_a_place_whatever_its_name(room_file, run):
    assert run("segment", room_file, "--out", "folder.pcd/x.npz", *CLASSIC).code == 0


@pytest.mark.parametrize("command", [["segment"], ["segment", "--merge"], ["normals"]])
def test_no_result_takes_the_place_of_an_input(room_file, tmp_path, monkeypatch, run, command):
    monkeypatch.chdir(tmp_path)
    Path("other").mkdir()
    for folder in (".", "other"):
        shutil.copy(room_file, Path(folder, "room é.npz"))
    before = Path("room é.npz").read_bytes()
    # A second name of the same file is no other place.
    Path("linked.npz").hardlink_to("room é.npz")
    several = ["other/room é.npz"] if "--merge" in command else []
    for out in ("room é.npz", ".", "linked.npz"):
        done = run(*command, *several, "room é.npz", "--out", out)
        assert done.code == 2
        assert "would overwrite an input or another result" in done.error
    assert Path("room é.npz").read_bytes() == before


@pytest.mark.parametrize("command", [*([name] for name in COMMANDS), ["convert", "folder"]])
def test_a_command_without_arguments_is_wrong_use(command, capsys):
    try:
        code = main(command)
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    shown = capsys.readouterr()
    assert "missing required" in shown.err or shown.out.startswith("usage: torchrg convert")


def run_into(output, *arguments):
    """Run a command, its output into a file that is open, as from a shell."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-m", "torchrg", *map(str, arguments)]
    return subprocess.run(
        command, stdout=output, stderr=subprocess.PIPE, text=True, env=environment, check=False
    )


def test_a_reader_that_goes_away_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as output:
        done = run_into(output, "--help")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_output_that_cannot_be_written_is_one_line(room_file):
    with Path("/dev/full").open("w") as output:
        done = run_into(output, "info", room_file)
    assert (done.returncode, done.stderr) == (2, "torchrg: info: No space left on device.\n")


def test_every_command_is_named_by_help_and_to_those_who_misspell_one(run):
    wrong = run("segmnet")
    assert "got 'segmnet'. Did you mean segment?" in wrong.error
    assert all(name in wrong.error and name in run("--help").out for name in COMMANDS)


def test_info_says_what_a_file_holds_and_where_it_is(room_file, tmp_path, run):
    shown = run("info", room_file).out
    assert "6,000 of float32" in shown
    assert "labels" in shown
    surfaces = next(line[12:] for line in shown.splitlines() if line.startswith("surfaces"))
    assert surfaces in run("segment", room_file, "--out", tmp_path / "a.npz").out
    far = np.array([[500000.125, 4000000.25, 1], [500001.375, 4000000.5, 2]])
    np.save(tmp_path / "far.npy", far)
    shown = run("info", tmp_path / "far.npy").out
    assert "lowest      500000.125 4000000.25 1" in shown
    assert "extent      1.25 0.25 1" in shown


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


@pytest.mark.filterwarnings("default")
def test_a_run_without_kernels_says_once_and_in_one_line_how_to_get_them(
    room_file, tmp_path, run, monkeypatch
):
    monkeypatch.delenv("TORCHRG_NO_KERNELS", raising=False)
    monkeypatch.setattr(kernels, "_kind", lambda: "of-no-processor")
    for command in (("info",), ("segment", "--out", tmp_path / "seg.npz")):
        monkeypatch.setattr(kernels, "_library", cache(kernels._library.__wrapped__))
        code, _, err = run(command[0], room_file, *command[1:])
        (line,) = (line for line in err.splitlines() if "kernels" in line)
        assert line.startswith("torchrg: warning: torchrg runs without its kernels")
        assert line.endswith("or set TORCHRG_KERNELS (see the guide Install).")
        assert (code, "_library()" in err) == (0, False)


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
        assert "expected text or .npy input for --columns, got files with" in error


def test_what_gives_way_to_a_result_is_told(room_file, tmp_path, run):
    out = tmp_path / "a.ply"
    names = "label as label_input, normals as normals_input"
    done = run("segment", room_file, *CLASSIC, "--out", out)
    assert f"input fields are kept next to the result: {names}" in done.err
    expected, fields = read_cloud(room_file).fields, read_cloud(out).fields
    np.testing.assert_array_equal(fields["label_input"], expected["labels"])
    np.testing.assert_array_equal(fields["normals_input"], expected["normals"])
    # Archives hold the result alone, which the line about it says.
    shown = run("segment", room_file, *CLASSIC, "--out", tmp_path / "a.npz")
    assert shown.err == ""
    assert shown.out.endswith("a.npz (without the input fields labels, normals)\n")


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
    reported = "4 of 6,000 points are not finite or beyond 1e+12; they stay unlabeled"
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


def test_single_points_far_off_that_cost_precision_are_told(room_file, tmp_path, run):
    far = read_cloud(room_file).coordinates.astype(np.float64) + np.array([5e5, 5.4e6, 300])
    far[5] = 0
    np.save(tmp_path / "zero.npy", far)
    done = run("segment", tmp_path / "zero.npy", "--out", tmp_path / "a.npz", *CLASSIC)
    first, second = done.err.splitlines()
    assert "zero.npy: half of the points lie within " in first
    assert "no plane found" in second
