"""OKLab, a space in which the distance of two colours is about how different they look."""

import torch
from torch import Tensor

_TO_CONES = (
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
)
_TO_LAB = (
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
)


def rgb_to_oklab(colors: Tensor) -> Tensor:
    """Convert colours from sRGB to OKLab [1].

    Args:
        colors: sRGB in [0, 1], shape ``(*, 3)``.

    Returns:
        Lightness in [0, 1] and the two opponent axes, shape ``(*, 3)``.

    References:
        [1] B. Ottosson. A perceptual color space for image processing. 2020.

    Example:
        >>> rgb_to_oklab(torch.tensor([1.0, 1.0, 1.0])).round(decimals=3).abs()
        tensor([1., 0., 0.])
    """
    linear = torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    cones = linear @ _matrix(_TO_CONES, colors).T
    return cones ** (1 / 3) @ _matrix(_TO_LAB, colors).T


def oklab_to_rgb(colors: Tensor) -> Tensor:
    """Convert colours from OKLab to sRGB; values outside [0, 1] are colours no screen shows.

    Args:
        colors: OKLab, shape ``(*, 3)``.

    Returns:
        sRGB, shape ``(*, 3)``.

    Example:
        >>> oklab_to_rgb(torch.tensor([0.5, 0.0, 0.0])).round(decimals=3)
        tensor([0.3890, 0.3890, 0.3890])
    """
    cones = colors @ torch.linalg.inv(_matrix(_TO_LAB, colors)).T
    linear = cones**3 @ torch.linalg.inv(_matrix(_TO_CONES, colors)).T
    bright = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, linear * 12.92, bright)


def to_bytes(colors: Tensor) -> Tensor:
    """Return sRGB colours in [0, 1] as uint8, what is outside cut off."""
    return (colors.clamp(0, 1) * 255).round().to(torch.uint8)


def _matrix(rows: tuple[tuple[float, ...], ...], like: Tensor) -> Tensor:
    return torch.tensor(rows, dtype=like.dtype, device=like.device)
