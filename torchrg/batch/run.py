"""A batch: its plan, checked before the first scan, its run on an engine, and its report."""

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import filelock

from torchrg.batch.records import Record, describe_versions, read_record, reason_to_convert
from torchrg.batch.scans import Job, Source
from torchrg.batch.task import STATUSES, Reports, TaskReport
from torchrg.datasets.folder import SceneFiles
from torchrg.errors import ConfigError, FormatError
from torchrg.io import atomic_path
from torchrg.io.files import check_space, folded_name, mark_of, marked_parts

REPORT = "report.json"
"""Name of the report in the output directory."""
LOCK = ".torchrg.lock"
"""Name of the file in the output directory that is locked; it stays there, empty."""
DATA_SETS = ".torchrg.scans.json"
"""Name of the file in the output directory that lists the scans of its data sets; see
:mod:`torchrg.batch.stale`."""
_BYTES_PER_SCAN = 32_768
"""Space that files of a scan take beyond their content: six to eight, half a block of 4 KiB lost in
each, and its tables."""
PATIENCE_SECONDS = 5.0
"""Seconds to wait for a lock: a command that is interrupted ends its workers by then."""


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Have the right to write into an existing directory, which one command has at a time.

    The lock is the operating system's, which goes with the process however that ends; the workers
    of a command end with it. Over a network it holds where the file system passes it on: see the
    package filelock.

    Raises:
        FormatError: If another command has the right, or the file of the lock cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, lock_folder(Path(folder)):
        ...     print("nobody else writes here")
        nobody else writes here
    """
    lock = filelock.FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=PATIENCE_SECONDS)
    except filelock.Timeout:
        raise FormatError(
            f"{folder}: another torchrg command writes here; wait for it, stop it, or choose "
            "another directory."
        ) from None
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FormatError(f"{folder / LOCK}: cannot be locked: {reason}.") from error
    try:
        yield
    finally:
        lock.release()


class Plan(NamedTuple):
    """The scans of a batch in natural order, and why each that is not done is to be converted."""

    jobs: tuple[Job, ...]
    reasons: dict[str, str]

    @property
    def to_convert(self) -> list[Job]:
        """The jobs that are not done."""
        return [job for job in self.jobs if job.name in self.reasons]

    @property
    def done(self) -> list[Job]:
        """The jobs that are done."""
        return [job for job in self.jobs if job.name not in self.reasons]

    @property
    def num_bytes(self) -> int:
        """The disk space that the jobs that are not done take, by the estimates of the scans."""
        return sum(
            _BYTES_PER_SCAN + job.source.bytes_per_point * job.scan.num_points
            for job in self.to_convert
        )


def list_jobs(source: Source, out: Path, *, only: str | None = None) -> list[Job]:
    """Return a job for each scan of a source whose results go to ``out``, in natural order.

    With ``only``, for those whose names match a pattern as in a shell; ``*`` matches slashes too.

    Raises:
        ConfigError: If no name matches the pattern, or results would go in among the scans.
        FormatError: If the source has no scans, or the results of one have no place of their own.
    """
    is_among = source.root in out.parents
    scans = [] if is_among else source.list_scans(out)
    if is_among or _is_among_scans(source, scans, out):
        raise ConfigError(
            f"{out}: expected a directory outside {source.root}, so that no result is read as a "
            "scan; choose another."
        )
    source.check_results(scans, out)
    _check_names(source.root, scans)
    return match_jobs([Job(source, scan, out) for scan in scans], only)


def match_jobs(jobs: Sequence[Job], only: str | None) -> list[Job]:
    """Return the jobs of the scans whose names match a pattern, all without one.

    Raises:
        ConfigError: If no name matches.
    """
    chosen = [job for job in jobs if only is None or fnmatchcase(job.name, only)]
    if not chosen:
        names = ", ".join(job.name for job in jobs[:5])
        more = f" and {len(jobs) - 5:,} more" if len(jobs) > 5 else ""
        raise ConfigError(f"expected --only to match a scan, got {only!r}; they are {names}{more}.")
    return chosen


def _is_among_scans(source: Source, scans: Sequence[SceneFiles], out: Path) -> bool:
    """Whether results would be read as scans the next time, also through links."""
    if source.root == out:
        return False
    inputs = (Path(os.path.realpath(file)) for scan in scans for file in scan.files)
    return any((out / scan.name).is_relative_to(source.root) for scan in scans) or (
        not source.root.is_relative_to(out) and any(file.is_relative_to(out) for file in inputs)
    )


def _check_names(root: Path, scans: Sequence[SceneFiles]) -> None:
    """Refuse scans whose results would share a folder, or replace files of the batch."""
    batch_files = {folded_name(name): name for name in (REPORT, LOCK, DATA_SETS)}
    taken: dict[str, str] = {}
    for name in (scan.name for scan in scans):
        key = folded_name(name)
        if name.startswith("/") or ".." in name.split("/"):
            raise FormatError(
                f"{root}: expected names of scans below a folder, got {name!r}; rename it."
            )
        if key in taken:
            raise FormatError(
                f"{root}: expected a folder for each scan, got one for {taken[key]} and {name}, "
                "which many file systems take for the same; rename one."
            )
        taken[key] = name
        if (first := key.partition("/")[0]) in batch_files:
            raise FormatError(
                f"{root}: expected no scan called {name}, as OUT/{batch_files[first]} is a file "
                "of the command; rename it."
            )


def make_plan(
    jobs: Sequence[Job],
    *,
    force: bool = False,
    threads: int = 1,
    on_scan: Callable[[], object] = lambda: None,
) -> Plan:
    """Find out which scans are to be converted, by :func:`reason_to_convert`.

    So many ``threads`` look at a scan each; ``on_scan`` is called when one has been looked at. With
    ``force``, those that are done are converted too.
    """

    def look(job: Job) -> str:
        reason = "forced" if force else reason_to_convert(job)
        on_scan()
        return reason

    with ThreadPoolExecutor(threads) as pool:
        reasons = list(pool.map(look, jobs))
    named = {job.name: reason for job, reason in zip(jobs, reasons, strict=True) if reason}
    return Plan(tuple(jobs), named)


def check_room(plan: Plan) -> None:
    """Raise FormatError if the disk has no room for the results, by the estimates of the scans."""
    if num_scans := len(plan.to_convert):
        repair = "convert fewer with --only"
        check_space(plan.jobs[0].out, plan.num_bytes, f"{num_scans:,} scans", repair=repair)


@dataclass(frozen=True)
class BatchReport:
    """What became of all scans of a batch.

    Attributes:
        scans: A report of each, in natural order.
        started: When, in seconds since 1970.
        seconds: How long it took.
        engine: The name of the engine.
        workers: Most scans at a time; None if the engine decides.
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
        return [scan for scan in self.scans if scan.status in ("converted", "kept")]

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Time of each stage, of all scans converted now."""
        total: dict[str, float] = {}
        for scan in self.with_status("converted"):
            for stage, seconds in scan.seconds.items():
                total[stage] = total.get(stage, 0.0) + seconds
        return total

    @property
    def num_points(self) -> int:
        """Points converted now."""
        return sum(scan.num_points for scan in self.with_status("converted"))

    def to_json(self) -> Record:
        """Return the report as JSON can hold it."""
        points, stages = self.num_points, self.stage_seconds
        return {
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


def _kept_report(job: Job) -> TaskReport:
    """Return the report of a task that an earlier run has done, from its record."""
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
    """Take the reports of an engine that converts a plan, until all are there.

    A full disk ends it, as every further scan would fail after its work; so does an interrupt. What
    is complete then stays, and the next run goes on from there. ``engine`` and ``workers`` are
    noted; ``on_report`` is called with each report.
    """
    started, begin = time.time(), time.perf_counter()
    by_name = {job.name: _kept_report(job) for job in plan.done}
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
    return BatchReport(tuple(scans), started, seconds, engine, workers, interrupted)


def write_report(out: Path, report: BatchReport) -> None:
    """Write ``report.json`` into the output directory; raise FormatError if it cannot be."""
    with marked_parts(mark_of(REPORT)), atomic_path(out / REPORT) as beside:
        beside.write_text(json.dumps(report.to_json(), indent=1) + "\n", encoding="utf-8")
