"""Planes of square and narrow windows of a depth image, and their noise.

Windows are squares of 5 by 5 cells, and a cell is 1, 2, 4 or 8 pixels wide. Windows are one cell
apart, so that all large ones together cost less than the smallest.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import nonzero_rows
from torchrg.depth.passes import has_kernels, pass_over_rows
from torchrg.linalg.moments import Segments, kth_smallest
from torchrg.linalg.precision import machine_epsilon
from torchrg.neighbors.order import sort_integers

CELL_SIZES = (8, 4, 2, 1)
"""Cell widths in pixels, largest first."""
REACH = 2
"""Cells of a window on each side of its center cell."""
SIDE = 2 * REACH + 1
"""Cells along a side of a window."""
NARROW = ((3, 9), (9, 3))
"""Rows and columns of narrow windows in pixels; each has about the area of the smallest square."""
_MIN_FRACTION = 0.4
"""Minimum fraction of seen pixels for a window to have a plane."""
_MIN_SPREAD = 0.2
"""Minimum determinant of the covariance of a window's pixels, as a fraction of a full window's.
Below it, the pixels are nearly collinear and do not define a plane."""
_NUM_MOMENTS = 10
"""Number of moment sums required for the plane of a window."""
_FLAT_QUANTILE = 0.35
"""Fraction of the windows of an image that deviate by noise alone: at least a third is flat."""
_SAMPLE_STRIDE = 4
"""Stride of the small windows used for the noise, in pixels: windows overlap, so none is lost."""
_NUM_BINS = 12
"""Number of depth bins for the noise fit."""
_MAX_GROWTH = 1.4
"""Maximum growth of the window noise from one size to the next."""
_MAX_JITTER = 0.15
"""Maximum standard deviation of rays from their pixel centers, in pixels."""
_ROUNDING = 8.0
"""Minimum noise of inverse depth, in units of the rounding of the depth."""
_MIN_ROUNDING = 1e-7
"""Minimum relative noise of inverse depth for any dtype: the rounding of float32."""


class Image(NamedTuple):
    """Inverse depths ``(H, W)``, float64 and finite, a mask of pixels with depth, and coordinates.

    Columns ``u`` ``(W,)`` and rows ``v`` ``(H,)`` are relative to the optical axis.
    """

    values: Tensor
    seen: Tensor
    u: Tensor
    v: Tensor


class Windows(NamedTuple):
    """Planes ``value = u_slope * u + v_slope * v + origin`` of windows, each field ``(h, w)``.

    ``deviation`` is the standard deviation of a window's pixels from its plane, infinite if there
    is none, ``mean`` their mean value. :func:`torchrg.depth.normals.rate_windows` adds limits of
    the deviation: the noise; the noise or a slight bend; the strongest bend. ``relative`` is the
    deviation of a flat window as a fraction of the second limit, otherwise infinite.
    """

    u_slope: Tensor
    v_slope: Tensor
    origin: Tensor
    deviation: Tensor
    mean: Tensor
    noise: Tensor
    tolerance: Tensor
    max_bend: Tensor
    relative: Tensor


NUM_PLANE = 5
"""Number of plane fields of a window; the remaining fields rate it."""


def fit_windows(image: Image) -> dict[int, Tensor]:
    """Fit a least-squares plane to the window around each cell, for ascending cell sizes.

    Cells begin at the first pixel, and windows are clipped to the image. A window with too few or
    nearly collinear seen pixels has no plane. Returns tables ``(9, h, w)`` of :class:`Windows` with
    the plane fields filled in; they are contiguous in memory.
    """
    values, seen, u, v = image
    columns = len(Windows._fields)
    shapes = [[-(-length // size) for length in seen.shape] for size in sorted(CELL_SIZES)]
    parts = [columns * math.prod(shape) for shape in shapes]
    flat = torch.split(values.new_empty(sum(parts)), parts)
    tables = {
        size: part.view(columns, *shape)
        for size, part, shape in zip(sorted(CELL_SIZES), flat, shapes, strict=True)
    }
    if not has_kernels(values):
        ones = seen.to(values.dtype)
        w = torch.where(seen, values, 0.0)
        mu, mv = ones * u, ones * v[:, None]
        cells = torch.stack([ones, mu, mv, w, mu * u, mu * mv, mv * mv, w * mu, w * mv, w * w])
        for size, table in tables.items():
            cells = _pool_sums(cells) if size > 1 else cells
            table[:NUM_PLANE] = _planes_from_sums(_window_sums(cells), SIDE * size, SIDE * size)
        return tables
    cells = values
    for size, table in tables.items():
        height, width = table.shape[1:]
        coarse = values.new_empty(_NUM_MOMENTS, -(-height // 2), -(-width // 2))
        name, source = ("cell", [cells]) if size > 1 else ("pixel", [values, seen, u, v])
        limits = _min_moments(SIDE * size, SIDE * size)
        planes = table[:NUM_PLANE]
        pass_over_rows(f"fit_{name}_windows", height, *source, planes, coarse, *limits)
        cells = coarse
    return tables


def fit_narrow_windows(image: Image, indices: Tensor, pixels: Tensor) -> Tensor:
    """Fit a plane to the narrow windows of both shapes around the given pixels ``(n,)``.

    Only these pixels count: ``indices`` ``(H, W)`` are their indices, -1 for other pixels. Returns
    a table ``(9, 2, n)``; see :func:`fit_windows`.
    """
    values, _, u, v = image
    table = values.new_empty(len(Windows._fields), len(NARROW), len(pixels))
    if has_kernels(values):
        limits, planes = _min_moments(*NARROW[0]), table[:NUM_PLANE]
        fixed = values, u, v, indices, pixels, *limits, planes
        pass_over_rows("fit_narrow_windows", len(pixels), *fixed)
        return table
    for shape, (rows, columns) in enumerate(NARROW):
        sums = values.new_zeros(_NUM_MOMENTS, len(pixels))
        for at, _ in window_pixels(indices, pixels, rows, columns):
            ones = (at >= 0).to(values.dtype)
            at = at.clamp(min=0)
            row, column = at // len(u), at % len(u)
            mu, mv, w = u[column] * ones, v[row] * ones, values[row, column] * ones
            sums += torch.stack([ones, mu, mv, w, mu * mu, mu * mv, mv * mv, w * mu, w * mv, w * w])
        table[:NUM_PLANE, shape] = _planes_from_sums(sums, rows, columns)
    return table


def window_pixels(
    indices: Tensor, pixels: Tensor, rows: int, columns: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield, for each position of a narrow window, the pixels there ``(n,)`` and their indices.

    Row by row; both are -1 where no pixel counts.
    """
    height, width = indices.shape
    for step in range(rows * columns):
        row = pixels // width + step // columns - rows // 2
        column = pixels % width + step % columns - columns // 2
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        index = torch.where(inside, row * width + column, 0)
        number = torch.where(inside, indices.flatten()[index], -1)
        yield torch.where(number >= 0, index, -1), number


