"""Converting one scan: what goes wrong is in the report, and files are whole or not there."""

import dataclasses
import hashlib
import json
import tempfile

import numpy as np
import pytest

from torchrg import scratch
from torchrg.batch.memory import scan_memory
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import RECORD, convert_scan, reason_to_convert
from torchrg.batch.sources import CloudSource
from torchrg.config import load_config
from torchrg.datasets import FolderOfClouds


def test_the_record_tells_what_was_made_from_what(faults, tmp_path):
    (job,) = faults.make_jobs(tmp_path, {"12_a": "plain"})
    report = convert_scan(job)
    assert (report.status, report.num_points, report.warnings) == ("converted", 12, ("was plain",))
    assert set(report.seconds) == {"hash", "read", "write", "record"}
    assert report.peak_memory > 1e7
    record = json.loads((job.folder / RECORD).read_text())
    assert record["inputs"][0]["name"] == "12_a.txt"
    assert set(record["outputs"]) == {"result.txt"}
    assert record["warnings"] == ["was plain"]
    assert set(record["versions"]) == {"kernels", "numpy", "scipy", "torch", "torchrg"}
    text = json.dumps(record)
    assert not any(word in text for word in ("seconds", "host", str(tmp_path)))


def test_a_failure_leaves_no_record_of_an_earlier_success(faults, tmp_path):
    (job,) = faults.make_jobs(tmp_path, {"12_a": "plain"})
    convert_scan(job)
    job.scan.files[0].write_text("corrupt")
    assert convert_scan(job).status == "failed"
    assert reason_to_convert(job) == "new"


def test_remains_of_a_killed_run_and_of_other_options_go(faults, tmp_path):
    (job,) = faults.make_jobs(tmp_path, {"12_a": "plain"})
    convert_scan(job)
    record = json.loads((job.folder / RECORD).read_text())
    nothing = {"bytes": 0, "sha256": hashlib.sha256().hexdigest()}
    earlier = ("superpoint.npy", "edited.npy", "../../other.npy")
    record["outputs"] |= dict.fromkeys(earlier, nothing)
    (job.folder / RECORD).write_text(json.dumps(record))
    unfinished = ".result.0123456789abcdef01234567.txt"
    for name in (*earlier, unfinished, "theirs.npy", ".result.0123abcd.txt"):
        (job.folder / name).touch()
    (job.folder / "edited.npy").write_text("by the user since")
    convert_scan(job)
    names = {path.name for path in job.folder.iterdir()}
    assert names == {"result.txt", RECORD, "theirs.npy", "edited.npy", ".result.0123abcd.txt"}
    assert (tmp_path / "other.npy").exists()


def make_claim(path):
    """Turn a record into what a conversion leaves that is killed."""
    record = json.loads(path.read_text())
    claims = dict.fromkeys(record.pop("outputs"))
    path.write_text(json.dumps({**record, "claims": claims}))


def interrupt(*_):
    """Take the place of a function at which the process is killed."""
    raise KeyboardInterrupt


@pytest.fixture
def job_of_a_room(room, tmp_path):
    """``job_of_a_room(...)``: a job for a small room whose results go to ``out/room``."""

    def make(**settings):
        (tmp_path / "in").mkdir()
        np.save(tmp_path / "in" / "room.npy", room(500).points)
        source = CloudSource(FolderOfClouds(tmp_path / "in"), load_config("classic"), **settings)
        return list_jobs(source, tmp_path / "out")[0]

    return make


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("coord.npy", b"points of a user"),
        ("plane.npy", b""),
        ("planes.json", b'{"planes": 3}'),
        ("provenance.json", b'{"outputs": {"coord.npy": {}}}'),
        ("provenance.json", b'["of another program"]'),
    ],
)
def test_files_of_others_are_never_replaced(job_of_a_room, name, content):
    job = job_of_a_room()
    job.folder.mkdir(parents=True)
    (job.folder / name).write_bytes(content)
    report = convert_scan(job)
    assert report.status == "failed"
    assert report.reason.startswith(f"{job.folder / name}: ")
    assert "move it" in report.reason
    assert {path.name: path.read_bytes() for path in job.folder.iterdir()} == {name: content}


def test_results_are_replaced_by_those_of_other_settings_and_no_others(job_of_a_room):
    job = job_of_a_room(superpoint=True)
    assert convert_scan(job).status == "converted"
    (job.folder / "notes.npy").write_bytes(b"of a user")
    other = dataclasses.replace(job, source=dataclasses.replace(job.source, superpoint=False))
    assert convert_scan(other).status == "converted"
    assert sorted(path.name for path in job.folder.iterdir()) == [
        "coord.npy",
        "curvature.npy",
        "normal.npy",
        "notes.npy",
        "plane.npy",
        "planes.json",
        "provenance.json",
    ]
    # Killed after the claim and before the record.
    make_claim(job.folder / "provenance.json")
    assert convert_scan(job).status == "converted"
    assert (job.folder / "superpoint.npy").exists()


def test_a_scan_above_the_limit_has_its_arrays_on_disk(job_of_a_room, monkeypatch):
    job, arrays = job_of_a_room(), []
    convert_scan(job)
    names = ("plane.npy", "normal.npy", "planes.json")
    expected = [(job.folder / name).read_bytes() for name in names]
    assert not job.within(job.memory).on_disk
    large = job.within(job.memory - 1)
    assert large.memory == scan_memory(500, on_disk=True) < job.memory
    monkeypatch.setattr(scratch, "_MIN_BYTES", 0)
    monkeypatch.setenv("TMPDIR", str(job.out))
    create = tempfile.TemporaryFile
    monkeypatch.setattr(
        tempfile, "TemporaryFile", lambda **_: arrays.append(_["dir"]) or create(**_)
    )
    assert convert_scan(large).status == "converted"
    assert set(arrays) == {job.out}
    assert [(job.folder / name).read_bytes() for name in names] == expected


def test_a_scan_that_failed_keeps_its_table(job_of_a_room, tmp_path, room, monkeypatch):
    job, path = job_of_a_room(table="planes.csv"), tmp_path / "in" / "room.npy"
    assert convert_scan(job).status == "converted"
    whole = path.read_bytes()
    for _ in range(2):
        path.write_bytes(b"damaged")
        assert convert_scan(job).status == "failed"
    path.write_bytes(whole)
    assert convert_scan(job).status == "converted"
    assert reason_to_convert(job) == ""
    # A new table is known as torchrg's when the conversion is killed then.
    np.save(path, room(400).points)
    with monkeypatch.context() as patch:
        patch.setattr("torchrg.datasets.provenance.remove_unwritten", interrupt)
        with pytest.raises(KeyboardInterrupt):
            convert_scan(job)
    other = dataclasses.replace(job, source=dataclasses.replace(job.source, table=None))
    assert convert_scan(other).warnings == ()
    assert not (job.folder / "planes.csv").exists()
    (job.folder / "other.csv").write_text("of a user")
    other = dataclasses.replace(job, source=dataclasses.replace(job.source, table="other.csv"))
    assert "other.csv: was not written by torchrg for this scan" in convert_scan(other).reason


def test_a_folder_that_was_there_stays(job_of_a_room, tmp_path):
    job = job_of_a_room()
    (tmp_path / "in" / "room.npy").write_bytes(b"damaged")
    assert convert_scan(job).status == "failed"
    assert not job.folder.exists()
    job.folder.mkdir(parents=True)
    assert convert_scan(job).status == "failed"
    assert job.folder.is_dir()
