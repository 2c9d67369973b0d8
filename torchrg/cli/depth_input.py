"""Depth images and organised clouds as the commands read them."""

from pathlib import Path

import torch
from torch import Tensor

from torchrg.datasets.rgbd_images import DEPTH_SUFFIXES, read_depth
from torchrg.errors import ConfigError, FormatError
from torchrg.io import read_cloud
from torchrg.structures import Cloud
from torchrg.transforms.depth_camera import depth_to_points, find_intrinsics, make_intrinsics


def read_frame(
    source: Path, *, intrinsics: str | None, depth_scale: float | None, organised: bool
) -> tuple[Cloud, Tensor, Tensor]:
    """Read a depth image, or an organised cloud.

    Args:
        source: The file.
        intrinsics: Camera as ``fx,fy,cx,cy``; clouds can do without.
        depth_scale: Stored value of one metre; clouds have none.
        organised: Whether it is an organised cloud whatever its suffix.

    Returns:
        The cloud in camera coordinates, its depth ``(H, W)``, and the camera matrix ``(3, 3)``.

    Raises:
        ConfigError: If camera or scale are needed and not given.
        FormatError: If the file is damaged, or not such a file.
    """
    if source.suffix.lower() not in DEPTH_SUFFIXES or organised:
        return _read_organised(source, intrinsics)
    if intrinsics is None or depth_scale is None:
        flag = "--intrinsics fx,fy,cx,cy" if intrinsics is None else "--depth-scale"
        raise ConfigError(f"{source}: expected {flag}, which depth images do not hold; pass it.")
    camera = parse_intrinsics(intrinsics)
    depth = read_depth(source, depth_scale=depth_scale)
    points = depth_to_points(depth[None].double(), camera[None])[0]
    height, width = depth.shape
    coordinates = points.view(-1, 3).float().numpy()
    return Cloud(coordinates, grid_shape=(height, width), source=str(source)), depth, camera


def _read_organised(source: Path, given: str | None) -> tuple[Cloud, Tensor, Tensor]:
    """Return an organised cloud, its depth, and the camera that is given or found."""
    cloud = read_cloud(source)
    if cloud.grid_shape is None:
        raise FormatError(
            f"{source}: expected an organised cloud, with a height above 1, got a list of points; "
            "leave out --image."
        )
    points = torch.from_numpy(cloud.coordinates).view(*cloud.grid_shape, 3)
    intrinsics = find_intrinsics(points) if given is None else parse_intrinsics(given)
    if intrinsics is None:
        raise FormatError(
            f"{source}: expected points of a pinhole camera in its own coordinates, got others; "
            "leave out --image."
        )
    depth = points[..., 2]
    return cloud, torch.where(depth.isfinite(), depth, 0.0), intrinsics


def parse_intrinsics(text: str) -> Tensor:
    """Return the camera matrix of ``fx,fy,cx,cy``.

    Raises:
        ConfigError: If these are not four numbers, or no camera.

    Example:
        >>> parse_intrinsics("525,525,319.5,239.5")[0].tolist()
        [525.0, 0.0, 319.5]
    """
    try:
        fx, fy, cx, cy = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(
            f"expected --intrinsics fx,fy,cx,cy, four numbers without blanks, got {text!r}."
        ) from None
    return make_intrinsics(fx, fy, cx, cy)
