"""Planning, execution and report of a batch."""

import contextlib
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import filelock

from torchrg.batch.scans import Job, Source, reason_to_convert
from torchrg.batch.task import STATUSES, Reports, TaskReport
from torchrg.datasets.folder import SceneFiles
from torchrg.datasets.provenance import Record, describe_versions, read_record
from torchrg.errors import ConfigError, FormatError
from torchrg.io.files import (
    OUTPUT_MARK,
    PARSE_ERRORS,
    atomic_path,
    check_space,
    list_some,
    normalize_file_name,
)

__all__ = [
    "BatchReport",
    "Plan",
    "check_free_space",
    "list_jobs",
    "lock_folder",
    "make_plan",
    "match_jobs",
    "read_failed",
    "run_plan",
    "write_report",
]
__dir__ = __all__.copy

REPORT = "report.json"
"""Name of the report in the output directory."""
LOCK = ".torchrg.lock"
"""Name of the lock file in the output directory; it remains there, empty."""
_BYTES_PER_SCAN = 32_768
"""Disk space of a scan beyond its arrays: tables, and half a block of 4 KiB for each file."""
LOCK_TIMEOUT_SECONDS = 5.0
"""Timeout for the lock, in seconds: an interrupted command ends its workers by then."""


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock an existing output directory for one command at a time.

    It is an operating system lock, released when the process ends, even on a crash; workers end
    with their command. On network file systems it works if they support locking.

    Raises:
        FormatError: If another command holds the lock, or the lock file cannot be written.
    """
    lock = filelock.FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=LOCK_TIMEOUT_SECONDS)
    except filelock.Timeout:
        raise FormatError(
            f"{folder}: locked by another torchrg process; wait for it, stop it, or choose another."
        ) from None
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FormatError(f"{folder}: cannot be locked: {reason}; use another disk.") from error
    try:
        yield
    finally:
        lock.release()


class Plan(NamedTuple):
    """Scans of a batch in natural order, and the reasons to convert those not up to date."""

    jobs: tuple[Job, ...]
    reasons: dict[str, str]

    @property
    def to_convert(self) -> list[Job]:
        """Jobs to run."""
        return [job for job in self.jobs if job.name in self.reasons]

    @property
    def done(self) -> list[Job]:
        """Jobs that are up to date."""
        return [job for job in self.jobs if job.name not in self.reasons]

    @property
    def num_bytes(self) -> int:
        """Estimated disk space of the results of the jobs to run."""
        return sum(
            _BYTES_PER_SCAN + job.source.bytes_per_point * job.scan.num_points
            for job in self.to_convert
        )


def list_jobs(source: Source, out: Path, *, only: str | None = None) -> list[Job]:
    """Return a job for each scan of a source, in natural order, with results in ``out``.

    ``only`` selects names by a shell pattern; ``*`` also matches slashes.

    Raises:
        ConfigError: If no name matches the pattern, or results would be written among the scans.
        FormatError: If the source has no scans, or results of two scans would collide.
    """
    is_inside = source.root in out.parents
    scans = [] if is_inside else source.list_scans(out)
    if is_inside or _is_inside_scans(source, scans, out):
        raise ConfigError(
            f"{out}: expected a directory outside {source.root}, so that no result is read as a "
            "scan; choose another."
        )
    source.check_results(scans, out)
    _check_names(source.root, scans)
    return match_jobs([Job(source, scan, out) for scan in scans], only)


def match_jobs(jobs: Sequence[Job], only: str | None) -> list[Job]:
    """Return the jobs of the scans whose names match a pattern; all if it is None.

    Raises:
        ConfigError: If no name matches.
    """
    selected = [job for job in jobs if only is None or fnmatchcase(job.name, only)]
    if not selected:
        names = list_some([job.name for job in jobs], max_names=5)
        raise ConfigError(f"expected --only to match a scan, got {only!r}; they are {names}.")
    return selected


def _is_inside_scans(source: Source, scans: Sequence[SceneFiles], out: Path) -> bool:
    """Whether results would be read as scans by the next run, also through links."""
    if source.root == out:
        return not source.data.allows_results(source.layout)
    inputs = (Path(os.path.realpath(file)) for scan in scans for file in scan.files)
    return any((out / scan.name).is_relative_to(source.root) for scan in scans) or (
        not source.root.is_relative_to(out) and any(file.is_relative_to(out) for file in inputs)
    )


def _check_names(root: Path, scans: Sequence[SceneFiles]) -> None:
    """Raise FormatError if results would share a folder, or replace files of the batch."""
    batch_files = {normalize_file_name(name): name for name in (REPORT, LOCK)}
    owners: dict[str, str] = {}
    for name in (scan.name for scan in scans):
        key = normalize_file_name(name)
        if name.startswith("/") or ".." in name.split("/"):
            raise FormatError(f"{root}: expected a name inside OUT, got {name!r}; rename it.")
        if key in owners:
            raise FormatError(
                f"{root}: expected distinct scan names, got {owners[key]} and {name}, which are "
                "the same on many file systems; rename one."
            )
        owners[key] = name
        if (first := key.partition("/")[0]) in batch_files:
            raise FormatError(
                f"{root}: a scan cannot be named {name}, like OUT/{batch_files[first]}; rename it."
            )


def make_plan(
    jobs: Sequence[Job],
    *,
    force: bool = False,
    threads: int = 1,
    on_scan: Callable[[], object] = lambda: None,
) -> Plan:
    """Determine the scans to convert, each with its reason.

    Each of ``threads`` checks one scan at a time, then calls ``on_scan``. ``force`` selects all.
    """

    def check(job: Job) -> str:
        reason = "forced" if force else reason_to_convert(job)
        on_scan()
        return reason

    with ThreadPoolExecutor(threads) as pool:
        reasons = list(pool.map(check, jobs))
    named = {job.name: reason for job, reason in zip(jobs, reasons, strict=True) if reason}
    return Plan(tuple(jobs), named)


def check_free_space(plan: Plan) -> None:
    """Raise FormatError if the disk has too little space for the estimated results."""
    if num_scans := len(plan.to_convert):
        repair = "convert fewer with --only"
        check_space(plan.jobs[0].out, plan.num_bytes, f"{num_scans:,} scans", repair=repair)


@dataclass(frozen=True)
class BatchReport:
    """Results of all scans of a batch.

    Attributes:
        scans: Report of each scan, in natural order.
        started: Start time, in seconds since 1970.
        seconds: Duration.
        engine: Name of the engine.
        workers: Maximum number of concurrent scans; None if the engine decides.
        interrupted: Whether it was stopped by Ctrl-C or SIGTERM.
        root: The directory of the data set.
    """

    scans: tuple[TaskReport, ...]
    started: float
    seconds: float
    engine: str
    workers: int | None
    interrupted: bool = False
    root: str = ""

    @property
    def disk_full(self) -> bool:
        """Whether the batch stopped because the disk is full."""
        return any(scan.disk_full for scan in self.scans)

    def with_status(self, status: str) -> list[TaskReport]:
        """Return the reports with the given status."""
        return [scan for scan in self.scans if scan.status == status]

    @property
    def complete(self) -> list[TaskReport]:
        """Reports of scans with complete results."""
        return [scan for scan in self.scans if scan.status in ("converted", "kept")]

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Total seconds per stage of the scans converted now."""
        total = Counter[str]()
        for scan in self.with_status("converted"):
            total.update(scan.seconds)
        return dict(total)

    @property
    def num_points(self) -> int:
        """Number of points converted now."""
        return sum(scan.num_points for scan in self.with_status("converted"))

    def to_json(self) -> Record:
        """Return the report as JSON values."""
        points, stages = self.num_points, self.stage_seconds
        return {
            "root": self.root,
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self.started)),
            "seconds": self.seconds,
            "engine": self.engine,
            "workers": self.workers,
            "versions": describe_versions(),
            "scans_by_status": {name: len(self.with_status(name)) for name in STATUSES},
            "points": points,
            "points_per_second": points / self.seconds if self.seconds else 0.0,
            "points_per_second_of_a_worker": {
                stage: points / seconds for stage, seconds in stages.items() if seconds
            },
            "stage_seconds": stages,
            "peak_memory": max((scan.peak_memory for scan in self.scans), default=0),
            "scans": [asdict(scan) for scan in self.scans],
        }


