"""Transforms of samples: dicts of tensors, PyG ``Data`` or ``Batch``.

:mod:`torchrg.transforms.pointcept` registers them with Pointcept; for other loaders see
:mod:`torchrg.datasets`.

All transforms accept ``keys``, which renames the entries of a sample, as in ``{"coord": "pos"}``.
Transforms that use neighbors accept ``keep_neighbors``, which stores them in the sample for the
next transform, see :class:`torchrg.transforms.sample.NeighborSearch`.

``depth`` is channels-first, ``(B, 1, H, W)``, as in kornia, and ``intrinsics`` may be 4 x 4 or a
``PinholeCamera``. The results of :class:`SegmentDepth` differ: ``plane`` and ``curvature`` are
``(B, H, W)`` and ``normal`` is ``(B, H, W, 3)``, with vectors last as in clouds. The guide on depth
cameras applies kornia's augmentations to them.
"""

import torch

from torchrg.neighbors import expand_to_points, sample_voxels
from torchrg.transforms.depth import DepthToCloud, SegmentDepth, fuse_depth
from torchrg.transforms.planes import (
    AlignAxes,
    EstimateNormals,
    GrowRegions,
    MakeSuperpoints,
    OrientNormals,
    SegmentPlanes,
)
from torchrg.transforms.sample import CenterCloud, KeepFinite, NeighborSearch, SampleVoxels

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
    "expand_to_points",
    "fuse_depth",
    "sample_voxels",
]
__dir__ = __all__.copy

# Lets torch.load(weights_only=True) read checkpoints of transforms, and their samples.
torch.serialization.add_safe_globals(
    [NeighborSearch, *(value for value in globals().values() if isinstance(value, type))]
)
