"""Order statistics of the pairwise differences of many short rows."""

from collections.abc import Iterator
from math import comb

import numpy as np
import torch
from torch import Tensor

from torchrg._chunks import chunks_of, share_chunks

_CHUNK_BYTES = 2**21
_NETWORK = 512
"""Values of 4 bytes that NumPy sorts without a branch (AVX-512), far faster than it partitions.

As integers, whose order is that of non-negative floats, they take two thirds of the time."""


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
    rank = comb(half_size(n), 2)
    out = sorted_rows.new_empty(num_rows)

    def work(chunks: Iterator[slice]) -> None:
        lagged = _Lagged(sorted_rows, paired=True)
        for chunk in chunks:
            out[chunk] = lagged.select(sorted_rows[chunk], rank)

    share_chunks(work, _chunks(sorted_rows), sorted_rows.device)
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
    out = torch.empty(len(sorted_rows), dtype=torch.int32, device=sorted_rows.device)

    def work(chunks: Iterator[slice]) -> None:
        lagged = _Lagged(sorted_rows, paired=False)
        for chunk in chunks:
            out[chunk] = lagged.count(sorted_rows[chunk], bound)

    share_chunks(work, _chunks(sorted_rows), sorted_rows.device)
    return out


class _Lagged:
    """A buffer for the differences at lags 1 to h - 1 of the rows of a chunk, side by side.

    With ``paired``, differences that fill two sorting networks go to one each.
    """

    def __init__(self, rows: Tensor, *, paired: bool) -> None:
        n = rows.shape[1]
        size = _chunk_size(rows)
        lags = range(1, half_size(n))
        width = sum(n - lag for lag in lags)
        first = _fitting(n, _NETWORK)
        self.on_cpu = rows.device.type == "cpu"
        self.paired = (
            paired
            and self.on_cpu
            and rows.element_size() == 4
            and _NETWORK < width <= _NETWORK + sum(n - lag for lag in range(1, first + 1))
            and sum(n - lag for lag in lags[first:]) <= _NETWORK
        )
        self.rows = rows.new_empty(size, n)
        self.differences = rows.new_empty(size, 2 * _NETWORK if self.paired else -(-width // 8) * 8)
        self._steps: list[tuple[Tensor, Tensor, Tensor]] = []
        self._pads: list[Tensor] = []
        start = 0
        for lag in lags:
            if self.paired and lag == first + 1:
                self._pads.append(self.differences[:, start:_NETWORK])
                start = _NETWORK
            near, far = self.rows[:, :-lag], self.rows[:, lag:]
            out = self.differences[:, start : start + n - lag]
            self._steps.append((far, near, out))
            start += n - lag
        self._pads.append(self.differences[:, start:])

    def _fill(self, rows: Tensor) -> Tensor:
        """Write the differences of up to a chunk of sorted rows."""
        self.rows[: len(rows)] = rows
        for minuend, subtrahend, out in self._steps:
            torch.sub(minuend, subtrahend, out=out)
        for pad in self._pads:
            pad.fill_(torch.inf)
        return self.differences[: len(rows)]

    def select(self, rows: Tensor, rank: int) -> Tensor:
        """The ``rank``-th smallest difference of each row."""
        differences = self._fill(rows)
        if self.paired:
            if not rows[:, :: rows.shape[1] - 1].isfinite().all():
                differences.abs_()  # inf - inf may be a NaN with a sign, which would sort first
            bits = differences.view(torch.int32)
            second = bits[:, _NETWORK:]
            torch.bitwise_not(second, out=second)
            bits.view(-1, _NETWORK).numpy().sort(axis=1)
            # Of two ascending rows, min(a_i, b_(r-1-i)) are the r smallest values together. The
            # second network has them inverted, so that they descend.
            mirrored = bits[:, 2 * _NETWORK - rank :].bitwise_not()
            return torch.minimum(bits[:, :rank], mirrored).amax(dim=1).view(torch.float32)
        if self.on_cpu:
            differences.numpy().partition(rank - 1, axis=1)
            return differences[:, rank - 1]
        return differences.kthvalue(rank, dim=1).values

    def count(self, rows: Tensor, bound: float) -> Tensor:
        """The number of differences at or below ``bound`` of each row."""
        differences = self._fill(rows)
        if not self.on_cpu:
            return (differences <= bound).sum(dim=1, dtype=torch.int32)
        flags = np.less_equal(differences.numpy(), bound).view(np.uint64)
        # Eight flags at a time: each byte of a sum counts up to 255 of them.
        parts = [flags[:, part].sum(axis=1) for part in chunks_of(flags.shape[1], 255)]
        counts = np.stack(parts, axis=1).view(np.uint8).sum(axis=1, dtype=np.int32)
        return torch.from_numpy(counts)


def _fitting(n: int, room: int) -> int:
    """How many lags from 1 on have together no more differences than there is room for."""
    lag = 0
    while lag < half_size(n) - 1 and room >= n - lag - 1:
        lag += 1
        room -= n - lag
    return lag


def _chunk_size(rows: Tensor) -> int:
    n = rows.shape[1]
    width = max(2 * _NETWORK, sum(n - lag for lag in range(1, half_size(n))))
    scale = 1 if rows.device.type == "cpu" else 256
    return min(len(rows), max(1, scale * _CHUNK_BYTES // (width * rows.element_size()))) or 1


def _chunks(rows: Tensor) -> list[slice]:
    return chunks_of(len(rows), _chunk_size(rows))
