"""``torchrg convert``: a folder of rooms from end to end, what it refuses, and what it tells."""

import errno
import io
import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest
from tqdm import tqdm

from tests.batch.test_interruptions import results_of
from tests.datasets.s3dis_tree import write_clean_room
from torchrg.batch.run import lock_folder
from torchrg.batch.scans import RECORD
from torchrg.batch.task import TaskReport
from torchrg.cli import main
from torchrg.cli.loop import Progress
from torchrg.config import load_config
from torchrg.io import read_cloud
from torchrg.pipeline import segment_planes


@pytest.fixture
def convert(run):
    """``convert(kind, root, out, ...)``: the command on small rooms."""
    return lambda *arguments: run("convert", *arguments, "--preset", "classic")


@pytest.fixture(scope="module")
def rooms(folder_of_clouds):
    """A folder of two rooms, one of them below another folder."""
    folder = folder_of_clouds("hall.npz", "east/office.ply")
    points = read_cloud(folder / "east" / "office.ply").coordinates
    (folder / "east" / "office.ply").unlink()
    np.save(folder / "east" / "office.npy", points)
    return folder


@pytest.fixture(scope="module")
def converted(rooms, tmp_path_factory):
    """The rooms converted by two workers."""
    out = tmp_path_factory.mktemp("converted") / "out"
    flags = ["--preset", "classic", "--workers", "2"]
    assert main(["convert", "folder", str(rooms), str(out), *flags]) == 0
    return out


def test_a_folder_holds_what_the_contract_says(rooms, converted):
    names = {"coord.npy", "normal.npy", "curvature.npy", "plane.npy", "planes.json"}
    expected = {
        f"{room}/{name}" for room in ("hall", "east/office") for name in (*names, "provenance.json")
    }
    assert set(results_of(converted)) == expected
    points = np.load(rooms / "hall.npz")["points"]
    seg = segment_planes(points, load_config("classic"))
    hall = {name: np.load(converted / "hall" / f"{name}.npy") for name in ("coord", "normal")}
    assert np.array_equal(hall["coord"], points)
    assert np.array_equal(hall["normal"], seg.normals.numpy())
    assert np.array_equal(np.load(converted / "hall" / "plane.npy"), seg.labels.numpy())
    assert np.array_equal(np.load(converted / "hall" / "curvature.npy"), seg.curvature.numpy())
    table = json.loads((converted / "hall" / "planes.json").read_text())
    assert [row["count"] for row in table["planes"]] == seg.planes.count.tolist()


@pytest.mark.usefixtures("in_workers")
def test_one_worker_and_little_memory_give_the_same_bytes(rooms, converted, tmp_path, convert):
    done = convert("folder", rooms, tmp_path / "out", "--workers", 1, "--limit-memory", 0.1)
    assert done.err.count("may exceed the memory limit of 0.1 GB; it runs alone") == 2
    assert "moving the largest arrays of 2 of 2 scans, which exceed the memory limit," in done.out
    assert results_of(tmp_path / "out") == results_of(converted)


def test_what_is_done_is_kept_and_a_bad_file_stops_no_other(rooms, converted, tmp_path, convert):
    shutil.copytree(rooms, tmp_path / "in")
    shutil.copytree(converted, tmp_path / "out")
    (tmp_path / "in" / "bad.ply").write_text("ply\nformat")
    (tmp_path / "out" / "hall" / "plane.npy").write_bytes(b"")
    command = ("folder", tmp_path / "in", tmp_path / "out")
    shown = convert(*command, "--dry-run").out
    assert "plane.npy changed" in shown
    assert "2 scans to convert, 1 done" in shown
    done = convert(*command, "--workers", 1)
    assert done.code == 3
    assert done.out.splitlines()[1].split()[:2] == ["bad", "failed"]
    first, last = done.err.splitlines()
    assert first.startswith(f"torchrg: bad: {tmp_path / 'in' / 'bad.ply'}: line 2: ")
    assert "2 of 3 scans are complete" in last
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    status = {scan["name"]: scan["status"] for scan in report["scans"]}
    assert status == {"bad": "failed", "hall": "converted", "east/office": "kept"}
    assert all(name in done.out for name in status)
    assert results_of(tmp_path / "out") == results_of(converted)
    assert "seconds" not in done.out
    assert set(report["stage_seconds"]) >= {"read", "normals", "write"}
    assert "\n1 scans to convert, 0 done" in convert(*command, "--only-failed", "--dry-run").out
    (tmp_path / "in" / "bad.ply").rename(tmp_path / "in" / "good.txt")
    assert convert(*command, "--only-failed").out.startswith("nothing to do: ")
    done = convert(*command, "--exclude", "no.ply", "--exclude", "go*.txt", "east/*")
    assert (done.code, done.err) == (0, "")
    assert "1 of 1 scans are complete" in done.out


def test_failures_of_scans_that_a_run_omits_stay_in_the_report(rooms, tmp_path, convert):
    shutil.copytree(rooms, tmp_path / "in")
    for name in ("bad", "worse"):
        (tmp_path / "in" / f"{name}.ply").write_text("ply\nformat")
    command = ("folder", tmp_path / "in", tmp_path / "out")
    assert convert(*command, "--workers", 1).code == 3
    assert convert(*command, "--workers", 1, "--only", "hall", "--force").code == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["scans_by_status"]["failed"] == 2
    assert "\n2 scans to convert, 0 done" in convert(*command, "--only-failed", "--dry-run").out
    shutil.copy(rooms / "east" / "office.npy", tmp_path / "in" / "bad.npy")
    (tmp_path / "in" / "bad.ply").unlink()
    assert convert(*command, "--workers", 1, "--only", "bad").code == 0
    assert "\n1 scans to convert, 0 done" in convert(*command, "--only-failed", "--dry-run").out


