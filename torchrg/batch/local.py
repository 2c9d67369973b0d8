"""Local engine: single-threaded worker processes within a memory limit."""

import contextlib
import gc
import os
import signal
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from multiprocessing import connection, get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkContext, SpawnContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Thread

from torchrg.batch.scans import Job, convert_scan
from torchrg.batch.task import Reports, TaskReport

__all__ = ["run_local"]
__dir__ = __all__.copy

POLL_SECONDS = 0.5
"""Interval at which an engine yields None, so that progress is shown and Ctrl-C is handled."""
CHILD_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS"), "1"
) | {"PYTHONSAFEPATH": "1"}
"""Environment of all child processes, read by Python and its libraries at startup: one thread, and
no imports from the working directory."""
_STDERR = 2
"""File descriptor of standard error."""
_NUM_LOOKS = 100
"""Maximum number of milliseconds in which an ended thread leaves the list of the system."""
_MAX_CAUSE_LENGTH = 300
"""Maximum characters of a worker's last message in a report; a few lines of a terminal."""


def run_local(jobs: Sequence[Job], *, workers: int, memory_limit: int) -> Reports:
    """Convert scans in local processes, largest memory first.

    A scan starts when a worker is free and all running scans fit the limit; a scan above the limit
    runs alone. If a worker dies, its scan is retried once, alone, after all others.

    Args:
        jobs: The scans to convert.
        workers: Maximum number of processes.
        memory_limit: Bytes that all running scans may use.

    Yields:
        The report of each finished scan, and None while there is none, so that the caller can show
        progress. Closing the iterator stops the workers.
    """
    waiting = sorted(jobs, key=lambda job: -job.memory)
    retries: list[Job] = []
    idle: list[_Worker] = []
    busy: dict[Connection, _Worker] = {}

    def start(job: Job, *, attempt: int) -> None:
        worker = idle.pop() if idle else _Worker()
        busy[worker.pipe] = worker
        worker.begin(job, attempt=attempt)

    try:
        while waiting or retries or busy:
            while len(busy) < workers:
                free = memory_limit - sum(worker.job.memory for worker in busy.values())
                candidates = (job for job in waiting if job.memory <= free or not busy)
                job = next(candidates, None)
                if job is None:
                    break
                waiting.remove(job)
                start(job, attempt=1)
            if not busy:
                start(retries.pop(0), attempt=2)
            ready = connection.wait(busy, timeout=POLL_SECONDS)
            if not ready:
                yield None
            for worker in [worker for pipe, worker in busy.items() if pipe in ready]:
                del busy[worker.pipe]
                report = worker.collect()
                if report is not None:
                    idle.append(worker)
                    yield report
                elif worker.attempt == 1:
                    retries.append(worker.job)
                else:
                    yield worker.death_report()
    finally:
        for worker in [*idle, *busy.values()]:
            worker.stop()


