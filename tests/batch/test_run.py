"""A whole batch: a full disk and an interrupt end it, and the next run goes on from there."""

import json
import os

import pytest

from torchrg.batch.run import make_plan, run_plan, write_report
from torchrg.batch.scans import convert_scan
from torchrg.cli.report import format_costs, format_report
from torchrg.io.files import OUTPUT_MARK, remove_leftovers


def run(jobs, on_report=lambda report: None):
    """Run a plan in this process."""
    plan = make_plan(jobs)
    reports = (convert_scan(job) for job in plan.to_convert)
    return run_plan(plan, reports, engine="local", workers=1, on_report=on_report)


def statuses(ending):
    """Return what became of each scan."""
    return {scan.name: scan.status for scan in ending.scans}


def test_a_full_disk_ends_the_batch_and_the_next_run_goes_on(faults, tmp_path):
    behaviors = {"1_a": "plain", "2_b": "full", "3_c": "plain"}
    jobs = faults.make_jobs(tmp_path, behaviors)
    ending = run(jobs)
    assert ending.disk_full
    assert statuses(ending) == {"1_a": "converted", "2_b": "failed", "3_c": "not started"}
    assert "No space left on device" in ending.with_status("failed")[0].reason
    (tmp_path / "in" / "2_b.txt").write_text("plain")
    ending = run(jobs)
    assert not ending.disk_full
    assert statuses(ending) == {"1_a": "kept", "2_b": "converted", "3_c": "converted"}


def test_an_interrupt_ends_the_batch_with_what_is_complete(faults, tmp_path):
    jobs = faults.make_jobs(tmp_path, {"1_a": "plain", "2_b": "plain"})

    def interrupt(report):
        raise KeyboardInterrupt

    ending = run(jobs, interrupt)
    assert ending.interrupted
    assert statuses(ending)["2_b"] == "not started"
    assert make_plan(jobs).reasons == {"2_b": "new"}


def test_the_report_has_everything_and_the_table_what_fits(faults, tmp_path):
    jobs = faults.make_jobs(tmp_path, {"9_a": "plain", "8_b": "corrupt"})
    report = run(jobs)
    write_report(tmp_path, report)
    written = json.loads((tmp_path / "report.json").read_text())
    statuses = {"converted": 1, "kept": 0, "failed": 1, "not started": 0}
    assert written["scans_by_status"] == statuses
    assert written["points"] == 9
    assert set(written["stage_seconds"]) == {"hash", "read", "write", "record"}
    assert "line 7" in next(s["reason"] for s in written["scans"] if s["name"] == "8_b")
    assert all(s["host"] for s in written["scans"])
    table = format_report(report)
    assert "9_a" in table
    assert "9_a: was plain" in table
    kept = run(jobs).with_status("kept")[0]
    assert (kept.num_points, kept.num_regions, kept.warnings) == (9, 1, ("was plain",))


def test_a_report_that_was_not_completed_is_removed_the_next_time(faults, tmp_path, monkeypatch):
    report = run(faults.make_jobs(tmp_path, {"9_a": "plain"}))
    with monkeypatch.context() as killed:
        killed.setattr(os, "unlink", lambda path: None)
        killed.setattr(os, "replace", lambda *paths: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            write_report(tmp_path, report)
    (left,) = tmp_path.glob(".report.*.json")
    remove_leftovers(tmp_path, OUTPUT_MARK)
    assert not left.exists()


def test_many_small_scans_take_room_and_time_of_their_own(faults, tmp_path):
    plan = make_plan(faults.make_jobs(tmp_path, {f"1_{number}": "plain" for number in range(99)}))
    assert plan.num_bytes > 99 * 6 * 4096
    costs = format_costs(plan, 1, 10**10, 10**10, (10.0, "points"))
    assert "disk: about 0.003 GB" in costs
    assert "time: about 0:00:03 (h:mm:ss), at 10 core seconds" in costs
    assert "time: about 0:04:58 " in format_costs(
        plan._replace(jobs=plan.jobs * 100), 1, 10**10, 10**10, (10.0, "points")
    )


def test_a_long_table_shows_failures_only(faults, tmp_path, monkeypatch):
    monkeypatch.setattr("torchrg.cli.report.MAX_ROWS", 1)
    report = run(faults.make_jobs(tmp_path, {"9_a": "plain", "8_b": "corrupt"}))
    table = format_report(report)
    assert "8_b" in table
    assert "9_a" not in table
    assert "1 scans have notes; see report.json" in table
