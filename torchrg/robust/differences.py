"""Order statistics of the pairwise differences of many short rows."""

from math import comb

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.robust.chunks import chunks_of, run_chunks

_CHUNK_BYTES = 2**20
"""Differences of one chunk: they are read several times, so they have to stay in the cache."""


def half_size(n: int) -> int:
    """Size of the smallest majority of ``n`` values, the h of Qn: ``floor(n / 2) + 1``."""
    return n // 2 + 1


def majority_difference(sorted_rows: Tensor) -> Tensor:
    """Return the C(h, 2)-th smallest pairwise difference of each sorted row, h = floor(n/2) + 1.

    Two values that are h or more places apart enclose at least C(h + 1, 2) pairs that are no
    further apart than they are, so only lags 1 to h - 1 of the sorted row can hold the answer.

    Args:
        sorted_rows: Ascending values, shape ``(B, n)``, n >= 2; rows with NaN are allowed.

    Returns:
        The order statistic, shape ``(B,)``, exact; NaN where a row has one.
    """
    num_rows, n = sorted_rows.shape
    h = half_size(n)
    rank, num_differences = comb(h, 2), sum(n - lag for lag in range(1, h))
    out = sorted_rows.new_empty(num_rows)
    itemsize = sorted_rows.element_size()
    chunk_size = max(1, _CHUNK_BYTES // (num_differences * itemsize))
    if sorted_rows.device.type == "cpu":
        rows, result = sorted_rows.numpy(), out.numpy()

        def work(chunk: slice) -> None:
            differences = _lagged_differences(rows[chunk], h)
            differences.partition(rank - 1, axis=1)
            result[chunk] = differences[:, rank - 1]

        run_chunks(work, chunks_of(num_rows, chunk_size))
    else:
        lower, upper = _lagged_pairs(n, h, sorted_rows.device)
        for chunk in chunks_of(num_rows, 256 * chunk_size):
            differences = sorted_rows[chunk][:, upper] - sorted_rows[chunk][:, lower]
            out[chunk] = torch.kthvalue(differences, rank, dim=1).values
    out[sorted_rows[:, -1].isnan()] = torch.nan
    return out


def count_differences(sorted_rows: Tensor, bound: float) -> Tensor:
    """Count the pairwise differences at or below ``bound`` at lags below h, shape ``(B,)``."""
    num_rows, n = sorted_rows.shape
    count = torch.zeros(num_rows, dtype=torch.int32, device=sorted_rows.device)
    for lag in range(1, half_size(n)):
        near = sorted_rows[:, lag:] - sorted_rows[:, :-lag] <= bound
        count += near.sum(dim=1, dtype=torch.int32)
    return count


def _lagged_differences(rows: NDArray[np.floating], h: int) -> NDArray[np.floating]:
    """Write the differences at lags 1 to h - 1 of sorted ``rows`` side by side."""
    n = rows.shape[1]
    differences = np.empty((len(rows), sum(n - lag for lag in range(1, h))), rows.dtype)
    start = 0
    for lag in range(1, h):
        np.subtract(rows[:, lag:], rows[:, :-lag], out=differences[:, start : start + n - lag])
        start += n - lag
    return differences


def _lagged_pairs(n: int, h: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Places of the lower and upper value of each pair at lags 1 to h - 1."""
    lower = torch.cat([torch.arange(n - lag, device=device) for lag in range(1, h)])
    upper = torch.cat([torch.arange(lag, n, device=device) for lag in range(1, h)])
    return lower, upper
