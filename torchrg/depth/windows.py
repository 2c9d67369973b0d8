"""Planes of square windows all over a depth image, of narrow ones here and there, and their noise.

Windows are squares of 5 by 5 cells, and a cell is 1, 2, 4 or 8 pixels wide. Windows stand a cell
apart, so that the sums over all large ones together cost less than those over the smallest.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import map_rows, map_tasks
from torchrg.linalg import machine_epsilon
from torchrg.linalg.moments import kth_smallest

CELL_SIZES = (8, 4, 2, 1)
"""Widths of the cells in pixels, the largest first."""
REACH = 2
"""A window reaches over so many cells around its middle one."""
SIDE = 2 * REACH + 1
"""Cells along a side of a window."""
NARROW = ((3, 9), (9, 3))
"""Rows and columns of narrow windows in pixels; each has about as many as the smallest square."""
_LEAST_SHARE = 0.4
"""Least share of a window's pixels that must be seen for it to have a plane."""
_LEAST_SPREAD = 0.2
"""Least determinant of the covariance of a window's pixels, as a share of that of a full window.
With less, the pixels lie nearly on a line and tell no plane."""
_FLAT_QUANTILE = 0.35
"""Share of the windows of an image that deviate by noise alone: at least a third of it is flat."""
_NUM_BINS = 12
"""Classes of depth that noise is fitted to."""
_MOST_GROWTH = 1.4
"""Noise of windows grows at most by this from one size to the next."""
_MOST_JITTER = 0.15
"""Pixels by which rays may be off the middles of their pixels, standard deviation."""
_ROUNDING = 8.0
"""Least noise of inverse depth, in units of the rounding of the depth."""
_LEAST_ROUNDING = 1e-7
"""Least noise of inverse depth as a share of it, whatever the dtype: the rounding of float32."""


class WindowPlanes(NamedTuple):
    """Planes ``value = u_slope * u + v_slope * v + origin`` of windows.

    ``deviation`` is the standard deviation of a window's pixels from its plane, infinite where
    there is none, ``mean`` their mean value. All are of one shape, ``(h, w)`` for the windows
    around the cells of an image.
    """

    u_slope: Tensor
    v_slope: Tensor
    origin: Tensor
    deviation: Tensor
    mean: Tensor

    def take(self, places: Tensor) -> "WindowPlanes":
        """Return those at some row-major places."""
        return WindowPlanes(*(part.flatten()[places] for part in self))


def fit_windows(values: Tensor, seen: Tensor, u: Tensor, v: Tensor) -> dict[int, WindowPlanes]:
    """Fit a plane by least squares to the window around each cell, for ascending sizes of cells.

    The image ``(H, W)``, float64, holds anything finite where not seen; its columns are at ``u``
    ``(W,)``, its rows at ``v`` ``(H, 1)``. Cells begin at the first pixel, and windows are cut off
    at the borders of the image. One with too few pixels seen, or nearly on a line, has no plane.
    """
    ones = seen.to(values.dtype)
    w = torch.where(seen, values, 0.0)
    mu, mv = ones * u, ones * v
    moments = [ones, mu, mv, w, mu * u, mu * v, mv * v, w * u, w * v, w * w]
    sums = zip(*map_tasks(_window_sums, moments, values.device), strict=True)
    return {
        size: _fit_planes(some, (SIDE * size, SIDE * size))
        for size, some in zip(sorted(CELL_SIZES), sums, strict=True)
    }


