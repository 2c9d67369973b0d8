"""Planes of depth images, found from pixel to pixel."""

from torchrg.config import DepthConfig
from torchrg.depth.camera import depth_to_points, find_intrinsics, make_intrinsics
from torchrg.depth.segment import segment_depth

__all__ = [
    "DepthConfig",
    "depth_to_points",
    "find_intrinsics",
    "make_intrinsics",
    "segment_depth",
]
