"""Chunked, multi-threaded work on rows.

Each thread takes whole tasks and runs every operation alone. OpenMP threads within an operation,
torch's default, wait for each other. If another process needs a core, that takes ten times as long.
"""

import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from contextvars import ContextVar, copy_context
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from threadpoolctl import ThreadpoolController
from torch import Tensor

Task = TypeVar("Task")
Returned = TypeVar("Returned")

CACHE_BYTES = 2**22
"""Size of one array processed at a time by a thread, in bytes, so that it stays in the cache."""
ROWS_IN_CACHE = 8192
"""Rows of about 50 values processed at a time by a thread, so that they stay in the cache."""
CHUNK_SIZE = 16384
"""Default number of points processed at a time by each stage."""
ROWS_AT_ONCE = 65536
"""Number of rows per pass over a cloud: few calls, temporaries of bounded memory."""
TYPICAL_WIDTH = 64
"""Number of values per row, such as neighbors, up to which the numbers above apply."""
_DEVICE_CHUNKS = 5
"""Factor by which chunks on other devices have more rows: they must fit not into a cache but into
few hundred MB of memory, and the start of an operation takes as long as a small chunk."""
_MIN_ROWS = 4096
"""Minimum rows per thread: at a few tenths of a microsecond each they outweigh its start."""
_RETAINED_BYTES = 31 * 2**20
"""Just below 32 MiB, the largest freed block that raises the trim threshold of glibc."""


def split_rows(num_rows: int, chunk_size: int) -> list[slice]:
    """Split ``num_rows`` rows into slices of at most ``chunk_size`` rows."""
    return [
        slice(start, min(start + chunk_size, num_rows)) for start in range(0, num_rows, chunk_size)
    ]


