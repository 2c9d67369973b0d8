"""Data sets: S3DIS as released, any folder of clouds, and Pointcept's processed layout.

Every data set is a map-style :class:`torch.utils.data.Dataset`: ``len(data)``, ``data[i]`` is a
sample dict (``coord``, ``color``, ``segment``, ``instance``, ``name``, ...), ``transform=`` is
called with it, and ``data.scenes`` lists what there is without reading it: :class:`Scene` with
``name`` (the place below an output folder), ``path``, and ``files`` (every input file).

* ``S3DIS(root, areas=(1, ..., 6), *, class_order="pointcept", cache=FOLDER, transform=None)``;
  ``S3DIS.read_room(i)`` is ``Room(coord, color, segment, instance, report)``.
* ``read_room(path, *, class_order="pointcept")`` reads one room without any cache. Its ``report``
  has ``repairs`` (:class:`Repair`: file, line, column, line before and after), ``skipped`` (file,
  reason) and ``as_clutter`` (files of classes that are not among the 13).
* ``FolderOfClouds(root, *, suffixes=..., transform=None)``; folders of Pointcept count as clouds.
* ``read_pointcept_scene(folder)`` is a sample; ``write_pointcept_scene(folder, sample,
  segmentation, *, superpoint=False, origin=None)`` writes or completes a scene folder, and returns
  the names of the files it wrote.
* ``RGBDFrames(frames)``, ``RGBDFrames.from_folder(root, layout)``: depth frames with cameras and
  poses, in the folders of TUM, ICL-NUIM, ScanNet, 7-Scenes, or any (:class:`RGBDFrame`).
* ``describe_planes(planes, *, origin=None)`` is the content of ``planes.json``.
* ``collate_offset(samples)`` joins samples into a ragged batch.

A new data set is a :class:`~torchrg.datasets.folder.SceneDataset` in a file of its own, exported
here, and a test; a new folder of depth frames is a row of
:data:`~torchrg.datasets.rgbd.LAYOUTS`.
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
