"""Run a plan on an engine, and collect what becomes of each scan."""

import contextlib
import json
import os
import platform
import time
from collections.abc import Callable, Generator
from multiprocessing import reduction
from pathlib import Path
from typing import Any, NamedTuple

from torchrg.batch.convert import ScanReport
from torchrg.batch.plan import Plan
from torchrg.batch.report import BatchReport, kept_report
from torchrg.errors import FormatError
from torchrg.io import atomic_path

REPORT = "report.json"
"""Name of the report in the output directory."""
LOCK = ".torchrg.lock"
"""Name of the file that is locked. It stays when the lock goes."""
_PATIENCE_SECONDS = 5.0
"""How long a lock that is held is waited for: workers of a command that was killed end by then."""
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
    whole = BatchReport(tuple(scans), started, seconds, engine, workers)
    return Ending(whole, interrupted, disk_full)


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

    Raises:
        FormatError: If another process holds the lock.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with DirectoryLock(Path(folder)):
        ...         print("nobody else writes here")
        nobody else writes here
    """

    def __init__(self, folder: Path, *, patience: float = _PATIENCE_SECONDS) -> None:
        import fcntl

        self.descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        end = time.monotonic() + patience
        while True:
            try:
                fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= end:
                    holder = os.pread(self.descriptor, 200, 0).decode(errors="replace").strip()
                    os.close(self.descriptor)
                    raise FormatError(
                        f"{folder}: another torchrg convert ({holder or 'unknown'}) writes here; "
                        "wait for it, stop it, or choose another directory."
                    ) from None
                time.sleep(0.05)
        os.ftruncate(self.descriptor, 0)
        os.pwrite(self.descriptor, f"process {os.getpid()} on {platform.node()}".encode(), 0)

    def __enter__(self) -> "DirectoryLock":
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self.descriptor)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _hold, (reduction.DupFd(self.descriptor),)


def _hold(duplicate: Any) -> DirectoryLock:  # noqa: ANN401
    """Return the lock in a process that was started with it."""
    lock = DirectoryLock.__new__(DirectoryLock)
    lock.descriptor = duplicate.detach()
    return lock
