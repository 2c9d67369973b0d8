"""Work on many rows: chunks that fit the cache, on as many threads as torch may use.

A thread here takes whole tasks and works alone on each operation. Threads of OpenMP, which torch
would use within an operation, wait for each other while they compute: where another process wants
a core, that takes ten times as long and more.
"""

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import Context, ContextVar, copy_context
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from threadpoolctl import ThreadpoolController
from torch import Tensor

Task = TypeVar("Task")
Result = TypeVar("Result")

CACHE_BYTES = 2**22
"""Bytes of one array that a thread works on at a time, so that it stays in the cache."""

ROWS_IN_CACHE = 8192
"""Rows of some fifty values that a thread works on at a time, so that they stay in the cache."""

CHUNK_SIZE = 16384
"""Points that each stage handles at a time by default."""

ROWS_AT_ONCE = 65536
"""Rows that one pass over a cloud takes at a time: few calls, and temporaries of bounded memory."""

CHILD_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS"), "1"
) | {"PYTHONSAFEPATH": "1"}
"""Environment of every process that is started here, set before Python and its libraries read it:
one thread, and no module from the folder that the command runs in."""

_MIN_ROWS = 4096
"""Rows at some tenths of a microsecond each that are worth a thread's start."""

_KEPT_BYTES = 31 * 2**20
"""Just below 32 MiB, the largest freed block from which glibc learns what to keep."""


@contextmanager
def in_empty_folder() -> Iterator[None]:
    """Start processes in a folder without modules, as Python 3.10 and libraries import from there.

    Paths that they are given have to be absolute.
    """
    folder = Path.cwd()
    os.chdir("/")
    try:
        yield
    finally:
        os.chdir(folder)


