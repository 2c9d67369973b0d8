"""The local engine: processes of one thread each, as many as memory allows."""

import contextlib
import gc
import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import replace
from multiprocessing import connection, get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from threading import Thread

from torchrg._parallel import CHILD_ENVIRONMENT, in_empty_folder
from torchrg.batch.scans import Job, convert_scan
from torchrg.batch.task import Reports, TaskReport

BEAT_SECONDS = 0.5
"""How often an engine yields while no scan ends, so that progress is shown and Ctrl-C is heard."""
_STDERR = 2
"""Number of the stream for errors, of every process."""
_LONGEST_CAUSE = 300
"""Characters, some lines of a terminal, that a report shows of what a process said last."""


def run_local(jobs: Sequence[Job], *, workers: int, memory_limit: int) -> Reports:
    """Convert scans in processes of this machine, those that take most memory first.

    A scan starts when a worker is free and all that run stay within the limit; one that takes more
    than the limit runs alone. When a worker dies, its scan waits until all others are done and is
    tried once more, alone. Workers end with this process, however it ends.

    Args:
        jobs: The scans to convert.
        workers: Most processes at a time.
        memory_limit: Bytes that all scans at a time may take.

    Yields:
        A report of each scan when it ends, and None while there is none, so that progress can be
        shown. Closing the iterator stops the workers.
    """
    waiting = sorted(jobs, key=lambda job: -job.memory)
    lost: list[Job] = []
    idle: list[_Worker] = []
    busy: dict[Connection, _Worker] = {}

    def start(job: Job, *, attempt: int) -> None:
        worker = idle.pop() if idle else _Worker()
        busy[worker.pipe] = worker
        worker.begin(job, attempt=attempt)

    try:
        while waiting or lost or busy:
            while len(busy) < workers:
                free = memory_limit - sum(worker.job.memory for worker in busy.values())
                fitting = (job for job in waiting if job.memory <= free or not busy)
                job = next(fitting, None)
                if job is None:
                    break
                waiting.remove(job)
                start(job, attempt=1)
            if not busy:
                start(lost.pop(0), attempt=2)
            ready = connection.wait(busy, timeout=BEAT_SECONDS)
            if not ready:
                yield None
            for worker in [worker for pipe, worker in busy.items() if pipe in ready]:
                del busy[worker.pipe]
                report = worker.collect()
                if report is not None:
                    idle.append(worker)
                    yield report
                elif worker.attempt == 1:
                    lost.append(worker.job)
                else:
                    yield worker.death_report()
    finally:
        for worker in [*idle, *busy.values()]:
            worker.stop()


class _Worker:
    """A process that converts one scan after another, and the pipe to it."""

    job: Job
    attempt: int

    def __init__(self) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        # What ends it before its first scan is a line of a report, no traceback on the terminal.
        self.errors, errors = os.pipe()
        with in_empty_folder(), _environment(), _no_interrupts(), _stderr_to(errors) as stderr:
            self.process = context.Process(target=_serve, args=(theirs, stderr))
            self.process.start()
        os.close(errors)
        theirs.close()

    def begin(self, job: Job, *, attempt: int) -> None:
        """Hand over a scan."""
        self.job, self.attempt = job, attempt
        # A worker that is dead already is noticed when its answer is collected.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send(job)

    def collect(self) -> TaskReport | None:
        """Return the report that is ready, or None if the process died instead."""
        try:
            report: TaskReport = self.pipe.recv()
        except (EOFError, OSError):
            self.stop()
            return None
        return replace(report, attempts=self.attempt)

    def death_report(self) -> TaskReport:
        """Return the report of a scan whose worker died."""
        code = self.process.exitcode or 0
        end = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        reason = f"its process {end}, twice, the second time alone"
        if cause := self._cause():
            reason = f"{reason}: {cause}"
        if code == -signal.SIGKILL or cause.startswith("MemoryError"):
            reason = f"{reason}; is the memory enough?"
        return TaskReport(self.job.name, "failed", reason=reason, attempts=self.attempt)

    def _cause(self) -> str:
        """Return what the process said last before its first scan, in one line, or nothing."""
        lines = self.said.decode(errors="replace").splitlines()
        # A message goes on in lines that are set in; before it is the traceback.
        begins = [number for number, line in enumerate(lines) if line[:1].strip()]
        return " ".join(" ".join(lines[begins[-1] :]).split())[:_LONGEST_CAUSE] if begins else ""

    def stop(self) -> None:
        """End the process, and remove what it was writing."""
        self.process.terminate()
        self.process.join(timeout=5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()
        os.set_blocking(self.errors, False)
        with os.fdopen(self.errors, "rb") as errors:
            self.said = errors.read() or b""
        if hasattr(self, "job"):
            self.job.clean()


def _serve(pipe: Connection, stderr: Connection | None) -> None:
    """Convert scans until the pipe closes; from the first on errors go to ``stderr``."""
    import torch

    gc.freeze()  # Loaded modules are no garbage.
    gc.enable()
    Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    # Reading and writing fail once the process that hands over scans is gone.
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            job = pipe.recv()
            if stderr is not None:
                os.dup2(stderr.fileno(), _STDERR)
                stderr.close()
                stderr = None
            pipe.send(convert_scan(job))


def _end_with_parent() -> None:
    """End this process as soon as the one that started it is gone."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """Start processes in the environment for them."""
    before = dict(os.environ)
    os.environ.update(CHILD_ENVIRONMENT)
    try:
        yield
    finally:
        for name in CHILD_ENVIRONMENT.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


@contextlib.contextmanager
def _no_interrupts() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach: this one hears it, and stops them."""
    # Its start would undo the mask.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@contextlib.contextmanager
def _stderr_to(pipe: int) -> Iterator[Connection | None]:
    """Start processes whose errors go to a pipe, and yield what they return to ours with.

    It is None where this process has closed its own.
    """
    try:
        ours = Connection(os.dup(_STDERR), readable=False)
    except OSError:
        yield None
        return
    os.dup2(pipe, _STDERR)
    try:
        yield ours
    finally:
        os.dup2(ours.fileno(), _STDERR)
        ours.close()
