"""Work on many rows in chunks that fit the cache, on as many threads as torch may use."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch


def chunks_of(num_rows: int, chunk_size: int) -> list[slice]:
    """Cut ``num_rows`` rows into slices of at most ``chunk_size`` rows.

    Example:
        >>> chunks_of(5, 2)
        [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    return [
        slice(start, min(start + chunk_size, num_rows)) for start in range(0, num_rows, chunk_size)
    ]


def run_chunks(
    work: Callable[[slice], None], chunks: Sequence[slice], device: torch.device
) -> None:
    """Call ``work`` on each chunk, on a CPU on ``torch.get_num_threads()`` threads.

    Threads that each take whole chunks need no synchronisation between operations, which costs
    more than the operations themselves on tensors that fit the cache. Every chunk writes its own
    rows, so the result does not depend on the number of threads.
    """
    num_threads = torch.get_num_threads()
    if device.type != "cpu" or num_threads < 2 or len(chunks) < 2:
        for chunk in chunks:
            work(chunk)
        return
    try:
        with ThreadPoolExecutor(
            min(num_threads, len(chunks)), initializer=torch.set_num_threads, initargs=(1,)
        ) as pool:
            for _ in pool.map(work, chunks):
                pass
    finally:
        # The initializer changed the default that later threads start with.
        torch.set_num_threads(num_threads)
