"""Rasterization of points as small tilted discs, and their shading.

Discs extend beyond the edge of their surface and would hide the surface behind it. Their depth is
therefore domed: of discs at about one depth, the one with the nearest center in the image wins.
Ties are broken by color, not by the order of the points.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

_DEPTH_BITS = 32
"""Number of bits of a key below the depth."""
_CHUNK_DISCS = 131_072
"""Number of discs drawn at a time, which fit the cache."""
_DOME = 0.1
"""Curvature of discs, as depth of the rim in radii. With less, discs hide the surface beyond an
edge; with more, thin plates are transparent."""
_LIGHT = (-0.45, -0.7, -0.55)
"""Direction toward the light in camera axes: from the left, above and behind the camera."""
_MIN_BRIGHTNESS = 0.62
"""Brightness of a surface that faces away from the light; its color stays recognizable."""


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
            the disc, and scales its dome.
        bounds: Signed distance of each center from the lines where its surface ends, of any scale,
            and its change per pixel to the right and down, shape ``(N, L, 3)``. The distance on the
            surface is not negative; zero for no line.
    """

    pixels: Tensor
    inverse_depth: Tensor
    colors: Tensor
    radii: Tensor
    slopes: Tensor
    max_change: Tensor
    bounds: Tensor

    def select(self, rows: Tensor) -> "Discs":
        """Return the selected discs."""
        return Discs(*(values.index_select(0, rows) for values in self))

    def by_color(self) -> "Discs":
        """Return the discs in the order of their colors, which breaks ties."""
        red, green, blue = self.colors.int().unbind(dim=1)
        return self.select((red << 16 | green << 8 | blue).sort(stable=True).indices)


def draw_discs(discs: Discs, *, width: int, height: int, max_radius: float) -> Tensor:
    """Return the key of the nearest disc of each pixel, shape ``(height, width)``, int64.

    A key has the bits of the inverse depth, which sort like the float, above the row of the disc
    plus 1; see :func:`split_keys`. Radii are clamped to ``max_radius``, in pixels. The time grows
    with the covered pixels, the memory with the number of discs.
    """
    device = discs.pixels.device
    # Discs may extend beyond the image, into a margin that is never shown.
    margin = math.ceil(max_radius)
    stride = width + 2 * margin
    front = torch.zeros(stride * (height + 2 * margin), dtype=torch.int64, device=device)
    ends = (discs.bounds != 0).flatten(1).any(dim=1)
    for is_kind, num_lines in ((~ends, 0), (ends, discs.bounds.shape[1])):
        kind = discs._replace(bounds=discs.bounds[:, :num_lines])
        for rows in torch.split(is_kind.nonzero().squeeze(1), _CHUNK_DISCS):
            _draw_chunk(front, kind, rows, (width, height), max_radius)
    return front.view(-1, stride)[margin : margin + height, margin : margin + width]


def _draw_chunk(
    front: Tensor, discs: Discs, rows: Tensor, size: tuple[int, int], max_radius: float
) -> None:
    """Draw some discs, given as rows, into the flat keys of an image with a margin."""
    centers = discs.pixels[rows].round()
    inside = ((centers >= 0) & (centers < centers.new_tensor(size))).all(dim=1)
    # Few distinct sizes and a stable sort keep neighboring discs close in memory.
    sizes = (2 * discs.radii[rows].clamp(max=max_radius)).round() / 2
    sizes, order = sizes[inside].sort(descending=True, stable=True)
    rows, centers = rows[inside][order], centers[inside][order]
    shown, margin = discs.select(rows), math.ceil(max_radius)
    stride = size[0] + 2 * margin
    column, row = (centers + margin).long().unbind(dim=1)
    targets, (slope_x, slope_y) = row * stride + column, shown.slopes.T.contiguous()
    start = ((centers - shown.pixels) * shown.slopes).sum(dim=1)
    away = centers - shown.pixels
    bounds = shown.bounds.permute(1, 2, 0).contiguous()
    bounds[:, 0] += (bounds[:, 1:] * away.T).sum(dim=1)
    dome = _DOME * shown.max_change / sizes.clamp(min=1).square_()
    numbers = (rows + 1).int()
    for offsets, counts in _pixels_of(sizes):
        count, (dx, dy) = int(counts[0]), offsets.T[..., None].to(start)
        limit = shown.max_change[:count]
        change = torch.addcmul(start[:count], slope_x[:count], dx).addcmul_(slope_y[:count], dy)
        beyond = change.abs() > limit
        if not bool(offsets[0].any()):
            beyond[0] = False
        if len(offsets) > 1:
            beyond |= torch.arange(count, device=counts.device) >= counts[:, None]
        for bound, bound_x, bound_y in bounds[:, :, :count]:
            beyond |= torch.addcmul(bound, bound_x, dx).addcmul_(bound_y, dy) < 0
        change.clamp_(-limit, limit).add_(shown.inverse_depth[:count])
        change.sub_(dome[:count] * (dx.square() + dy.square()))
        keys = torch.empty(*change.shape, 2, dtype=torch.int32, device=change.device)
        keys[..., 0] = numbers[:count]
        keys[..., 1] = change.masked_fill_(beyond, -torch.inf).view(torch.int32)
        covered = targets[:count] + (offsets[:, 1:] * stride + offsets[:, :1])
        front.scatter_reduce_(0, covered.flatten(), keys.view(torch.int64).flatten(), "amax")


def _pixels_of(sizes: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield pixels of discs of descending sizes, and the number of discs that cover each.

    Pixels are columns and rows ``(n, 2)`` relative to the center, which every disc covers. Their
    counts ``(n,)`` descend, at most to a half.
    """
    if len(sizes) == 0:
        return
    reach = int(sizes[0])
    steps = torch.arange(-reach, reach + 1, device=sizes.device)
    offsets = torch.cartesian_prod(steps, steps)
    distances, order = offsets.to(sizes.dtype).norm(dim=1).sort(stable=True)
    counts = torch.searchsorted(-sizes, -distances, right=True)
    counts[:1] = len(sizes)
    offsets, first = offsets[order], 0
    halves = torch.searchsorted(-counts, -(counts + 1) // 2, right=True)
    while first < len(offsets) and (count := int(counts[first])) > 0:
        end = min(first + max(_CHUNK_DISCS // count, 1), int(halves[first]))
        yield offsets[first:end], counts[first:end]
        first = end


def split_keys(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return views of the inverse depth ``(*)`` and of the rows of discs plus 1, 0 for none."""
    halves = keys.contiguous().view(torch.int32).view(*keys.shape, 2)
    return halves.view(torch.float32)[..., 1], halves[..., 0]


def close_gaps(keys: Tensor, *, reach: int) -> Tensor:
    """Return the morphological closing of keys, which fills gaps of up to ``2 * reach`` pixels."""
    return -_window_maximum(-_window_maximum(keys, reach), reach)


def _window_maximum(image: Tensor, reach: int) -> Tensor:
    """Return the maximum in the square window around each pixel of an image ``(H, W)``.

    Windows of double width are combined from two windows, so the cost grows with the logarithm.
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
