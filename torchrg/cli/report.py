"""Console output of ``torchrg convert``: plan, cost estimate and report."""

import math
from collections.abc import Iterable, Sequence
from datetime import timedelta

from torchrg.batch.run import BatchReport, Plan
from torchrg.batch.task import TaskReport
from torchrg.cli.ending import printable

_SECONDS_PER_SCAN = 0.03
"""Time for a scan of 40 points on one core of an AMD EPYC, in seconds: hashing, flushing."""
MAX_ROWS = 300
"""Maximum number of scans in a report with one row per scan."""


def format_plan(plan: Plan) -> str:
    """Format a plan: one row per scan to convert."""
    sums = f"{len(plan.to_convert):,} scans to convert, {len(plan.done):,} done"
    if not plan.to_convert:
        return sums
    rows = [
        [job.name, plan.reasons[job.name], f"{job.scan.num_points:,}"] for job in plan.to_convert
    ]
    return "\n".join([format_table(["scan", "why", "points (about)"], rows), sums])


def format_costs(plan: Plan, workers: int, limit: int, free: int, rate: tuple[float, str]) -> str:
    """Format the estimated costs of a plan.

    ``limit`` is the memory limit of all workers and ``free`` the free disk space, in bytes;
    ``rate`` is the time per million points of one core, in seconds, and the name of the points.
    """
    jobs, (seconds, of_what) = plan.to_convert, rate
    if not jobs:
        return "nothing to do"
    memory, at_once = 0, 0
    for needed in sorted((job.memory for job in jobs), reverse=True)[:workers]:
        if at_once and memory + needed > limit:
            break
        memory, at_once = memory + needed, at_once + 1
    num_points = sum(job.scan.num_points for job in jobs)
    total = seconds * num_points / 1e6 + _SECONDS_PER_SCAN * len(jobs)
    duration = timedelta(seconds=math.ceil(total / at_once))
    return (
        f"disk: about {plan.num_bytes / 1e9:,.3f} GB of {free / 1e9:,.1f} GB free\n"
        f"memory: about {memory / 1e9:,.1f} GB, {at_once} at a time, limit {limit / 1e9:,.1f} GB\n"
        f"time: about {duration} (h:mm:ss), at {seconds:g} core seconds per million {of_what}"
    )


def format_report(report: BatchReport, *, unit: str = "scan") -> str:
    """Format a report: one row per scan, failed ones first, notes, then the totals.

    With more than :data:`MAX_ROWS` scans, only failures are listed. ``unit`` names a scan.
    """
    failed = report.with_status("failed")
    shown = [*failed, *(scan for scan in report.scans if scan.status != "failed")]
    shown = shown if len(shown) <= MAX_ROWS else failed
    rows = [_row(scan) for scan in shown]
    totals = report.with_status("converted")
    peak = max((scan.peak_memory for scan in totals), default=0) / 1e9
    planes = sum(scan.num_regions for scan in totals)
    sums = [f"{len(totals)} converted", f"{report.num_points:,}", f"{planes:,}"]
    rows.append(["all", *sums, f"{peak:.2f}"])
    notes = []
    for scan in shown:
        again = [f"done at attempt {scan.attempts}"] if scan.attempts > 1 else []
        lines = (*(f"repaired: {text}" for text in scan.repairs), *scan.warnings, *again)
        notes += [printable(f"{scan.name}: {note}") for note in lines]
    if len(report.scans) > MAX_ROWS and (num_noted := sum(bool(s.warnings) for s in report.scans)):
        notes.append(f"{num_noted:,} {unit}s have notes; see report.json")
    seconds = report.seconds or math.inf
    speed = (
        f"{report.num_points:,} points in {report.seconds:,.1f} s: "
        f"{report.num_points / seconds:,.0f} points, {len(totals) / seconds:,.2f} {unit}s a second"
    )
    head = ["scan", "status", "points", "planes", "GB"]
    return "\n".join([format_table(head, rows), *notes, speed])


def _row(scan: TaskReport) -> list[str]:
    """Return the table row of a scan; empty cells are unknown."""
    counts = [f"{scan.num_points:,}", f"{scan.num_regions:,}"] if scan.num_points else ["", ""]
    memory = f"{scan.peak_memory / 1e9:.2f}" if scan.peak_memory else ""
    return [scan.name, scan.status, *counts, memory]


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format rows as aligned columns, with numbers right-aligned."""
    columns = []
    for cells in zip(*(map(printable, row) for row in (head, *rows)), strict=True):
        width = max(map(len, cells))
        numeric = all(cell[:1].isdigit() or not cell for cell in cells[1:])
        columns.append([cell.rjust(width) if numeric else cell.ljust(width) for cell in cells])
    return "\n".join("  ".join(row).rstrip() for row in zip(*columns, strict=True))
