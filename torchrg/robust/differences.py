"""Order statistics of the pairwise differences of many short rows."""

from collections.abc import Iterator
from functools import lru_cache
from math import comb
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._chunks import chunks_of, share_chunks

_CHUNK_BYTES = 2**22
_NETWORK = 512
"""Values of 4 bytes that NumPy sorts without a branch (AVX-512), far faster than it partitions.

As integers, whose order is that of non-negative floats, they take two thirds of the time."""

_MOST_LAGS = 8
"""Lags in one subtraction. They are all as wide as the first of them."""


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
        lagged = _Lagged(sorted_rows, sorts=True)
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
        lagged = _Lagged(sorted_rows, sorts=False)
        for chunk in chunks:
            out[chunk] = lagged.count(sorted_rows[chunk], bound)

    share_chunks(work, _chunks(sorted_rows), sorted_rows.device)
    return out


class _Lagged:
    """A buffer for the differences at lags 1 to h - 1 of the rows of a chunk, side by side.

    With ``sorts``, differences that fill one or two sorting networks go to these.
    """

    def __init__(self, rows: Tensor, *, sorts: bool) -> None:
        n = rows.shape[1]
        size, pitch = _chunk_size(rows), n + half_size(n)
        self.on_cpu = rows.device.type == "cpu"
        self.finite = bool(rows[:, :: max(n - 1, 1)].isfinite().all())
        runs = _runs_in_networks(n) if sorts and self.on_cpu and rows.element_size() == 4 else []
        self.num_networks = -(-runs[-1].stop // _NETWORK) if runs else 0
        runs = runs or _lay_out(n, _MOST_LAGS, room=None)
        width = self.num_networks * _NETWORK or -(-runs[-1].stop // 8) * 8
        # Windows that reach beyond the end of a row find infinity there.
        self.rows = rows.new_full((size, pitch), torch.inf)
        self.differences = rows.new_empty(size, width)
        self._steps: list[tuple[Tensor, Tensor, Tensor]] = []
        self._pads: list[Tensor] = []
        for run, following in zip(runs, [*runs[1:], None], strict=True):
            shape = (size, run.num_lags, run.width)
            far = self.rows.as_strided(shape, (pitch, 1, 1), run.lag)
            out = self.differences[:, run.start : run.stop].view(shape)
            self._steps.append((far, self.rows[:, None, : run.width], out))
            end = width if following is None else following.start
            if run.stop < end:
                self._pads.append(self.differences[:, run.stop : end])

    def _fill(self, rows: Tensor) -> Tensor:
        """Write the differences of up to a chunk of sorted rows."""
        count, n = rows.shape
        steps = self._steps
        if count < len(self.rows):
            steps = [(far[:count], near[:count], out[:count]) for far, near, out in steps]
        self.rows[:count, :n] = rows
        for far, near, out in steps:
            torch.sub(far, near, out=out)
        for pad in self._pads:
            pad.fill_(torch.inf)
        return self.differences[:count]

    def select(self, rows: Tensor, rank: int) -> Tensor:
        """The ``rank``-th smallest difference of each row."""
        differences = self._fill(rows)
        if self.num_networks:
            if not self.finite:
                differences.abs_()  # inf - inf may be a NaN with a sign, which would sort first
            bits = differences.view(torch.int32)
            if self.num_networks == 1:
                bits.numpy().sort(axis=1)
                return bits[:, rank - 1].view(torch.float32)
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


class _Run(NamedTuple):
    """Consecutive lags whose differences are one subtraction of overlapping windows."""

    lag: int
    num_lags: int
    width: int
    start: int

    @property
    def stop(self) -> int:
        """Where its differences end."""
        return self.start + self.num_lags * self.width


def _lay_out(n: int, most_lags: int, room: int | None) -> list[_Run]:
    """Lay lags 1 to h - 1 out in runs, none of which crosses a multiple of ``room``."""
    runs: list[_Run] = []
    lag, start = 1, 0
    while lag < half_size(n):
        width = n - lag
        num_lags = min(most_lags, half_size(n) - lag)
        if room is not None:
            left = room - start % room
            if left < width:
                start += left
                left = room
            num_lags = min(num_lags, left // width)
        runs.append(_Run(lag, num_lags, width, start))
        lag, start = lag + num_lags, runs[-1].stop
    return runs


@lru_cache(maxsize=256)
def _runs_in_networks(n: int) -> list[_Run]:
    """The fewest runs that fit two sorting networks, none if they do not."""
    for most_lags in range(_MOST_LAGS, 0, -1) if n <= _NETWORK else ():
        runs = _lay_out(n, most_lags, _NETWORK)
        if runs and runs[-1].stop <= 2 * _NETWORK:
            return runs
    return []


def _chunk_size(rows: Tensor) -> int:
    n = rows.shape[1]
    width = max(2 * _NETWORK, sum(n - lag for lag in range(1, half_size(n))))
    scale = 1 if rows.device.type == "cpu" else 256
    return min(len(rows), max(1, scale * _CHUNK_BYTES // (width * rows.element_size()))) or 1


def _chunks(rows: Tensor) -> list[slice]:
    return chunks_of(len(rows), _chunk_size(rows))