def _report_from_record(job: Job) -> TaskReport:
    """Return the report of a scan that is up to date, from its record."""
    record = read_record(job.folder) or {}
    return TaskReport(
        job.name,
        "kept",
        num_points=record.get("points", 0),
        num_regions=record.get("regions", 0),
        files=tuple(record.get("outputs", ())),
        repairs=tuple(map(str, record.get("repairs", ()))),
        warnings=tuple(map(str, record.get("warnings", ()))),
        attempts=0,
    )


def run_plan(
    plan: Plan,
    reports: Reports,
    *,
    engine: str,
    workers: int | None,
    on_report: Callable[[TaskReport | None], None] = lambda report: None,
) -> BatchReport:
    """Collect the reports of an engine that runs a plan.

    A full disk or an interrupt ends the run, because further scans would fail. Complete results are
    kept, and the next run resumes from there. ``engine`` and ``workers`` are only noted;
    ``on_report`` is called with each report.
    """
    started, begin = time.time(), time.perf_counter()
    by_name = {job.name: _report_from_record(job) for job in plan.done}
    interrupted = False
    try:
        with contextlib.closing(reports):
            for report in reports:
                on_report(report)
                if report is not None:
                    by_name[report.name] = report
                    if report.disk_full:
                        break
    except KeyboardInterrupt:
        interrupted = True
    names = [job.name for job in plan.jobs]
    scans = [by_name.get(name, TaskReport(name, "not started", attempts=0)) for name in names]
    seconds = time.perf_counter() - begin
    root = str(plan.jobs[0].source.root)
    return BatchReport(tuple(scans), started, seconds, engine, workers, interrupted, root)


def write_report(out: Path, report: BatchReport, others: Collection[str] = ()) -> None:
    """Write ``report.json`` into the output directory; raise FormatError on failure.

    Failures of ``others``, scans that this run did not select, are kept from the last report.
    """
    record, last = report.to_json(), read_report(out)
    known = [scan for scan in last.get("scans", ()) if scan["name"] in others]
    failed = [scan for scan in known if scan["status"] == "failed"]
    record["scans"] += failed
    record["scans_by_status"]["failed"] += len(failed)
    with atomic_path(out / REPORT, mark=OUTPUT_MARK) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def read_report(out: Path) -> Record:
    """Return the last report of an output directory; empty if there is none, or it is damaged."""
    try:
        report: Any = json.loads((out / REPORT).read_bytes())
    except (OSError, *PARSE_ERRORS):
        return {}
    return report if isinstance(report, dict) else {}


def read_failed(out: Path) -> set[str]:
    """Return the names of the scans that failed when they were last converted.

    Raises:
        ConfigError: If there is no report of a run.
    """
    if "scans" not in (report := read_report(out)):
        raise ConfigError(
            f"{out / REPORT}: expected the report of an earlier run, got none; omit --only-failed."
        )
    return {scan["name"] for scan in report["scans"] if scan["status"] == "failed"}
