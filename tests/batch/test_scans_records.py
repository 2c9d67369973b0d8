"""When a scan counts as done: same input, settings, options, version, and results untouched."""

import json
import os
from dataclasses import replace

import pytest

from torchrg import version
from torchrg.batch.run import make_plan
from torchrg.batch.scans import RECORD, convert_scan, reason_to_convert
from torchrg.config import load_config


@pytest.fixture
def job(faults, tmp_path):
    (job,) = faults.make_jobs(tmp_path, {"12_a": "plain"})
    assert reason_to_convert(job) == "new"
    assert convert_scan(job).status == "converted"
    return job


def test_other_settings_are_noticed_but_not_those_that_change_no_result(job):
    for settings, reason in (
        (job.source.settings, ""),
        (load_config("classic"), "settings changed"),
        (replace(job.source.settings, chunk_size=7), ""),
    ):
        source = replace(job.source, settings=settings)
        assert reason_to_convert(replace(job, source=source)) == reason


def test_another_input_is_noticed_even_at_the_same_size_and_time(job):
    path = job.scan.files[0]
    before = path.stat()
    path.write_text("PLAIN")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert reason_to_convert(job) == "input changed"
    path.unlink()
    assert reason_to_convert(job) == "input cannot be read"


def test_another_version_is_noticed(job, monkeypatch):
    monkeypatch.setattr(version, "__version__", "99.0")
    assert reason_to_convert(job) == "version changed"


def test_results_that_changed_or_are_gone_are_noticed(job):
    result = job.folder / "result.txt"
    result.write_text("plaim")
    assert reason_to_convert(job) == "result.txt changed"
    result.unlink()
    assert reason_to_convert(job) == "result.txt missing"


@pytest.mark.parametrize(
    "change", [{"points": "x"}, {"regions": None}, {"repairs": 3}, {"warnings": {}}]
)
def test_a_record_that_a_report_cannot_repeat_is_noticed(job, change):
    record = json.loads((job.folder / RECORD).read_text())
    (job.folder / RECORD).write_text(json.dumps(record | change))
    assert reason_to_convert(job) == "record damaged"


def test_records_hold_no_place_or_time(faults, tmp_path):
    records = []
    for folder in ("here", "there"):
        (job,) = faults.make_jobs(tmp_path / folder, {"12_a": "plain"})
        convert_scan(job)
        records.append((job.folder / RECORD).read_bytes())
    assert records[0] == records[1]
    assert json.loads(records[0])["points"] == 12


def test_the_plan_says_why(faults, tmp_path):
    jobs = faults.make_jobs(tmp_path, {"12_a": "plain", "13_b": "plain"})
    convert_scan(jobs[0])
    plan = make_plan(jobs)
    assert plan.reasons == {"13_b": "new"}
    assert [job.scan.name for job in plan.done] == ["12_a"]
    assert make_plan(jobs, force=True).reasons == {"12_a": "forced", "13_b": "forced"}
