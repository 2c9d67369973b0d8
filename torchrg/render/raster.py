"""Two-pass rasterization of points as small tilted discs.

The first pass finds the nearest disc of each pixel. Discs extend beyond the edge of their surface
and hide the surface behind it. The second pass therefore chooses, for each pixel, the disc with the
nearest center in the image, among the discs that the nearest disc may wrongly hide. Such a disc is
at most a disc diameter behind. Unlike for a real occluder, the center of the nearest disc is not in
front of its plane. Ties are broken by color, not by the order of the points.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

_WHITE = 0xFFFFFF
"""Color of pixels without a disc, as three bytes."""
_DEPTH_BITS = 32
"""Number of bits of a key below the depth."""
_OVERHANG = 2.0
"""Maximum depth difference, in disc radii, at which a disc may wrongly hide another at an edge."""
_DOME = 0.1
"""Curvature of discs, as depth of the rim in radii: of coplanar discs, the nearest center wins."""
_FLAT = 0.1
"""Tolerance in depth, in radii of a disc, since noise moves the centers of one surface off the
planes of its discs. With 0 more pixels of noisy boxes get the color of another surface."""
_LIGHT = (-0.45, -0.7, -0.55)
"""Direction toward the light in camera axes: from the left, above and behind the camera."""
_MIN_BRIGHTNESS = 0.62
"""Brightness of a surface that faces away from the light; its color stays recognizable."""
_MAX_DARKENING = 0.6
"""Maximum fraction of brightness lost in a hollow. More looks like dirt."""
_REACHES = ((1, 0.5), (2, 0.3), (3, 0.2))
"""Distances at which hollows are detected, in radii of a disc, with weights. The weights sum to 1
and decrease, so that creases are thin lines."""
_NOISE = 0.7
"""Tangent of a bend over one disc radius, below which it is noise and not shaded."""
_MAX_SEARCH = 20
"""Maximum reach for an exhaustive search, in pixels; its time grows with the square. Clouds of
20,000 points and more need less in an image of 1,600 pixels."""
_MAX_SHADE_RADIUS = 4.0
"""Maximum radius for detecting hollows, in pixels; larger ones create halos."""


class Discs(NamedTuple):
    """Surface discs in an image.

    Inverse depth of a plane is linear in the image: a value at the center, and two slopes.

    Attributes:
        pixels: Column and row of the centers, shape ``(N, 2)``; integers are pixel centers. Discs
            with a center outside the image are dropped.
        inverse_depth: Inverse depth of the centers, positive, shape ``(N,)``, float32.
        colors: Shape ``(N, 3)``, uint8.
        radii: In pixels, shape ``(N,)``; every disc covers at least one pixel.
        slopes: Change of the inverse depth per pixel to the right and down, shape ``(N, 2)``.
        max_change: Maximum difference of the inverse depth from the center, shape ``(N,)``: it ends
            the disc, and is the tolerance for equally near discs.
    """

    pixels: Tensor
    inverse_depth: Tensor
    colors: Tensor
    radii: Tensor
    slopes: Tensor
    max_change: Tensor

    def pixel_offsets(self) -> Tensor:
        """Return the offsets of the centers from their pixel centers, shape ``(N, 2)``."""
        return self.pixels - self.pixels.round()

    def pixel_depths(self) -> Tensor:
        """Return the inverse depth of the planes at the pixels of the centers."""
        return self.inverse_depth - (self.slopes * self.pixel_offsets()).sum(dim=1)

    def select(self, rows: Tensor) -> "Discs":
        """Return the selected discs."""
        discs = Discs(*(values.index_select(0, rows) for values in self))
        # Contiguous columns are faster to read.
        return discs._replace(slopes=discs.slopes.T.contiguous().T)


class DepthBuffer:
    """Buffer of the nearest disc in each pixel of an image.

    Args:
        width: Width of the image, in pixels.
        height: Height of the image, in pixels.
        max_radius: Maximum radius of a disc, in pixels; larger radii are clamped.
        device: Device of the buffer.

    Example:
        >>> buffer = DepthBuffer(3, 1, max_radius=1)
        >>> colors = torch.tensor([[9, 9, 9], [7, 7, 7]], dtype=torch.uint8)
        >>> ends, flat = torch.tensor([[0.0, 0.0], [2.0, 0.0]]), torch.zeros(2, 2)
        >>> discs = Discs(ends, torch.ones(2), colors, torch.ones(2), flat, torch.zeros(2))
        >>> buffer.draw(discs)
        >>> buffer.end_drawing()
        >>> buffer.paint(discs)
        >>> depth_and_colors(buffer.keys())[1].tolist()
        [[[9, 9, 9], [9, 9, 9], [7, 7, 7]]]
    """

    def __init__(
        self, width: int, height: int, *, max_radius: float, device: torch.device | None = None
    ) -> None:
        self.width, self.height, self.max_radius = width, height, max_radius
        # Discs may extend beyond the image, into a margin that is never shown.
        self._margin = math.ceil(max_radius)
        self._stride = width + 2 * self._margin
        size = self._stride * (height + 2 * self._margin)
        # Bits of the inverse depth, which sort like the float, above the index of a disc.
        self._front = torch.zeros(size, dtype=torch.int64, device=device)
        # Bits of the nearness of the center, above three bytes of color.
        self._colors = torch.full((size,), _WHITE, dtype=torch.int64, device=device)
        # Column, row and inverse depth of the centers of all discs, after an empty entry; the same
        # for the nearest disc of each pixel, and its inverse depth there.
        self._centers, self._nearest = (torch.zeros(1, n, device=device) for n in (3, 4))

    def keys(self) -> Tensor:
        """Return the key of each pixel ``(height, width)``, int64; see :func:`depth_and_colors`."""
        shown = slice(self._margin, self._margin + self.height)
        columns = slice(self._margin, self._margin + self.width)
        front, colors = (
            values.view(-1, self._stride)[shown, columns] for values in (self._front, self._colors)
        )
        return (front >> _DEPTH_BITS << _DEPTH_BITS) | (colors & _WHITE)

    def draw(self, discs: Discs) -> None:
        """First pass: find the nearest disc of each pixel."""
        number = torch.arange(len(discs.pixels), device=self._front.device) + len(self._centers)
        centers = torch.cat([discs.pixels, discs.inverse_depth[:, None]], dim=1)
        self._centers = torch.cat([self._centers, centers])
        order, sizes, indices = self._by_size(discs)
        shown, number = discs.select(order), number.index_select(0, order)
        start = shown.pixel_depths()
        dome = _DOME * shown.max_change / sizes.clamp(min=1).square_()
        for dx, dy, count in _pixels_of(sizes):
            depth = _depth_at_offset(shown, start, dx, dy, count)
            depth.sub_(dome[:count], alpha=dx * dx + dy * dy)
            keys = depth.view(torch.int32).long() << _DEPTH_BITS
            index = indices[:count] + self._step(dx, dy)
            self._front.scatter_reduce_(0, index, keys.bitwise_or_(number[:count]), "amax")

    def end_drawing(self) -> None:
        """Look up the nearest discs between the passes."""
        number = self._front & (2**_DEPTH_BITS - 1)
        depth = (self._front >> _DEPTH_BITS).int().view(torch.float32)[:, None]
        self._nearest = torch.cat([self._centers.index_select(0, number), depth], dim=1)

    def paint(self, discs: Discs) -> None:
        """Second pass: color the covered pixels."""
        order, sizes, indices = self._by_size(discs)
        shown = discs.select(order)
        away_x, away_y = shown.pixel_offsets().T.contiguous()
        start = shown.pixel_depths()
        slope_x, slope_y = shown.slopes.T
        # The inverse depth of a disc's plane in the corner of the image, plus the noise tolerance.
        corner = shown.inverse_depth - (shown.slopes * shown.pixels).sum(dim=1)
        corner += _FLAT * shown.max_change
        keys = torch.zeros(len(sizes), 8, dtype=torch.uint8, device=discs.colors.device)
        keys[:, :3] = shown.colors
        nearness, keys = keys.view(torch.float32)[:, 1], keys.view(torch.int64).squeeze(-1)
        for dx, dy, count in _pixels_of(sizes):
            index = indices[:count] + self._step(dx, dy)
            x, y, at_middle, front = self._nearest.index_select(0, index).unbind(dim=1)
            depth = _depth_at_offset(shown, start, dx, dy, count)
            seen = depth.add_(shown.max_change[:count], alpha=_OVERHANG) >= front
            seen &= x.mul_(slope_x[:count]) + y.mul_(slope_y[:count]) + corner[:count] >= at_middle
            sq_distance = (away_x[:count] - dx).square_()
            sq_distance += (away_y[:count] - dy).square_()
            nearness[:count] = sq_distance.add_(1).reciprocal_().mul_(seen)
            self._colors.scatter_reduce_(0, index, keys[:count], "amax")

    def _step(self, dx: int, dy: int) -> int:
        """Return the offset of a pixel in the flat buffer."""
        return dy * self._stride + dx

    def _by_size(self, discs: Discs) -> tuple[Tensor, Tensor, Tensor]:
        """Return the visible discs by descending size, their radii, and flat center indices."""
        center = discs.pixels.round()
        inside = (center >= 0) & (center < center.new_tensor([self.width, self.height]))
        # Few distinct sizes and a stable sort keep neighboring discs close in memory.
        sizes = (2 * discs.radii.clamp(max=self.max_radius)).round() / 2
        sizes, order = torch.where(inside.all(dim=-1), sizes, -1.0).sort(
            descending=True, stable=True
        )
        order = order[: int((sizes >= 0).sum())]
        column, row = (center[order] + self._margin).long().unbind(dim=-1)
        return order, sizes[: len(order)], row * self._stride + column


def _pixels_of(sizes: Tensor) -> Iterator[tuple[int, int, int]]:
    """Yield the pixels of discs of descending sizes, and the number of discs that cover each.

    Pixels are columns and rows relative to the center, which every disc covers.
    """
    reach = int(sizes[0]) if len(sizes) else -1
    steps = range(-reach, reach + 1)
    offsets = [(dx, dy) for dy in steps for dx in steps]
    distances = torch.tensor([math.hypot(dx, dy) for dx, dy in offsets], device=sizes.device)
    counts = torch.searchsorted(-sizes, -distances.to(sizes.dtype), right=True).tolist()
    for (dx, dy), count in zip(offsets, counts, strict=True):
        count = len(sizes) if dx == dy == 0 else count
        if count > 0:
            yield dx, dy, count


def _depth_at_offset(discs: Discs, start: Tensor, dx: int, dy: int, count: int) -> Tensor:
    """Return the inverse depth of the first discs at an offset, negative beyond their rims.

    ``start`` is the inverse depth of their planes at the center pixel, which all discs cover.
    """
    slope_x, slope_y = discs.slopes[:count].unbind(dim=-1)
    center, limit = discs.inverse_depth[:count], discs.max_change[:count]
    change = (slope_y * dy).add_(slope_x, alpha=dx).add_(start[:count]).sub_(center)
    if dx == dy == 0:
        return change.clamp_(-limit, limit).add_(center)
    ends = change.abs() > limit
    return change.add_(center).masked_fill_(ends, -torch.inf)


def depth_and_colors(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return views of the inverse depth ``(*)``, 0 for empty pixels, and of the colors ``(*, 3)``.

    A key has the bits of the inverse depth above three bytes of color. Positive floats sort like
    integers, so the nearest disc has the largest key.
    """
    halves = keys.view(torch.float32).view(*keys.shape, 2)
    return halves[..., 1], keys.view(torch.uint8).view(*keys.shape, 8)[..., :3]


