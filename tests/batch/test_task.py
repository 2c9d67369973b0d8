"""Task reports of failed scans."""

import warnings

import pytest

from torchrg.batch.scans import convert_scan
from torchrg.batch.task import collecting_notes


@pytest.mark.parametrize(
    ("behavior", "reason", "is_foreseen"),
    [
        ("corrupt", "room.txt: line 7: expected six numbers, got five.", True),
        ("bug", "KeyError: 'what'", False),
        ("memory", "out of memory; use a machine with more", True),
        ("torch memory", "out of memory; use a machine with more", True),
        ("full", "result.txt: cannot be written: No space left on device.", True),
    ],
)
def test_what_goes_wrong_is_in_the_report(faults, tmp_path, behavior, reason, is_foreseen):
    (job,) = faults.make_jobs(tmp_path, {"12_a": behavior})
    report = convert_scan(job)
    assert report.status == "failed"
    assert reason in report.reason
    assert (report.details == "") == is_foreseen
    assert "Traceback" in report.details or is_foreseen
    assert report.disk_full == (behavior == "full")
    assert not job.folder.exists()


def test_an_input_that_is_gone_is_named(faults, tmp_path):
    (job,) = faults.make_jobs(tmp_path, {"12_a": "plain"})
    job.scan.files[0].unlink()
    assert convert_scan(job).reason == f"{job.scan.files[0]}: No such file or directory."


def test_collecting_notes_by_example():
    with collecting_notes() as notes:
        warnings.warn("no labels", stacklevel=1)
    assert notes == ["no labels"]
