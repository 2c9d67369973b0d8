"""What ``torchrg convert`` prints of a batch: its plan, what it will take, what became of it."""

import math
from collections.abc import Iterable, Sequence

from torchrg.batch.run import BatchReport, Plan
from torchrg.batch.task import TaskReport
from torchrg.cli.ending import printable

_SECONDS_PER_SCAN = 0.03
"""Time of one core of an AMD EPYC for a scan of 40 points: hashes, and files that are flushed."""
_SHORT = 100
"""Seconds or minutes from which on a duration is in the next unit."""
MAX_ROWS = 300
"""Most scans of a batch that is printed scan by scan."""


def format_plan(plan: Plan) -> str:
    """Return what a plan would do: a row for each scan that is to be converted."""
    sums = f"{len(plan.to_convert):,} scans to convert, {len(plan.done):,} done"
    if not plan.to_convert:
        return sums
    rows = [
        [job.name, plan.reasons[job.name], f"{job.scan.num_points:,}"] for job in plan.to_convert
    ]
    return "\n".join([format_table(["scan", "why", "points (about)"], rows), sums])


def format_costs(plan: Plan, workers: int, limit: int, free: int, rate: tuple[float, str]) -> str:
    """Return what a plan would take, in words, or that there is nothing to do.

    ``limit`` is the memory of all workers and ``free`` the room on the disk, in bytes; ``rate`` is
    the seconds of a core for a million points, and what these points are.
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
    return (
        f"disk: about {plan.num_bytes / 1e9:,.3f} GB of "
        f"{free / 1e9:,.1f} that are free\n"
        f"memory: about {memory / 1e9:,.1f} GB for {at_once} at a time, within {limit / 1e9:,.1f}\n"
        f"time: about {_format_time(total / at_once)}, at {seconds:g} s of a core for a million "
        f"{of_what}"
    )


def format_report(report: BatchReport, *, unit: str = "scan") -> str:
    """Return a report as text: a row for each scan, notes below, then the sums.

    With more than :data:`MAX_ROWS` scans, only failures have a row. ``unit`` is what a scan is
    called where its number in a second counts.
    """
    stages = list(report.stage_seconds)
    shown = report.scans if len(report.scans) <= MAX_ROWS else report.with_status("failed")
    head = ["scan", "status", "points", "planes", *(f"{stage} (s)" for stage in stages), "GB"]
    rows = [_row(scan, stages) for scan in shown]
    totals = report.with_status("converted")
    peak = max((scan.peak_memory for scan in totals), default=0) / 1e9
    planes = sum(scan.num_regions for scan in totals)
    times = [f"{seconds:.1f}" for seconds in report.stage_seconds.values()]
    sums = [f"{len(totals)} converted", f"{report.num_points:,}", f"{planes:,}"]
    rows.append(["all", *sums, *times, f"{peak:.2f}"])
    notes = []
    for scan in shown:
        if scan.status != "failed":
            again = [f"done at attempt {scan.attempts}"] if scan.attempts > 1 else []
            told = (*(f"repaired: {text}" for text in scan.repairs), *scan.warnings, *again)
            notes += [printable(f"{scan.name}: {note}") for note in told]
    if len(report.scans) > MAX_ROWS and (num_noted := sum(bool(s.warnings) for s in report.scans)):
        notes.append(f"{num_noted:,} {unit}s have notes, which report.json holds")
    seconds = report.seconds or math.inf
    speed = (
        f"{report.num_points:,} points in {report.seconds:,.1f} s: "
        f"{report.num_points / seconds:,.0f} points, {len(totals) / seconds:,.2f} {unit}s a second"
    )
    return "\n".join([format_table(head, rows), *notes, speed])


def _format_time(seconds: float) -> str:
    """Return a duration in the unit that suits it.

    Example:
        >>> _format_time(8), _format_time(500), _format_time(9000)
        ('8 s', '8 min', '2.5 h')
    """
    if seconds < _SHORT:
        return f"{math.ceil(seconds)} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < _SHORT else f"{minutes / 60:,.1f} h"


def _row(scan: TaskReport, stages: Sequence[str]) -> list[str]:
    """Return the cells of a scan."""
    points = f"{scan.num_points:,}" if scan.num_points else ""
    return [
        scan.name,
        scan.status,
        points,
        f"{scan.num_regions:,}" if points else "",
        *(f"{scan.seconds[stage]:.1f}" if stage in scan.seconds else "" for stage in stages),
        f"{scan.peak_memory / 1e9:.2f}" if scan.peak_memory else "",
    ]


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return rows of text as aligned columns, numbers to the right.

    Example:
        >>> print(format_table(["scan", "points"], [["hall", "1,000"], ["office", "20"]]))
        scan    points
        hall     1,000
        office      20
    """
    columns = []
    for cells in zip(*(map(printable, row) for row in (head, *rows)), strict=True):
        width = max(map(len, cells))
        numeric = all(cell[:1].isdigit() or not cell for cell in cells[1:])
        columns.append([cell.rjust(width) if numeric else cell.ljust(width) for cell in cells])
    return "\n".join("  ".join(row).rstrip() for row in zip(*columns, strict=True))
