"""Robust scales of many short rows: median absolute deviation, Qn, tau.

The constants make the scales consistent for the standard deviation of normal data.
"""

from collections.abc import Callable
from math import comb
from statistics import NormalDist

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ShapeError
from torchrg.robust.differences import count_differences, half_size, majority_difference
from torchrg.robust.lanes import median_of_sorted, sort_rows, sum_points

MAD_FACTOR = 1.4826
"""1 / Phi^-1(3/4), to the digits of the literature."""

QN_FACTOR = 2.2219
"""Factor of Qn as printed by Rousseeuw and Croux (1993), eq. 3.9, and by the method's eq. 7.

The exact value 1 / (sqrt(2) Phi^-1(5/8)) is 2.219144.
"""

QN_REVISED_FACTOR = 2.21914
"""Factor that goes with the finite-sample factors of :func:`qn_sample_factor`."""

_TAU_WEIGHT_CUT = 4.5
_TAU_SCALE_CUT = 3.0

_QN_SMALL: tuple[float, ...] = (0.399356, 0.99365, 0.51321, 0.84401, 0.6122, 0.85877)
_QN_SMALL += (0.66993, 0.87344, 0.72014, 0.88906, 0.75743)


def median(x: Tensor, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Return the median along an axis, the mean of the middle two for an even count.

    Args:
        x: Values, floating point, any shape.
        dim: Axis to reduce.
        mask: Which values count, same shape as ``x``, bool. Default: all.

    Returns:
        Medians, the shape of ``x`` without ``dim``; NaN where no value counts or one that counts
        is NaN.

    Raises:
        ShapeError: If ``x`` is not floating point, has no such axis, or ``mask`` differs in shape.

    Example:
        >>> median(torch.tensor([4.0, 1.0, 3.0, 2.0])).item()
        2.5
    """
    return _per_count("median", x, dim, mask, _sorted_median)


def mad(x: Tensor, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Return the median absolute deviation from the median, times 1.4826.

    Args:
        x: Values, floating point, any shape.
        dim: Axis to reduce.
        mask: Which values count, same shape as ``x``, bool. Default: all.

    Returns:
        Scales, the shape of ``x`` without ``dim``; 0 where more than half of the values are equal,
        NaN where no value counts or one that counts is NaN.

    Raises:
        ShapeError: If ``x`` is not floating point, has no such axis, or ``mask`` differs in shape.

    Example:
        >>> mad(torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0])).item()
        1.4825999736785889
    """

    def of_sorted(rows: Tensor) -> Tensor:
        deviations = (rows - _sorted_median(rows)[:, None]).abs()
        return MAD_FACTOR * _sorted_median(sort_rows(deviations))

    return _per_count("mad", x, dim, mask, of_sorted)


def qn(
    x: Tensor, *, dim: int = -1, finite_sample: bool = False, mask: Tensor | None = None
) -> Tensor:
    r"""Return the scale Qn of Rousseeuw and Croux, an order statistic of pairwise differences.

    :math:`Q_n = 2.2219 \{|x_i - x_j|;\ i < j\}_{(\kappa)}` with :math:`\kappa = \binom{h}{2}` and
    :math:`h = \lfloor n/2 \rfloor + 1` [1]. The order statistic is exact, without interpolation.

    Args:
        x: Values, floating point, any shape.
        dim: Axis to reduce.
        finite_sample: Multiply by the revised factor 2.21914 and by :func:`qn_sample_factor`
            instead of 2.2219, as R's robustbase does by default.
        mask: Which values count, same shape as ``x``, bool. Default: all.

    Returns:
        Scales, the shape of ``x`` without ``dim``; 0 where h values or more are equal or only one
        counts, NaN where none counts or one that counts is NaN.

    Raises:
        ShapeError: If ``x`` is not floating point, has no such axis, or ``mask`` differs in shape.

    References:
        [1] P. J. Rousseeuw, C. Croux. Alternatives to the median absolute deviation. Journal of
        the American Statistical Association 88, 1993.

    Example:
        >>> qn(torch.tensor([1.0, 2.0, 4.0, 8.0, 100.0]))
        tensor(6.6657)
    """

    def of_sorted(rows: Tensor) -> Tensor:
        n = rows.shape[1]
        if n < 2:
            return rows.new_zeros(len(rows)) if n else rows.new_full((len(rows),), torch.nan)
        factor = QN_REVISED_FACTOR * qn_sample_factor(n) if finite_sample else QN_FACTOR
        return factor * majority_difference(rows)

    return _per_count("qn", x, dim, mask, of_sorted)


def qn_exceeds(x: Tensor, threshold: float, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Tell where ``qn(x) > threshold``, by counting differences and selecting none.

    Args:
        x: Values, floating point, any shape.
        threshold: The bound, at least 0, in the unit of ``x``.
        dim: Axis to reduce.
        mask: Which values count, same shape as ``x``, bool. Default: all.

    Returns:
        The same as ``qn(x, dim=dim, mask=mask) > threshold``, bool; False where Qn is NaN.

    Raises:
        ShapeError: If ``x`` is not floating point, has no such axis, or ``mask`` differs in shape.

    Example:
        >>> qn_exceeds(torch.tensor([[1.0, 2, 3, 4], [1, 2, 30, 40]]), 5.0)
        tensor([False,  True])
    """

    def of_sorted(rows: Tensor) -> Tensor:
        n = rows.shape[1]
        if n < 2:
            return torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        bound = _largest_within(threshold, QN_FACTOR, rows.dtype)
        count = count_differences(rows, bound)
        return (count < comb(half_size(n), 2)) & ~rows[:, -1].isnan()

    return _per_count("qn_exceeds", x, dim, mask, of_sorted)


def tau(x: Tensor, *, dim: int = -1, mask: Tensor | None = None) -> Tensor:
    r"""Return the tau scale of Maronna and Zamar: a truncated standard deviation.

    With :math:`s_0` the median of the deviations from the median: the centre is the mean with
    bisquare weights that vanish at :math:`4.5 s_0`, and the scale the root of the mean square
    about it, each deviation cut at :math:`3 s_0` [1]. Cheaper than Qn for long rows, linear but
    for a sort.

    Args:
        x: Values, floating point, any shape.
        dim: Axis to reduce.
        mask: Which values count, same shape as ``x``, bool. Default: all.

    Returns:
        Scales, the shape of ``x`` without ``dim``; 0 where more than half of the values are equal,
        NaN where no value counts or one that counts is NaN.

    Raises:
        ShapeError: If ``x`` is not floating point, has no such axis, or ``mask`` differs in shape.

    References:
        [1] R. A. Maronna, R. H. Zamar. Robust estimates of location and dispersion for
        high-dimensional datasets. Technometrics 44, 2002.

    Example:
        >>> tau(torch.tensor([1.0, 2.0, 3.0, 4.0, 1000.0]))
        tensor(1.7441)
    """
    return _per_count("tau", x, dim, mask, tau_of_sorted)


def tau_of_sorted(rows: Tensor) -> Tensor:
    """Tau scale of each sorted row of ``(B, n)``, shape ``(B,)``."""
    if rows.shape[1] == 0:
        return rows.new_full((len(rows),), torch.nan)
    lanes = rows.t().contiguous()
    spread = _sorted_median(sort_rows((rows - _sorted_median(rows)[:, None]).abs()))
    unit = torch.where(spread > 0, spread, 1.0)
    standard = (lanes - _sorted_median(rows)) / unit
    weights = (1 - (standard / _TAU_WEIGHT_CUT) ** 2).clamp(min=0) ** 2
    center = sum_points(weights * standard) / sum_points(weights)
    squares = ((standard - center) ** 2).clamp(max=_TAU_SCALE_CUT**2)
    variance = sum_points(squares) / (len(lanes) * _tau_consistency())
    return torch.where(spread > 0, unit * variance.sqrt(), spread)


def _tau_consistency() -> float:
    """Mean of the truncated squares where the values are standard normal."""
    normal = NormalDist()
    cut = _TAU_SCALE_CUT * normal.inv_cdf(0.75)
    inside = (1 - cut * cut) * normal.cdf(cut) - cut * normal.pdf(cut) + cut * cut
    return 2 * inside - 1


def qn_sample_factor(n: int) -> float:
    """Return the factor that makes Qn of ``n`` normal values unbiased (robustbase's revision).

    Example:
        >>> round(qn_sample_factor(50), 6)
        0.930802
    """
    if n < 2:
        return 1.0
    if n <= 12:
        return _QN_SMALL[n - 2]
    if n % 2:
        return 1 / (1 + (1.60188 + (-2.1284 - 5.172 / n) / n) / n)
    return 1 / (1 + (3.67561 + (1.9654 + (6.987 - 77 / n) / n) / n) / n)


def _sorted_median(rows: Tensor) -> Tensor:
    """Median of each sorted row; NaN where the row is empty or has a NaN, which sorts last."""
    if rows.shape[1] == 0:
        return rows.new_full((len(rows),), torch.nan)
    return torch.where(rows[:, -1].isnan(), torch.nan, median_of_sorted(rows))


def _per_count(
    caller: str, x: Tensor, dim: int, mask: Tensor | None, of_sorted: Callable[[Tensor], Tensor]
) -> Tensor:
    """Apply a function of sorted rows ``(B, n)`` along ``dim``, once for each number of values.

    Values that do not count become +inf, sort last, and are cut off; a NaN that counts sorts
    behind them, so rows with one are set apart first.
    """
    x = as_tensor(caller, "x", x)
    check_floating(caller, x=x)
    check_shapes(caller, x=(x, "*"), mask=(mask, "*"))
    if not -x.dim() <= dim < x.dim():
        raise ShapeError(f"{caller}: expected x with an axis {dim}, got shape {tuple(x.shape)}.")
    rows = x.detach().movedim(dim, -1)
    shape, n = rows.shape[:-1], rows.shape[-1]
    rows = rows.reshape(shape.numel(), n)
    if mask is None:
        return of_sorted(sort_rows(rows.contiguous())).reshape(shape)
    counted = mask.movedim(dim, -1).reshape(shape.numel(), n)
    broken = (rows.isnan() & counted).any(dim=1)
    ascending = sort_rows(torch.where(counted, rows, torch.inf))
    counts = counted.sum(dim=1)
    out = rows.new_full((len(rows),), torch.nan)
    results: Tensor | None = None
    for count in sorted(set(counts.tolist())) or [n]:
        chosen = (counts == count) & ~broken
        found = of_sorted(ascending[chosen][:, :count].contiguous())
        results = out.to(found.dtype) if results is None else results
        results[chosen] = found
    return (out if results is None else results).reshape(shape)


def _largest_within(threshold: float, factor: float, dtype: torch.dtype) -> float:
    """Largest x of ``dtype`` with ``factor * x <= threshold`` in the arithmetic of ``dtype``."""
    kind = np.float32 if dtype == torch.float32 else np.float64
    limit, scale = kind(threshold), kind(factor)
    x = limit / scale
    while scale * x > limit:
        x = np.nextafter(x, kind(-np.inf))
    while scale * np.nextafter(x, kind(np.inf)) <= limit < np.inf:
        x = np.nextafter(x, kind(np.inf))
    return float(x)