def close_gaps(keys: Tensor, *, reach: int, thickness: float) -> Tensor:
    """Fill gaps in a surface of up to ``2 * reach`` pixels.

    A pixel is a gap if it is farther than the morphological closing of the inverse depth by more
    than ``thickness``, in units of the cloud. It takes the nearest key within ``reach`` that is not
    in front of the closing. With a reach beyond 20 pixels, as for a few large discs, it takes the
    key of the closing, at constant cost.
    """
    around = _window_maximum(keys, reach)
    closing = -_window_maximum(-around, reach)
    depth, closed = depth_and_colors(keys)[0], depth_and_colors(closing)[0]
    rows, columns = (closed > depth + thickness * depth * closed).nonzero().unbind(dim=-1)
    best, closed = closing[rows, columns], closed[rows, columns]
    if reach <= _MAX_SEARCH:
        limit = closed / (1 - thickness * closed).clamp(min=0.5)
        # The largest key of this depth.
        max_keys = (limit.view(torch.int32).long() << _DEPTH_BITS) + 2**_DEPTH_BITS - 1
        best = around[rows, columns]
        is_left = best > max_keys
        best[is_left] = _nearest_behind(
            keys, (rows[is_left], columns[is_left]), max_keys[is_left], reach=reach
        )
    return keys.index_put((rows, columns), best)


