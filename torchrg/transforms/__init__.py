"""Modules for data pipelines: a dict of tensors (or a PyG ``Data``, ``Batch``) in, a new one out.

:mod:`torchrg.transforms.pointcept` makes them known to Pointcept; for other loaders see
:mod:`torchrg.datasets`.
"""

from torchrg.neighbors import restore_points, sample_voxels
from torchrg.transforms.depth import DepthToCloud, SegmentDepth, fuse_depth
from torchrg.transforms.planes import (
    AlignAxes,
    EstimateNormals,
    GrowRegions,
    MakeSuperpoints,
    SegmentPlanes,
)
from torchrg.transforms.sample import CenterCloud, KeepFinite, SampleVoxels

__all__ = [
    "AlignAxes",
    "CenterCloud",
    "DepthToCloud",
    "EstimateNormals",
    "GrowRegions",
    "KeepFinite",
    "MakeSuperpoints",
    "SampleVoxels",
    "SegmentDepth",
    "SegmentPlanes",
    "fuse_depth",
    "restore_points",
    "sample_voxels",
]
