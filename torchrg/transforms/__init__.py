"""Modules for data pipelines: a dict of tensors (or a PyG ``Data``, ``Batch``) in, a new one out.

:mod:`torchrg.transforms.pointcept` makes them known to Pointcept; for other loaders see
:mod:`torchrg.datasets`.

Depth images and kornia. As in kornia, ``depth`` is channels-first, ``(B, 1, H, W)``, and
``intrinsics`` may be 4 x 4 or a ``PinholeCamera``. What :class:`SegmentDepth` adds is not:
``plane`` and ``curvature`` are ``(B, H, W)`` and ``normal`` is ``(B, H, W, 3)``, with vectors last
as in clouds. For kornia's augmentations they become masks by ``plane[:, None].float()`` and
``normal.movedim(-1, 1)``, and come back by ``[:, 0].long()`` and ``movedim(1, -1)``. These move
pixels, by the ``transform_matrix`` ``M``; the camera moves along as ``M @ intrinsics``. A flip
leaves a negative focal length, with which all stays as it was in space. For the scene in a mirror,
with a positive one, x is reversed in both: ``F = diag(-1, 1, 1)`` makes ``M @ intrinsics @ F`` and
``normal @ F``.

>>> import torch
>>> from kornia.augmentation import AugmentationSequential, CenterCrop, RandomHorizontalFlip
>>> camera = torch.tensor([[[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]])
>>> sample = {"depth": torch.full((1, 1, 30, 40), 2.0), "intrinsics": camera}
>>> found = SegmentDepth()(sample)
>>> moves = AugmentationSequential(
...     RandomHorizontalFlip(p=1.0), CenterCrop((20, 30)), data_keys=["input", "mask", "mask"]
... )
>>> masks = found["plane"][:, None].float(), found["normal"].movedim(-1, 1)
>>> depth, plane, normal = moves(found["depth"], *masks)
>>> mirror = torch.diag(torch.tensor([-1.0, 1, 1]))
>>> intrinsics = moves.transform_matrix @ camera @ mirror
>>> normal = normal.movedim(1, -1) @ mirror
>>> depth.shape, plane.unique(), intrinsics[0, :2].tolist()
(torch.Size([1, 1, 20, 30]), tensor([0.]), [[50.0, 0.0, 14.0], [0.0, 50.0, 10.0]])
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
