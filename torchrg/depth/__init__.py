"""Plane segmentation of depth images.

:func:`segment_depth` takes an image and a camera matrix. :func:`make_intrinsics` builds the matrix
from four numbers; :func:`find_intrinsics` estimates it for an organized cloud. In data
loaders, use :class:`torchrg.transforms.SegmentDepth`.
"""

from torchrg.config import DepthConfig
from torchrg.depth.camera import depth_to_points, find_intrinsics, make_intrinsics
from torchrg.depth.segment import segment_depth

__all__ = ["DepthConfig", "depth_to_points", "find_intrinsics", "make_intrinsics", "segment_depth"]
__dir__ = __all__.copy
