"""A depth buffer into which points are drawn as small tilted discs.

A pixel is one 64-bit key: the bits of the inverse depth (a positive float, which as an integer has
the same order) above three bytes of colour. The nearest disc is the largest key, so equal depths
are decided by colour and never by the order of the points.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

_NOTHING = 0xFFFFFF
"""Key of a pixel in which nothing is drawn: white, and infinitely far away."""
_LIGHT = (-0.45, -0.7, -0.55)
"""Direction toward the light in the axes of the camera: from the left, above, and behind it."""
_DARKEST = 0.62
"""Brightness of a surface that faces away from the light. Its colour can still be told."""
_DEEPEST = 0.85
"""Share of its brightness that a pixel loses in the deepest hollow."""
_REACHES = ((1, 0.5), (2, 0.3), (3, 0.2))
"""Distances at which hollows are looked for, in radii of a disc, and how much each counts. Together
they count 1, and the nearest counts most, so that creases are drawn as thin lines."""
_NOISE = 0.35
"""Tangent of a bend over the radius of one disc. A smaller bend is noise and is not shown."""


class DepthBuffer:
    """What is nearest in each pixel of a picture.

    Args:
        width: Width of the picture, in pixels.
        height: Height of the picture, in pixels.
        max_radius: Largest radius of a disc, in pixels; larger ones are drawn as large as this.
        device: Where to draw.

    Example:
        >>> buffer = DepthBuffer(2, 1, max_radius=0)
        >>> middle = torch.tensor([[1.0, 0.0], [1.0, 0.0]])
        >>> colors = torch.tensor([[9, 9, 9], [7, 7, 7]], dtype=torch.uint8)
        >>> buffer.draw_discs(middle, torch.tensor([0.5, 0.2]), colors, torch.zeros(2))
        >>> depth_and_colors(buffer.keys())[1].tolist()
        [[[255, 255, 255], [9, 9, 9]]]
    """

    def __init__(
        self, width: int, height: int, *, max_radius: float, device: torch.device | None = None
    ) -> None:
        self.width, self.height, self.max_radius = width, height, max_radius
        # Discs reach over the edges of the picture into a margin that is never shown.
        self._margin = math.ceil(max_radius)
        self._stride = width + 2 * self._margin
        size = self._stride * (height + 2 * self._margin)
        self._keys = torch.full((size,), _NOTHING, dtype=torch.int64, device=device)

    def keys(self) -> Tensor:
        """Return the keys, shape ``(height, width)``, int64; see :func:`depth_and_colors`."""
        shown = slice(self._margin, self._margin + self.height)
        columns = slice(self._margin, self._margin + self.width)
        return self._keys.view(-1, self._stride)[shown, columns].contiguous()

    def draw_discs(
        self,
        pixels: Tensor,
        inverse_depth: Tensor,
        colors: Tensor,
        radii: Tensor,
        *,
        slopes: Tensor | None = None,
        max_change: Tensor | None = None,
    ) -> None:
        """Draw discs of surface.

        The inverse depth of a plane is linear over its picture, so a disc is given by the value at
        its middle and two slopes. Middles are rounded to whole pixels.

        Args:
            pixels: Column and row of the middles, shape ``(N, 2)``; whole numbers are the centres
                of pixels. Discs with their middle outside the picture are left out.
            inverse_depth: One over the depth, positive, shape ``(N,)``, float32.
            colors: Shape ``(N, 3)``, uint8.
            radii: In pixels, shape ``(N,)``; every disc covers at least one pixel.
            slopes: Change of the inverse depth per pixel to the right and down, shape ``(N, 2)``.
                Default: discs face the camera.
            max_change: A disc ends where its inverse depth differs by more than this from that of
                its middle, shape ``(N,)``. Given together with ``slopes``.
        """
        middle = pixels.round()
        inside = (middle >= 0) & (middle < middle.new_tensor([self.width, self.height]))
        # Few sizes and a stable sort keep discs that are close in space close in memory.
        sizes = (2 * radii.clamp(max=self.max_radius)).round() / 2
        sizes, order = torch.where(inside.all(dim=-1), sizes, -1.0).sort(
            descending=True, stable=True
        )
        order = order[: int((sizes >= 0).sum())]
        column, row = (middle[order] + self._margin).long().unbind(dim=-1)
        keys = torch.zeros(len(order), 8, dtype=torch.uint8, device=colors.device)
        keys[:, :3] = colors[order]
        keys.view(torch.float32)[:, 1] = inverse_depth[order]
        tilt = None
        if slopes is not None and max_change is not None:
            slope_x, slope_y = slopes[order].T.contiguous()
            tilt = (inverse_depth[order], slope_x, slope_y, max_change[order])
        self._draw(row * self._stride + column, sizes[: len(order)], keys.view(torch.int64), tilt)

    def _draw(
        self,
        places: Tensor,
        sizes: Tensor,
        keys: Tensor,
        tilt: tuple[Tensor, Tensor, Tensor, Tensor] | None,
    ) -> None:
        """Draw discs of descending size, all of them at once for each pixel of a disc."""
        keys = keys.squeeze(-1)
        depth = keys.view(torch.float32).view(-1, 2)[:, 1]
        reach = int(sizes[0]) if len(sizes) else 0
        steps = range(-reach, reach + 1)
        offsets = [(dx, dy) for dy in steps for dx in steps]
        distances = torch.tensor([math.hypot(dx, dy) for dx, dy in offsets], device=sizes.device)
        counts = torch.searchsorted(-sizes, -distances.to(sizes.dtype), right=True).tolist()
        for (dx, dy), count in zip(offsets, counts, strict=True):
            count = len(places) if dx == dy == 0 else count
            if count == 0:
                continue
            if tilt is not None:
                middle, slope_x, slope_y, max_change = (part[:count] for part in tilt)
                change = (slope_y * dy).add_(slope_x, alpha=dx)
                ends = change.abs() > max_change
                depth[:count] = change.add_(middle).masked_fill_(ends, 0.0)
            offset = dy * self._stride + dx
            self._keys.scatter_reduce_(0, places[:count] + offset, keys[:count], "amax")


def depth_and_colors(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return views of the inverse depth ``(*)``, 0 for nothing, and of the colours ``(*, 3)``."""
    halves = keys.view(torch.float32).view(*keys.shape, 2)
    return halves[..., 1], keys.view(torch.uint8).view(*keys.shape, 8)[..., :3]