def chunks_of(num_rows: int, chunk_size: int) -> list[slice]:
    """Cut ``num_rows`` rows into slices of at most ``chunk_size`` rows.

    Example:
        >>> chunks_of(5, 2)
        [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    return [
        slice(start, min(start + chunk_size, num_rows)) for start in range(0, num_rows, chunk_size)
    ]


def map_chunks(
    work: Callable[[slice], Result],
    num_rows: int,
    chunk_size: int,
    device: torch.device,
    *,
    least: int = _MIN_ROWS,
) -> list[Result]:
    """Call ``work`` on slices that together cover all rows, in their order; see :func:`map_tasks`.

    Without rows it is called once, on an empty slice; ``least`` is the number of rows below which
    another thread is not worth its start.

    Example:
        >>> map_chunks(lambda rows: rows.stop, 5, 3, torch.device("cpu"))
        [3, 5]
        >>> map_chunks(lambda rows: rows, 0, 3, torch.device("cpu"))
        [slice(0, 0, None)]
    """
    num_threads = allowed_threads() if device.type == "cpu" else 1
    # All threads have equally many slices.
    num_chunks = -(-num_rows // (chunk_size * num_threads)) * num_threads
    size = max(-(-num_rows // max(num_chunks, 1)), min(least, chunk_size))
    return map_tasks(work, chunks_of(num_rows, size) or [slice(0, 0)], device)


def map_rows(
    work: Callable[..., Sequence[Tensor]], columns: Sequence[Tensor], *others: Tensor
) -> list[Tensor]:
    """Call ``work`` on an equal share of rows for each thread, and return what it returns, whole.

    It takes rows of each of the ``columns``, of one length, then the ``others`` as they are, and
    returns tensors of rows.

    Example:
        >>> map_rows(lambda x, y, factor: (factor * x + y,), [torch.ones(2)] * 2, torch.tensor(3))
        [tensor([4., 4.])]
    """
    first, *more = map_chunks(
        lambda rows: work(*(column[rows] for column in columns), *others),
        len(columns[0]),
        max(len(columns[0]), 1),
        columns[0].device,
    )
    parts = zip(first, *more, strict=True)
    return [torch.cat(same) for same in parts] if more else list(first)


def map_chosen(work: Callable[[Tensor], Result], chosen: Tensor, chunk_size: int) -> list[Result]:
    """Call ``work`` on chunks of the row numbers of the chosen points; see :func:`map_chunks`."""
    rows = places_of(chosen)
    return map_chunks(lambda chunk: work(rows[chunk]), len(rows), chunk_size, rows.device)


def map_tasks(
    work: Callable[[Task], Result], tasks: Sequence[Task], device: torch.device
) -> list[Result]:
    """Return what ``work`` returns for each task, on a CPU on as many threads as torch may use.

    Every task writes its own rows, so the result does not depend on the number of threads.

    Example:
        >>> map_tasks(len, ["a", "bc"], torch.device("cpu"))
        [1, 2]
    """
    if device.type != "cpu":
        return [work(task) for task in tasks]
    _keep_freed_memory()
    num_threads = min(allowed_threads(), len(tasks))
    with sequential_operations():
        if num_threads < 2:
            return [work(task) for task in tasks]
        results, waiting = {}, iter(list(enumerate(tasks)))

        def take_tasks() -> None:
            try:
                for place, task in waiting:
                    results[place] = work(task)
            finally:
                # After an error nobody begins another task.
                for _ in waiting:
                    pass

        # This thread works too: until others run, and instead of them where no core is free.
        settings = torch.is_grad_enabled(), torch.is_inference_mode_enabled(), copy_context()
        with ThreadPoolExecutor(
            num_threads - 1, initializer=_begin_thread, initargs=settings
        ) as pool:
            others = [pool.submit(take_tasks) for _ in range(num_threads - 1)]
            token = _THREADS.set(1)
            try:
                take_tasks()
            finally:
                _THREADS.reset(token)
            for other in others:
                other.result()
        return [results[place] for place in range(len(tasks))]


@contextmanager
def sequential_operations() -> Iterator[None]:
    """Let each operation of torch run on this thread alone; also a decorator.

    :func:`map_tasks` goes on to use as many threads as torch might before. Other threads keep their
    setting, which :func:`torch.set_num_threads` would change for those that start meanwhile.

    Example:
        >>> before = torch.get_num_threads()
        >>> with sequential_operations():
        ...     print(torch.get_num_threads())
        1
        >>> torch.get_num_threads() == before
        True
    """
    if _THREADS.get() is not None:
        yield
        return
    token = _THREADS.set(torch.get_num_threads())
    before = _set_own_threads([1] * (1 + len(_openmp_libraries())))
    try:
        yield
    finally:
        _set_own_threads(before)
        _THREADS.reset(token)


_THREADS: ContextVar[int | None] = ContextVar("threads", default=None)
"""How many threads the tasks of this call may use; None outside of calls."""


def allowed_threads() -> int:
    """Return on how many threads tasks may run."""
    return _THREADS.get() or torch.get_num_threads()


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_OF_THREAD = threading.local()


def _begin_thread(grad_enabled: bool, inference: bool, context: Context) -> None:
    """Let a thread work alone on each operation, with the settings of the one that started it."""
    for variable, value in context.items():
        variable.set(value)
    _THREADS.set(1)
    # Torch gives a thread its number of threads when the thread first asks for it.
    torch.get_num_threads()
    _set_own_threads([1] * (1 + len(_openmp_libraries())))
    torch.set_grad_enabled(grad_enabled)
    if inference:
        # The mode lasts as long as its guard, and this as long as the thread.
        _OF_THREAD.inference = torch.inference_mode()
        _OF_THREAD.inference.__enter__()


def _set_own_threads(numbers: Sequence[int]) -> list[int]:
    """Set MKL's threads of this thread (0: its default), then OpenMP's; return those before."""
    mkl, libraries = _mkl_setter(), _openmp_libraries()
    before = [mkl(numbers[0]), *(library.num_threads for library in libraries)]
    for library, number in zip(libraries, numbers[1:], strict=True):
        library.set_num_threads(number)
    return before


@lru_cache(maxsize=1)
def _openmp_libraries() -> list[Any]:
    """Return the OpenMP libraries of this process, whose setting is one of each thread."""
    return list(ThreadpoolController().select(user_api="openmp").lib_controllers)


@lru_cache(maxsize=1)
def _mkl_setter() -> Callable[[int], int]:
    """Return what sets and returns MKL's number of threads for this thread.

    Torch sets it too, and MKL asks OpenMP only where it is 0; without MKL it stays 0.
    """
    for library in Path(torch.__file__).parent.glob("lib/*torch_cpu.*"):
        setter = getattr(ctypes.CDLL(str(library)), "MKL_Set_Num_Threads_Local", None)
        if setter is not None:
            return lambda number: int(setter(number))
    return lambda number: 0


@lru_cache(maxsize=1)
def _keep_freed_memory() -> None:
    """Free one large block, once: glibc then keeps what is freed instead of returning it.

    Otherwise every temporary tensor of some hundred kilobytes is fetched from the system page by
    page again: without this, segmenting 200,000 points takes a third more CPU time.
    """
    block = torch.empty(_KEPT_BYTES, dtype=torch.uint8)
    del block


def return_freed_memory() -> None:
    """Give the system back what the C library keeps of freed memory, where it can: with glibc."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def places_of(mask: Tensor) -> Tensor:
    """Return where a mask is True, counted along all its elements, shape ``(n,)``, int64.

    Example:
        >>> places_of(torch.tensor([[True, False], [False, True]]))
        tensor([0, 3])
    """
    if mask.device.type == "cpu":
        # Ten times faster than torch's, and than selecting by the mask.
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.reshape(-1).nonzero().squeeze(1)
