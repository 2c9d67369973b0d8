"""Ray engine, based on Ray's scheduling and node management."""

import signal
import socket
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch

from torchrg._optional import require
from torchrg.batch.local import CHILD_ENVIRONMENT, POLL_SECONDS, in_root_directory
from torchrg.batch.scans import Job, convert_scan
from torchrg.batch.task import Reports, TaskReport
from torchrg.errors import ConfigError
from torchrg.io.files import first_line

__all__ = ["run_ray"]
__dir__ = __all__.copy

_ATTEMPTS = 3
"""Maximum attempts at a scan whose process or node is lost; Ray itself may retry without limit."""
_CONNECT_SECONDS = 10.0
"""Timeout of the test of an address. Ray itself tries for minutes."""
_OBJECT_STORE_BYTES = 100_000_000
"""Object store size: only tasks and reports pass through it, never points."""


def run_ray(
    jobs: Sequence[Job],
    *,
    workers: int | None = None,
    memory_limit: int,
    address: str | None = None,
) -> Reports:
    """Convert scans on Ray, largest memory first.

    Each task requests one CPU and its memory, capped at the largest node. All nodes must see inputs
    and outputs under the same path, and have torchrg installed.

    Args:
        jobs: The scans to convert.
        workers: Maximum number of concurrent scans. Default: decided by Ray.
        memory_limit: Memory of a cluster that is started here, in bytes.
        address: Cluster to use. Default: one is started here, and stopped at the end.

    Yields:
        The report of each finished scan, and None while there is none. Closing it cancels others.

    Raises:
        ConfigError: If the address is not that of a cluster, or Ray cannot start or connect.
        MissingDependencyError: If Ray is not installed.
    """
    ray = require("ray", extra="ray", purpose="convert on a Ray cluster")
    started = {
        "num_cpus": workers,
        "_memory": memory_limit,
        "object_store_memory": _OBJECT_STORE_BYTES,
        "include_dashboard": False,
    }
    if address is not None:
        _check_address(address)
    with in_root_directory(), _keep_interrupts():
        try:
            ray.init(
                address="local" if address is None else address,
                logging_level="error",
                log_to_driver=False,
                runtime_env={"env_vars": CHILD_ENVIRONMENT},
                **(started if address is None else {}),
            )
        except (ValueError, RuntimeError, OSError, ray.exceptions.RayError) as error:
            where = "Ray" if address is None else f"Ray address {address}"
            raise ConfigError(f"{where}: no connection: {first_line(error)}.") from error
    pending: dict[Any, Job] = {}
    attempts: Counter[str] = Counter()
    try:
        largest = max(
            int(node["Resources"].get("memory", 0)) for node in ray.nodes() if node["Alive"]
        )
        run = ray.remote(num_cpus=1, max_retries=0)(_run)
        waiting = sorted(jobs, key=lambda job: job.memory)
        while waiting or pending:
            while waiting and (workers is None or len(pending) < workers):
                job = waiting.pop()
                attempts[job.name] += 1
                pending[run.options(memory=min(job.memory, largest)).remote(job)] = job
            ready, _ = ray.wait(list(pending), num_returns=1, timeout=POLL_SECONDS)
            if not ready:
                yield None
            for reference in ready:
                job = pending.pop(reference)
                report = _collect(ray, reference, job, attempts[job.name])
                if report is None:
                    waiting.append(job)
                else:
                    yield report
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)
        ray.shutdown()


def _run(job: Job) -> TaskReport:
    """Convert a scan in one thread."""
    torch.set_num_threads(1)
    return convert_scan(job)


def _check_address(address: str) -> None:
    """Raise ConfigError unless a process listens at an address of the form ``host:port``.

    Other addresses of Ray, ``auto`` and ``ray://host:port``, are not tested.
    """
    if address in ("auto", "local") or "://" in address:
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(f"Ray address {address!r}: expected auto or host:port of a cluster.")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"Ray {address}: no cluster: {first_line(error)}; run ray start --head --port {port}."
        ) from error


@contextmanager
def _keep_interrupts() -> Iterator[None]:
    """Restore the handlers of Ctrl-C and SIGTERM, which Ray replaces when it starts."""
    signals = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.getsignal(number) for number in signals}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _collect(ray: Any, reference: Any, job: Job, attempts: int) -> TaskReport | None:  # noqa: ANN401
    """Return the report of a scan, or None if it must be tried again."""
    try:
        report: TaskReport = ray.get(reference)
    except ray.exceptions.RayError as error:
        job.clean()
        if not isinstance(error, ray.exceptions.RayTaskError) and attempts < _ATTEMPTS:
            return None
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]
        if isinstance(error, ray.exceptions.OutOfMemoryError):
            reason = (
                f"the memory of its node ran out in {attempts} attempts; use nodes with more "
                "memory, or a smaller part of the data"
            )
        return TaskReport(job.name, "failed", reason=reason, attempts=attempts)
    return replace(report, attempts=attempts)
