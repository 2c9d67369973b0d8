"""What engines do: tasks, and the report of what became of each."""

import os
import platform
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.errors import OUT_OF_MEMORY, PrecisionWarning, TorchrgError
from torchrg.io.files import is_disk_full


class Converted(NamedTuple):
    """What is known of a scan once its results are written; equal runs give equal values.

    Attributes:
        num_points: Number of points, those that are not finite included.
        num_regions: Number of planes.
        files: Names of the files written, in the scan's folder.
        repairs: What was put right in the input, a line each.
        warnings: What a user should know, a line each.
    """

    num_points: int
    num_regions: int
    files: tuple[str, ...]
    repairs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class TaskReport:
    """What became of a task.

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


Reports = Generator[TaskReport | None, None, None]
"""What an engine yields: a report of each task when it ends, None while there is none."""


class Task(Protocol):
    """Work that any process can do: on a scan or a frame.

    It travels to that process, so it holds settings and paths but no open files.
    """

    @property
    def name(self) -> str:
        """What it is called; no other task of a run has the same name."""

    @property
    def memory(self) -> int:
        """Bytes that a process with this task takes at most."""

    @property
    def inputs(self) -> Sequence[Path]:
        """The files that it reads."""

    def run(self) -> TaskReport:
        """Do the work; what goes wrong with it is in the report and never raised."""

    def clean(self) -> None:
        """Remove what a process that was killed at this task left half-written."""


def report_on(name: str, convert: Callable[[Callable[[str], None]], Converted]) -> TaskReport:
    """Do the work of a task; what goes wrong with it is in the report and never raised.

    ``convert`` is called with a function that it calls with the name of each stage that begins.
    """
    clock = _StageClock()
    outcome: dict[str, Any]
    reset_peak_memory()
    try:
        with warnings.catch_warnings():
            # It is among the warnings of the report.
            warnings.simplefilter("ignore", PrecisionWarning)
            outcome = {"status": "converted", **convert(clock.begin)._asdict()}
        del outcome["files"]
    except Exception as error:  # noqa: BLE001 One task must never end the others.
        is_foreseen = isinstance(error, TorchrgError | OSError) or _is_out_of_memory(error)
        outcome = {
            "status": "failed",
            "reason": _reason(error),
            "details": "" if is_foreseen else traceback.format_exc(),
            "disk_full": is_disk_full(error),
        }
    clock.begin("done")
    return TaskReport(
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
        return OUT_OF_MEMORY
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}."
    text = " ".join(str(error).split())
    return text if isinstance(error, TorchrgError) else f"{type(error).__name__}: {text}"


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether memory could not be had; torch says so by a RuntimeError."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
    )