def _pool_sums(cells: Tensor) -> Tensor:
    """Return the sums over cells of twice the width, ``(*, ceil(h / 2), ceil(w / 2))``."""
    height, width = cells.shape[1:]
    cells = torch.nn.functional.pad(cells, (0, width % 2, 0, height % 2))
    rows = cells[:, 0::2] + cells[:, 1::2]
    return rows[:, :, 0::2] + rows[:, :, 1::2]


def _window_sums(cells: Tensor) -> Tensor:
    """Return the sums over the cells of the window around each cell, ``(*, h, w)``."""
    for axis in (1, 2):
        length, total = cells.shape[axis], cells.clone()
        for step in range(1, min(REACH, length - 1) + 1):
            total.narrow(axis, step, length - step).add_(cells.narrow(axis, 0, length - step))
            total.narrow(axis, 0, length - step).add_(cells.narrow(axis, step, length - step))
        cells = total
    return cells


def _min_moments(rows: int, columns: int) -> tuple[float, float]:
    """Return the minimum pixel count and spread of a window that has a plane."""
    full = (rows * rows - 1) * (columns * columns - 1) / 144
    return _MIN_FRACTION * rows * columns, _MIN_SPREAD * full


def _planes_from_sums(sums: Tensor, rows: int, columns: int) -> Tensor:
    """Return planes ``(5, *)`` of windows from sums of moments ``(10, *)``."""
    count = sums[0]
    weight = 1 / count.clamp(min=1)
    u, v, w, uu, uv, vv, uw, vw, ww = (moment * weight for moment in sums[1:])
    uu, uv, vv = uu - u * u, uv - u * v, vv - v * v
    uw, vw, ww = uw - u * w, vw - v * w, ww - w * w
    spread = uu * vv - uv * uv
    min_count, min_spread = _min_moments(rows, columns)
    has_plane = (count >= min_count) & (spread > min_spread)
    spread = torch.where(has_plane, spread, 1.0)
    u_slope, v_slope = (vv * uw - uv * vw) / spread, (uu * vw - uv * uw) / spread
    variance = (ww - u_slope * uw - v_slope * vw).clamp(min=0) * count / (count - 3).clamp(min=1)
    has_plane &= variance.isfinite()
    deviation = torch.where(has_plane, variance.sqrt(), torch.inf)
    return torch.stack([u_slope, v_slope, w - u_slope * u - v_slope * v, deviation, w])


class WindowNoise(NamedTuple):
    """Noise of inverse depth ``w`` in windows of a size: ``factor (growth + constant w^2)``.

    It is at least ``rounding`` times the inverse depth.
    """

    factor: float
    constant: float
    growth: float
    rounding: float

    def evaluate(self, inverse: Tensor) -> Tensor:
        """Return the noise at inverse depths."""
        minimum = self.rounding * inverse
        typical = torch.maximum(self.growth + self.constant * (inverse * inverse), minimum)
        return torch.maximum(self.factor * typical, minimum)