class _Worker:
    """Process that converts scans one after another, and the pipe to it."""

    job: Job
    attempt: int

    def __init__(self) -> None:
        context = _context()
        self.pipe, child_pipe = context.Pipe()
        # Errors before the first scan go to a report, not as a traceback to the terminal.
        self.errors, errors = os.pipe()
        try:
            with in_root_directory(), _environment(), _block_sigint(), _redirect(errors) as stderr:
                self.process = context.Process(target=_serve, args=(child_pipe, stderr))
                self.process.start()
        except BlockingIOError as error:
            raise RuntimeError("can't start new process") from error
        os.close(errors)
        child_pipe.close()

    def begin(self, job: Job, *, attempt: int) -> None:
        """Send a scan to the process."""
        self.job, self.attempt = job, attempt
        # A dead worker is detected when its report is collected.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send(job)

    def collect(self) -> TaskReport | None:
        """Return the available report, or None if the process died."""
        try:
            report: TaskReport = self.pipe.recv()
        except (EOFError, OSError):
            self.stop()
            return None
        return replace(report, attempts=self.attempt)

    def death_report(self) -> TaskReport:
        """Return the report of a scan whose worker died twice."""
        code = self.process.exitcode or 0
        end = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        reason = f"its process {end}, twice (second attempt ran alone)"
        if cause := self._cause():
            reason = f"{reason}: {cause}"
        if code == -signal.SIGKILL or cause.startswith("MemoryError"):
            reason = f"{reason}; it may have run out of memory"
        return TaskReport(self.job.name, "failed", reason=reason, attempts=self.attempt)

    def _cause(self) -> str:
        """Return the last message of the process before its first scan, in one line."""
        lines = self.stderr_bytes.decode(errors="replace").splitlines()
        # Continuation lines of a message are indented; the traceback precedes it.
        starts = [number for number, line in enumerate(lines) if line[:1].strip()]
        return " ".join(" ".join(lines[starts[-1] :]).split())[:_MAX_CAUSE_LENGTH] if starts else ""

    def stop(self) -> None:
        """End the process, and remove its temporary files."""
        self.process.terminate()
        self.process.join(timeout=5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()
        os.set_blocking(self.errors, False)
        with os.fdopen(self.errors, "rb") as errors:
            self.stderr_bytes = errors.read() or b""
        if hasattr(self, "job"):
            self.job.clean()


def _context() -> ForkContext | SpawnContext:
    """Return how workers start: forked, with all modules loaded, if no other thread is running.

    A forked process lacks the other threads and would wait for their locks. A thread that has just
    ended is listed for a moment. System libraries of macOS do not work after a fork.
    """
    for _ in range(_NUM_LOOKS if sys.platform == "linux" else 0):
        if len(list(Path("/proc/self/task").iterdir())) == 1:
            import_module("scipy.spatial")  # Once for all workers.
            return get_context("fork")
        time.sleep(0.001)
    return get_context("spawn")


def _serve(pipe: Connection, stderr: Connection | None) -> None:
    """Convert scans in a new process; from the first scan on, errors go to ``stderr``."""
    parent = parent_process()
    kept = {pipe.fileno(), *([] if stderr is None else [stderr.fileno()])}
    if sys.platform == "linux":
        _close_others(kept | ({int(parent.sentinel)} if parent is not None else set()))
    if parent is not None:
        Thread(target=_end_with, args=(parent,), daemon=True).start()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    gc.freeze()  # Loaded modules are not garbage.
    gc.enable()
    _convert_scans(pipe, stderr)


def _close_others(kept: Collection[int]) -> None:
    """Close all file descriptors above standard error except ``kept``.

    A forked process inherits the lock of the output directory and the pipes of other workers, which
    would outlive the parent process.
    """
    for descriptor in [int(path.name) for path in Path("/proc/self/fd").iterdir()]:
        if descriptor > _STDERR and descriptor not in kept:
            with contextlib.suppress(OSError):  # The one that lists the directory.
                os.close(descriptor)


def _convert_scans(pipe: Connection, stderr: Connection | None) -> None:
    """Convert scans until the pipe closes."""
    import torch

    torch.set_num_threads(1)
    # The pipe fails once the parent process is gone.
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            job = pipe.recv()
            if stderr is not None:
                os.dup2(stderr.fileno(), _STDERR)
                stderr.close()
                stderr = None
            pipe.send(convert_scan(job))


def _end_with(parent: BaseProcess) -> None:
    """End this process as soon as its parent is gone."""
    parent.join()
    os._exit(1)


@contextlib.contextmanager
def in_root_directory() -> Iterator[None]:
    """Start processes in an empty directory, because Python 3.10 and libraries import from there.

    Their paths must be absolute.
    """
    folder = Path.cwd()
    os.chdir("/")
    try:
        yield
    finally:
        os.chdir(folder)


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """Set the environment of child processes while they start."""
    original = dict(os.environ)
    os.environ.update(CHILD_ENVIRONMENT)
    try:
        yield
    finally:
        for name in CHILD_ENVIRONMENT.keys() - original.keys():
            del os.environ[name]
        os.environ.update(original)


@contextlib.contextmanager
def _block_sigint() -> Iterator[None]:
    """Block Ctrl-C in processes that start here; the parent handles it and stops them."""
    # Starting the tracker later would undo the mask.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@contextlib.contextmanager
def _redirect(pipe: int) -> Iterator[Connection | None]:
    """Redirect the errors of processes that start here to a pipe, and yield the original stream.

    It is None if this process has closed its own.
    """
    try:
        original = Connection(os.dup(_STDERR), readable=False)
    except OSError:
        yield None
        return
    os.dup2(pipe, _STDERR)
    try:
        yield original
    finally:
        os.dup2(original.fileno(), _STDERR)
        original.close()
