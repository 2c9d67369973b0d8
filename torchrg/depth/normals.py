"""The plane at each pixel of a depth image: square windows, their noise, the largest flat one.

Planes through all windows of a size are fitted at once, from running sums.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import machine_epsilon

RADII = (16, 8, 4, 2)
"""Radii of the windows, the largest first."""
_FLAT = 1.35
"""A flat window deviates from its plane by at most this many times the noise."""
_OWN_REACH = 3.5
"""A pixel is on the plane of a window within this many times the noise."""
_SAME_NOISE = 2.0
"""A flat window deviates by at most this over its side in pixels more than its quarters do."""
_LEAST_QUARTERS = 0.7
"""Quarters count as if they deviated by this many times the noise at least."""
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
    """Planes ``value = u_slope * u + v_slope * v + origin`` of the windows around all pixels.

    ``deviation`` is the standard deviation of a window's pixels from its plane, infinite where
    there is none. All are of shape ``(H, W)``.
    """

    u_slope: Tensor
    v_slope: Tensor
    origin: Tensor
    deviation: Tensor

    def at(self, u: Tensor, v: Tensor) -> Tensor:
        """Return the values of the planes at coordinates that broadcast to ``(H, W)``."""
        return self.u_slope * u + self.v_slope * v + self.origin

    def take(self, pixels: Tensor) -> "WindowPlanes":
        """Return for each pixel the plane of another one, given by its row-major place."""
        return WindowPlanes(*(part.flatten()[pixels] for part in self))

    def where(self, chosen: Tensor, other: "WindowPlanes") -> "WindowPlanes":
        """Return these planes where chosen, else those of another image."""
        return WindowPlanes(*(torch.where(chosen, a, b) for a, b in zip(self, other, strict=True)))


class PixelPlanes(NamedTuple):
    """A plane in inverse depth for each pixel.

    The planes are in columns and rows from the optical axis. ``radius`` is that of the window each
    comes from, 0 where there is none; ``flat`` tells whether that window is flat, ``edge`` whether
    it is but could not lie around the pixel; ``noise`` is the standard deviation of inverse depth,
    as large windows see it. All are of shape ``(H, W)``.
    """

    planes: WindowPlanes
    radius: Tensor
    flat: Tensor
    edge: Tensor
    noise: Tensor


def fit_pixels(
    inverse: Tensor,
    seen: Tensor,
    u: Tensor,
    v: Tensor,
    *,
    noise: tuple[float, float] | None,
    dtype: torch.dtype,
) -> PixelPlanes:
    r"""Choose for each pixel the largest flat window that holds it.

    In inverse depth ``w = 1 / z`` a plane of space is a plane over the image [1],
    ``w = (n_x x + n_y y + n_z) / d`` with the ray ``(x, y, 1)``, and the noise of a triangulating
    sensor is the same everywhere, so that plain least squares is right. A window is flat when it
    deviates from its plane by hardly more than the noise, and than its four quarters do from planes
    of their own; one across a step or an edge is not. For each radius, the largest first, a pixel
    takes the window around itself if that is flat; else the flattest window that holds it [2]; in
    both cases only if the pixel itself is on the plane. Pixels in no flat window take the smallest
    around them.

    ``inverse`` ``(H, W)``, float64, is anything finite where not ``seen``; columns ``u`` ``(W,)``
    and rows ``v`` ``(H, 1)`` count from the optical axis; ``noise`` is that of
    :class:`torchrg.config.DepthConfig`, ``dtype`` that of the depth.

    References:
        [1] D. Gallup, J.-M. Frahm, M. Pollefeys. Piecewise planar and non-planar stereo for urban
        scene reconstruction. CVPR, 2010.
        [2] M. Kuwahara et al. Processing of RI-angiocardiographic images. Digital Processing of
        Biomedical Images, 1976.
    """
    windows = {radius: fit_windows(inverse, seen, u, v, radius) for radius in RADII}
    levels = noise_by_radius(windows, inverse, seen, noise, dtype)
    smallest = windows[RADII[-1]]
    chosen, flat = smallest, torch.zeros_like(seen)
    edge, radius = torch.zeros_like(seen), torch.zeros_like(seen, dtype=torch.int64)
    radius[seen & smallest.deviation.isfinite()] = RADII[-1]
    for size in RADII:
        around, level = windows[size], levels[size]
        relative = torch.where(seen, around.deviation / level, torch.inf)
        if size // 2 in windows:
            quarters = _deviation_of_quarters(windows[size // 2].deviation, size // 2)
            # Neighbouring pixels err alike, so that parts of a flat window deviate less too.
            usual = torch.maximum(quarters * (level / levels[size // 2]), _LEAST_QUARTERS * level)
            same = around.deviation <= (1 + _SAME_NOISE / (2 * size + 1)) * usual
            relative = torch.where(same, relative, torch.inf)
        least, places = least_in_windows(relative, size)
        for planes, ratio, beside in (
            (around, relative, False),
            (around.take(places), least, True),
        ):
            near = (inverse - planes.at(u, v)).abs() <= _OWN_REACH * level
            new = seen & ~flat & near & (ratio <= _FLAT)
            chosen = planes.where(new, chosen)
            radius[new] = size
            edge |= new & beside
            flat |= new
    return PixelPlanes(chosen, radius, flat, edge, levels[RADII[0]])


def _deviation_of_quarters(deviation: Tensor, reach: int) -> Tensor:
    """Return the root mean square deviation of the four windows around a place; inf without any."""
    squares, count = torch.zeros_like(deviation), torch.zeros_like(deviation)
    for step in ((-reach, -reach), (-reach, reach), (reach, -reach), (reach, reach)):
        part = moved(deviation, step, fill=torch.inf)
        squares += torch.where(part.isfinite(), part * part, 0.0)
        count += part.isfinite()
    return torch.where(count > 0, squares / count, torch.inf).sqrt()


def fit_windows(values: Tensor, seen: Tensor, u: Tensor, v: Tensor, radius: int) -> WindowPlanes:
    """Fit a plane by least squares to each window of ``2 radius + 1`` pixels square.

    The image ``(H, W)``, float64, holds anything finite where not seen; its columns are at ``u``
    ``(W,)``, its rows at ``v`` ``(H, 1)``. A window with too few pixels seen, or whose pixels lie
    nearly on a line, has no plane.
    """
    ones = seen.to(values.dtype)
    w = torch.where(seen, values, 0.0)
    mu, mv = ones * u, ones * v
    terms = [ones, mu, mv, w, mu * u, mu * v, mv * v, w * u, w * v, w * w]
    count, *sums = _window_sums(torch.stack(terms), radius)
    mean_u, mean_v, mean_w, uu, uv, vv, uw, vw, ww = (part / count.clamp(min=1) for part in sums)
    uu, uv, vv = uu - mean_u * mean_u, uv - mean_u * mean_v, vv - mean_v * mean_v
    uw, vw, ww = uw - mean_u * mean_w, vw - mean_v * mean_w, ww - mean_w * mean_w
    spread = uu * vv - uv * uv
    full = radius * (radius + 1) / 3
    found = (count >= _LEAST_SHARE * (2 * radius + 1) ** 2) & (spread > _LEAST_SPREAD * full**2)
    spread = torch.where(found, spread, 1.0)
    u_slope, v_slope = (vv * uw - uv * vw) / spread, (uu * vw - uv * uw) / spread
    variance = (ww - u_slope * uw - v_slope * vw).clamp(min=0) * count / (count - 3).clamp(min=1)
    return WindowPlanes(
        u_slope,
        v_slope,
        mean_w - u_slope * mean_u - v_slope * mean_v,
        torch.where(found, variance.sqrt(), torch.inf),
    )


def _window_sums(images: Tensor, radius: int) -> Tensor:
    """Return the sums over the windows around all pixels, cut off at the borders, ``(C, H, W)``.

    They are differences of running sums, whose cost does not depend on the radius.
    """
    for axis in (1, 2):
        length = images.shape[axis]
        running = images.cumsum(dim=axis)
        running = torch.cat([torch.zeros_like(running.narrow(axis, 0, 1)), running], dim=axis)
        place = torch.arange(length, device=images.device)
        last = (place + radius + 1).clamp(max=length)
        first = (place - radius).clamp(min=0)
        images = running.index_select(axis, last) - running.index_select(axis, first)
    return images


def least_in_windows(image: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Return the least value in the window around each pixel, and its row-major place."""
    best, place = -image[None, None], torch.arange(image.numel(), device=image.device)
    for axis in (1, 0):
        size, pad = [1, 1], [0, 0]
        size[axis], pad[axis] = 2 * radius + 1, radius
        best, chosen = torch.nn.functional.max_pool2d(best, size, 1, pad, return_indices=True)
        place = place[chosen.flatten()]
    return -best[0, 0], place.view(image.shape)


