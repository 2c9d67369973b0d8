"""Data sets: S3DIS, ScanNet, cloud folders, Pointcept folders, RGB-D frames.

Every data set is a map-style :class:`torch.utils.data.Dataset`: ``len(data)``; ``data[i]`` is a
sample dict (``coord``, ``color``, ``segment``, ``instance``, ``name``, ...); ``transform=`` is
applied to it; ``data.scenes`` lists the scenes without reading them, as :class:`SceneFiles` with
``name`` (the path below an output folder), ``path``, and ``files`` (every input file).
``data.read_cloud(i)`` returns a scene as a :class:`torchrg.Cloud`, except for depth frames.
:func:`collate_offset` collates samples into a ragged batch. :func:`read_room` reads an S3DIS room,
:func:`read_pointcept_scene` and :func:`write_pointcept_scene` a folder in Pointcept's layout.

The guide with recipes for other programs shows how their loaders use these results.

To add a data set, see :class:`SceneDataset`; to add a layout of depth frames,
:mod:`torchrg.datasets.rgbd_layouts`.
"""

from torchrg.datasets.collate import collate_offset
from torchrg.datasets.folder import FolderOfClouds, SceneDataset, SceneFiles, read_pointcept_area
from torchrg.datasets.nag import make_nag
from torchrg.datasets.pointcept import read_pointcept_scene, write_pointcept_scene
from torchrg.datasets.rgbd import RGBDFrame, RGBDFrames
from torchrg.datasets.s3dis import CLASS_ORDERS, S3DIS, read_room
from torchrg.datasets.scannet import ScanNet, read_scannet_scan

__all__ = [
    "CLASS_ORDERS",
    "S3DIS",
    "FolderOfClouds",
    "RGBDFrame",
    "RGBDFrames",
    "ScanNet",
    "SceneDataset",
    "SceneFiles",
    "collate_offset",
    "make_nag",
    "read_pointcept_area",
    "read_pointcept_scene",
    "read_room",
    "read_scannet_scan",
    "write_pointcept_scene",
]
__dir__ = __all__.copy
