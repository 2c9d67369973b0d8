"""Light: by normals, and by hollows in the depth buffer."""

import torch
from torch import Tensor
from torch.nn import functional

_LIGHT = (-0.45, -0.7, -0.55)  # toward the light: left, above, behind the camera
_DARKEST = 0.62
_REACHES = ((1, 0.5), (2, 0.3), (3, 0.2))  # in disc radii, and their weights
_NOISE = 0.35  # a bend over one disc radius that is not shown, as a tangent


def light_colors(colors: Tensor, normals: Tensor, positions: Tensor) -> Tensor:
    """Shade colours softly by the angle between surface and light.

    Args:
        colors: Shape ``(N, 3)``, uint8.
        normals: In the axes of the camera, of arbitrary sign, shape ``(N, 3)``; zero where unknown.
        positions: In the axes of the camera, shape ``(N, 3)``.

    Returns:
        Shape ``(N, 3)``, uint8.

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
    its second difference counts, so that tilted planes stay clean.

    Args:
        inverse_depth: Shape ``(H, W)``; 0: nothing.
        focal: Focal length in pixels.
        radius: Usual radius of a disc in pixels; finer steps are noise.

    Returns:
        Shape ``(H, W)``, in (0, 1]; 1 where there is nothing.

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
    return torch.where(drawn, 1 - 0.85 * darkness, 1.0)