def close_gaps(keys: Tensor, *, reach: int, thickness: float) -> Tensor:
    """Fill gaps through which one sees past a surface, up to ``2 * reach`` pixels wide.

    The morphological closing of the inverse depth tells where they are. A gap takes the nearest
    key of its surroundings that is not in front of the closing. A pixel is a gap if it is farther
    than the closing by more than ``thickness``, in the unit of the cloud.
    """
    depth, _ = depth_and_colors(keys)
    closed = -_largest_around(-_largest_around(depth, reach), reach)
    rows, columns = (closed > depth + thickness * depth * closed).nonzero().unbind(dim=-1)
    closed = closed[rows, columns]
    limit = closed / (1 - thickness * closed).clamp(min=0.5)
    height, width = keys.shape
    best = keys[rows, columns]
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            near = keys[(rows + dy).clamp(0, height - 1), (columns + dx).clamp(0, width - 1)]
            fits = depth_and_colors(near)[0] <= limit
            best = torch.where(fits, torch.maximum(best, near), best)
    return keys.index_put((rows, columns), best)


def _largest_around(image: Tensor, reach: int) -> Tensor:
    """Return the largest value in the square around each pixel of an image ``(H, W)``."""
    for axis in (0, 1):
        edges = (reach, reach, 0, 0) if axis else (0, 0, reach, reach)
        image = functional.pad(image, edges, value=-torch.inf)
        width = 1
        while width <= 2 * reach:
            step = min(width, 2 * reach + 1 - width)
            count = image.shape[axis] - step
            image = torch.maximum(image.narrow(axis, 0, count), image.narrow(axis, step, count))
            width += step
    return image


def light_colors(colors: Tensor, normals: Tensor, positions: Tensor) -> Tensor:
    """Shade colours softly by the angle between surface and light.

    Normals, of arbitrary sign and zero where unknown, and positions are in the axes of the camera.

    Example:
        >>> wall = torch.tensor([[0.0, 0, 1], [0, 0, -1]])
        >>> light_colors(torch.full((2, 3), 100, dtype=torch.uint8), wall, torch.ones(2, 3))[:, 0]
        tensor([91, 91], dtype=torch.uint8)
    """
    light = functional.normalize(normals.new_tensor(_LIGHT), dim=0)
    away = (normals * positions).sum(dim=-1) > 0
    cosine = torch.where(away, -1.0, 1.0) * (normals @ light)
    brightness = _DARKEST + (1 - _DARKEST) * (0.5 + 0.5 * cosine)
    return (colors * brightness[:, None]).round_().to(torch.uint8)


def shade_hollows(inverse_depth: Tensor, *, focal: float, radius: float) -> Tensor:
    """Return how bright each pixel is: creases, and what lies behind an edge, are darker.

    Eye-dome lighting [1] on the inverse depth, which is linear over the picture of a plane: only
    its second difference counts, so that tilted planes stay clean. Pixels are 0 where there is
    nothing; steps finer than ``radius``, the usual one of a disc in pixels, are noise.

    References:
        [1] C. Boucheny, A. Ribes. Eye-dome lighting: a non-photorealistic shading technique. 2011.

    Example:
        >>> step = torch.tensor([[1.0, 1.0, 2.0, 2.0]]).repeat(4, 1)
        >>> shade_hollows(step, focal=100.0, radius=1.0)[1] < 1
        tensor([ True,  True, False, False])
    """
    height, width = inverse_depth.shape
    drawn = inverse_depth > 0
    depth = torch.where(drawn, 1 / inverse_depth, 0.0)
    darkness = torch.zeros_like(inverse_depth)
    for factor, weight in _REACHES:
        reach = max(1, round(factor * radius))
        padded = functional.pad(inverse_depth[None, None], [reach] * 4, mode="replicate")[0, 0]
        for dx, dy in ((reach, 0), (0, reach), (reach, reach), (reach, -reach)):
            after, before = (
                padded[reach + y : reach + y + height, reach + x : reach + x + width]
                for x, y in ((dx, dy), (-dx, -dy))
            )
            per_step = focal / (dx * dx + dy * dy) ** 0.5
            # Noise of a surface seen at a small angle is long in depth, as its slope is large.
            slope = torch.minimum((after - inverse_depth).abs_(), (before - inverse_depth).abs_())
            slope.mul_(depth).mul_(per_step)
            hollow = (after + before).mul_(depth).sub_(2).mul_(per_step / 2)
            hollow.sub_(_NOISE * radius / reach).clamp_(min=0)
            hollow.div_(slope.square_().add_(1).sqrt_())
            darkness.add_(hollow.div_(hollow + 1), alpha=weight / 4)
    return torch.where(drawn, 1 - _DEEPEST * darkness, 1.0)
