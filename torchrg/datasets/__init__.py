"""Data sets: S3DIS as released, any folder of clouds, Pointcept's layout, and RGB-D frames.

Every data set is a map-style :class:`torch.utils.data.Dataset`: ``len(data)``, ``data[i]`` is a
sample dict (``coord``, ``color``, ``segment``, ``instance``, ``name``, ...), ``transform=`` is
called with it, and ``data.scenes`` lists what there is without reading it: :class:`Scene` with
``name`` (the place below an output folder), ``path``, and ``files`` (every input file).
:func:`collate_offset` joins samples into a ragged batch. :func:`read_room` reads one room of S3DIS,
:func:`read_pointcept_scene` and :func:`write_pointcept_scene` one folder of Pointcept's layout.

**Other people's loaders.** Pointcept loads what ``torchrg convert`` wrote once
:mod:`torchrg.transforms.pointcept` is imported. Loaders that take whole areas of S3DIS get them
from :func:`read_pointcept_area` after ``torchrg convert s3dis RAW OUT --class-order spt``, whose
classes are in their order. KPConv reads ``original_ply/Area_1.ply`` (further fields stay unread
until its ``load_subsampled_clouds`` is told of them)::

    area = {key: np.asarray(value) for key, value in read_pointcept_area("OUT/Area_1").items()}
    fields = {"color": area["color"], "class": area["segment"].astype(np.int32)}
    fields |= {"normals": area["normal"], "plane": area["plane"]}
    torchrg.write_cloud("original_ply/Area_1.ply", torchrg.Cloud(area["coord"], fields))

Superpoint Transformer reads what ``read_single_raw_cloud`` of its ``S3DIS`` returns; with ``OUT``
as ``data/s3dis/raw``, a subclass returns (leave ``normal`` out of the keys of ``PointFeatures``)::

    area = read_pointcept_area(raw_cloud_path)
    sizes = area["offset"].diff(prepend=area["offset"].new_zeros(1))
    is_val = torch.tensor([name in VALIDATION_ROOMS for name in area["name"]])
    return Data(pos=area["coord"], rgb=area["color"] / 255, y=area["segment"],
                normal=area["normal"], plane=area["plane"], is_val=is_val.repeat_interleave(sizes))

OpenPCSeg reads scans of cars only (SemanticKITTI, Waymo), of which there is nothing to convert; in
``__getitem__`` of a subclass, columns of ours go beside those of ``xyzret``::

    found = EstimateNormals()({"coord": torch.from_numpy(pc_data["xyzret"][:, :3])})
    columns = torch.column_stack([found["normal"], found["curvature"]]).numpy()
    pc_data["xyzret"] = np.hstack([pc_data["xyzret"], columns])

A new data set is a :class:`~torchrg.datasets.folder.SceneDataset` in a file of its own, exported
here, and a test; a new folder of depth frames is a row of :data:`~torchrg.datasets.rgbd.LAYOUTS`.
"""

from torchrg.datasets.collate import collate_offset
from torchrg.datasets.folder import FolderOfClouds, Scene, read_pointcept_area
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
    "read_pointcept_area",
    "read_pointcept_scene",
    "read_room",
    "write_pointcept_scene",
]