def _nearest_behind(
    keys: Tensor, pixels: tuple[Tensor, Tensor], max_keys: Tensor, *, reach: int
) -> Tensor:
    """Return the largest key within reach of each pixel, at most ``max_keys``, ``(n,)`` each."""
    padded = functional.pad(keys, [reach] * 4)
    stride, values = padded.shape[1], padded.flatten()
    first = pixels[0] * stride + pixels[1]
    best = torch.zeros_like(max_keys)
    for dy in range(2 * reach + 1):
        for dx in range(2 * reach + 1):
            near = values.index_select(0, first + (dy * stride + dx))
            torch.maximum(best, near.masked_fill_(near > max_keys, 0), out=best)
    return best


def _window_maximum(image: Tensor, reach: int) -> Tensor:
    """Return the maximum in the square window around each pixel of an image ``(H, W)``.

    Windows of double width are combined from two windows, so the cost grows with the logarithm.

    Example:
        >>> _window_maximum(torch.tensor([[1, 2, 3, 9], [0, 0, 0, 0]]), 1).tolist()
        [[2, 3, 9, 9], [2, 3, 9, 9]]
    """
    lowest = torch.iinfo(image.dtype).min
    for axis in (0, 1):
        sides = [0, 0, reach, reach] if axis == 0 else [reach, reach]
        image, width = functional.pad(image, sides, value=lowest), 1
        while width < 2 * reach + 1:
            step = min(width, 2 * reach + 1 - width)
            count = image.shape[axis] - step
            image = torch.maximum(image.narrow(axis, 0, count), image.narrow(axis, step, count))
            width += step
    return image


