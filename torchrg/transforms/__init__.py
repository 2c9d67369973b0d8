"""Modules for data pipelines: a dict of tensors (or a PyG ``Data``) in, a new one out."""

from torchrg.transforms.cloud import CenterCloud, KeepFinite
from torchrg.transforms.depth import DepthToCloud, SegmentDepth
from torchrg.transforms.depth_config import DepthConfig
from torchrg.transforms.depth_fusion import fuse_depth
from torchrg.transforms.depth_segment import segment_depth
from torchrg.transforms.planes import EstimateNormals, GrowRegions, SegmentPlanes
from torchrg.transforms.voxel_planes import segment_voxels
from torchrg.transforms.voxels import SampleVoxels, restore_points, sample_voxels

__all__ = [
    "CenterCloud",
    "DepthConfig",
    "DepthToCloud",
    "EstimateNormals",
    "GrowRegions",
    "KeepFinite",
    "SampleVoxels",
    "SegmentDepth",
    "SegmentPlanes",
    "fuse_depth",
    "restore_points",
    "sample_voxels",
    "segment_depth",
    "segment_voxels",
]
