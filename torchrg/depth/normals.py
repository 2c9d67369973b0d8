"""The plane at each pixel of a depth image: square windows, their noise, the largest flat one.

Windows are squares of 5 by 5 cells, and a cell is 1, 2, 4 or 8 pixels wide. Windows stand a cell
apart, so that the sums over all large ones together cost less than those over the smallest.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import map_tasks
from torchrg.linalg import machine_epsilon
from torchrg.linalg.moments import kth_smallest

CELL_SIZES = (8, 4, 2, 1)
"""Widths of the cells in pixels, the largest first."""
_REACH = 2
"""A window reaches over so many cells around its middle one."""
_SIDE = 2 * _REACH + 1
"""Cells along a side of a window."""
_FLAT = 1.35
"""A flat window deviates from its plane by at most this many times the tolerance."""
_OWN_REACH = 3.5
"""A pixel is on the plane of a window within this many times the noise."""
_SAME_NOISE = 2.0
"""A flat window deviates by at most this over its side in pixels more than its quarters do."""
_LEAST_QUARTERS = 0.7
"""Quarters count as if they deviated by this many times the tolerance at least."""
_BEND = 0.005
"""A flat window may bend by this share of half its side, however little noise there is."""
_MOST_BEND = 0.03
"""A smallest window by this, where none is flat: twice as much would hide creases of 20 degrees."""
_STEEPEST = 4.0
"""Surfaces seen at a cosine below the inverse of this may not bend: there a step looks like one."""
_LEAST_SHARE = 0.4
"""A window with fewer of its pixels seen has no plane."""
_LEAST_SPREAD = 0.2
"""Nor has one whose pixels have a covariance with less than this of a full window's determinant:
they lie nearly on a line."""
_FLAT_QUANTILE = 0.35
"""At least a third of an indoor image is flat: its windows deviate by noise alone."""
_NUM_BINS = 12
"""Classes of depth that noise is fitted to."""
_MOST_GROWTH = 1.4
"""Noise of windows grows at most by this from one size to the next."""
_ROUNDING = 8.0
"""Least noise of inverse depth, in units of the rounding of the depth."""
_LEAST_ROUNDING = 1e-7
"""And as a share of it, whatever the dtype."""


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


class PixelPlanes(NamedTuple):
    """A plane in inverse depth for each pixel: that of a window.

    The planes are in columns and rows from the optical axis. ``window`` tells pixels of one window
    from those of others, ``side`` is its side in pixels, and ``middle`` ``(2, H, W)`` row and
    column of its middle. ``valid`` tells which pixels have a plane, ``flat`` whether their window
    is flat, ``edge`` whether it is but could not lie around the pixel; ``noise`` is the standard
    deviation of inverse depth, as large windows see it, and ``tolerance`` what a flat window may
    deviate by. All others are of shape ``(H, W)``.
    """

    planes: WindowPlanes
    window: Tensor
    side: Tensor
    middle: Tensor
    valid: Tensor
    flat: Tensor
    edge: Tensor
    noise: Tensor
    tolerance: Tensor

    def sq_slope_noise(self, pixels: Tensor) -> Tensor:
        """Return the variance of the slopes of the windows of some pixels, by row-major place.

        That of least squares over n^2 pixels of variance (n^2 - 1) / 12 along either axis.
        """
        side = self.side.flatten()[pixels]
        return 12 * (self.tolerance.flatten()[pixels] / (side * side)).square()

    def holds(self, pixels: Tensor, others: Tensor) -> Tensor:
        """Return whether the windows of some pixels hold others, all by row-major place."""
        width = self.window.shape[1]
        row, column = (part.flatten()[pixels] for part in self.middle)
        away = torch.maximum((others // width - row).abs(), (others % width - column).abs())
        return away <= self.side.flatten()[pixels] / 2


class _Tolerances(NamedTuple):
    """What windows of one size may deviate by, each of shape ``(h, w)``.

    By noise alone, by noise or a slight bend, and by the strongest bend.
    """

    noise: Tensor
    flat: Tensor
    most: Tensor


def fit_pixels(
    inverse: Tensor,
    seen: Tensor,
    u: Tensor,
    v: Tensor,
    *,
    focal: tuple[float, float],
    noise: tuple[float, float] | None,
    dtype: torch.dtype,
) -> PixelPlanes:
    r"""Choose for each pixel the largest flat window that holds it.

    In inverse depth ``w = 1 / z`` a plane of space is a plane over the image [1],
    ``w = (n_x x + n_y y + n_z) / d`` with the ray ``(x, y, 1)``, and the noise of a triangulating
    sensor is the same everywhere, so that plain least squares is right. A window is flat when it
    deviates from its plane by hardly more than the noise, or than a slight bend, and than its four
    quarters do from planes of their own; one across a step or an edge is not. For each size, the
    largest first, a pixel takes the window around its cell if that is flat; else the flattest
    window that holds it [2]; in both cases only if the pixel itself is on the plane. Where none is
    flat but the smallest is smooth, as on a column without noise, it takes that. Pixels in no flat
    window have the smallest around them.

    ``inverse`` ``(H, W)``, float64, is anything finite where not ``seen``; columns ``u`` ``(W,)``
    and rows ``v`` ``(H, 1)`` count from the optical axis; ``focal`` are the focal lengths along
    both, ``noise`` is that of :class:`torchrg.config.DepthConfig`, ``dtype`` that of the depth.

    References:
        [1] D. Gallup, J.-M. Frahm, M. Pollefeys. Piecewise planar and non-planar stereo for urban
        scene reconstruction. CVPR, 2010.
        [2] M. Kuwahara et al. Processing of RI-angiocardiographic images. Digital Processing of
        Biomedical Images, 1976.
    """
    planes = fit_windows(inverse, seen, u, v)
    noises = noise_by_size(planes, noise, dtype)
    windows, first = dict[int, _SizedWindows](), 0
    for size, found in planes.items():
        limit = _tolerances(found, noises[size], size, focal)
        windows[size] = _SizedWindows(size, first, found, noises[size], limit)
        first += found.mean.numel()
    choice = _Choice(inverse, seen, u, v)
    for size in CELL_SIZES:
        _offer_windows(choice, windows[size], windows.get(size // 2))
    return _pixel_planes(choice, seen, windows.values(), noises[CELL_SIZES[0]].at(inverse))


class _SizedWindows(NamedTuple):
    """The windows of one size; they are numbered through all sizes, these from ``first`` on."""

    size: int
    first: int
    planes: WindowPlanes
    noise: "WindowNoise"
    limit: _Tolerances


def _offer_windows(
    choice: "_Choice", windows: _SizedWindows, quarters: _SizedWindows | None
) -> None:
    """Offer pixels the flat windows of a size; the smallest has no ``quarters``."""
    limit, deviation = windows.limit, windows.planes.deviation
    relative = _flatness(windows, quarters)
    own = torch.arange(relative.numel(), device=relative.device).view(relative.shape)
    choice.offer(windows, torch.where(relative <= _FLAT, own, -1), _OWN_REACH * limit.flat)
    if quarters is None:
        smooth = torch.where(deviation <= limit.most, own, -1)
        choice.offer(windows, smooth, torch.full_like(deviation, torch.inf))
    least, places = least_in_windows(relative, _REACH)
    reach = torch.maximum(_OWN_REACH * limit.noise, limit.flat)
    choice.offer(windows, torch.where(least <= _FLAT, places, -1), reach, beside=True)


def _flatness(windows: _SizedWindows, quarters: _SizedWindows | None) -> Tensor:
    """Return what windows deviate by in units of the tolerance; inf if their quarters do less."""
    limit, deviation = windows.limit, windows.planes.deviation
    relative = deviation / limit.flat
    if quarters is None:
        return relative
    usual = _deviation_of_quarters(quarters.planes.deviation, relative.shape)
    # Neighbouring pixels err alike, so that parts of a flat window deviate less too.
    usual = usual * (limit.noise / quarters.noise.at(windows.planes.mean))
    usual = torch.maximum(usual, _LEAST_QUARTERS * limit.flat)
    same = deviation <= (1 + _SAME_NOISE / (_SIDE * windows.size)) * usual
    return torch.where(same, relative, torch.inf)


class _Choice:
    """The window that each pixel of an image takes, numbered through all windows of all sizes.

    Pixels that have none are offered one after the other, and keep the first that they are on.
    """

    def __init__(self, inverse: Tensor, seen: Tensor, u: Tensor, v: Tensor) -> None:
        self.shape = inverse.shape
        self._values = inverse.flatten()
        self._u, self._v = (place.expand_as(inverse).flatten() for place in (u, v))
        self.window = torch.arange(inverse.numel(), device=inverse.device)
        self.flat = torch.zeros_like(self.window, dtype=torch.bool)
        self.edge = torch.zeros_like(self.flat)
        self._waiting = seen.flatten().nonzero().squeeze(1)

    def take(self, images: Sequence[Tensor]) -> Tensor:
        """Return the values of the pixels' windows ``(H, W)`` from those of each size."""
        return torch.cat([part.flatten() for part in images])[self.window].view(self.shape)

    def offer(
        self, windows: _SizedWindows, places: Tensor, reach: Tensor, *, beside: bool = False
    ) -> None:
        """Offer each cell of a size a window, by its row-major place ``(h, w)``; -1 for none.

        A pixel takes it if it is within reach ``(h, w)`` of the window's plane; ``beside`` tells
        that the windows are not around the cells.
        """
        width, size, waiting = self.shape[1], windows.size, self._waiting
        cells = (waiting // width // size) * places.shape[1] + waiting % width // size
        chosen = places.flatten()[cells]
        has = (chosen >= 0).nonzero().squeeze(1)
        pixels, chosen = waiting[has], chosen[has]
        plane = windows.planes.take(chosen)
        value = plane.u_slope * self._u[pixels] + plane.v_slope * self._v[pixels] + plane.origin
        near = (self._values[pixels] - value).abs() <= reach.flatten()[chosen]
        taken = pixels[near]
        self.window[taken] = chosen[near] + windows.first
        self.flat[taken] = True
        self.edge[taken] = beside
        self._waiting = waiting[~self.flat[waiting]]


def _pixel_planes(
    choice: _Choice, seen: Tensor, windows: Iterable[_SizedWindows], noise: Tensor
) -> PixelPlanes:
    """Return the planes of the windows that pixels chose."""
    sizes = list(windows)
    table = zip(*(part.planes for part in sizes), strict=True)
    planes = WindowPlanes(*(choice.take(part) for part in table))
    tolerance = choice.take([part.limit.flat for part in sizes])
    side = choice.take([torch.full_like(w.planes.mean, _SIDE * w.size) for w in sizes])
    middles = zip(*(_middles(part) for part in sizes), strict=True)
    flat = choice.flat.view(choice.shape)
    is_smooth = flat & (planes.deviation > _FLAT * tolerance)
    tolerance = torch.where(is_smooth, planes.deviation, torch.maximum(tolerance, noise))
    return PixelPlanes(
        planes,
        choice.window.view(choice.shape),
        side,
        torch.stack([choice.take(part) for part in middles]),
        flat | (seen & planes.deviation.isfinite()),
        flat,
        choice.edge.view(choice.shape),
        noise,
        tolerance,
    )


def _middles(windows: _SizedWindows) -> tuple[Tensor, Tensor]:
    """Return row and column of the middle pixel of each window, each ``(h, w)``."""
    mean, size = windows.planes.mean, windows.size
    row, column = (
        torch.arange(length, device=mean.device, dtype=mean.dtype) * size + (size - 1) / 2
        for length in mean.shape
    )
    return row[:, None].expand_as(mean), column.expand_as(mean)


def _tolerances(
    planes: WindowPlanes, noise: "WindowNoise", size: int, focal: tuple[float, float]
) -> _Tolerances:
    """Return what windows of a size may deviate by.

    A bend is a share of half a window's side on the surface. On a plane at a distance d from the
    camera, seen at a depth z, a pixel is up to ``z^2 / (f d)`` long, and a deviation e of inverse
    depth is one of ``d z e`` from the plane.
    """
    (fx, fy), level = focal, noise.at(planes.mean)
    sq_nearness = (
        (planes.u_slope * fx).square() + (planes.v_slope * fy).square() + planes.origin.square()
    )
    is_steep = sq_nearness > (_STEEPEST * planes.mean).square()
    half = _SIDE * size / 2 / max(abs(fx), abs(fy))
    bend = half * torch.where(is_steep, 0.0, sq_nearness) / planes.mean
    bend = torch.where(planes.mean > 0, bend, 0.0)
    return _Tolerances(level, torch.maximum(level, _BEND * bend), _MOST_BEND * bend)


def _deviation_of_quarters(deviation: Tensor, shape: torch.Size) -> Tensor:
    """Return the root mean square deviation of the quarters of windows ``(h, w)``; inf without any.

    They are windows of half the size: the four at the corners of a window cover it exactly.
    """
    height, width = shape
    corner = _SIDE
    padded = deviation.new_full((2 * height + corner, 2 * width + corner), torch.inf)
    padded[_REACH : _REACH + deviation.shape[0], _REACH : _REACH + deviation.shape[1]] = deviation
    squares, count = deviation.new_zeros(shape), deviation.new_zeros(shape)
    for row in (0, corner):
        for column in (0, corner):
            part = padded[row : row + 2 * height : 2, column : column + 2 * width : 2]
            found = part.isfinite()
            squares += torch.where(found, part * part, 0.0)
            count += found
    return torch.where(count > 0, squares / count, torch.inf).sqrt()


def fit_windows(values: Tensor, seen: Tensor, u: Tensor, v: Tensor) -> dict[int, WindowPlanes]:
    """Fit a plane by least squares to the window around each cell, for each size of cells.

    The image ``(H, W)``, float64, holds anything finite where not seen; its columns are at ``u``
    ``(W,)``, its rows at ``v`` ``(H, 1)``. Cells begin at the first pixel, and windows are cut off
    at the borders of the image. One with too few pixels seen, or whose pixels lie nearly on a line,
    has no plane. Sizes ascend.
    """
    ones = seen.to(values.dtype)
    w = torch.where(seen, values, 0.0)
    mu, mv = ones * u, ones * v
    moments = [ones, mu, mv, w, mu * u, mu * v, mv * v, w * u, w * v, w * w]
    sums = zip(*map_tasks(_window_sums, moments, values.device), strict=True)
    return {
        size: _fit_planes(some, _SIDE * size)
        for size, some in zip(sorted(CELL_SIZES), sums, strict=True)
    }


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
        for step in range(1, min(_REACH, length - 1) + 1):
            total.narrow(axis, step, length - step).add_(cells.narrow(axis, 0, length - step))
            total.narrow(axis, 0, length - step).add_(cells.narrow(axis, step, length - step))
        cells = total
    return cells


def _fit_planes(sums: Sequence[Tensor], side: int) -> WindowPlanes:
    """Return the planes of windows with so many pixels along a side, from sums of moments."""
    count, *moments = sums
    share = 1 / count.clamp(min=1)
    mean_u, mean_v, mean_w, uu, uv, vv, uw, vw, ww = (part * share for part in moments)
    uu, uv, vv = uu - mean_u * mean_u, uv - mean_u * mean_v, vv - mean_v * mean_v
    uw, vw, ww = uw - mean_u * mean_w, vw - mean_v * mean_w, ww - mean_w * mean_w
    spread = uu * vv - uv * uv
    full = (side * side - 1) / 12
    found = (count >= _LEAST_SHARE * side**2) & (spread > _LEAST_SPREAD * full**2)
    spread = torch.where(found, spread, 1.0)
    u_slope, v_slope = (vv * uw - uv * vw) / spread, (uu * vw - uv * uw) / spread
    variance = (ww - u_slope * uw - v_slope * vw).clamp(min=0) * count / (count - 3).clamp(min=1)
    return WindowPlanes(
        u_slope,
        v_slope,
        mean_w - u_slope * mean_u - v_slope * mean_v,
        torch.where(found, variance.sqrt(), torch.inf),
        mean_w,
    )


def least_in_windows(image: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return the least value within reach of each cell along both axes, and its row-major place."""
    best, place = -image[None, None], torch.arange(image.numel(), device=image.device)
    for axis in (1, 0):
        size, pad = [1, 1], [0, 0]
        size[axis], pad[axis] = 2 * reach + 1, reach
        best, chosen = torch.nn.functional.max_pool2d(best, size, 1, pad, return_indices=True)
        place = place[chosen.flatten()]
    return -best[0, 0], place.view(image.shape)


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
        least = self.rounding * inverse
        usual = torch.maximum(self.growth + self.constant * (inverse * inverse), least)
        return torch.maximum(self.factor * usual, least)


def noise_by_size(
    windows: Mapping[int, WindowPlanes], given: tuple[float, float] | None, dtype: torch.dtype
) -> dict[int, WindowNoise]:
    r"""Return the noise of inverse depth as windows of each size see it.

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
        found = windows[size].deviation.isfinite()
        deviation, mean = windows[size].deviation[found], windows[size].mean[found]
        ratios = torch.maximum(deviation, rounding * mean) / shape.at(mean)
        usual = float(_low_quantile(ratios)) if len(ratios) else factor
        factor = usual if factor == 0 else min(max(usual, factor), _MOST_GROWTH * factor)
        noises[size] = shape._replace(factor=factor)
    return noises


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