def moved(image: Tensor, step: tuple[int, int], *, fill: float) -> Tensor:
    """Return for each pixel the value of the one a step away, ``fill`` outside, ``(H, W, *)``."""
    result = torch.full_like(image, fill)
    target, source = [], []
    for length, way in zip(image.shape, step, strict=False):
        target.append(slice(max(0, -way), max(0, length - max(0, way))))
        source.append(slice(max(0, way), max(0, length - max(0, -way))))
    result[tuple(target)] = image[tuple(source)]
    return result


def noise_by_radius(
    windows: Mapping[int, WindowPlanes],
    inverse: Tensor,
    seen: Tensor,
    given: tuple[float, float] | None,
    dtype: torch.dtype,
) -> dict[int, Tensor]:
    r"""Return the noise of inverse depth at each pixel ``(H, W)``, for windows of each size.

    A standard deviation of ``a + b z^2`` in depth is one of ``b + a w^2`` in inverse depth
    ``w = 1 / z``. Where ``a`` and ``b`` are not given, they are fitted to what windows deviate from
    their planes: to the 35 % quantiles of twelve classes of depth. Neighbouring pixels of a sensor
    err alike, and its depth has steps, so that large windows deviate more than small ones: the
    noise has a factor for each size. It is never less than the rounding of ``dtype``, that of the
    depth.
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
