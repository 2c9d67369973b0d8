"""Planes of depth images, found from pixel to pixel.

:func:`segment_depth` takes an image and a camera matrix, which :func:`make_intrinsics` makes of
four numbers and :func:`find_intrinsics` finds for an organised cloud. As a module for loaders it is
:class:`torchrg.transforms.SegmentDepth`.
"""

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