def fit_narrow_windows(
    values: Tensor, seen: Tensor, u: Tensor, v: Tensor, pixels: Tensor
) -> tuple[WindowPlanes, Tensor]:
    """Fit a plane to the window of either narrow shape around some pixels ``(n,)``.

    The other arguments are those of :func:`fit_windows`. Returns planes of shape ``(2, n)``, and
    the pixels that the windows hold ``(2, n, 27)``, by row-major place; -1 for those not seen.
    """
    (height, width), usable = values.shape, seen.flatten()
    held = []
    for rows, columns in NARROW:
        step = torch.arange(rows * columns, device=pixels.device)
        row = pixels[:, None] // width + step // columns - rows // 2
        column = pixels[:, None] % width + step % columns - columns // 2
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        place = torch.where(inside, row * width + column, 0)
        held.append(torch.where(inside & usable[place], place, -1))
    places = torch.stack(held)
    at, ones = places.clamp(min=0), (places >= 0).to(values.dtype)
    mu, mv, w = u[at % width] * ones, v.flatten()[at // width] * ones, values.flatten()[at] * ones
    products = [ones, mu, mv, w, mu * mu, mu * mv, mv * mv, w * mu, w * mv, w * w]
    return _fit_planes([part.sum(dim=2) for part in products], NARROW[0]), places


def _window_sums(image: Tensor) -> list[Tensor]:
    """Return the sums of an image over the windows of each size ``(h, w)``; sizes ascend."""
    sums = []
    for size in sorted(CELL_SIZES):
        image = _sums_of_pairs(image) if size > 1 else image
        sums.append(_sums_around(image))
    return sums


def _sums_of_pairs(cells: Tensor) -> Tensor:
    """Return the sums over cells of twice the width, ``(ceil(h / 2), ceil(w / 2))``."""
    height, width = cells.shape
    if height % 2 or width % 2:
        cells = torch.nn.functional.pad(cells, (0, width % 2, 0, height % 2))
    rows = cells[0::2] + cells[1::2]
    return rows[:, 0::2] + rows[:, 1::2]


def _sums_around(cells: Tensor) -> Tensor:
    """Return the sums over the cells of the window around each, ``(h, w)``."""
    for axis in (0, 1):
        length, total = cells.shape[axis], cells.clone()
        for step in range(1, min(REACH, length - 1) + 1):
            total.narrow(axis, step, length - step).add_(cells.narrow(axis, 0, length - step))
            total.narrow(axis, 0, length - step).add_(cells.narrow(axis, step, length - step))
        cells = total
    return cells


def _fit_planes(sums: Sequence[Tensor], sides: tuple[int, int]) -> WindowPlanes:
    """Return the planes of windows with so many pixels along their sides, from sums of moments."""
    one, other = sides
    full = (one * one - 1) * (other * other - 1) / 144
    least = sums[0].new_tensor([_LEAST_SHARE * one * other, _LEAST_SPREAD * full])
    columns = map_rows(_planes_of_sums, [part.flatten() for part in sums], least)
    return WindowPlanes(*(part.view(sums[0].shape) for part in columns))


def _planes_of_sums(
    count: Tensor,
    u: Tensor,
    v: Tensor,
    w: Tensor,
    uu: Tensor,
    uv: Tensor,
    vv: Tensor,
    uw: Tensor,
    vw: Tensor,
    ww: Tensor,
    least: Tensor,
) -> tuple[Tensor, ...]:
    """Return the planes of windows; ``least`` is the count and the spread of one that has any."""
    share = 1 / count.clamp(min=1)
    u, v, w, uu, uv, vv, uw, vw, ww = (sums * share for sums in (u, v, w, uu, uv, vv, uw, vw, ww))
    uu, uv, vv = uu - u * u, uv - u * v, vv - v * v
    uw, vw, ww = uw - u * w, vw - v * w, ww - w * w
    spread = uu * vv - uv * uv
    least_count, least_spread = least.unbind()
    has_plane = (count >= least_count) & (spread > least_spread)
    spread = torch.where(has_plane, spread, 1.0)
    u_slope, v_slope = (vv * uw - uv * vw) / spread, (uu * vw - uv * uw) / spread
    variance = (ww - u_slope * uw - v_slope * vw).clamp(min=0) * count / (count - 3).clamp(min=1)
    deviation = torch.where(has_plane, variance.sqrt(), torch.inf)
    return u_slope, v_slope, w - u_slope * u - v_slope * v, deviation, w


class WindowNoise(NamedTuple):
    """Noise of inverse depth ``w`` as windows of a size see it: ``factor (growth + constant w^2)``.

    It is never less than ``rounding`` times the inverse depth.
    """

    factor: float
    constant: float
    growth: float
    rounding: float

    def at(self, inverse: Tensor) -> Tensor:
        """Return the noise at inverse depths."""
        return noise_at(inverse, *self)


def noise_at(
    inverse: Tensor,
    factor: float | Tensor,
    constant: float | Tensor,
    growth: float | Tensor,
    rounding: float | Tensor,
) -> Tensor:
    """Return the noise at inverse depths, from the parts of :class:`WindowNoise`."""
    least = rounding * inverse
    usual = torch.maximum(growth + constant * (inverse * inverse), least)
    return torch.maximum(factor * usual, least)


def noise_by_size(
    windows: Mapping[int, WindowPlanes], given: tuple[float, float] | None, dtype: torch.dtype
) -> dict[int, WindowNoise]:
    """Return the noise of inverse depth as windows of each size see it.

    A standard deviation of ``a + b z^2`` in depth is one of ``b + a w^2`` in inverse depth
    ``w = 1 / z``. Where ``a`` and ``b`` are not given, they are fitted to what windows deviate from
    their planes: to the 35 % quantiles of twelve classes of depth. Neighbouring pixels of a sensor
    err alike, and its depth has steps, so that large windows deviate more than small ones: the
    noise has a factor for each size. It is never less than the rounding of ``dtype``, that of the
    depth.
    """
    rounding = max(_ROUNDING * machine_epsilon(dtype), _LEAST_ROUNDING)
    if given is not None:
        constant, growth = given
        return dict.fromkeys(windows, WindowNoise(1.0, constant, growth, rounding))
    middle = windows[sorted(windows)[len(windows) // 2 - 1]]
    shape = WindowNoise(1.0, *_fit_noise(middle, rounding), rounding)
    noises, factor = {}, 0.0
    for size in sorted(windows):
        has_plane = windows[size].deviation.isfinite()
        deviation, mean = windows[size].deviation[has_plane], windows[size].mean[has_plane]
        ratios = torch.maximum(deviation, rounding * mean) / shape.at(mean)
        usual = float(_low_quantile(ratios)) if len(ratios) else factor
        factor = usual if factor == 0 else min(max(usual, factor), _MOST_GROWTH * factor)
        noises[size] = shape._replace(factor=factor)
    return noises


def find_jitter(windows: WindowPlanes) -> float:
    """Return by how many pixels the rays of an image are off the middles of their pixels.

    It is a standard deviation, from 0 for exact rays to 0.15. Jitter moves a value by as much of
    what it changes from one pixel to the next, so that it shows in windows that are steep: no flat
    window deviates by less. Of the steeper half of the classes of steepness the one counts where
    flat windows deviate least.
    """
    # Windows stand a cell apart and overlap.
    some = WindowPlanes(*(part[::REACH, ::REACH] for part in windows))
    slope = torch.hypot(some.u_slope, some.v_slope)
    used = some.deviation.isfinite() & (slope > 0)
    slope, order = slope[used].sort()
    ratio = some.deviation[used][order] / slope
    steep = ratio.tensor_split(_NUM_BINS)[_NUM_BINS // 2 :]
    return min([_MOST_JITTER, *(float(_low_quantile(part)) for part in steep if len(part))])


def _low_quantile(values: Tensor) -> Tensor:
    """Return the quantile of values that flat windows reach."""
    return kth_smallest(values, int(_FLAT_QUANTILE * (len(values) - 1)))


def _fit_noise(windows: WindowPlanes, rounding: float) -> tuple[float, float]:
    """Fit ``b + a w^2``, both not negative, to the deviations of flat windows; return a and b."""
    used = windows.deviation.isfinite()
    mean, order = windows.mean[used].sort()
    deviation = torch.maximum(windows.deviation[used][order], rounding * mean)
    bins = [part for part in torch.arange(len(order)).tensor_split(_NUM_BINS) if len(part)]
    if not bins:
        return 0.0, 0.0
    x = torch.stack([mean[part].square().mean() for part in bins])
    q = torch.stack([_low_quantile(deviation[part]) for part in bins])
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
