"""A batch: its plan, checked before the first scan, its run on an engine, and its lock."""

import contextlib
import json
import os
import platform
import re
import shutil
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatchcase
from multiprocessing import reduction
from pathlib import Path
from typing import Any, NamedTuple

from torchrg.batch.convert import ScanReport
from torchrg.batch.records import reason_to_convert
from torchrg.batch.report import BatchReport, format_table, kept_report
from torchrg.batch.scans import Job, Scan, Source
from torchrg.datasets.folder import folded_name
from torchrg.errors import ConfigError, FormatError
from torchrg.io import atomic_path
from torchrg.io.files import make_mark, sync_folder

REPORT = "report.json"
"""Name of the report in the output directory."""
LOCK = ".torchrg.lock"
"""Name of the file that is locked. It stays when the lock goes."""
_HELD = re.compile(r"(?:([0-9a-f]{16}) )?(process \d+ on .*)?", re.DOTALL)
"""What is in it: a mark, which older versions did not write, and who holds it or did last."""
_PATIENCE_SECONDS = 5.0
"""How long a lock that is held is waited for: workers of a command that was killed end by then."""
Reports = Generator[ScanReport | None, None, None]


class Plan(NamedTuple):
    """The scans of a batch in natural order, and why each is to be converted, by name.

    A scan that is done is not among the reasons.
    """

    jobs: tuple[Job, ...]
    reasons: dict[str, str]

    @property
    def to_convert(self) -> list[Job]:
        """The jobs that are not done."""
        return [job for job in self.jobs if job.scan.name in self.reasons]

    @property
    def done(self) -> list[Job]:
        """The jobs that are."""
        return [job for job in self.jobs if job.scan.name not in self.reasons]


def list_jobs(source: Source, out: Path, *, only: str | None = None) -> list[Job]:
    """Return a job for each scan of a source, in natural order.

    Args:
        source: The data set.
        out: Where results go.
        only: Pattern of the names to convert, as in a shell; ``*`` matches slashes too.

    Raises:
        ConfigError: If no name matches the pattern, or results would go in among the scans.
        FormatError: If the source has no scans, or the results of one have no place of their own.
    """
    is_among = source.root in out.parents or (source.root == out and not source.in_place)
    scans = [] if is_among else source.list_scans()
    if is_among or _is_among_scans(source, scans, out):
        raise ConfigError(
            f"{out}: expected a directory outside {source.root}, so that no result is read as a "
            "scan; choose another."
        )
    _check_names(source.root, scans)
    chosen = [scan for scan in scans if only is None or fnmatchcase(scan.name, only)]
    if not chosen:
        names = ", ".join(scan.name for scan in scans[:5])
        more = f" and {len(scans) - 5:,} more" if len(scans) > 5 else ""
        raise ConfigError(f"expected --only to match a scan, got {only!r}; they are {names}{more}.")
    return [Job(source, scan, out) for scan in chosen]


def _is_among_scans(source: Source, scans: Sequence[Scan], out: Path) -> bool:
    """Whether results would be read as scans the next time, also through links."""
    if source.root == out:
        return False
    inputs = (Path(os.path.realpath(file)) for scan in scans for file in scan.inputs)
    return any((out / scan.name).is_relative_to(source.root) for scan in scans) or (
        not source.root.is_relative_to(out) and any(file.is_relative_to(out) for file in inputs)
    )


def _check_names(root: Path, scans: Sequence[Scan]) -> None:
    """Refuse scans whose results would share a folder, or take the place of the batch's own files.

    See :func:`torchrg.datasets.folder.folded_name`.
    """
    batch_files = {folded_name(name): name for name in (REPORT, LOCK)}
    taken: dict[str, str] = {}
    for name in (scan.name for scan in scans):
        key = folded_name(name)
        if name.startswith("/") or ".." in name.split("/"):
            raise FormatError(f"{root}: expected names of scans below a folder, got {name!r}.")
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
    jobs: list[Job],
    *,
    force: bool = False,
    threads: int = 1,
    on_scan: Callable[[], object] = lambda: None,
) -> Plan:
    """Find out which scans are to be converted.

    A scan is done if its record says what would be done now, from the same bytes, and its results
    have not changed since: files are read to see, those of scans without a record are not.

    So many ``threads`` look at a scan each; ``on_scan`` is called when one has been looked at. With
    ``force``, those that are done are converted too.
    """

    def look(job: Job) -> str:
        reason = "forced" if force else reason_to_convert(job)
        on_scan()
        return reason

    with ThreadPoolExecutor(threads) as pool:
        reasons = list(pool.map(look, jobs))
    named = {job.scan.name: reason for job, reason in zip(jobs, reasons, strict=True) if reason}
    return Plan(tuple(jobs), named)


