"""What became of a batch: as JSON, and as a table for the terminal."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from torchrg.batch.convert import ScanReport
from torchrg.batch.records import describe_versions, read_record
from torchrg.batch.scans import Job

_STAGES = ("hash", "read", "neighbors", "normals", "regions", "planes", "write", "record")
"""Stages in the order of the table; those of other sources follow."""
MOST_ROWS = 300
"""A longer batch is not printed scan by scan."""


@dataclass(frozen=True)
class BatchReport:
    """What became of all scans of a batch.

    Attributes:
        scans: A report of each, in natural order.
        started: When, in seconds since 1970.
        seconds: How long it took.
        engine: Which one.
        workers: How many scans at a time at most, None without a bound of ours.
        interrupted: Whether it was stopped by Ctrl-C or SIGTERM.
    """

    scans: tuple[ScanReport, ...]
    started: float
    seconds: float
    engine: str
    workers: int | None
    interrupted: bool = False

    @property
    def disk_full(self) -> bool:
        """Whether it stopped because there is no space left."""
        return any(scan.disk_full for scan in self.scans)

    def with_status(self, status: str) -> list[ScanReport]:
        """Return the scans of a status."""
        return [scan for scan in self.scans if scan.status == status]

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Time of each stage, of all scans converted now."""
        total: dict[str, float] = {}
        for scan in self.with_status("converted"):
            for stage, seconds in scan.seconds.items():
                total[stage] = total.get(stage, 0.0) + seconds
        return {
            stage: total[stage] for stage in dict.fromkeys((*_STAGES, *total)) if stage in total
        }

    @property
    def num_points(self) -> int:
        """Points converted now."""
        return sum(scan.num_points for scan in self.with_status("converted"))

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON can hold it."""
        points, stages = self.num_points, self.stage_seconds
        return {
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self.started)),
            "seconds": self.seconds,
            "engine": self.engine,
            "workers": self.workers,
            "versions": describe_versions(),
            "scans_by_status": {
                status: len(self.with_status(status))
                for status in ("converted", "kept", "failed", "not started")
            },
            "points": points,
            "points_per_second": points / self.seconds if self.seconds else 0.0,
            "points_per_second_of_a_worker": {
                stage: points / seconds for stage, seconds in stages.items() if seconds
            },
            "stage_seconds": stages,
            "peak_memory": max((scan.peak_memory for scan in self.scans), default=0),
            "scans": [asdict(scan) for scan in self.scans],
        }


def kept_report(job: Job) -> ScanReport:
    """Return the report of a scan that an earlier run has done, from its record."""
    record = read_record(job) or {}
    return ScanReport(
        job.scan.name,
        "kept",
        num_points=record.get("points", 0),
        num_regions=record.get("regions", 0),
        repairs=tuple(record.get("repairs", ())),
        warnings=tuple(record.get("warnings", ())),
        attempts=0,
    )


def format_report(report: BatchReport, *, unit: str = "scan") -> str:
    """Return a report as text: a row for each scan, notes below, then the sums.

    With more than :data:`MOST_ROWS` scans, only failures have a row. ``unit`` is what a scan is
    called where its number in a second counts.
    """
    stages = list(report.stage_seconds)
    shown = report.scans if len(report.scans) <= MOST_ROWS else report.with_status("failed")
    head = ["scan", "status", "points", "planes", *stages, "GB"]
    rows = [_row(scan, stages) for scan in shown]
    totals = report.with_status("converted")
    rows.append(
        [
            "all",
            f"{len(totals)} converted",
            f"{report.num_points:,}",
            f"{sum(scan.num_regions for scan in totals):,}",
            *(f"{seconds:.1f}" for seconds in report.stage_seconds.values()),
            f"{max((scan.peak_memory for scan in totals), default=0) / 1e9:.2f}",
        ]
    )
    notes = [
        f"{scan.name}: {note}"
        for scan in shown
        for note in (
            *(f"repaired: {text}" for text in scan.repairs),
            *scan.warnings,
            *([f"done at attempt {scan.attempts}"] if scan.attempts > 1 else []),
        )
        if scan.status != "failed"
    ]
    points, scans = (
        number / report.seconds if report.seconds else 0.0
        for number in (report.num_points, len(totals))
    )
    speed = (
        f"{report.num_points:,} points in {report.seconds:,.1f} s: {points:,.0f} points, "
        f"{scans:,.2f} {unit}s a second"
    )
    return "\n".join([format_table(head, rows), *notes, speed])


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return rows of text as aligned columns, numbers to the right.

    Example:
        >>> print(format_table(["scan", "points"], [["hall", "1,000"], ["office", "20"]]))
        scan    points
        hall     1,000
        office      20
    """
    table = [list(head), *map(list, rows)]
    widths = [max(len(row[column]) for row in table) for column in range(len(head))]
    numeric = [
        all(row[column][:1].isdigit() or row[column] == "" for row in table[1:])
        for column in range(len(head))
    ]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in table
    )


def _row(scan: ScanReport, stages: Sequence[str]) -> list[str]:
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
