"""Stored values of depth images, converted to meters along the optical axis.

Depth images of every layout, command and transform pass through :func:`convert_depth`.
"""

from typing import Literal, TypeVar

import torch
from torch import Tensor

from torchrg._checks import check_choices, check_floating
from torchrg._parallel import nonzero_rows
from torchrg.errors import ConfigError, DepthWarning, warn
from torchrg.structures.points import Array

Image = TypeVar("Image", Tensor, Array)
DepthKind = Literal["z", "ray"]
"""Meaning of depth: distance along the optical axis, or from the camera center along the ray."""
_MAX_16_BIT = 65535.0
"""Largest value of 16 bits: "no depth" of many recorders, also after conversion to wider types."""
_MIN_MEDIAN_DEPTH, _MAX_MEDIAN_DEPTH = 0.05, 20.0
"""Plausible range of the median depth, in meters. Depth cameras measure 0.1 to 20."""
_SAMPLED = 20_000
"""Pixels sampled for the median."""


def has_depth(depth: Tensor) -> Tensor:
    """Return a mask of pixels with depth, in the shape of ``depth``.

    Depth is finite and positive; the largest integer of its type and of 16 bits mean none.
    """
    if depth.is_floating_point():
        return (depth > 0) & (depth < torch.inf) & (depth != _MAX_16_BIT)
    values, largest = depth.double(), float(torch.iinfo(depth.dtype).max)
    return (values > 0) & (values != _MAX_16_BIT) & (values != largest)


def drop_channel(image: Image) -> Image:
    """Return an array or tensor of shape ``(1, H, W)`` or ``(H, W, 1)`` as ``(H, W)``."""
    if image.ndim == 3 and 1 in (image.shape[0], image.shape[2]):
        return image[0] if image.shape[0] == 1 else image[..., 0]
    return image


def check_conversion(caller: str, depth_scale: float, depth_kind: DepthKind) -> None:
    """Raise ConfigError if ``depth_scale`` is not positive or ``depth_kind`` is unknown."""
    check_choices(caller, depth_kind=(depth_kind, DepthKind))
    if not 0 < depth_scale < float("inf"):
        raise ConfigError(f"{caller}: expected depth_scale > 0 units per meter, got {depth_scale}.")


def convert_depth(
    caller: str,
    stored: Tensor,
    intrinsics: Tensor | None,
    depth_scale: float = 1.0,
    depth_kind: DepthKind = "z",
) -> Tensor:
    """Convert stored depth to meters along the optical axis, with 0 for missing depth.

    ``stored`` ``(*, H, W)`` has any memory layout; float64 stays, integers become float32.
    ``intrinsics`` ``(*, 3, 3)`` are for distances along the ray, ``caller`` for messages.

    Warns:
        DepthWarning: If the median depth is below 5 cm or above 20 m.
    """
    check_conversion(caller, depth_scale, depth_kind)
    if stored.dtype == torch.bool or stored.is_floating_point() or stored.is_complex():
        check_floating(caller, depth=stored)
    exact = depth_scale == 1 and stored.is_floating_point()
    values = stored if exact else stored.double() / depth_scale
    seen = has_depth(stored)
    meters = torch.where(seen, values, 0.0)
    if depth_kind == "ray" and intrinsics is not None:
        from kornia.geometry.depth import depth_to_3d_v2

        images = meters.reshape(-1, *meters.shape[-2:]).double()
        cameras = intrinsics.to(images).reshape(-1, 3, 3)
        points = depth_to_3d_v2(images, cameras, normalize_points=True)
        meters = points[..., 2].reshape(meters.shape)
    valid = nonzero_rows(seen)
    sample = meters.flatten()[valid[:: len(valid) // _SAMPLED + 1]]
    median = float(sample.median()) if len(sample) else 1.0
    if not _MIN_MEDIAN_DEPTH <= median <= _MAX_MEDIAN_DEPTH:
        warn(
            f"{caller}: expected a median depth of {_MIN_MEDIAN_DEPTH} to {_MAX_MEDIAN_DEPTH:g} m, "
            f"got {median:,.4g} m with --depth-scale (depth_scale) {depth_scale:g}; pass 1000 for "
            "millimeters, 1 for meters.",
            DepthWarning,
        )
    dtype = stored.dtype if stored.is_floating_point() else torch.float32
    return meters.to(dtype).contiguous()
