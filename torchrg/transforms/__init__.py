"""Modules for data pipelines: a dict of tensors (or a PyG ``Data``, ``Batch``) in, a new one out.

:mod:`torchrg.transforms.pointcept` makes them known to Pointcept; for other loaders see
:mod:`torchrg.datasets`.

All take ``keys``, other names for the entries of a sample, as in ``{"coord": "pos"}``. Those that
search neighbours, or hold them anyway, take ``keep_neighbors``: the sample then carries these to
the next, see :class:`torchrg.transforms.sample.NeighborSearch`.

As in kornia, ``depth`` is channels-first, ``(B, 1, H, W)``, and ``intrinsics`` may be 4 x 4 or a
``PinholeCamera``. What :class:`SegmentDepth` adds is not: ``plane`` and ``curvature`` are
``(B, H, W)`` and ``normal`` is ``(B, H, W, 3)``, with vectors last as in clouds. The guide on depth
cameras takes them through kornia's augmentations.
"""

from torchrg.neighbors import restore_points, sample_voxels
from torchrg.transforms.depth import DepthToCloud, SegmentDepth, fuse_depth
from torchrg.transforms.planes import (
    AlignAxes,
    EstimateNormals,
    GrowRegions,
    MakeSuperpoints,
    OrientNormals,
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
    "OrientNormals",
    "SampleVoxels",
    "SegmentDepth",
    "SegmentPlanes",
    "fuse_depth",
    "restore_points",
    "sample_voxels",
]
