"""Robust scales of many short rows: median absolute deviation, Qn and tau.

The factors make the scales consistent with the standard deviation of normal data.
"""

from collections.abc import Callable
from math import comb
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels
from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._opaque import opaque
from torchrg._parallel import CACHE_BYTES, ROWS_AT_ONCE, map_chunks
from torchrg.errors import ShapeError

MAD_FACTOR = 1.4826
"""1 / Phi^-1(3/4), with the digits used in the literature."""
QN_FACTOR = 2.2219
"""Factor of Qn in Rousseeuw and Croux (1993), eq. 3.9, and in the method's eq. 7.

The exact value 1 / (sqrt(2) Phi^-1(5/8)) is 2.219144.
"""
_QN_REVISED_FACTOR = 2.21914
"""Factor used with the finite-sample factors of :func:`qn_sample_factor`."""
_QN_SMALL: tuple[float, ...] = (0.399356, 0.99365, 0.51321, 0.84401, 0.6122, 0.85877)
_QN_SMALL += (0.66993, 0.87344, 0.72014, 0.88906, 0.75743)
"""Finite-sample factors for 2 to 12 values."""

_TAU_WEIGHT_CUT = 4.5
"""Deviation, in median deviations, beyond which a value has no weight in the center."""
_GPU_FRACTION = 256
"""Factor of the chunk size on a GPU, which has enough memory and a high launch overhead."""
_MAX_LISTED_VALUES = 400
"""Number of values per row up to which Qn lists the pairs; beyond it, counting them is faster."""
_TAU_SCALE_CUT = 3.0
"""Deviation at which values are truncated, in median deviations."""
_TAU_CONSISTENCY = 0.9247153921761306
"""Mean of the squares of standard normal values, truncated at this deviation."""


