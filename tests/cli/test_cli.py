"""The command line: the main job, and one line for every mistake."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torchrg.cli import COMMANDS, main
from torchrg.io import read_cloud, write_cloud
from torchrg.structures import Cloud


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    path = tmp_path_factory.mktemp("room") / "room.npz"
    assert main(["sample", str(path), "--num-points", "6000", "--seed", "2"]) == 0
    return path


def error_line(capsys):
    """Return the single line that a command wrote on stderr."""
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


@pytest.fixture(scope="module")
def result(room):
    path = room.with_name("seg.npz")
    assert main(["segment", str(room), "--out", str(path), "--preset", "classic"]) == 0
    return path


def test_score_of_a_result_has_the_keys_of_the_contract(room, result, capsys):
    assert main(["score", str(result), str(room), "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    external = {"precision", "recall", "f1", "pairs", "regions", "faces", "mean_best_iou", "ari"}
    assert external | {"precision_iou50", "recall_iou50"} <= set(scores["labels"])
    assert {"msae", "rms"} <= set(scores["normals"])


def test_result_holds_what_the_contract_says(room, result):
    with np.load(result, allow_pickle=False) as found, np.load(room) as source:
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


def test_equal_runs_write_equal_bytes_and_say_how_many_points(room, result, tmp_path, capsys):
    again = tmp_path / "b.npz"
    assert main(["segment", str(room), "--out", str(again), "--preset", "classic"]) == 0
    assert again.read_bytes() == result.read_bytes()
    assert "6,000 points" in capsys.readouterr().out


def test_flags_win_over_the_file_and_the_file_over_the_defaults(room, tmp_path):
    config = tmp_path / "my.yaml"
    config.write_text("normals: {method: pca, k: 30}\ngrowing: {min_size: 77}\n")
    out = tmp_path / "seg.npz"
    command = ["segment", str(room), "--out", str(out), "--config", str(config)]
    assert main([*command, "--growing.min-size", "10", "--growing.max-angle-deg=7"]) == 0
    with np.load(out) as result:
        used = json.loads(str(result["provenance"]))["config"]
    assert (used["normals"]["k"], used["normals"]["method"]) == (30, "pca")
    assert (used["growing"]["min_size"], used["growing"]["max_angle_deg"]) == (10, 7.0)


@pytest.mark.parametrize(
    ("flags", "angles"),
    [
        (["--angle-deg", "8"], (8.0, 8.0)),
        (["--angle_deg=8", "--growing.max-angle-deg", "3"], (8.0, 3.0)),
        (["--normals.sharp-angle-deg", "2"], (2.0, 5.0)),
    ],
)
def test_one_flag_moves_both_angles(room, tmp_path, flags, angles):
    out = tmp_path / "seg.npz"
    assert main(["segment", str(room), "--out", str(out), "--preset", "paper", *flags]) == 0
    with np.load(out) as result:
        used = json.loads(str(result["provenance"]))["config"]
    assert (used["normals"]["sharp_angle_deg"], used["growing"]["max_angle_deg"]) == angles


def test_several_inputs_go_to_a_directory_and_a_bad_one_stops_no_other(room, tmp_path, capsys):
    bad = tmp_path / "bad.pcd"
    bad.write_bytes(b"not a cloud")
    out = tmp_path / "out"
    command = ["segment", str(bad), str(room), "--out", str(out), "--preset", "classic"]
    assert main(command) == 3
    assert sorted(path.name for path in out.iterdir()) == ["room.npz"]
    assert "1 of 2 inputs failed" in capsys.readouterr().err


def test_points_that_are_not_finite_are_counted(room, tmp_path, capsys):
    points = read_cloud(room).coordinates.copy()
    points[[3, 9]] = np.nan
    np.savez(tmp_path / "holes.npz", points=points)
    command = ["segment", str(tmp_path / "holes.npz"), "--out", str(tmp_path / "seg.npz")]
    assert main([*command, "--preset", "classic"]) == 0
    assert "2 of 6,000 points are not finite" in error_line(capsys)
    with np.load(tmp_path / "seg.npz") as result:
        assert np.array_equal(result["points"], points, equal_nan=True)
        assert result["labels"][[3, 9]].tolist() == [-1, -1]


def test_equal_points_give_no_region_and_a_warning(tmp_path, capsys):
    np.save(tmp_path / "one.npy", np.ones((300, 3), dtype=np.float32))
    command = ["segment", str(tmp_path / "one.npy"), "--out", str(tmp_path / "seg.npz")]
    assert main(command) == 0
    assert "no plane found: all points are equal" in error_line(capsys)


@pytest.fixture
def mistakes(tmp_path, room):
    """Files that cannot be read, by name."""
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    header += "WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"

    def pcd(name, fields, promised, held):
        text = header.format(fields=fields, n=promised).encode()
        (tmp_path / name).write_bytes(text + bytes(12 * held))

    pcd("short.pcd", "x y z", 100, 7)
    pcd("huge.pcd", "x y z", 10**12, 7)
    pcd("fields.pcd", "a b c", 7, 7)
    pcd("empty.pcd", "x y z", 0, 0)
    ply = "ply\nformat binary_little_endian 1.0\nelement vertex 100\n"
    ply += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "short.ply").write_bytes(ply.encode() + bytes(50))
    np.savez(tmp_path / "pickled.npz", points=np.array([{"a": 1}], dtype=object))
    np.save(tmp_path / "nan.npy", np.full((100, 3), np.nan, dtype=np.float32))
    (tmp_path / "wrong.yaml").write_text("growing: {max_angle: 3}\n")
    (tmp_path / "short.xlsx").write_text("x")
    (tmp_path / "folder.pcd").mkdir()
    return tmp_path


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
        ("ROOM", ["--config", "wrong.yaml"], "unknown key 'max_angle'"),
        ("ROOM", ["--config", "none.yaml"], "No such file"),
        ("ROOM", ["--normals.k", "2"], "expected k >= 3, got 2"),
        ("ROOM", ["--normals.k", "many"], "--normals.k"),
        ("ROOM", ["--no-such-flag"], "no-such-flag"),
        ("ROOM", ["--threads", "0"], "--threads from 1 to 1,024"),
        ("ROOM", ["--voxel", "nan"], "--voxel > 0"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(
    mistakes, room, monkeypatch, capsys, file, flags, message
):
    monkeypatch.chdir(mistakes)
    source = str(room) if file == "ROOM" else file
    assert main(["segment", source, "--out", "seg.npz", *flags]) == 2
    line = error_line(capsys)
    assert message in line
    assert "Traceback" not in line
    assert not os.path.lexists("seg.npz")


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("seg.docx", "ends in one of"),
        ("no/such/seg.npz", "there is no folder"),
        ("folder.pcd/x.npz", None),
    ],
)
def test_the_output_is_checked_before_the_work(mistakes, room, monkeypatch, capsys, out, message):
    monkeypatch.chdir(mistakes)
    code = main(["segment", str(room), "--out", out, "--preset", "classic"])
    assert code == (2 if message else 0)
    if message:
        assert message in error_line(capsys)


@pytest.mark.parametrize("command", [["segment"], ["segment", "--merge"], ["normals"]])
def test_no_result_takes_the_place_of_an_input(room, tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    Path("other").mkdir()
    for folder in (".", "other"):
        shutil.copy(room, Path(folder, "room é.npz"))
    before = Path("room é.npz").read_bytes()
    for out in ("room é.npz", "."):
        several = ["other/room é.npz"] if "--merge" in command else []
        assert main([*command, *several, "room é.npz", "--out", out]) == 2
        assert "expected a place of its own for each result" in error_line(capsys)
    # A second name of the same file is no other place.
    Path("linked.npz").hardlink_to("room é.npz")
    assert main([*command, *several, "room é.npz", "--out", "linked.npz"]) == 2
    assert "expected a place of its own for each result" in error_line(capsys)
    assert Path("room é.npz").read_bytes() == before


@pytest.mark.parametrize("command", [*([name] for name in COMMANDS), ["convert", "folder"]])
def test_a_command_without_arguments_is_wrong_use(command, capsys):
    try:
        code = main(command)
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    shown = capsys.readouterr()
    assert "Missing from torchrg" in shown.err or shown.out.startswith("usage: torchrg convert")


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
def test_output_that_cannot_be_written_is_one_line(room):
    with Path("/dev/full").open("w") as output:
        done = run_into(output, "info", room)
    assert (done.returncode, done.stderr) == (2, "torchrg: info: No space left on device.\n")


def test_unknown_command_lists_the_known_ones(capsys):
    assert main(["segmnet"]) == 2
    line = error_line(capsys)
    assert "got 'segmnet'. Did you mean segment?" in line
    assert all(name in line for name in COMMANDS)


def test_help_names_every_command(capsys):
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)


def test_view_draws_a_picture(room, tmp_path, capsys):
    out = tmp_path / "room.png"
    assert main(["view", str(room), "--out", str(out), "--width", "200"]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    assert main(["view", str(room), "--out", str(out), "--color", "curvature"]) == 2
    assert "expected curvature for --color curvature" in error_line(capsys)
    assert main(["view", str(room), "--out", "room.jpg"]) == 2
    capsys.readouterr()
    assert main(["view", str(room), "--out", str(out), "--azimuth-deg", "nan"]) == 2
    assert "expected azimuth_deg to be finite, got nan" in error_line(capsys)


def test_view_shows_colours_of_sixteen_bits_as_those_of_eight(room, tmp_path):
    points = read_cloud(room).coordinates
    color = np.random.default_rng(0).integers(0, 256, points.shape, dtype=np.uint8)
    wide = color.astype(np.uint16) * 257
    wide[0, 0] += 1 if wide[0, 0] < 65535 else -1
    pictures = []
    for name, values in (("narrow", color), ("wide", wide)):
        np.savez(tmp_path / f"{name}.npz", points=points, color=values)
        assert read_cloud(tmp_path / f"{name}.npz").fields["color"].dtype == values.dtype
        picture = tmp_path / f"{name}.png"
        command = ["view", str(tmp_path / f"{name}.npz"), "--out", str(picture), "--width", "100"]
        assert main(command) == 0
        pictures.append(picture.read_bytes())
    assert pictures[0] == pictures[1]


def test_info_says_what_a_file_holds_and_where_it_is(room, tmp_path, capsys):
    assert main(["info", str(room)]) == 0
    shown = capsys.readouterr().out
    assert "6,000 of float32" in shown
    assert "labels" in shown
    np.save(
        tmp_path / "far.npy", np.array([[500000.125, 4000000.25, 1], [500001.375, 4000000.5, 2]])
    )
    assert main(["info", str(tmp_path / "far.npy")]) == 0
    shown = capsys.readouterr().out
    assert "lowest      500000.125 4000000.25 1" in shown
    assert "extent      1.25 0.25 1" in shown


@pytest.fixture
def leica(room, tmp_path):
    """Points, intensity, colour and no names, and what the colours are."""
    cloud = read_cloud(room)
    rng = np.random.default_rng(0)
    values = rng.integers(0, 256, (len(cloud), 4))
    path = tmp_path / "leica.txt"
    np.savetxt(path, np.hstack([cloud.coordinates, values]), fmt="%.9g")
    return path, values


NAMES = ["--columns", "x,y,z,intensity,r,g,b"]


def test_columns_are_named_by_a_rule_that_is_shown_or_by_a_flag(leica, tmp_path, capsys):
    path, values = leica
    taken = "its columns have no names and are taken as x y z column_4 column_5 column_6 column_7"
    assert main(["info", str(path)]) == 0
    assert f"note        {taken}; if they are others, name them with --columns" in (
        capsys.readouterr().out
    )
    assert main(["info", str(path), *NAMES]) == 0
    shown = capsys.readouterr().out
    assert "note" not in shown
    assert "color       3 uint8" in shown
    for command in (["segment", "--preset", "classic"], ["normals", "--method", "pca"]):
        out = tmp_path / "out.ply"
        assert main([*command, str(path), "--out", str(out)]) == 0
        assert taken in error_line(capsys)
        assert "color" not in read_cloud(out).fields
        assert main([*command, str(path), "--out", str(out), *NAMES]) == 0
        assert capsys.readouterr().err == ""
        found = read_cloud(out).fields
        np.testing.assert_array_equal(found["color"], values[:, 1:])
        np.testing.assert_array_equal(found["intensity"], values[:, 0])


def test_names_of_columns_count_for_each_file_without_its_own(tmp_path, capsys):
    rng = np.random.default_rng(0)
    flat = np.hstack([rng.random((2_000, 2)), np.zeros((2_000, 1))])
    np.save(tmp_path / "a.npy", np.hstack([flat, rng.random((2_000, 1))]))
    write_cloud(tmp_path / "b.ply", Cloud(flat[:100] + np.eye(3)[2], {"d": flat[:100, 0]}))
    inputs = [str(tmp_path / "a.npy"), str(tmp_path / "b.ply"), "--merge", "--preset", "classic"]
    out = ["--out", str(tmp_path / "r.npz")]
    assert main(["segment", *inputs, *out, "--columns", "x,y,z,d"]) == 0
    shown = capsys.readouterr()
    assert "(without its own d)" in shown.out
    assert shown.err == ""
    with np.load(tmp_path / "r.npz") as result:
        np.testing.assert_array_equal(result["points"][:2_000], flat)
        assert (result["labels"][:2_000] == 0).mean() > 0.9
        assert json.loads(str(result["provenance"]))["columns"] == "x,y,z,d"


def test_commands_that_read_truth_or_draw_take_names_too(leica, tmp_path, capsys):
    path, _ = leica
    assert main(["score", str(path), str(path), "--columns", "x,y,z,label,_,_,_"]) == 0
    assert "f1" in capsys.readouterr().out
    assert main(["score", str(path), str(path)]) == 2
    assert "shares neither labels nor normals" in capsys.readouterr().err
    view = ["view", str(path), "--out", str(tmp_path / "a.png"), "--width", "99", *NAMES]
    assert main([*view, "--color", "color"]) == 0
    (tmp_path / "in").mkdir()
    shutil.copy(path, tmp_path / "in")
    convert = ["convert", "folder", str(tmp_path / "in"), str(tmp_path / "out")]
    convert += ["--preset", "classic", "--workers", "1"]
    assert main(convert) == 0
    assert "leica: its columns have no names and are taken as x y z column_4" in (
        capsys.readouterr().out
    )
    assert not (tmp_path / "out" / "leica" / "color.npy").exists()
    # Other names are other results.
    assert main([*convert, *NAMES, "--dry-run"]) == 0
    assert "options changed" in capsys.readouterr().out


def test_names_for_files_that_have_their_own_are_wrong_use(room, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    shutil.copy(room, tmp_path / "in")
    for command in (
        ["info", str(room)],
        ["segment", str(room), "--out", str(tmp_path / "a.ply")],
        ["normals", str(room), "--out", str(tmp_path / "a.ply")],
        ["convert", "folder", str(tmp_path / "in"), str(tmp_path / "out")],
    ):
        assert main([*command, "--columns", "x,y,z"]) == 2
        assert "expected text or .npy for --columns, got files that name" in error_line(capsys)


def test_what_gives_way_to_a_result_is_told(room, tmp_path, capsys):
    out = tmp_path / "a.ply"
    command = ["--preset", "classic", "--out"]
    assert main(["segment", str(room), *command, str(out)]) == 0
    names = "label as label_input, normals as normals_input"
    assert f"its own fields are kept beside the result's: {names}" in error_line(capsys)
    expected, found = read_cloud(room).fields, read_cloud(out).fields
    np.testing.assert_array_equal(found["label_input"], expected["labels"])
    np.testing.assert_array_equal(found["normals_input"], expected["normals"])
    # Archives hold the result alone, which the line about it says.
    assert main(["segment", str(room), *command, str(tmp_path / "a.npz")]) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert shown.out.endswith("a.npz (without its own labels, normals)\n")


def test_codes_for_missing_points_are_no_points(room, tmp_path, capsys):
    far = read_cloud(room).coordinates.astype(np.float64) + np.array([5e5, 5.4e6, 300])
    np.save(tmp_path / "whole.npy", far)
    far[5], far[[9, 11], 2] = 1e30, (-3.4028235e38, 1e200)
    np.save(tmp_path / "codes.npy", far)
    labels = []
    for name in ("whole", "codes"):
        out = tmp_path / f"{name}.npz"
        command = ["segment", str(tmp_path / f"{name}.npy"), "--out", str(out)]
        assert main([*command, "--preset", "classic"]) == 0
        with np.load(out) as result:
            labels.append(result["labels"])
    told = "3 of 6,000 points are not finite or beyond 1e+12; they stay in place, unlabelled"
    assert told in error_line(capsys)
    assert labels[1][[5, 9, 11]].tolist() == [-1, -1, -1]
    assert (labels[1] != labels[0]).sum() < 60
    assert labels[1].max() == labels[0].max() >= 3
    np.save(tmp_path / "huge.npy", far * 1e20)
    assert main(["segment", str(tmp_path / "huge.npy"), "--out", str(tmp_path / "a.npz")]) == 2
    line = error_line(capsys)
    assert "huge.npy: expected finite points, got none in 6,000 points; those beyond 1e+12" in line


def test_single_points_far_off_that_cost_precision_are_told(room, tmp_path, capsys):
    far = read_cloud(room).coordinates.astype(np.float64) + np.array([5e5, 5.4e6, 300])
    far[5] = 0
    np.save(tmp_path / "zero.npy", far)
    command = ["segment", str(tmp_path / "zero.npy"), "--out", str(tmp_path / "a.npz")]
    assert main([*command, "--preset", "classic"]) == 0
    first, second = capsys.readouterr().err.splitlines()
    assert "zero.npy: half of its points lie within " in first
    assert "no plane found" in second
