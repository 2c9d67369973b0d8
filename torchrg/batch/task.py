"""Task reports: status, stage times, memory and errors."""

import os
import platform
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from torchrg._limits import system_limit
from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.errors import DepthWarning, PrecisionWarning, TorchrgError
from torchrg.io.files import is_disk_full

Status = Literal["converted", "kept", "failed", "not started"]
"""Final states of a task: done now, done by an earlier run, or not done."""
STATUSES: tuple[Status, ...] = get_args(Status)
Begin = Callable[[str], None]
"""Called with the name of each stage when it starts."""


@dataclass(frozen=True)
class TaskReport:
    """Result of a task.

    Attributes:
        name: Name of the task.
        status: ``converted`` now, ``kept`` from an earlier run, ``failed``, or ``not started``.
        num_points: Number of points, including non-finite ones.
        num_regions: Number of planes.
        files: Names of the files written now, in the folder of the scan.
        repairs: Input repairs, one per line.
        warnings: Notes for the user, one per line.
        measured: Measured properties of the cloud, and the settings derived from them.
        seconds: Time per stage, by name.
        peak_memory: Largest resident memory of the process, in bytes.
        reason: One-line reason of a failure.
        details: Traceback of an unexpected failure.
        disk_full: Whether the task failed because the disk is full.
        host: Machine and process that ran the task.
        attempts: Number of attempts.
    """

    name: str
    status: Status
    num_points: int = 0
    num_regions: int = 0
    files: tuple[str, ...] = ()
    repairs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    measured: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory: int = 0
    reason: str = ""
    details: str = ""
    disk_full: bool = False
    host: str = ""
    attempts: int = 1


Reports = Generator[TaskReport | None, None, None]
"""Reports yielded by an engine: one per finished task, or None while waiting."""


def report_on(name: str, work: Callable[[Begin], TaskReport]) -> TaskReport:
    """Run a task; errors are reported, never raised."""
    clock = _StageClock()
    reset_peak_memory()
    try:
        with warnings.catch_warnings():
            # These warnings are in the report, or were printed before the first task.
            warnings.simplefilter("ignore", PrecisionWarning)
            warnings.simplefilter("ignore", DepthWarning)
            report = work(clock.begin)
    except Exception as error:  # noqa: BLE001 A failing task must not stop other tasks.
        is_expected = isinstance(error, TorchrgError | OSError) or system_limit(error)
        report = TaskReport(
            name,
            "failed",
            reason=_reason(error),
            details="" if is_expected else traceback.format_exc(),
            disk_full=is_disk_full(error),
        )
    clock.begin("done")
    host = f"{platform.node()} ({os.getpid()})"
    return replace(report, seconds=clock.seconds, peak_memory=peak_memory(), host=host)


@contextmanager
def collecting_notes() -> Iterator[list[str]]:
    """Collect warnings as notes for a report, one per line."""
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield notes
        notes += dict.fromkeys(str(warning.message) for warning in caught)


class _StageClock:
    """Stopwatch for stages; starting a stage ends the previous one."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._start = "done", time.perf_counter()

    def begin(self, stage: str) -> None:
        """Start a stage; ``"done"`` stops the clock."""
        now = time.perf_counter()
        if self._stage != "done":
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._start
        self._stage, self._start = stage, now


def _reason(error: Exception) -> str:
    """Format an error as one line, with the file name if possible."""
    if limit := system_limit(error):
        return limit
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}."
    text = " ".join(str(error).split())
    return text if isinstance(error, TorchrgError) else f"{type(error).__name__}: {text}"
