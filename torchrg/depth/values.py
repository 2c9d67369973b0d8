"""Stored values of depth images, converted to meters along the optical axis.

Depth images of every layout, command and transform pass through :func:`convert_depth`.
"""

import warnings
from typing import Literal, TypeVar

import torch
from torch import Tensor

from torchrg._checks import check_choices, check_floating
from torchrg.errors import ConfigError, DepthWarning, ShapeError
from torchrg.structures import Array

Image = TypeVar("Image", Tensor, Array)
DepthKind = Literal["z", "ray"]
"""What depth images store: distances along the optical axis, or along the ray of each pixel."""
_MAX_16_BIT = 65535.0
"""Largest value of 16 bits: "no depth" of many recorders, also after conversion to wider types."""
_MIN_MEDIAN_DEPTH, _MAX_MEDIAN_DEPTH = 0.05, 20.0
"""Plausible range of the median depth, in meters. Depth cameras measure 0.1 to 20."""
_SAMPLED = 20_000
"""Pixels sampled for the median."""


def has_depth(depth: Tensor) -> Tensor:
    """Return a mask of pixels with depth, in the shape of ``depth``.

    Depth is finite and positive. The largest value of an integer type, and that of 16 bits in any
    type, stands for missing depth.

    Example:
        >>> has_depth(torch.tensor([1.5, 0.0, -1.0, torch.nan, 65535.0])).tolist()
        [True, False, False, False, False]
    """
    is_integer = not depth.is_floating_point()
    values = depth.double() if is_integer else depth
    seen = values.isfinite() & (values > 0) & (values != _MAX_16_BIT)
    return seen & (values != float(torch.iinfo(depth.dtype).max)) if is_integer else seen


def drop_channel(image: Image) -> Image:
    """Return an array or tensor of shape ``(1, H, W)`` or ``(H, W, 1)`` as ``(H, W)``."""
    if image.ndim == 3 and 1 in (image.shape[0], image.shape[2]):
        return image[0] if image.shape[0] == 1 else image[..., 0]
    return image


def check_conversion(caller: str, depth_scale: float, depth_kind: DepthKind) -> None:
    """Raise ConfigError if ``depth_scale`` is not positive or ``depth_kind`` is unknown."""
    check_choices(caller, depth_kind=(depth_kind, DepthKind))
    if not 0 < depth_scale < float("inf"):
        raise ConfigError(
            f"{caller}: expected depth_scale > 0, the depth units per meter, got {depth_scale}."
        )


def convert_depth(
    caller: str,
    stored: Tensor,
    intrinsics: Tensor | None,
    *,
    depth_scale: float = 1.0,
    depth_kind: DepthKind = "z",
) -> Tensor:
    """Convert stored depth to meters along the optical axis, with 0 for missing depth.

    Args:
        caller: Function or file for messages.
        stored: Depth images, shape ``(*, H, W)``, of any type of numbers and any memory layout.
        intrinsics: Camera matrices, shape ``(*, 3, 3)``; needed only for ``"ray"``.
        depth_scale: Depth units per meter: 1000 for millimeters, 1 for meters.
        depth_kind: ``"z"`` for depth along the optical axis, ``"ray"`` for distances from the
            camera center.

    Returns:
        Contiguous depth in the shape of ``stored``; float64 stays, integers become float32.

    Warns:
        DepthWarning: If the median depth is below 5 cm or above 20 m.

    Example:
        >>> stored = torch.tensor([[1500, 0, 65535]])
        >>> convert_depth("f", stored, None, depth_scale=1000)
        tensor([[1.5000, 0.0000, 0.0000]])
    """
    check_conversion(caller, depth_scale, depth_kind)
    if stored.is_floating_point():
        check_floating(caller, depth=stored)
    elif stored.dtype == torch.bool or stored.is_complex():
        raise ShapeError(f"{caller}: expected depth of real numbers, got {stored.dtype}.")
    meters = torch.where(has_depth(stored), stored.double(), 0.0) / depth_scale
    if depth_kind == "ray" and intrinsics is not None:
        meters = meters * _ray_cosines(intrinsics.to(stored.device), *stored.shape[-2:])
    _check_median(caller, meters, depth_scale)
    dtype = stored.dtype if stored.is_floating_point() else torch.float32
    return meters.to(dtype).contiguous()


def _ray_cosines(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Return the cosine between the optical axis and the ray of each pixel, ``(*, H, W)``."""
    matrix = intrinsics.double()
    columns = torch.arange(width, device=matrix.device)
    rows = torch.arange(height, device=matrix.device)[:, None]
    x = (columns - matrix[..., :1, 2:]) / matrix[..., :1, :1]
    y = (rows - matrix[..., 1:2, 2:]) / matrix[..., 1:2, 1:2]
    return (1 + x.square() + y.square()).rsqrt()


def _check_median(caller: str, meters: Tensor, depth_scale: float) -> None:
    """Warn if the median depth is implausible; a sample of the pixels suffices."""
    valid = meters[meters > 0]
    median = float(valid[:: len(valid) // _SAMPLED + 1].median()) if len(valid) else 1.0
    if not _MIN_MEDIAN_DEPTH <= median <= _MAX_MEDIAN_DEPTH:
        warnings.warn(
            f"{caller}: expected a median depth of {_MIN_MEDIAN_DEPTH} to {_MAX_MEDIAN_DEPTH:g} m, "
            f"got {median:,.4g} m with --depth-scale (depth_scale) {depth_scale:g}; pass 1000 for "
            "millimeters, 1 for meters.",
            DepthWarning,
            stacklevel=4,
        )