def test_a_dry_run_writes_nothing(rooms, tmp_path, convert):
    shown = convert("folder", rooms, tmp_path / "out", "--dry-run", "--only", "east/*").out
    assert "1 scans to convert" in shown
    assert "disk: about 0.000 GB of " in shown
    assert "memory: about 0.4 GB, 1 at a time" in shown
    assert "time: about 0:00:01 (h:mm:ss), at 10 core seconds per million points" in shown
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("flags", [[], ["--dry-run"]])
def test_a_disk_that_is_too_small_is_told_beforehand(rooms, tmp_path, convert, monkeypatch, flags):
    monkeypatch.setattr("torchrg.io.files.free_space", lambda _: 1000)
    done = convert("folder", rooms, tmp_path / "out", *flags)
    assert done.code == 2
    assert "MB of free disk for 2 scans, got 0.0 MB; free some space" in done.err


class Closed(io.StringIO):
    """A pipe whose reader has gone."""

    def write(self, text):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


def test_output_that_closes_keeps_the_code_and_the_report(rooms, tmp_path, monkeypatch):
    shutil.copytree(rooms, tmp_path / "in")
    (tmp_path / "in" / "bad.ply").write_bytes(b"ply\n")
    monkeypatch.setattr("sys.stdout", Closed())
    out, flags = tmp_path / "out", ["--preset", "classic", "--workers", "1"]
    assert main(["convert", "folder", str(tmp_path / "in"), str(out), *flags]) == 3
    report = json.loads((out / "report.json").read_text())
    assert report["scans_by_status"] == {
        "converted": 2, "kept": 0, "failed": 1, "not started": 0
    }  # fmt: skip


def test_another_converter_in_the_same_directory_is_refused(rooms, tmp_path, convert, monkeypatch):
    monkeypatch.setattr("torchrg.batch.run.LOCK_TIMEOUT_SECONDS", 0)
    with lock_folder(tmp_path):
        error = convert("folder", rooms, tmp_path).error
    assert f"{tmp_path}: locked by another torchrg process; " in error
    assert not results_of(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rooms", "IN", "OUT"], "expected a kind of data set (s3dis, folder"),
        (["folder", "IN", "OUT", "--workers", "0"], "expected --workers >= 1, got 0"),
        (["folder", "IN", "OUT", "--limit-memory", "0"], "expected --limit-memory above 0"),
        (["folder", "IN", "OUT", "--chunk-size", "0"], "expected --chunk-size >= 1"),
        (["folder", "IN", "OUT", "--engine", "spark"], "local, ray, auto or HOST:PORT"),
        (["folder", "IN", "OUT", "--only-failed"], "expected the report of an earlier run"),
        (["folder", "IN", "OUT", "--only", "west/*"], "they are east/office, hall"),
        (["folder", "IN", "IN/out"], "expected a directory outside"),
        (["folder", "IN", "IN"], "expected a directory outside"),
        (["folder", "NONE", "OUT"], "no such folder"),
        (["s3dis", "IN", "OUT"], "expected a folder Area_1"),
        (["folder", "IN", "IN/hall.npz"], "expected a directory outside"),
        (["folder", "IN", "FILE/out"], "cannot be created: Not a directory"),
    ],
)
def test_mistakes_are_one_line_before_any_work(rooms, tmp_path, convert, arguments, message):
    (tmp_path / "f").touch()
    places = {"IN": rooms, "OUT": tmp_path / "out", "NONE": tmp_path / "no", "FILE": tmp_path / "f"}
    words = []
    for word in arguments:
        first, slash, rest = word.partition("/")
        words.append(f"{places[first]}{slash}{rest}" if first in places else word)
    done = convert(*words)
    assert (done.code, done.out) == (2, "")
    assert message in done.error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("unit", "bar_unit", "sizes", "words"),
    [
        ("scan", "pt", {"a": 900, "b": 100}, ("1/2 scans, 1 failed:  90%", "900/1000", "pt/s]")),
        ("frame", "frame", {"a": 1, "b": 1}, ("1/2 frames, 1 failed:  50%", "1/2 [", "frame/s]")),
    ],
)
def test_progress_is_scans_points_a_second_and_time_left(unit, bar_unit, sizes, words):
    shown = io.StringIO()
    with tqdm(total=sum(sizes.values()), unit=bar_unit, file=shown, ncols=80) as bar:
        progress = Progress(bar, sizes, unit=unit)
        progress(None)
        progress(TaskReport("a", "failed"))
        bar.refresh()
    assert all(word in shown.getvalue().splitlines()[-1] for word in words)


@pytest.mark.filterwarnings("ignore:.*expected .* rooms")
def test_s3dis_points_up_along_z_unless_told_otherwise(tmp_path, run):
    write_clean_room(tmp_path / "in" / "Area_1" / "office_1", 1, {"wall_1": 300, "floor_1": 300})
    command = ("convert", "s3dis", tmp_path / "in", tmp_path / "out", "--workers", "1")
    run(*command)
    (record,) = (tmp_path / "out").rglob(RECORD)
    used, expected = json.loads(record.read_text())["config"], asdict(load_config())
    expected["planes"]["up"] = "z"
    for section in ("normals", "growing", "planes"):
        assert used[section] == expected[section]
    assert "nothing to do" in run(*command, "--dry-run").out
    assert "settings changed" in run(*command, "--preset", "classic", "--dry-run").out
