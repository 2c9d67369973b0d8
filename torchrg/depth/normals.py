"""The plane at each pixel of a depth image, from a window that crosses no edge."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.depth.windows import (
    WindowPlanes,
    fit_windows,
    least_in_windows,
    moved,
    noise_by_radius,
)

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
