"""The difference that Qn picks, by counting: what compiled code does faster than sorting.

All differences of a row are compared with a pivot, which moves between those that were too low and
too high, until one difference is left. It is the same number, to the last bit, as sorting finds.
"""

from math import inf

import torch
from torch import Tensor

from torchrg._compile import kernel
from torchrg._parallel import chunks_of

_LANES = 16
"""Rows side by side: the numbers of the widest vectors, and a cache line."""

_ROWS_AT_ONCE = 8192
"""Rows that are worked on together, so that they stay in the cache."""

_NORMAL_QUARTERS = 0.3336
"""The difference that Qn picks, in units of that between the quartiles, of normal data."""

_QUICK_PASSES = 5
"""Passes that only count, at a third of the cost of the others. Nine rows of ten of normal data are
done then but for the difference itself."""


def majority_difference(sorted_rows: Tensor) -> Tensor:
    """Return the C(h, 2)-th smallest pairwise difference of each sorted row ``(B, n)``.

    The values are finite, and n at least 2. Only lags below h of a row can hold the difference.
    """
    chunks = chunks_of(len(sorted_rows), _ROWS_AT_ONCE)
    parts = [_of_chunk(sorted_rows[chunk]) for chunk in chunks]
    return torch.cat(parts) if parts else sorted_rows.new_empty(0)


def _of_chunk(rows: Tensor) -> Tensor:
    n = rows.shape[1]
    lags = n // 2
    rank = lags * (lags + 1) / 2
    lanes = _side_by_side(rows)
    # Of each row: which differences are too low, the next, which are not, and how many are within.
    low = next_low = num_low = torch.zeros_like(lanes[:, 0])
    high = lanes[:, n - 1] - lanes[:, 0]
    num_high = torch.full_like(high, n * lags - rank)
    pivot = (lanes[:, 3 * n // 4] - lanes[:, n // 4]) * _NORMAL_QUARTERS
    settled = torch.full_like(pivot, inf)
    for turn in range(_QUICK_PASSES):
        (number,) = _num_within(lanes, pivot)
        settled = torch.where((number == rank) | (number == rank - 1), pivot, settled)
        low, num_low = _keep(number < rank, (pivot, number), (low, num_low))
        high, num_high = _keep(number >= rank, (pivot, number), (high, num_high))
        # Few differences are small: at first their number grows with the pivot.
        share = (rank - 0.5 - num_low) / (num_high - num_low)
        guess = low + (high - low) * share if turn else pivot * rank / number.clamp(min=1)
        pivot = _inside(guess, low, high)
    pivot = torch.where(settled.isfinite(), settled, pivot)

    found = rows.new_empty(len(rows))
    places, is_middle = torch.arange(len(rows), device=rows.device), False
    while True:
        number, below, above = _around(lanes, pivot)
        low, num_low, next_low = _keep(
            number < rank, (pivot, number, above), (low, num_low, next_low)
        )
        high, num_high = _keep(number >= rank, (below, number), (high, num_high))
        high = torch.where(number == rank - 1, above, high)
        found[places] = high.flatten()[: len(places)]
        is_left = (number != rank) & (high > torch.maximum(low, next_low))
        left = is_left.flatten()[: len(places)].nonzero().squeeze(1)
        if len(left) == 0:
            return found
        places = places[left]
        lanes = _side_by_side(rows[places])
        low, num_low, next_low, high, num_high = (
            _fill_up(state.flatten()[left]).view(-1, _LANES)
            for state in (low, num_low, next_low, high, num_high)
        )
        guess = low + (high - low) * (rank - 0.5 - num_low) / (num_high - num_low)
        # In turns with the middle, which is also taken for a guess that is no better than a bound.
        pivot = torch.maximum(_inside(low if is_middle else guess, low, high), next_low)
        is_middle = not is_middle


def _keep(is_new: Tensor, new: tuple[Tensor, ...], old: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return what is new where it is to be taken."""
    return tuple(torch.where(is_new, a, b) for a, b in zip(new, old, strict=True))


def _inside(pivot: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the pivot where it is between the bounds, else their middle."""
    return torch.where((pivot > low) & (pivot < high), pivot, low + (high - low) / 2)


def _side_by_side(rows: Tensor) -> Tensor:
    """Lay rows ``(B, n)`` out as ``(B / 16, 3 L + 1, 16)``, with infinity behind their ends."""
    n = rows.shape[1]
    rows = _fill_up(rows)
    padded = rows.new_full((len(rows) // _LANES, 3 * (n // 2) + 1, _LANES), inf)
    padded[:, :n] = rows.view(-1, _LANES, n).transpose(1, 2)
    return padded


def _fill_up(rows: Tensor) -> Tensor:
    """Repeat the last row until there are whole blocks of rows."""
    missing = -len(rows) % _LANES
    return torch.cat([rows, rows[-1:].expand(missing, *rows.shape[1:])]) if missing else rows


@kernel("n 3L+1 16", "n 16")
def _num_within(lanes: Tensor, pivot: Tensor) -> tuple[Tensor]:
    """Return how many differences are at most the pivot."""
    within = _differences(lanes) <= pivot[:, None, None]
    return (within.to(lanes.dtype).sum(dim=(1, 2)),)


@kernel("n 3L+1 16", "n 16")
def _around(lanes: Tensor, pivot: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return how many differences are at most the pivot, the largest of them, and the next."""
    differences = _differences(lanes)
    within = differences <= pivot[:, None, None]
    beyond = differences > pivot[:, None, None]  # not so the NaN of what is infinite
    return (
        within.to(lanes.dtype).sum(dim=(1, 2)),
        torch.where(within, differences, 0.0).amax(dim=(1, 2)),
        torch.where(beyond, differences, inf).amin(dim=(1, 2)),
    )


def _differences(lanes: Tensor) -> Tensor:
    """Return the differences of rows ``(n, 3 L + 1, 16)`` at lags 1 to L, ``(n, 2 L + 1, L, 16)``.

    Rows have 2 L + 1 values, of which the last may be infinite, and L infinite ones behind them.
    """
    lags = (lanes.shape[1] - 1) // 3
    near = torch.arange(2 * lags + 1, device=lanes.device)[:, None]
    far = near + torch.arange(lags, device=lanes.device) + 1
    return lanes[:, far] - lanes[:, near]
