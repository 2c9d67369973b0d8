"""How noisy the depths of an image are, in the image itself."""

from collections.abc import Mapping

import torch
from torch import Tensor

from torchrg.depth.windows import WindowPlanes
from torchrg.linalg import machine_epsilon

_FLAT_QUANTILE = 0.35
_NUM_BINS = 12
_MOST_GROWTH = 1.4
_ROUNDING = 8.0
_LEAST_ROUNDING = 1e-7


def noise_by_radius(
    windows: Mapping[int, WindowPlanes],
    inverse: Tensor,
    seen: Tensor,
    given: tuple[float, float] | None,
    dtype: torch.dtype,
) -> dict[int, Tensor]:
    r"""Return the noise of inverse depth at each pixel, for windows of each size.

    A standard deviation of ``a + b z^2`` in depth is one of ``b + a w^2`` in inverse depth
    ``w = 1 / z``. Where ``a`` and ``b`` are not given, they are fitted to what windows deviate from
    their planes: to the 35 % quantiles of twelve classes of depth, as at least a third of an indoor
    image is flat. Neighbouring pixels of a sensor err alike, and its depth has steps, so that large
    windows deviate more than small ones: the noise has a factor for each size, which grows at most
    by 1.4 from one to the next.

    Args:
        windows: Planes of the windows by radius.
        inverse: Inverse depth, shape ``(H, W)``, float64.
        seen: Pixels with depth, shape ``(H, W)``, bool.
        given: The two numbers, if they are known.
        dtype: Dtype of the depth, whose rounding is the least noise.

    Returns:
        Noise by radius, shape ``(H, W)`` each, positive where seen.

    Example:
        >>> inverse, seen = torch.full((4, 4), 0.5).double(), torch.ones(4, 4).bool()
        >>> noise = noise_by_radius({}, inverse, seen, (0.0, 0.001), torch.float32)
        >>> noise
        {}
    """
    rounding = max(_ROUNDING * machine_epsilon(dtype), _LEAST_ROUNDING) * inverse
    square = inverse * inverse
    if given is not None:
        constant, growth = given
        known = torch.maximum(growth + constant * square, rounding)
        return dict.fromkeys(windows, known)
    middle = sorted(windows)[len(windows) // 2 - 1]
    constant, growth = _fit_noise(windows[middle].deviation, square, seen, rounding)
    shape = torch.maximum(growth + constant * square, rounding)
    noise, factor = {}, 0.0
    for radius in sorted(windows):
        deviation = torch.maximum(windows[radius].deviation, rounding)
        ratios = (deviation / shape)[seen & deviation.isfinite()]
        found = float(_low_quantile(ratios)) if len(ratios) else factor
        factor = found if factor == 0 else min(max(found, factor), _MOST_GROWTH * factor)
        noise[radius] = torch.maximum(factor * shape, rounding)
    return noise


def _low_quantile(values: Tensor) -> Tensor:
    """Return the quantile of values that flat windows reach."""
    return values.kthvalue(1 + int(_FLAT_QUANTILE * (len(values) - 1))).values


def _fit_noise(
    deviation: Tensor, square: Tensor, seen: Tensor, rounding: Tensor
) -> tuple[float, float]:
    """Fit ``b + a w^2``, both not negative, to the deviations of flat windows; return a and b."""
    used = seen & deviation.isfinite()
    squares, order = square[used].sort()
    deviations, least = deviation[used][order], rounding[used][order]
    bins = [part for part in torch.arange(len(order)).tensor_split(_NUM_BINS) if len(part)]
    if not bins:
        return 0.0, 0.0
    x = torch.stack([squares[part].mean() for part in bins])
    q = torch.stack(
        [torch.maximum(_low_quantile(deviations[part]), least[part[0]]) for part in bins]
    )
    # Relative errors: a class whose windows are all cluttered counts little.
    p, e = x / q, 1 / q
    spread = (p * p).sum() * (e * e).sum() - (p * e).sum() ** 2
    constant = (p.sum() * (e * e).sum() - e.sum() * (p * e).sum()) / spread
    growth = (e.sum() * (p * p).sum() - p.sum() * (p * e).sum()) / spread
    if not bool(growth > 0):
        return float(p.sum() / (p * p).sum()), 0.0
    if not bool(constant > 0):
        return 0.0, float(e.sum() / (e * e).sum())
    return float(constant), float(growth)