def limit_rows(num_rows: int, width: int) -> int:
    """Return the number of rows of ``width`` values that take the memory of typical ``num_rows``.

    At least 1 and at most ``num_rows``. Rows that wide, such as neighborhoods, may be wider than
    the memory allows for all of ``num_rows``.
    """
    return max(num_rows * TYPICAL_WIDTH // max(width, TYPICAL_WIDTH), 1)


def rows_at_once(num_rows: int, device: torch.device) -> int:
    """Return the number of rows processed at a time on a device, if a CPU takes ``num_rows``."""
    return num_rows if device.type == "cpu" else num_rows * _DEVICE_CHUNKS


def map_chunks(
    work: Callable[[slice], Returned],
    num_rows: int,
    chunk_size: int,
    device: torch.device,
    *,
    min_rows: int = _MIN_ROWS,
) -> list[Returned]:
    """Call ``work`` on slices that cover all rows, in order; see :func:`map_tasks`.

    Without rows it is called once, on an empty slice. ``min_rows`` is the minimum per thread.
    """
    num_threads = allowed_threads() if device.type == "cpu" else 1
    chunk_size = rows_at_once(chunk_size, device)
    # Each thread gets the same number of slices.
    num_chunks = -(-num_rows // (chunk_size * num_threads)) * num_threads
    size = max(-(-num_rows // max(num_chunks, 1)), min(min_rows, chunk_size))
    return map_tasks(work, split_rows(num_rows, size) or [slice(0, 0)], device)


def map_selected(
    work: Callable[[Tensor], Returned], chosen: Tensor, chunk_size: int
) -> list[Returned]:
    """Call ``work`` on chunks of the row indices of the chosen points; see :func:`map_chunks`."""
    rows = nonzero_rows(chosen)
    return map_chunks(lambda chunk: work(rows[chunk]), len(rows), chunk_size, rows.device)


def map_tasks(
    work: Callable[[Task], Returned], tasks: Sequence[Task], device: torch.device
) -> list[Returned]:
    """Return the result of ``work`` for each task; on a CPU, multi-threaded.

    Every task writes different rows, so the result does not depend on the number of threads.
    """
    if device.type == "cpu" and _THREADS.get() is None:
        with sequential_operations():
            return map_tasks(work, tasks, device)
    num_threads = min(allowed_threads(), len(tasks))
    if num_threads < 2 or device.type != "cpu":
        return [work(task) for task in tasks]
    results, waiting = {}, iter(list(enumerate(tasks)))
    grad_enabled, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def take_tasks() -> None:
        token = _THREADS.set(1)
        try:
            with torch.inference_mode(inference), torch.set_grad_enabled(grad_enabled):
                for index, task in waiting:
                    results[index] = work(task)
        finally:
            # Drain the queue after an error, so that no further task starts.
            for _ in waiting:
                pass
            _THREADS.reset(token)

    pool, others = _started_threads(), list[Future[None]]()
    try:
        # No thread starts while the interpreter exits, or at the limit of a container.
        with suppress(RuntimeError):
            for _ in range(num_threads - 1):
                others.append(pool.submit(copy_context().run, take_tasks))
        # The calling thread also processes tasks.
        take_tasks()
    finally:
        wait(others)
        if len(others) < num_threads - 1:
            # A started thread may hold the task whose own thread did not start.
            _POOL.get().remove(pool)
            pool.shutdown()
    for other in others:
        other.result()
    return [results[index] for index in range(len(tasks))]


@contextmanager
def sequential_operations() -> Iterator[None]:
    """Run each torch operation on this thread alone; also a decorator.

    :func:`map_tasks` still uses torch's previous number of threads. Unlike
    :func:`torch.set_num_threads`, this does not change other threads.
    """
    if _THREADS.get() is not None:
        yield
        return
    _retain_freed_memory()
    token, pool_token = _THREADS.set(torch.get_num_threads()), _POOL.set([])
    before = _set_thread_counts([1] * (1 + len(_openmp_libraries())))
    try:
        yield
    finally:
        for pool in _POOL.get():
            pool.shutdown()
        _set_thread_counts(before)
        _POOL.reset(pool_token)
        _THREADS.reset(token)


_THREADS: ContextVar[int | None] = ContextVar("threads", default=None)
"""Number of threads for the tasks of this call; None outside of calls."""
_POOL: ContextVar[list[ThreadPoolExecutor]] = ContextVar("pool")
"""The threads of this call, empty until the first of them starts."""


def allowed_threads() -> int:
    """Return the number of threads for tasks."""
    return _THREADS.get() or torch.get_num_threads()


def num_cores() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _started_threads() -> ThreadPoolExecutor:
    """Return the threads of this call; starting them for every stage would cost a millisecond."""
    pools = _POOL.get()
    if not pools:
        pools.append(ThreadPoolExecutor(allowed_threads() - 1, initializer=_init_thread))
    return pools[0]


def _init_thread() -> None:
    """Limit a worker thread to sequential operations."""
    # Torch sets the number of threads of a thread at its first query.
    torch.get_num_threads()
    _set_thread_counts([1] * (1 + len(_openmp_libraries())))


def _set_thread_counts(numbers: Sequence[int]) -> list[int]:
    """Set this thread's MKL (0: default) and OpenMP thread counts; return the previous ones."""
    mkl, libraries = _mkl_setter(), _openmp_libraries()
    before = [mkl(numbers[0]), *(library.num_threads for library in libraries)]
    for library, number in zip(libraries, numbers[1:], strict=True):
        library.set_num_threads(number)
    return before


@lru_cache(maxsize=1)
def _openmp_libraries() -> list[Any]:
    """Return the OpenMP libraries of this process; their setting is per thread."""
    return list(ThreadpoolController().select(user_api="openmp").lib_controllers)


@lru_cache(maxsize=1)
def _mkl_setter() -> Callable[[int], int]:
    """Return the function that sets MKL's thread count of this thread and returns the previous one.

    Torch sets it too; MKL falls back to OpenMP's count only if it is 0. Without MKL it stays 0.
    """
    for library in Path(torch.__file__).parent.glob("lib/*torch_cpu.*"):
        setter = getattr(ctypes.CDLL(str(library)), "MKL_Set_Num_Threads_Local", None)
        if setter is not None:
            return lambda number: int(setter(number))
    return lambda number: 0


@lru_cache(maxsize=1)
def _retain_freed_memory() -> None:
    """Free one large block once, so that glibc keeps freed memory instead of returning it.

    Otherwise every temporary tensor of some hundred kilobytes is paged in again: segmenting 200,000
    points then takes a third more CPU time.
    """
    torch.empty(_RETAINED_BYTES, dtype=torch.uint8)


if hasattr(os, "register_at_fork"):
    # As in data loaders. OpenMP threads do not survive a fork: an operation of the child that uses
    # several would wait for them forever.
    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


def return_freed_memory() -> None:
    """Return freed memory that glibc keeps to the system; no effect with other C libraries."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def nonzero_rows(mask: Tensor) -> Tensor:
    """Return the flat indices of True elements, shape ``(n,)``, int64."""
    if mask.device.type == "cpu":
        # Ten times faster than nonzero in torch, and than indexing with the mask.
        return torch.from_numpy(mask.numpy().ravel().nonzero()[0])
    return mask.reshape(-1).nonzero().squeeze(1)
