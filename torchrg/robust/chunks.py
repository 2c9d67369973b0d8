"""Work on many rows in chunks that fit the cache, on as many threads as torch may use."""

from collections.abc import Callable, Iterable
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


def run_chunks(work: Callable[[slice], None], chunks: Iterable[slice]) -> None:
    """Call ``work`` on each chunk, on ``torch.get_num_threads()`` threads.

    Every chunk writes its own rows, so the result does not depend on the number of threads. What
    ``work`` calls has to release the interpreter lock, as NumPy's loops, sorts and partitions do.
    """
    todo = list(chunks)
    num_threads = min(torch.get_num_threads(), len(todo))
    if num_threads < 2:
        for chunk in todo:
            work(chunk)
        return
    with ThreadPoolExecutor(num_threads) as pool:
        for _ in pool.map(work, todo):
            pass
