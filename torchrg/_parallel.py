"""Work on many rows: chunks that fit the cache, on as many threads as torch may use."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from threading import Lock
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Result = TypeVar("Result")

_KEPT_BYTES = 31 * 2**20
_MIN_SHARE = 4096


def chunks_of(num_rows: int, chunk_size: int) -> list[slice]:
    """Cut ``num_rows`` rows into slices of at most ``chunk_size`` rows.

    Example:
        >>> chunks_of(5, 2)
        [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    return [
        slice(start, min(start + chunk_size, num_rows)) for start in range(0, num_rows, chunk_size)
    ]


def fair_chunks(num_rows: int, chunk_size: int) -> list[slice]:
    """Cut rows as :func:`chunks_of`, so that all threads have equally many; at least one slice.

    Example:
        >>> fair_chunks(0, 10)
        [slice(0, 0, None)]
    """
    num_threads = torch.get_num_threads()
    num_chunks = -(-num_rows // (chunk_size * num_threads)) * num_threads
    size = max(-(-num_rows // max(num_chunks, 1)), min(_MIN_SHARE, chunk_size))
    return chunks_of(num_rows, size) or [slice(0, 0)]


def map_chunks(
    work: Callable[[slice], Result], chunks: Sequence[slice], device: torch.device
) -> list[Result]:
    """Return what ``work`` returns for each chunk, in their order; see :func:`run_chunks`."""
    results: dict[int, Result] = {}

    def keep(chunk: slice) -> None:
        results[chunk.start] = work(chunk)

    run_chunks(keep, chunks, device)
    return [results[chunk.start] for chunk in chunks]


def run_chunks(
    work: Callable[[slice], None], chunks: Sequence[slice], device: torch.device
) -> None:
    """Call ``work`` on each chunk, on a CPU on ``torch.get_num_threads()`` threads.

    Threads that each take whole chunks need no synchronisation between operations, which costs
    more than the operations themselves on tensors that fit the cache. Every chunk writes its own
    rows, so the result does not depend on the number of threads.
    """

    def work_on_all(some: Iterator[slice]) -> None:
        for chunk in some:
            work(chunk)

    share_chunks(work_on_all, chunks, device)


def share_chunks(
    work: Callable[[Iterator[slice]], None], chunks: Sequence[slice], device: torch.device
) -> None:
    """Call ``work`` once on each thread, with an iterator that hands out the chunks.

    As :func:`run_chunks`, for work that keeps buffers from one chunk to the next. A single chunk is
    worked on by one thread too: threads that wait for each other within an operation make it many
    times slower where another process wants a core.
    """
    if device.type != "cpu":
        work(iter(chunks))
        return
    _keep_freed_memory()
    setting = torch.get_num_threads()
    num_threads = min(setting, len(chunks))
    try:
        # The setting is one of each thread, and the default of those that start later.
        torch.set_num_threads(1)
        if num_threads < 2:
            work(iter(chunks))
            return
        shared = _Shared(chunks)
        with ThreadPoolExecutor(
            num_threads, initializer=_begin_thread, initargs=(torch.is_grad_enabled(),)
        ) as pool:
            for _ in pool.map(work, [shared] * num_threads):
                pass
    finally:
        torch.set_num_threads(setting)


def _begin_thread(grad_enabled: bool) -> None:
    """Give a thread the settings of the one that started it."""
    torch.set_num_threads(1)
    torch.set_grad_enabled(grad_enabled)


class _Shared(Iterator[slice]):
    """One iterator over chunks for several threads."""

    def __init__(self, chunks: Sequence[slice]) -> None:
        self._chunks, self._lock = iter(chunks), Lock()

    def __next__(self) -> slice:
        with self._lock:
            return next(self._chunks)


@lru_cache(maxsize=1)
def _keep_freed_memory() -> None:
    """Free one large block, once: glibc then keeps what is freed instead of returning it.

    Otherwise every temporary tensor of some hundred kilobytes is fetched from the system page by
    page again, which costs a fifth of the time.
    """
    block = torch.empty(_KEPT_BYTES, dtype=torch.uint8)
    del block


Scalar = TypeVar("Scalar", bound=np.generic)


def take(values: NDArray[Scalar], places: NDArray[np.integer]) -> NDArray[Scalar]:
    """Return ``values[places]``, rows of ``values`` at places of any shape.

    NumPy's indexing and ``take`` hold the interpreter's lock, and keep other threads waiting.

    Example:
        >>> take(np.array([5, 6, 7]), np.array([[2, 0]])).tolist()
        [[7, 5]]
    """
    rows = torch.from_numpy(values).index_select(0, torch.from_numpy(places.reshape(-1)))
    return rows.numpy().reshape(places.shape + values.shape[1:])


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


def each_block(
    work: Callable[[slice], None], num_rows: int, block_size: int, device: torch.device
) -> None:
    """Call ``work`` on slices that together cover all rows; it writes its own rows only.

    Example:
        >>> seen = []
        >>> each_block(seen.append, 5, 3, torch.device("cpu"))
        >>> sorted(seen, key=lambda block: block.start)
        [slice(0, 3, None), slice(3, 5, None)]
    """
    run_chunks(work, fair_chunks(num_rows, block_size), device)


def each_block_of(work: Callable[[Tensor], None], chosen: Tensor, block_size: int) -> None:
    """Call ``work`` on blocks of the row numbers of the chosen points.

    Example:
        >>> seen = []
        >>> each_block_of(seen.append, torch.tensor([True, False, True]), 5)
        >>> seen
        [tensor([0, 2])]
    """
    rows = chosen.nonzero().squeeze(-1)
    each_block(lambda block: work(rows[block]), len(rows), block_size, rows.device)
