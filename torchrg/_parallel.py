"""Work on many rows: chunks that fit the cache, on as many threads as torch may use."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

Task = TypeVar("Task")
Result = TypeVar("Result")

CACHE_BYTES = 2**22
"""Bytes of one array that a thread works on at a time, so that it stays in the cache."""

ROWS_IN_CACHE = 8192
"""Rows of some fifty values that a thread works on at a time, so that they stay in the cache."""

CHUNK_SIZE = 16384
"""Points that each stage handles at a time where the caller does not say."""

ROWS_AT_ONCE = 65536
"""Rows that one pass over a cloud takes at a time: few calls, and temporaries of bounded memory."""

_LEAST_ROWS = 4096
"""Rows at some tenths of a microsecond each that are worth a thread's start."""

_KEPT_BYTES = 31 * 2**20
"""Just below 32 MiB, the largest freed block from which glibc learns what to keep."""


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
    least: int = _LEAST_ROWS,
) -> list[Result]:
    """Call ``work`` on slices that together cover all rows; see :func:`map_tasks`.

    ``work`` is called at least once, without rows on an empty slice; ``least`` is the number of
    rows below which another thread is not worth its start. The results are in the order of rows.

    Example:
        >>> map_chunks(lambda rows: rows.stop, 5, 3, torch.device("cpu"))
        [3, 5]
        >>> map_chunks(lambda rows: rows, 0, 3, torch.device("cpu"))
        [slice(0, 0, None)]
    """
    num_threads = torch.get_num_threads() if device.type == "cpu" else 1
    # All threads have equally many slices.
    num_chunks = -(-num_rows // (chunk_size * num_threads)) * num_threads
    size = max(-(-num_rows // max(num_chunks, 1)), min(least, chunk_size))
    return map_tasks(work, chunks_of(num_rows, size) or [slice(0, 0)], device)


def map_chosen(work: Callable[[Tensor], Result], chosen: Tensor, chunk_size: int) -> list[Result]:
    """Call ``work`` on chunks of the row numbers of the chosen points; see :func:`map_chunks`.

    Example:
        >>> map_chosen(torch.Tensor.tolist, torch.tensor([True, False, True]), 5)
        [[0, 2]]
    """
    rows = places_of(chosen)
    return map_chunks(lambda chunk: work(rows[chunk]), len(rows), chunk_size, rows.device)


def map_tasks(
    work: Callable[[Task], Result], tasks: Sequence[Task], device: torch.device
) -> list[Result]:
    """Return what ``work`` returns for each task, on a CPU on ``torch.get_num_threads()`` threads.

    Threads that each take whole tasks need no synchronisation between operations, which costs more
    than the operations themselves on tensors that fit the cache. A single task is worked on by one
    thread too: threads that wait for each other within an operation make it many times slower where
    another process wants a core. Every task writes its own rows, so the result does not depend on
    the number of threads.

    Example:
        >>> map_tasks(len, ["a", "bc"], torch.device("cpu"))
        [1, 2]
    """
    if device.type != "cpu":
        return [work(task) for task in tasks]
    _keep_freed_memory()
    setting = torch.get_num_threads()
    num_threads = min(setting, len(tasks))
    try:
        # The setting is one of each thread, and the default of those that start later.
        torch.set_num_threads(1)
        if num_threads < 2:
            return [work(task) for task in tasks]
        with ThreadPoolExecutor(
            num_threads, initializer=_begin_thread, initargs=(torch.is_grad_enabled(),)
        ) as pool:
            return list(pool.map(work, tasks))
    finally:
        torch.set_num_threads(setting)


def _begin_thread(grad_enabled: bool) -> None:
    """Give a thread the settings of the one that started it."""
    torch.set_num_threads(1)
    torch.set_grad_enabled(grad_enabled)


@lru_cache(maxsize=1)
def _keep_freed_memory() -> None:
    """Free one large block, once: glibc then keeps what is freed instead of returning it.

    Otherwise every temporary tensor of some hundred kilobytes is fetched from the system page by
    page again: without this, segmenting 200,000 points takes a third more CPU time.
    """
    block = torch.empty(_KEPT_BYTES, dtype=torch.uint8)
    del block


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
