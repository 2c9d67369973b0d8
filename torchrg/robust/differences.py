"""Order statistics of the pairwise differences of many short rows."""

from math import comb

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.robust.chunks import chunks_of, run_chunks

_CHUNK_BYTES = 2**21
"""Differences of one chunk; they are written once and read twice, so they should stay near."""
_NETWORK = 512
"""Values of 4 bytes that NumPy sorts without a branch (AVX-512), far faster than it partitions."""


def half_size(n: int) -> int:
    """Size of the smallest majority of ``n`` values, the h of Qn: ``floor(n / 2) + 1``."""
    return n // 2 + 1


def majority_difference(sorted_rows: Tensor) -> Tensor:
    """Return the C(h, 2)-th smallest pairwise difference of each sorted row, h = floor(n/2) + 1.

    Two values that are h or more places apart enclose at least C(h + 1, 2) pairs that are no
    further apart than they are, so only lags 1 to h - 1 of the sorted row can hold the answer.

    Args:
        sorted_rows: Ascending values, shape ``(B, n)``, n >= 2; NaN last.

    Returns:
        The order statistic, shape ``(B,)``, exact; NaN where a row has one.
    """
    num_rows, n = sorted_rows.shape
    rank, width = comb(half_size(n), 2), _num_lagged(n)
    out = sorted_rows.new_empty(num_rows)
    pieces = -(-width // _NETWORK) if sorted_rows.element_size() == 4 else 0
    padded = _NETWORK * pieces if pieces in (1, 2) and width > _NETWORK // 2 else width

    def work(chunk: slice) -> None:
        differences = _lagged_differences(sorted_rows[chunk], padded)
        if differences.device.type == "cpu":
            out.numpy()[chunk] = _select_row_wise(differences.numpy(), rank)
        else:
            out[chunk] = differences.kthvalue(rank, dim=1).values

    run_chunks(work, _chunks(sorted_rows, padded), sorted_rows.device)
    out[sorted_rows[:, -1].isnan()] = torch.nan
    return out


def count_differences(sorted_rows: Tensor, bound: float) -> Tensor:
    """Count the pairwise differences at lags 1 to h - 1 that are at or below ``bound``.

    Args:
        sorted_rows: Ascending values, shape ``(B, n)``, n >= 2; NaN last.
        bound: The bound, at least 0.

    Returns:
        Counts, shape ``(B,)``, int32.
    """
    num_rows, n = sorted_rows.shape
    width = -(-_num_lagged(n) // 8) * 8
    out = torch.empty(num_rows, dtype=torch.int32, device=sorted_rows.device)

    def work(chunk: slice) -> None:
        differences = _lagged_differences(sorted_rows[chunk], width)
        if differences.device.type == "cpu":
            # Eight flags at a time: each byte of a sum counts up to 255 of them.
            flags = np.less_equal(differences.numpy(), bound).view(np.uint64)
            bytes_ = [flags[:, part].sum(axis=1).view(np.uint8) for part in _parts(width // 8)]
            counts = np.concatenate([b.reshape(-1, 8) for b in bytes_], axis=1).sum(axis=1)
            out.numpy()[chunk] = counts
        else:
            out[chunk] = (differences <= bound).sum(dim=1, dtype=torch.int32)

    run_chunks(work, _chunks(sorted_rows, width), sorted_rows.device)
    return out


def _select_row_wise(differences: NDArray[np.floating], rank: int) -> NDArray[np.floating]:
    """The ``rank``-th smallest of each row; a row of one or two networks is overwritten."""
    width = differences.shape[1]
    if width not in (_NETWORK, 2 * _NETWORK) or rank > _NETWORK:
        differences.partition(rank - 1, axis=1)
        return differences[:, rank - 1]
    for part in (slice(0, _NETWORK), slice(_NETWORK, width)):
        differences[:, part].sort(axis=1)
    if width == _NETWORK:
        return differences[:, rank - 1]
    # Of two sorted rows, min(a_i, b_(r-1-i)) are the r smallest values together.
    low, high = differences[:, :rank], differences[:, _NETWORK : _NETWORK + rank]
    selected: NDArray[np.floating] = np.minimum(low, high[:, ::-1]).max(axis=1)
    return selected


def _lagged_differences(rows: Tensor, width: int) -> Tensor:
    """Differences of sorted ``rows`` at lags 1 to h - 1 side by side, then +inf up to ``width``."""
    num_rows, n = rows.shape
    differences = rows.new_empty(num_rows, width)
    start = 0
    for lag in range(1, half_size(n)):
        stop = start + n - lag
        torch.sub(rows[:, lag:], rows[:, :-lag], out=differences[:, start:stop])
        start = stop
    differences[:, start:] = torch.inf
    return differences


def _num_lagged(n: int) -> int:
    return sum(n - lag for lag in range(1, half_size(n)))


def _chunks(rows: Tensor, width: int) -> list[slice]:
    scale = 1 if rows.device.type == "cpu" else 256
    return chunks_of(len(rows), max(1, scale * _CHUNK_BYTES // (width * rows.element_size())))


def _parts(num_words: int) -> list[slice]:
    return chunks_of(num_words, 255)
