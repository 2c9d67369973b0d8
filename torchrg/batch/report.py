"""What became of a batch."""

import time
from dataclasses import asdict, dataclass
from typing import Any

from torchrg.batch.records import Recorded, describe_versions, read_record
from torchrg.batch.task import TaskReport

_STAGES = ("hash", "read", "neighbors", "normals", "regions", "planes", "write", "record")
"""Stages in their order; those of other sources follow."""


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

    scans: tuple[TaskReport, ...]
    started: float
    seconds: float
    engine: str
    workers: int | None
    interrupted: bool = False

    @property
    def disk_full(self) -> bool:
        """Whether it stopped because there is no space left."""
        return any(scan.disk_full for scan in self.scans)

    def with_status(self, status: str) -> list[TaskReport]:
        """Return the scans of a status."""
        return [scan for scan in self.scans if scan.status == status]

    @property
    def complete(self) -> list[TaskReport]:
        """The scans whose results are there."""
        return [*self.with_status("converted"), *self.with_status("kept")]

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


def kept_report(name: str, job: Recorded) -> TaskReport:
    """Return the report of a task that an earlier run has done, from its record."""
    record = read_record(job) or {}
    return TaskReport(
        name,
        "kept",
        num_points=record.get("points", 0),
        num_regions=record.get("regions", 0),
        repairs=tuple(record.get("repairs", ())),
        warnings=tuple(record.get("warnings", ())),
        attempts=0,
    )