def noise_by_size(
    tables: Mapping[int, Tensor], noise: tuple[float, float] | None, dtype: torch.dtype
) -> dict[int, WindowNoise]:
    """Return the noise of inverse depth in windows of each size.

    A standard deviation of ``a + b z^2`` in depth is ``b + a w^2`` in inverse depth ``w = 1 / z``.
    Without ``noise``, ``a`` and ``b`` are fitted to the deviations of windows from their planes,
    i.e. to the 35 % quantiles of twelve depth bins. Errors of adjacent sensor pixels are
    correlated, and depth is quantized. Large windows thus deviate more than small ones, and the
    noise has a factor for each size. It is at least the rounding of ``dtype``, that of the depth.
    """
    rounding = max(_ROUNDING * machine_epsilon(dtype), _MIN_ROUNDING)
    if noise is not None:
        constant, growth = noise
        return dict.fromkeys(tables, WindowNoise(1.0, constant, growth, rounding))
    names = "deviation", "mean"
    windows = {size: _sample_windows(tables[size], size, *names) for size in sorted(tables)}
    middle = windows[sorted(windows)[len(windows) // 2 - 1]]
    shape = WindowNoise(1.0, *_fit_noise(middle, rounding), rounding)
    noises, factor = {}, 0.0
    for size, (deviation, mean) in windows.items():
        ratios = torch.maximum(deviation, rounding * mean) / shape.evaluate(mean)
        rank = int(_FLAT_QUANTILE * (len(ratios) - 1))
        typical = float(kth_smallest(ratios, rank)) if len(ratios) else factor
        factor = typical if factor == 0 else min(max(typical, factor), _MAX_GROWTH * factor)
        noises[size] = shape._replace(factor=factor)
    return noises


def _sample_windows(table: Tensor, size: int, *names: str) -> list[Tensor]:
    """Return columns ``(n,)`` of valid windows four pixels or a cell apart, by name.

    The input is a table ``(9, h, w)`` of windows of one size.
    """
    step = max(_SAMPLE_STRIDE // size, 1)
    windows = Windows(*table[:, ::step, ::step])
    valid = nonzero_rows(windows.deviation < torch.inf)
    return [getattr(windows, name).flatten().index_select(0, valid) for name in names]


def find_jitter(table: Tensor, size: int) -> float:
    """Return the standard deviation of the rays from their pixel centers, in pixels.

    It ranges from 0 for exact rays to 0.15. Jitter changes a value in proportion to its slope, so
    it shows in steep windows: no flat window deviates by less. Among the steeper half of the slope
    bins, the one with the smallest deviation of flat windows counts. ``table`` ``(9, h, w)``
    contains windows of one size.
    """
    u_slope, v_slope, deviation = _sample_windows(table, size, "u_slope", "v_slope", "deviation")
    slope = torch.hypot(u_slope, v_slope)
    steep = nonzero_rows(slope > 0)
    _, ratios = _quantiles_by_bin(slope[steep], deviation[steep] / slope[steep])
    return min([_MAX_JITTER, *map(float, ratios[_NUM_BINS // 2 :])])


def _quantiles_by_bin(keys: Tensor, values: Tensor) -> tuple[list[Tensor], Tensor]:
    """Split positive keys ``(n,)`` into twelve ascending bins of about equal size.

    Returns the bins that are not empty, and for each the quantile of its values that flat windows
    reach.
    """
    if has_kernels(keys):
        # The bits of positive numbers are in the order of the numbers.
        rows, bits = sort_integers(keys.view(torch.int64))
        keys = bits.view(keys.dtype)
    else:
        keys, rows = keys.sort(stable=True)
    bins = [part for part in keys.tensor_split(_NUM_BINS) if len(part)]
    counts = torch.tensor([len(part) for part in bins], dtype=torch.int64, device=keys.device)
    return bins, Segments(torch.repeat_interleave(counts)).quantile(values[rows], _FLAT_QUANTILE)


def _fit_noise(columns: Sequence[Tensor], rounding: float) -> tuple[float, float]:
    """Fit nonnegative ``b + a w^2`` to deviations at means ``(n,)`` of windows; return a and b."""
    if len(columns[0]) == 0:
        return 0.0, 0.0
    bins, q = _quantiles_by_bin(columns[1], torch.maximum(columns[0], rounding * columns[1]))
    x = torch.stack([part.square().mean() for part in bins])
    # Relative errors: a bin with only cluttered windows has little weight.
    p, e = x / q, 1 / q
    spread = (p * p).sum() * (e * e).sum() - (p * e).sum() ** 2
    constant = (p.sum() * (e * e).sum() - e.sum() * (p * e).sum()) / spread
    growth = (e.sum() * (p * p).sum() - p.sum() * (p * e).sum()) / spread
    if not bool(growth > 0):
        return float(p.sum() / (p * p).sum()), 0.0
    if not bool(constant > 0):
        return 0.0, float(e.sum() / (e * e).sum())
    return float(constant), float(growth)
