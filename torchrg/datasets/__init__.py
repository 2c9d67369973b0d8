"""Data sets: S3DIS as released, any folder of clouds, Pointcept's layout, and RGB-D frames.

Every data set is a map-style :class:`torch.utils.data.Dataset`: ``len(data)``, ``data[i]`` is a
sample dict (``coord``, ``color``, ``segment``, ``instance``, ``name``, ...), ``transform=`` is
called with it, and ``data.scenes`` lists what there is without reading it: :class:`Scene` with
``name`` (the place below an output folder), ``path``, and ``files`` (every input file).
:func:`collate_offset` joins samples into a ragged batch. :func:`read_room` reads one room of S3DIS,
:func:`read_pointcept_scene` and :func:`write_pointcept_scene` one folder of Pointcept's layout.

A new data set is a :class:`~torchrg.datasets.folder.SceneDataset` in a file of its own, exported
here, and a test; a new folder of depth frames is a row of :data:`~torchrg.datasets.rgbd.LAYOUTS`.
"""

from torchrg.datasets.collate import collate_offset
from torchrg.datasets.folder import FolderOfClouds, Scene
from torchrg.datasets.pointcept import describe_planes, read_pointcept_scene, write_pointcept_scene
from torchrg.datasets.rgbd import RGBDFrame, RGBDFrames
from torchrg.datasets.rooms import CLASS_ORDERS, Repair, Room, RoomReport, Skipped, read_room
from torchrg.datasets.s3dis import S3DIS

__all__ = [
    "CLASS_ORDERS",
    "S3DIS",
    "FolderOfClouds",
    "RGBDFrame",
    "RGBDFrames",
    "Repair",
    "Room",
    "RoomReport",
    "Scene",
    "Skipped",
    "collate_offset",
    "describe_planes",
    "read_pointcept_scene",
    "read_room",
    "write_pointcept_scene",
]
