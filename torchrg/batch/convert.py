"""Convert one scan, in whatever process: the job function of every engine."""

import contextlib
import errno
import os
import platform
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.batch.records import (
    RECORD,
    check_record,
    describe_job,
    is_unchanged,
    read_record,
    write_record,
)
from torchrg.batch.scans import Converted, Job
from torchrg.errors import TorchrgError
from torchrg.io.files import check_place, marked_parts, sync_folder

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True)
class ScanReport:
    """What became of one scan.

    Attributes:
        name: Its name.
        status: ``converted`` now, ``kept`` from an earlier run, ``failed``, or ``not started``.
        num_points: Points read.
        num_regions: Planes found.
        seconds: Time of each stage by its name.
        peak_memory: Largest resident memory of the process, in bytes.
        repairs: What was put right in the input.
        warnings: What a user should know.
        reason: Why it failed, a line.
        details: The traceback of a failure that was not foreseen.
        disk_full: Whether it failed because there is no space left.
        host: Machine and process that did it.
        attempts: How often it was tried, as far as the engine tells: Ray does not.
    """

    name: str
    status: Literal["converted", "kept", "failed", "not started"]
    num_points: int = 0
    num_regions: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory: int = 0
    repairs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    reason: str = ""
    details: str = ""
    disk_full: bool = False
    host: str = ""
    attempts: int = 1


def convert_scan(job: Job) -> ScanReport:
    """Convert one scan; what goes wrong with it is in the report and never raised.

    The record of an earlier run is removed first, and the new one written last: whoever finds a
    record finds complete files.
    """

    def convert(begin: Callable[[str], None]) -> Converted:
        begin("hash")
        description = describe_job(job)
        job.folder.mkdir(parents=True, exist_ok=True)
        for folder in (job.folder, *job.folder.parents):
            sync_folder(folder.parent)
            if folder == job.out:
                break
        check_place(job.folder / RECORD)
        check_record(job)
        job.remove_leftovers()
        earlier = read_record(job) or {"outputs": {}}
        (job.folder / RECORD).unlink(missing_ok=True)
        with marked_parts(job.mark):
            converted = job.source.convert(job.scan, job.folder, begin)
            begin("record")
            for name in earlier["outputs"].keys() - set(converted.files):
                if is_unchanged(job, name, earlier["outputs"][name]):
                    (job.folder / name).unlink()
            write_record(job, description, converted)
        return converted

    is_new = not job.folder.exists()
    report = report_on(job.scan.name, convert)
    if report.status == "failed" and is_new:
        with contextlib.suppress(OSError):
            job.folder.rmdir()  # If it is empty.
    return report


def report_on(name: str, convert: Callable[[Callable[[str], None]], Converted]) -> ScanReport:
    """Convert a scan of some name; what goes wrong with it is in the report and never raised.

    ``convert`` is called with a function that it calls with the name of each stage that begins.
    """
    clock = _StageClock()
    outcome: dict[str, Any]
    reset_peak_memory()
    try:
        outcome = {"status": "converted", **convert(clock.begin)._asdict()}
        del outcome["files"]
    except Exception as error:  # noqa: BLE001 One scan must never end the others.
        is_foreseen = isinstance(error, TorchrgError | OSError) or _is_out_of_memory(error)
        outcome = {
            "status": "failed",
            "reason": _reason(error),
            "details": "" if is_foreseen else traceback.format_exc(),
            "disk_full": _is_disk_full(error),
        }
    clock.begin("done")
    return ScanReport(
        name,
        seconds=clock.seconds,
        peak_memory=peak_memory(),
        host=f"{platform.node()} ({os.getpid()})",
        **outcome,
    )


class _StageClock:
    """Seconds of each stage; one that begins ends the one before it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._start = "done", time.perf_counter()

    def begin(self, stage: str) -> None:
        """Begin a stage; ``"done"`` is none."""
        now = time.perf_counter()
        if self._stage != "done":
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._start
        self._stage, self._start = stage, now


def _reason(error: Exception) -> str:
    """Return an error as one line that names the file where it can."""
    if _is_out_of_memory(error):
        return "out of memory; lower --chunk-size, or use a machine with more."
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}."
    text = " ".join(str(error).split())
    return text if isinstance(error, TorchrgError) else f"{type(error).__name__}: {text}"


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether memory could not be had; torch says so by a RuntimeError."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
    )


def _is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error, or what caused it, is a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            return True
        error = error.__cause__
    return False
