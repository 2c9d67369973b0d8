"""Ray engine, based on Ray's retries and node management."""

from collections.abc import Sequence
from typing import Any

import torch

from torchrg._optional import require
from torchrg._parallel import CHILD_ENVIRONMENT, in_root_directory
from torchrg.batch.local import POLL_SECONDS
from torchrg.batch.scans import Job, convert_scan
from torchrg.batch.task import Reports, TaskReport

__all__ = ["run_ray"]
__dir__ = __all__.copy

_RETRIES = 3
"""Maximum retries of a task whose process or node was lost."""
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
        The report of each finished scan, and None while there is none. Closing the iterator cancels
        unfinished scans.

    Raises:
        MissingDependencyError: If Ray is not installed.
    """
    ray = require("ray", extra="ray", purpose="convert on a Ray cluster")
    started = {
        "num_cpus": workers,
        "_memory": memory_limit,
        "object_store_memory": _OBJECT_STORE_BYTES,
        "include_dashboard": False,
    }
    with in_root_directory():
        ray.init(
            address=address or "local",
            logging_level="error",
            log_to_driver=False,
            runtime_env={"env_vars": CHILD_ENVIRONMENT},
            **({} if address else started),
        )
    pending: dict[Any, Job] = {}
    try:
        largest = max(
            int(node["Resources"].get("memory", 0)) for node in ray.nodes() if node["Alive"]
        )
        run = ray.remote(num_cpus=1, max_retries=_RETRIES)(_run)
        waiting = sorted(jobs, key=lambda job: job.memory)
        while waiting or pending:
            while waiting and (workers is None or len(pending) < workers):
                job = waiting.pop()
                pending[run.options(memory=min(job.memory, largest)).remote(job)] = job
            ready, _ = ray.wait(list(pending), num_returns=1, timeout=POLL_SECONDS)
            if not ready:
                yield None
            for reference in ready:
                yield _collect(ray, reference, pending.pop(reference))
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)
        ray.shutdown()


def _run(job: Job) -> TaskReport:
    """Convert a scan in one thread."""
    torch.set_num_threads(1)
    return convert_scan(job)


def _collect(ray: Any, reference: Any, job: Job) -> TaskReport:  # noqa: ANN401
    """Return the report of a scan, or a failure report if Ray could not finish it."""
    try:
        report: TaskReport = ray.get(reference)
    except ray.exceptions.RayError as error:
        job.clean()
        text = " ".join(str(error).split())
        return TaskReport(job.name, "failed", reason=f"{type(error).__name__}: {text}"[:500])
    return report
