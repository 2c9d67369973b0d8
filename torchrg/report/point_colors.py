"""Colours for normals, curvature and sharp points."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ConfigError, ShapeError
from torchrg.report.oklab import oklab_to_rgb, to_bytes
from torchrg.report.palette import UNLABELED_GRAY

_LEVEL_LIGHTNESS, _UPRIGHT_LIGHTNESS, _CHROMA = 0.86, 0.66, 0.13
_RAMP = (  # OKLab: light gray, yellow, orange, red, violet; darker all the way
    (0.90, 0.00, 0.00),
    (0.87, 0.02, 0.10),
    (0.74, 0.11, 0.12),
    (0.55, 0.18, 0.06),
    (0.32, 0.13, -0.06),
)
_REGULAR, _SHARP = (205, 205, 205), (214, 40, 40)


def color_normals(
    normals: Tensor | NDArray[np.floating], *, up: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> Tensor:
    """Colour normals by direction; a normal and its opposite get the same colour.

    Level surfaces are light gray; upright ones are coloured by the direction they face, with
    perpendicular walls in opposite hues; slanted ones are between.

    Args:
        normals: Unit normals of arbitrary sign, shape ``(*, 3)``; zero where there is none.
        up: Upward direction.

    Returns:
        Shape ``(*, 3)``, uint8; gray where there is no normal.

    Raises:
        ShapeError: If the shape or dtype is not as above.
        ConfigError: If ``up`` is zero.

    Example:
        >>> color_normals(torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 0]]))[:, 0].tolist()
        [209, 209, 176]
    """
    tensor = as_tensor("color_normals", "normals", normals)
    check_shapes("color_normals", normals=(tensor, "* 3"))
    check_floating("color_normals", normals=tensor)
    if not any(up):
        raise ConfigError("color_normals: expected up to be a direction, got zeros.")
    axis = torch.nn.functional.normalize(tensor.new_tensor(up), dim=0)
    east = torch.zeros_like(axis)
    east[axis.abs().argmin()] = 1
    east = torch.nn.functional.normalize(east - (east @ axis) * axis, dim=0)
    x, y, z = (tensor @ side for side in (east, torch.linalg.cross(axis, east), axis))
    lightness = _UPRIGHT_LIGHTNESS + (_LEVEL_LIGHTNESS - _UPRIGHT_LIGHTNESS) * z * z
    lab = torch.stack([lightness, _CHROMA * (x * x - y * y), 2 * _CHROMA * x * y], dim=-1)
    missing = (tensor == 0).all(dim=-1, keepdim=True)
    gray = torch.tensor(UNLABELED_GRAY, dtype=torch.uint8, device=tensor.device)
    return torch.where(missing, gray, to_bytes(oklab_to_rgb(lab)))


def color_curvature(
    curvature: Tensor | NDArray[np.floating], *, max_curvature: float = 0.1
) -> Tensor:
    """Colour curvature from light gray over yellow and red to dark violet.

    The scale goes with the root of the curvature, and is the same for every cloud.

    Args:
        curvature: Surface variation in [0, 1/3], shape ``(*)``.
        max_curvature: Where the scale ends.

    Returns:
        Shape ``(*, 3)``, uint8.

    Raises:
        ShapeError: If the dtype is not as above.
        ConfigError: If ``max_curvature`` is not positive.

    Example:
        >>> color_curvature(torch.tensor([0.0, 0.1, 0.3])).tolist()
        [[222, 222, 222], [90, 0, 78], [90, 0, 78]]
    """
    tensor = as_tensor("color_curvature", "curvature", curvature)
    check_floating("color_curvature", curvature=tensor)
    if not max_curvature > 0:
        raise ConfigError(
            f"color_curvature: expected max_curvature to be positive, got {max_curvature!r}."
        )
    place = (tensor / max_curvature).clamp(0, 1).sqrt().nan_to_num() * (len(_RAMP) - 1)
    before = place.long().clamp(max=len(_RAMP) - 2)
    ramp = tensor.new_tensor(_RAMP)
    lab = torch.lerp(ramp[before], ramp[before + 1], (place - before)[..., None])
    return to_bytes(oklab_to_rgb(lab))


def color_sharp(sharp: Tensor | NDArray[Any]) -> Tensor:
    """Colour sharp feature points red and all others light gray.

    Args:
        sharp: Shape ``(*)``, bool.

    Returns:
        Shape ``(*, 3)``, uint8.

    Raises:
        ShapeError: If ``sharp`` is not bool.

    Example:
        >>> color_sharp(torch.tensor([False, True])).tolist()
        [[205, 205, 205], [214, 40, 40]]
    """
    tensor = as_tensor("color_sharp", "sharp", sharp)
    if tensor.dtype != torch.bool:
        dtype = str(tensor.dtype).removeprefix("torch.")
        raise ShapeError(f"color_sharp: expected sharp of bool, got {dtype}.")
    colors = torch.tensor([_REGULAR, _SHARP], dtype=torch.uint8, device=tensor.device)
    return colors[tensor.long()]
