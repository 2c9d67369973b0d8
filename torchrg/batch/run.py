"""Run a plan on an engine, and collect what becomes of each scan."""

import contextlib
import json
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import NamedTuple

from torchrg.batch.convert import ScanReport
from torchrg.batch.plan import Plan
from torchrg.batch.report import BatchReport, kept_report
from torchrg.io import atomic_path

REPORT = "report.json"

Reports = Generator[ScanReport | None, None, None]


class Ending(NamedTuple):
    """How a batch ended.

    Attributes:
        report: What became of the scans.
        interrupted: Whether it was stopped by Ctrl-C or SIGTERM.
        disk_full: Whether it stopped because there is no space left.
    """

    report: BatchReport
    interrupted: bool
    disk_full: bool


def run_plan(
    plan: Plan,
    reports: Reports,
    *,
    engine: str,
    workers: int | None,
    on_report: Callable[[ScanReport | None], None] = lambda report: None,
) -> Ending:
    """Convert the scans of a plan that are not done.

    A full disk ends the batch, as every further scan would fail after its work; so does an
    interrupt. What is complete stays, and the next run goes on from there.

    Args:
        plan: The plan.
        reports: The engine at work: reports as scans end, None in between.
        engine: Its name, for the report.
        workers: Most scans at a time, for the report.
        on_report: Called with everything that the engine yields.

    Returns:
        The report and how the batch ended.
    """
    started, begin = time.time(), time.perf_counter()
    found = {job.scan.name: kept_report(job) for job in plan.done}
    interrupted = disk_full = False
    try:
        with contextlib.closing(reports):
            for report in reports:
                on_report(report)
                if report is not None:
                    found[report.name] = report
                    if report.disk_full:
                        disk_full = True
                        break
    except KeyboardInterrupt:
        interrupted = True
    scans = [
        found.get(job.scan.name, ScanReport(job.scan.name, "not started", attempts=0))
        for job in plan.jobs
    ]
    seconds = time.perf_counter() - begin
    return Ending(
        BatchReport(tuple(scans), started, seconds, engine, workers), interrupted, disk_full
    )


def write_report(out: Path, report: BatchReport) -> None:
    """Write ``report.json`` into the output directory.

    Raises:
        FormatError: If it cannot be written.
    """
    with atomic_path(out / REPORT) as beside:
        beside.write_text(json.dumps(report.to_json(), indent=1) + "\n", encoding="utf-8")