def check_space(plan: Plan) -> None:
    """Raise FormatError if the disk has no room for the results, by the estimates of the scans."""
    if not plan.to_convert:
        return
    source, out = plan.jobs[0].source, plan.jobs[0].out
    needed = source.bytes_per_point * sum(job.scan.num_points for job in plan.to_convert)
    existing = next(place for place in (out, *out.absolute().parents) if place.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise FormatError(
            f"{out}: expected about {needed / 1e6:,.1f} MB of free disk for "
            f"{len(plan.to_convert):,} scans, got {free / 1e6:,.1f} MB; make room, choose another "
            "directory, or convert fewer with --only."
        )


def format_plan(plan: Plan) -> str:
    """Return what a plan would do: a row for each scan that is to be converted."""
    rows = [
        [job.scan.name, plan.reasons[job.scan.name], f"{job.scan.num_points:,}"]
        for job in plan.to_convert
    ]
    sums = f"{len(plan.to_convert):,} scans to convert, {len(plan.done):,} done"
    return "\n".join([format_table(["scan", "why", "points (about)"], rows), sums])


def run_plan(
    plan: Plan,
    reports: Reports,
    *,
    engine: str,
    workers: int | None,
    on_report: Callable[[ScanReport | None], None] = lambda report: None,
) -> BatchReport:
    """Convert the scans of a plan that are not done.

    A full disk ends the batch, as every further scan would fail after its work; so does an
    interrupt. What is complete stays, and the next run goes on from there.

    ``reports`` are those of the engine at work, as scans end, None in between; ``on_report`` is
    called with each. ``engine`` and ``workers`` are noted in the report.
    """
    started, begin = time.time(), time.perf_counter()
    found = {job.scan.name: kept_report(job) for job in plan.done}
    interrupted = False
    try:
        with contextlib.closing(reports):
            for report in reports:
                on_report(report)
                if report is not None:
                    found[report.name] = report
                    if report.disk_full:
                        break
    except KeyboardInterrupt:
        interrupted = True
    scans = [
        found.get(job.scan.name, ScanReport(job.scan.name, "not started", attempts=0))
        for job in plan.jobs
    ]
    seconds = time.perf_counter() - begin
    return BatchReport(tuple(scans), started, seconds, engine, workers, interrupted)


def write_report(out: Path, report: BatchReport) -> None:
    """Write ``report.json`` into the output directory; raise FormatError if it cannot be."""
    with atomic_path(out / REPORT) as beside:
        beside.write_text(json.dumps(report.to_json(), indent=1) + "\n", encoding="utf-8")


class DirectoryLock:
    """The right to write into a directory, held until every process that has this object ends.

    The lock is the operating system's own (``flock``) and goes with its last holder, however that
    one ends. It travels to the worker processes, so that what a killed command leaves running
    keeps the next one out.

    Args:
        folder: The directory; it exists.
        patience: Seconds to wait for another holder.

    Attributes:
        mark: Of the names that holders of this lock write under before files have their own, the
            same for all of them; see :func:`torchrg.io.files.marked_parts`.

    Raises:
        FormatError: If another process holds the lock, or the file of the lock is another one.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with DirectoryLock(Path(folder)):
        ...         print("nobody else writes here")
        nobody else writes here
    """

    def __init__(self, folder: Path, *, patience: float = _PATIENCE_SECONDS) -> None:
        path = folder / LOCK
        try:
            self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        except OSError as error:
            raise FormatError(f"{path}: cannot be written: {error.strerror}.") from error
        end = time.monotonic() + patience
        try:
            self._read(path)
            while not self._take():
                if time.monotonic() >= end:
                    _, holder = self._read(path)
                    raise FormatError(
                        f"{folder}: another torchrg command ({holder or 'unknown'}) writes here; "
                        "wait for it, stop it, or choose another directory."
                    )
                time.sleep(0.05)
        except FormatError:
            os.close(self.descriptor)
            raise
        mark, _ = self._read(path)
        self.mark = mark or make_mark()
        text = f"{self.mark} process {os.getpid()} on {platform.node()}".encode()
        os.pwrite(self.descriptor, text, 0)
        os.ftruncate(self.descriptor, len(text))
        os.fsync(self.descriptor)
        sync_folder(folder)

    def _read(self, path: Path) -> tuple[str | None, str | None]:
        """Return the mark in the file of the lock, and who holds the lock or did last."""
        text = os.pread(self.descriptor, 400, 0).decode(errors="replace").rstrip("\0")
        held = _HELD.fullmatch(text)
        if held is None:
            raise FormatError(
                f"{path}: is in the way, it is no lock of torchrg; move it away, or choose another "
                "directory."
            )
        return held[1], held[2]

    def _take(self) -> bool:
        """Return whether the lock could be had."""
        import fcntl

        try:
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def __enter__(self) -> "DirectoryLock":
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self.descriptor)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _hold, (reduction.DupFd(self.descriptor), self.mark)


def _hold(duplicate: Any, mark: str) -> DirectoryLock:  # noqa: ANN401
    """Return the lock in a process that was started with it."""
    lock = DirectoryLock.__new__(DirectoryLock)
    lock.descriptor, lock.mark = duplicate.detach(), mark
    return lock
