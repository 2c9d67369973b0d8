"""The command line: the main job, and one line for every mistake."""

import json
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from torchrg import kernels
from torchrg.cli import COMMANDS, main
from torchrg.io import read_cloud

CLASSIC = ("--preset", "classic")


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
        ("short.xlsx", [], "ending in one of"),
        ("short.pcd", [], "short.pcd"),
        ("short.ply", [], "short.ply"),
        ("pickled.npz", [], "pickle"),
        ("nan.npy", [], "finite"),
        ("ROOM", ["--preset", "clasic"], "classic, classic_increment"),
        ("ROOM", ["--angle-deg", "91"], "expected --angle-deg in [0, 90], got 91.0"),
        ("ROOM", ["--angle-deg", "five"], "--angle-deg"),
        ("ROOM", ["--config", "wrong.yaml"], "wrong.yaml: unknown setting 'growing.max_angle'"),
        ("ROOM", ["--config", "none.yaml"], "No such file"),
        ("ROOM", ["--normals.k", "2"], "expected --normals.k >= 3, got 2"),
        ("ROOM", ["--normals.k", "many"], "--normals.k"),
        ("ROOM", ["--no-such-flag"], "no-such-flag"),
        ("ROOM", ["--growing.merge-tolerance", "0.5"], "expected --growing.merge-tolerance >= 1"),
        ("ROOM", ["--voxel", "0"], "--voxel > 0"),
        ("ROOM", ["--threads", "0"], "--threads from 1 to 1,024"),
        ("ROOM", ["--voxel", "nan"], "expected --voxel to be a number"),
        ("ROOM", ["--out", "seg.docx"], "ending in one of"),
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
        assert "would overwrite an input or a result" in done.error
    assert Path("room é.npz").read_bytes() == before


@pytest.mark.parametrize(
    "command", [*([name] for name in COMMANDS if name != "settings"), ["convert", "folder"]]
)
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
    assert (done.returncode, done.stderr) == (
        2,
        "torchrg: standard output: No space left on device.\n",
    )


def test_every_command_is_named_by_help_and_to_those_who_misspell_one(run):
    wrong = run("segmnet")
    assert "got 'segmnet'. Did you mean segment?" in wrong.error
    assert all(name in wrong.error and name in run("--help").out for name in COMMANDS)


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


def test_what_gives_way_to_a_result_is_told(room_file, tmp_path, run):
    out = tmp_path / "a.ply"
    names = "label as label_input, normals as normals_input"
    done = run("segment", room_file, *CLASSIC, "--out", out)
    assert f"input fields are kept next to the result: {names}" in done.err
    expected, fields = read_cloud(room_file).fields, read_cloud(out).fields
    np.testing.assert_array_equal(fields["label_input"], expected["labels"])
    np.testing.assert_array_equal(fields["normals_input"], expected["normals"])
    # Archives hold the result alone, in place of earlier ones.
    shown = run("segment", room_file, *CLASSIC, "--out", tmp_path / "a.npz")
    assert shown.err == ""
    assert shown.out.endswith("a.npz\n")


def test_single_points_far_off_that_cost_precision_are_told(room_file, tmp_path, run):
    far = read_cloud(room_file).coordinates.astype(np.float64) + np.array([5e5, 5.4e6, 300])
    far[5] = 0
    np.save(tmp_path / "zero.npy", far)
    done = run("segment", tmp_path / "zero.npy", "--out", tmp_path / "a.npz", *CLASSIC)
    first, second = done.err.splitlines()
    assert "zero.npy: half of the points lie within " in first
    assert "no plane found" in second


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (RuntimeError("can't start new thread"), "no further thread can be started"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "out of memory"),
        (ImportError("libtorch_cpu.so: failed to map segment"), "out of memory"),
        (MemoryError(), "out of memory"),
    ],
)
def test_a_limit_of_the_system_is_one_line(error, message, run, monkeypatch):
    from torchrg.cli import info

    def fail(argv):
        raise error

    monkeypatch.setattr(info, "run", fail)
    done = run("info", "room.ply")
    assert done.code == 2
    assert f"torchrg: info: {message}" in done.error


def test_a_result_is_described_by_its_planes_and_settings_if_verbose(room_file, tmp_path, run):
    command = ("segment", room_file, "--out", tmp_path / "a.npz")
    (line,) = run(*command).out.splitlines()
    assert re.search(
        r": \d+ planes, [\d.]+ % labeled: 1 floor, 1 ceiling, 4 walls.*; [\d,]+ points in", line
    )
    first, last = run(*command, "-v").out.splitlines()
    assert re.search(r"\(whiteness [\d.]+\): noise_scope \w+, facet_tolerance", first)
    assert last.partition(" points in ")[0] == line.partition(" points in ")[0]
    assert run("segment", room_file, "on", "--out", tmp_path / "a.npz").err.endswith(
        "torchrg: on: file not found; check the path.\n"
    )


@pytest.mark.parametrize(
    ("word", "shown"), [("help", "usage: torchrg COMMAND"), ("-V", "torchrg 0.")]
)
def test_usual_words_for_help_and_version_are_taken(word, shown, run):
    done = run(word)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(shown)


def test_an_estimator_as_preset_leads_to_its_setting(room_file, run):
    err = run("segment", room_file, "--out", "a.npz", "--preset", "pca").err
    assert err.startswith("torchrg: expected a .yaml file, or a preset, one of algorithm2")
    assert "--normals.method pca" in err
