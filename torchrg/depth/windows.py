"""Planes through square windows of an image, for all windows of a size at once."""

from typing import NamedTuple

import torch
from torch import Tensor

LEAST_SHARE = 0.4
"""A window with fewer of its pixels seen has no plane."""

_LEAST_SPREAD = 0.2


class WindowPlanes(NamedTuple):
    """Planes ``value = u_slope * u + v_slope * v + origin`` of the windows around all pixels.

    Attributes:
        u_slope: Change from column to column, shape ``(H, W)``.
        v_slope: Change from row to row, shape ``(H, W)``.
        origin: Value at ``u = v = 0``, shape ``(H, W)``.
        deviation: Standard deviation of the window's pixels from the plane, shape ``(H, W)``;
            infinite where there is no plane.
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


def fit_windows(values: Tensor, seen: Tensor, u: Tensor, v: Tensor, radius: int) -> WindowPlanes:
    """Fit a plane by least squares to each window of ``2 radius + 1`` pixels square.

    The sums over windows are differences of running sums along rows, then along columns: their cost
    does not depend on the radius.

    Args:
        values: Image, shape ``(H, W)``, float64; anything finite where not seen.
        seen: Pixels that count, shape ``(H, W)``, bool.
        u: Coordinate of the columns, shape ``(W,)``.
        v: Coordinate of the rows, shape ``(H, 1)``.
        radius: Pixels from the middle of a window to its border.

    Returns:
        The planes. A window with less than 0.4 of its pixels seen, or whose pixels lie nearly on a
        line, has none.

    Example:
        >>> u, v = torch.arange(8.0).double(), torch.arange(6.0).double()[:, None]
        >>> image, seen = 2 * u - v + 5, torch.ones(6, 8, dtype=torch.bool)
        >>> planes = fit_windows(image, seen, u, v, 2)
        >>> [round(float(part[3, 4]), 9) for part in planes[:3]]
        [2.0, -1.0, 5.0]
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
    found = (count >= LEAST_SHARE * (2 * radius + 1) ** 2) & (spread > _LEAST_SPREAD * full**2)
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
    """Return the sums over the windows around all pixels, cut off at the borders, ``(C, H, W)``."""
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
    """Return the least value in the window around each pixel, and its row-major place.

    Args:
        image: Shape ``(H, W)``, without NaN.
        radius: Pixels from the middle of a window to its border.

    Returns:
        Values and places, each of shape ``(H, W)``.

    Example:
        >>> least_in_windows(torch.tensor([[3.0, 1, 2, 5]]), 1)
        (tensor([[1., 1., 1., 2.]]), tensor([[1, 1, 1, 2]]))
    """
    best, place = -image[None, None], torch.arange(image.numel(), device=image.device)
    for axis in (1, 0):
        size, pad = [1, 1], [0, 0]
        size[axis], pad[axis] = 2 * radius + 1, radius
        best, chosen = torch.nn.functional.max_pool2d(best, size, 1, pad, return_indices=True)
        place = place[chosen.flatten()]
    return -best[0, 0], place.view(image.shape)


def moved(image: Tensor, step: tuple[int, int], *, fill: float) -> Tensor:
    """Return for each pixel the value of the one a step away, ``fill`` outside, ``(H, W, *)``.

    Example:
        >>> moved(torch.tensor([[1, 2, 3]]), (0, 1), fill=0)
        tensor([[2, 3, 0]])
    """
    result = torch.full_like(image, fill)
    target, source = [], []
    for length, way in zip(image.shape, step, strict=False):
        target.append(slice(max(0, -way), max(0, length - max(0, way))))
        source.append(slice(max(0, way), max(0, length - max(0, -way))))
    result[tuple(target)] = image[tuple(source)]
    return result
