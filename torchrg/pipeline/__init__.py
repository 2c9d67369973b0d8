"""Segmentation of point clouds into planes and superpoints."""

from torchrg.pipeline.planes import segment_planes
from torchrg.pipeline.superpoints import make_superpoints, segment_mesh

__all__ = ["make_superpoints", "segment_mesh", "segment_planes"]
__dir__ = __all__.copy