def median(x: Tensor, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Return the median along an axis, the mean of the middle two for an even count.

    Args:
        x: Values, floating point, any shape.
        dim: Axis to reduce.
        mask: Mask of values to use, same shape as ``x``, bool. Default: all.

    Returns:
        The shape of ``x`` without ``dim``; NaN for empty rows and rows with NaN.

    Raises:
        ShapeError: If ``x`` is not floating point or lacks the axis, or ``mask`` differs in shape.

    Example:
        >>> median(torch.tensor([4.0, 1.0, 3.0, 2.0])).item()
        2.5
    """
    return _reduce_axis("median", x, dim, mask)


def mad(x: Tensor, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Return the median absolute deviation from the median, times 1.4826.

    Otherwise as :func:`median`. It is 0 if more than half of the values are equal.

    Example:
        >>> mad(torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0])).item()
        1.4825999736785889
    """
    return _reduce_axis("mad", x, dim, mask)


def qn(
    x: Tensor, *, dim: int = -1, finite_sample: bool = False, mask: Tensor | None = None
) -> Tensor:
    r"""Return the scale Qn of Rousseeuw and Croux, an order statistic of pairwise differences.

    :math:`Q_n = 2.2219 \{|x_i - x_j|;\ i < j\}_{(\kappa)}` with :math:`\kappa = \binom{h}{2}` and
    :math:`h = \lfloor n/2 \rfloor + 1` [1]. The order statistic is exact, without interpolation.
    With ``finite_sample`` it is multiplied by the revised factor 2.21914 and by
    :func:`qn_sample_factor` instead of 2.2219, as in R's robustbase by default. Otherwise as
    :func:`median`. It is 0 if at least h values are equal, or for a single value. More than 400
    values take n log n time and linear memory.

    References:
        [1] P. J. Rousseeuw, C. Croux. Alternatives to the median absolute deviation. Journal of
        the American Statistical Association 88, 1993.

    Example:
        >>> qn(torch.tensor([1.0, 2.0, 4.0, 8.0, 100.0]))
        tensor(6.6657)
    """
    return _reduce_axis("qn", x, dim, mask, finite_sample)


def qn_exceeds(x: Tensor, threshold: float, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Return whether ``qn(x, dim=dim, mask=mask) > threshold``.

    ``threshold`` is in units of ``x``. Otherwise as :func:`median`. False where Qn is NaN.

    Example:
        >>> qn_exceeds(torch.tensor([[1.0, 2, 3, 4], [1, 2, 30, 40]]), 5.0)
        tensor([False,  True])
    """
    return qn(x.detach(), dim=dim, mask=mask) > threshold


def tau(x: Tensor, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Return the tau scale of Maronna and Zamar: a truncated standard deviation.

    Let :math:`s_0` be the median of the deviations from the median. The center is the mean with
    bisquare weights that vanish at :math:`4.5 s_0`. The scale is the RMS deviation from it, with
    each deviation truncated at :math:`3 s_0` [1]. Faster than Qn for long rows: linear except for a
    sort. Otherwise as :func:`median`. It is 0 if more than half of the values are equal.

    References:
        [1] R. A. Maronna, R. H. Zamar. Robust estimates of location and dispersion for
        high-dimensional datasets. Technometrics 44, 2002.

    Example:
        >>> tau(torch.tensor([1.0, 2.0, 3.0, 4.0, 1000.0]))
        tensor(1.7441)
    """
    return _reduce_axis("tau", x, dim, mask)


Scale = Literal["median", "mad", "qn", "tau"]


def _reduce_axis(
    name: Scale, x: Tensor, dim: int, mask: Tensor | None, finite_sample: bool = False
) -> Tensor:
    """Check the arguments of a scale, and reduce an axis."""
    x = as_tensor(name, "x", x)
    check_floating(name, x=x)
    check_shapes(name, x=(x, "*"), mask=(mask, "*"))
    if not -x.dim() <= dim < x.dim():
        raise ShapeError(f"{name}: expected x with an axis {dim}, got shape {tuple(x.shape)}.")
    counted = None if mask is None else mask.movedim(dim, -1)
    return scale_of_rows(x.movedim(dim, -1), counted, name=name, finite_sample=finite_sample)


@opaque(lambda rows: rows.new_empty(rows.shape[:-1]))
def scale_of_rows(
    rows: Tensor, mask: Tensor | None = None, *, name: Scale, finite_sample: bool = False
) -> Tensor:
    """Return a scale of each row of ``(*, n)``.

    The gradient keeps the selected values fixed: for Qn, a pair.
    """
    if not torch.is_grad_enabled():
        rows = rows.detach()
    shape, n = rows.shape[:-1], rows.shape[-1]
    if n == 0:
        return rows.new_full(shape, torch.nan)
    rows = rows.reshape(shape.numel(), n).contiguous()
    if mask is not None:
        # Masked-out values become +inf and sort last, before NaN.
        mask = mask.reshape(rows.shape)
        rows = torch.where(mask, rows, torch.inf)
    counts, ascending = _count_values(rows, mask), sort_rows(rows)
    undefined = ascending[:, -1].isnan() | (counts == 0)
    ascending = torch.where(undefined[:, None], 0.0, ascending)
    scales: dict[Scale, Callable[[], Tensor]] = {
        "median": lambda: median_of_sorted(ascending, counts),
        "mad": lambda: MAD_FACTOR * _median_deviation(ascending, counts),
        "qn": lambda: qn_of_sorted(ascending, counts, finite_sample=finite_sample),
        "tau": lambda: tau_of_sorted(ascending, counts),
    }
    return torch.where(undefined, torch.nan, scales[name]()).reshape(shape)


def _count_values(rows: Tensor, mask: Tensor | None) -> Tensor:
    """Return the number of values of each row ``(B, n)`` in a mask, by default all."""
    return (torch.ones_like(rows, dtype=torch.bool) if mask is None else mask).sum(dim=1)


def sort_rows(rows: Tensor) -> Tensor:
    """Sort each row of a contiguous ``(B, n)`` tensor, NaN last; NumPy is faster on CPUs."""
    if rows.device.type == "cpu" and not rows.requires_grad:
        return torch.from_numpy(np.sort(rows.numpy(), axis=1))
    return rows.sort(dim=1).values


def median_of_sorted(rows: Tensor, counts: Tensor | None = None) -> Tensor:
    """Median of each sorted row of ``(B, n)``: the mean of the middle two for an even n.

    In all scales, the first ``counts`` ``(B,)`` values of the rows are used, by default all.
    """
    if counts is None:
        count = rows.shape[1]
        low, high = rows[:, (count - 1) // 2], rows[:, count // 2]
        return low if count % 2 else low + (high - low) / 2
    middle = torch.stack([(counts - 1).clamp(min=0), counts], dim=1) // 2
    low, high = rows.gather(1, middle).unbind(dim=1)
    return torch.where(counts % 2 == 1, low, low + (high - low) / 2)


def _median_deviation(rows: Tensor, counts: Tensor | None = None) -> Tensor:
    """Median of the absolute deviations of each sorted row from its median."""
    center = median_of_sorted(rows, counts)
    deviations = sort_rows((rows - center[:, None]).abs())
    return torch.where(center.isfinite(), median_of_sorted(deviations, counts), torch.nan)


def tau_of_sorted(rows: Tensor, counts: Tensor | None = None) -> Tensor:
    """Tau scale of each sorted row of ``(B, n)``, shape ``(B,)``."""
    n, spread, middle = (
        rows.shape[1],
        _median_deviation(rows, counts),
        median_of_sorted(rows, counts),
    )
    counts = _count_values(rows, None) if counts is None else counts
    counted = torch.arange(n, device=rows.device)[:, None] < counts
    unit = torch.where(spread > 0, spread, 1.0)
    standard = (torch.where(counted, rows.t(), middle) - middle) / unit
    weights = counted * (1 - (standard / _TAU_WEIGHT_CUT) ** 2).clamp(min=0) ** 2
    center = sum_points(weights * standard) / sum_points(weights)
    squares = counted * ((standard - center) ** 2).clamp(max=_TAU_SCALE_CUT**2)
    variance = sum_points(squares) / (counts.double() * _TAU_CONSISTENCY).to(squares.dtype)
    return torch.where(spread > 0, unit * torch.where(spread > 0, variance, 1.0).sqrt(), spread)


def sum_points(values: Tensor) -> Tensor:
    """Sum each lane of ``(K, *)`` over its points, in the same order for every lane.

    Sums are therefore bit-identical at any position. ``torch.sum`` does not guarantee this: it adds
    the last lanes of a tensor in a different order.
    """
    if values.requires_grad:
        total = values.sum(dim=0)
        return sum_points(values.detach()) + (total - total.detach())
    if values.device.type == "cpu":
        # NumPy adds row by row only if rows are contiguous and longer than one.
        flat = values.reshape(len(values), -1).contiguous()
        if flat.shape[1] == 1:
            flat = flat.expand(-1, 2).contiguous()
        total = torch.from_numpy(np.add.reduce(flat.numpy(), axis=0))
        return total[: values[0].numel()].reshape(values.shape[1:])
    while len(values) > 1:
        half = len(values) // 2
        folded = values[:half] + values[half : 2 * half]
        values = torch.cat([folded, values[2 * half :]]) if len(values) % 2 else folded
    return values[0]


def qn_of_sorted(rows: Tensor, counts: Tensor | None = None, *, finite_sample: bool) -> Tensor:
    """Qn of each sorted row of ``(B, n)``, shape ``(B,)``."""
    counts = _count_values(rows, None) if counts is None else counts
    factors = [qn_factor(n) if finite_sample else QN_FACTOR for n in range(rows.shape[1] + 1)]
    return rows.new_tensor(factors)[counts] * _majority_difference(rows, counts)


def qn_factor(n: int) -> float:
    """Return the factor of Qn of ``n`` values with its finite-sample factor."""
    return _QN_REVISED_FACTOR * qn_sample_factor(n)


def qn_sample_factor(n: int) -> float:
    """Return the factor that makes Qn of ``n`` normal values unbiased (revised in robustbase)."""
    if n < 2:
        return 1.0
    if n <= 12:
        return _QN_SMALL[n - 2]
    if n % 2:
        return 1 / (1 + (1.60188 + (-2.1284 - 5.172 / n) / n) / n)
    return 1 / (1 + (3.67561 + (1.9654 + (6.987 - 77 / n) / n) / n) / n)


def half_size(n: int) -> int:
    """Size of the smallest majority of ``n`` values, h in Qn: ``floor(n / 2) + 1``."""
    return n // 2 + 1


def _majority_difference(sorted_rows: Tensor, counts: Tensor) -> Tensor:
    """Return the C(h, 2)-th smallest pairwise difference of each sorted row; NaN with a NaN.

    Two values at least h ranks apart enclose at least C(h + 1, 2) pairs that are no farther apart.
    Only lags 1 to h - 1 of the sorted row can contain the result.
    """
    if sorted_rows.requires_grad:
        difference = _majority_difference(sorted_rows.detach(), counts)
        return _difference_of_pair(sorted_rows, difference)
    differences = torch.full_like(sorted_rows[:, 0], torch.nan).masked_fill_(counts < 2, 0.0)
    if kernels.serve(sorted_rows, k=sorted_rows.shape[1]):

        def find(rows: slice) -> Tensor:
            return kernels.call("majority_differences", sorted_rows[rows], counts[rows])[0]

        parts = map_chunks(find, len(sorted_rows), ROWS_AT_ONCE, sorted_rows.device)
        differences = torch.cat(parts)
    undefined = differences.isnan()
    for count in set(counts[undefined].tolist()):
        rows = undefined & (counts == count)
        select = _difference_by_counts if count > _MAX_LISTED_VALUES else _difference_by_lags
        differences[rows] = select(sorted_rows[rows, :count])
    return differences


def _difference_by_counts(sorted_rows: Tensor) -> Tensor:
    """Implement :func:`_majority_difference` by bisection, in n log n time and linear memory.

    The differences of a value to larger ones ascend, so counting those up to a limit is a search
    for the end of a run. Non-negative numbers ascend like the integers of their bits: bisecting
    these narrows the limit to one number, and the runs with it.
    """
    n = sorted_rows.shape[1]
    h = half_size(n)
    integers = torch.int32 if sorted_rows.dtype == torch.float32 else torch.int64

    def select(chunk: slice) -> Tensor:
        rows = sorted_rows[chunk].contiguous()
        # The shortest half has C(h, 2) pairs. Two infinite values have the largest difference.
        lengths = rows[:, h - 1 :] - rows[:, : n - h + 1]
        shortest = torch.where(lengths.isnan(), torch.inf, lengths).amin(dim=1)
        low, high = torch.zeros_like(shortest).view(integers), shortest.view(integers)
        middle = (shortest / 4).view(integers)  # the result is a third of it for normal values
        starts = torch.arange(1, n + 1, device=rows.device)
        first, last = (ends.expand(rows.shape) for ends in (starts, (starts + h - 1).clamp(max=n)))
        while bool((low < high).any()):
            ends = _ends_of_runs(rows, first, last, middle.view(rows.dtype)[:, None])
            enough = (ends - starts).sum(dim=1) >= comb(h, 2)
            low, high = torch.where(enough, low, middle + 1), torch.where(enough, middle, high)
            first = torch.where(enough[:, None], first, ends)
            last = torch.where(enough[:, None], ends, last)
            middle = low + (high - low) // 2
        return high.view(rows.dtype)

    size = max(CACHE_BYTES // (n * torch.int64.itemsize), 1)
    parts = map_chunks(select, len(sorted_rows), size, sorted_rows.device, min_rows=1)
    return torch.where(sorted_rows[:, -1].isnan(), torch.nan, torch.cat(parts))


def _ends_of_runs(rows: Tensor, first: Tensor, last: Tensor, limit: Tensor) -> Tensor:
    """Return where the differences to each value of sorted rows exceed a limit.

    The runs start right of the values; their ends are known to be from ``first`` to ``last``.
    """
    ends, largest = first, rows.shape[1] - 1
    for power in reversed(range(int((last - first).max()).bit_length())):
        further = ends + 2**power
        differences = rows.gather(1, (further - 1).clamp_(max=largest)).sub_(rows)
        ends = torch.where((differences <= limit) & (further <= last), further, ends)
    return ends


def _difference_by_lags(sorted_rows: Tensor) -> Tensor:
    """Implement :func:`_majority_difference` for all values and devices."""
    n, on_cpu = sorted_rows.shape[1], sorted_rows.device.type == "cpu"
    lags = range(1, half_size(n))
    rank, width = comb(half_size(n), 2), sum(n - lag for lag in lags)
    size = (1 if on_cpu else _GPU_FRACTION) * CACHE_BYTES // (width * sorted_rows.element_size())

    def select(chunk: slice) -> Tensor:
        rows = sorted_rows[chunk]
        differences = torch.cat([rows[:, lag:] - rows[:, : n - lag] for lag in lags], dim=1)
        # The difference of two infinite values is larger than all others.
        differences.nan_to_num_(nan=torch.inf, posinf=torch.inf)
        if on_cpu:
            differences.numpy().partition(rank - 1, axis=1)
            return differences[:, rank - 1].clone()
        return differences.kthvalue(rank, dim=1).values

    parts = map_chunks(select, len(sorted_rows), max(size, 1), sorted_rows.device)
    return torch.where(sorted_rows[:, -1].isnan(), torch.nan, torch.cat(parts))


def _difference_of_pair(sorted_rows: Tensor, difference: Tensor) -> Tensor:
    """Express the selected difference of each row by its first matching pair."""
    rows = sorted_rows.detach()
    # The sum may have a rounding error; the partner is at this index or next to it.
    index = torch.searchsorted(rows, rows + difference[:, None])
    last = rows.shape[1] - 1
    partners = torch.stack([(index + step).clamp(0, last) for step in (-1, 0, 1)], dim=-1)
    numbers = torch.arange(last + 1, device=rows.device)[:, None].expand_as(partners)
    gaps = rows[:, None].expand(*partners.shape[:2], -1).gather(2, partners) - rows[..., None]
    is_pair = (gaps == difference[:, None, None]) & (partners > numbers)
    pick = is_pair.flatten(1).to(torch.uint8).argmax(dim=1, keepdim=True)
    low, high = (sorted_rows.gather(1, i.flatten(1).gather(1, pick)) for i in (numbers, partners))
    return torch.where(difference.isfinite(), (high - low).squeeze(1), difference)
