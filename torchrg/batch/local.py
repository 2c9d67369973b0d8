"""The local engine: processes of one thread each, as many as memory allows."""

import contextlib
import os
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from multiprocessing import connection, get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from typing import Any

from torchrg.batch.convert import ScanReport, convert_scan
from torchrg.batch.memory import memory_of_scan
from torchrg.batch.run import DirectoryLock
from torchrg.batch.scans import Task

Work = Callable[[Any], ScanReport]
"""What is done with a task."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS"), "1"
)
"""Environment of a worker, set before the libraries that read it are loaded."""
BEAT_SECONDS = 0.5


def run_local(
    jobs: Sequence[Task],
    *,
    workers: int,
    memory_limit: int,
    lock: DirectoryLock | None = None,
    work: Work = convert_scan,
) -> Generator[ScanReport | None, None, None]:
    """Convert scans in processes of this machine, the largest first.

    A scan starts when a worker is free and the estimates of all that run stay within the limit; one
    that is larger than the limit runs alone. When a worker dies, its scan waits until all others
    are done and is tried once more, alone. Workers end with this process, however it ends. While
    scans are converted, the system is asked to read the files of the next ones.

    Args:
        jobs: The scans.
        workers: Most processes at a time.
        memory_limit: Bytes that the scans that run may take together, by
            :func:`torchrg.batch.memory.memory_of_scan`.
        lock: A lock for the workers to hold as long as they live.
        work: What to do with a job; importable by name.

    Yields:
        A report of each scan when it ends, and None while there is none, so that progress can be
        shown. Closing the iterator stops the workers.
    """
    waiting = sorted(jobs, key=lambda job: -job.scan.num_points)
    lost: list[Task] = []
    idle: list[_Worker] = []
    busy: dict[Connection, _Worker] = {}

    def start(job: Task, *, attempt: int) -> None:
        worker = idle.pop() if idle else _Worker(work, lock)
        busy[worker.pipe] = worker
        worker.begin(job, attempt=attempt)

    try:
        while waiting or lost or busy:
            while len(busy) < workers:
                running = [worker.job for worker in busy.values()]
                job = _next_that_fits(waiting, running, memory_limit)
                if job is None:
                    break
                waiting.remove(job)
                start(job, attempt=1)
                for following in waiting[workers - 1 : workers]:
                    read_ahead(following.scan.inputs)
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


def _next_that_fits(waiting: Sequence[Task], running: Sequence[Task], limit: int) -> Task | None:
    """Return the first scan for which there is memory; any if nothing runs."""
    if not running:
        return next(iter(waiting), None)
    free = limit - sum(memory_of_scan(job.scan.num_points) for job in running)
    return next((job for job in waiting if memory_of_scan(job.scan.num_points) <= free), None)


def read_ahead(files: Sequence[Path]) -> None:
    """Ask the system, where it can, to have files in memory soon; it reads them on the side."""
    if not hasattr(os, "posix_fadvise"):
        return
    for file in files:
        # One that cannot be read fails where it is needed.
        with contextlib.suppress(OSError), file.open("rb") as stream:
            os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_WILLNEED)


class _Worker:
    """A process that converts one scan after another, and the pipe to it."""

    job: Task
    attempt: int

    def __init__(self, work: Work, lock: DirectoryLock | None) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, work, lock))
        with _one_thread(), _no_interrupts():
            self.process.start()
        theirs.close()

    def begin(self, job: Task, *, attempt: int) -> None:
        """Hand over a scan."""
        self.job, self.attempt = job, attempt
        # A worker that is dead already is noticed when its answer is collected.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send(job)

    def collect(self) -> ScanReport | None:
        """Return the report that is ready, or None if the process died instead."""
        try:
            report: ScanReport = self.pipe.recv()
        except (EOFError, OSError):
            self.stop()
            return None
        return replace(report, attempts=self.attempt)

    def death_report(self) -> ScanReport:
        """Return the report of a scan whose worker died."""
        code = self.process.exitcode or 0
        end = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        return ScanReport(
            self.job.scan.name,
            "failed",
            reason=f"its process {end}, twice, the second time alone; is the memory enough?",
            attempts=self.attempt,
        )

    def stop(self) -> None:
        """End the process, and remove what it was writing."""
        self.process.terminate()
        self.process.join(timeout=5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()
        if hasattr(self, "job"):
            self.job.remove_leftovers()


def _serve(pipe: Connection, work: Work, lock: DirectoryLock | None) -> None:
    """Convert scans until the pipe closes; the lock is held by being here."""
    import torch

    Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(work(job))


def _end_with_parent() -> None:
    """End this process as soon as the one that started it is gone."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes that are started here use one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


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