def light_colors(colors: Tensor, normals: Tensor, positions: Tensor) -> Tensor:
    """Shade colors by the angle between surface and light.

    Normals (of arbitrary sign, zero if unknown) and positions are in camera axes.
    """
    light = functional.normalize(normals.new_tensor(_LIGHT), dim=0)
    away = (normals * positions).sum(dim=-1) > 0
    cosine = torch.where(away, -1.0, 1.0) * (normals @ light)
    brightness = _MIN_BRIGHTNESS + (1 - _MIN_BRIGHTNESS) * (0.5 + 0.5 * cosine)
    return (colors * brightness[:, None]).round_().to(torch.uint8)


def shade_hollows(inverse_depth: Tensor, *, focal: float, radius: float) -> Tensor:
    """Return the brightness of each pixel; creases and pixels behind an edge are darker.

    Eye-dome lighting [1] on the second difference of the inverse depth, which vanishes on planes,
    so that tilted planes stay clean. Empty pixels are 0. Steps finer than ``radius``, the median
    disc radius in pixels, count as noise.

    References:
        [1] C. Boucheny, A. Ribes. Eye-dome lighting: a non-photorealistic shading technique. 2011.
    """
    height, width = inverse_depth.shape
    drawn = inverse_depth > 0
    depth = torch.where(drawn, 1 / inverse_depth, 0.0)
    darkness = torch.zeros_like(inverse_depth)
    for factor, weight in _REACHES:
        reach = max(1, round(factor * min(radius, _MAX_SHADE_RADIUS)))
        padded = functional.pad(inverse_depth[None, None], [reach] * 4, mode="replicate")[0, 0]
        for dx, dy in ((reach, 0), (0, reach), (reach, reach), (reach, -reach)):
            after, before = (
                padded[reach + y : reach + y + height, reach + x : reach + x + width]
                for x, y in ((dx, dy), (-dx, -dy))
            )
            per_step = focal / (dx * dx + dy * dy) ** 0.5
            # Noise of a surface at a grazing angle has a large depth range, like its slope.
            slope = torch.minimum((after - inverse_depth).abs_(), (before - inverse_depth).abs_())
            slope.mul_(depth).mul_(per_step)
            hollow = (after + before).mul_(depth).sub_(2).mul_(per_step / 2)
            hollow.sub_(_NOISE * radius / reach).clamp_(min=0)
            hollow.div_(slope.square_().add_(1).sqrt_())
            darkness.add_(hollow.div_(hollow + 1), alpha=weight / 4)
    return torch.where(drawn, 1 - _MAX_DARKENING * darkness, 1.0)
