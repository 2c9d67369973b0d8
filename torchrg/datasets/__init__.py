"""Data sets: S3DIS and ScanNet as released, folders of clouds, Pointcept's layout, RGB-D frames.

Every data set is a map-style :class:`torch.utils.data.Dataset`: ``len(data)``, ``data[i]`` is a
sample dict (``coord``, ``color``, ``segment``, ``instance``, ``name``, ...), ``transform=`` is
called with it, and ``data.scenes`` lists what there is without reading it: :class:`SceneFiles` with
``name`` (the place below an output folder), ``path``, and ``files`` (every input file).
:func:`collate_offset` joins samples into a ragged batch. :func:`read_room` reads one room of S3DIS,
:func:`read_pointcept_scene` and :func:`write_pointcept_scene` one folder of Pointcept's layout.

**Other people's loaders.** Pointcept loads what ``torchrg convert`` wrote once
:mod:`torchrg.transforms.pointcept` is imported.

KPConv reads an area of S3DIS as ``original_ply/Area_1.ply``; after ``torchrg convert s3dis RAW OUT
--class-order spt``, whose classes are in its order, these lines write it (the fields beyond
``class`` stay unread until ``load_subsampled_clouds`` is told of them):

    area = {key: np.asarray(value) for key, value in read_pointcept_area("OUT/Area_1").items()}
    fields = {"color": area["color"], "class": area["segment"].astype(np.int32)}
    fields |= {"normals": area["normal"], "plane": area["plane"]}
    torchrg.write_cloud("original_ply/Area_1.ply", torchrg.Cloud(area["coord"], fields))

Superpoint Transformer reads S3DIS as released and averages points over voxels, labels too: planes
have to come after. With ``from torchrg.transforms import SegmentPlanes`` at the end of its
``src/transforms/__init__.py``, its configs name our transforms; in ``pre_transform``, after
``GridSampling3D`` (``plane`` also goes into ``point_save_keys``):

    - transform: SegmentPlanes
      params:
        config: s3dis

:func:`make_nag` nests superpoints as its ``NAG``.

Sonata, Concerto and other pretrained encoders want ``coord``, ``color`` and ``normal`` of scenes in
metres, z up, and know normals of meshes, which look into the room; zeros in their place cost
accuracy. Of a scan without normals these lines make the dict that their transforms begin with.
In made rooms 99.5 % of the normals of floors, ceilings and walls look into the room then, and 96 %
of all: those of plates thinner than two point spacings may not. ``torchrg align`` sets a scan
upright before, and ``torchrg normals --orient interior`` writes the normals into a file:

    cloud = torchrg.read_cloud("scan.ply")
    normals = torchrg.estimate_normals(cloud.points).normals
    normals = torchrg.normals.orient_normals(cloud.points, normals, towards="interior")
    point = {"coord": cloud.points.numpy(), "color": cloud.fields["color"].astype(np.float32)}
    point = sonata.transform.default()(point | {"normal": normals.numpy()})

OpenPCSeg reads scans of cars only (SemanticKITTI, Waymo), of which there is nothing to convert; in
``__getitem__`` of a subclass, columns of ours go beside those of ``xyzret``:

    found = EstimateNormals()({"coord": torch.from_numpy(pc_data["xyzret"][:, :3])})
    columns = torch.column_stack([found["normal"], found["curvature"]]).numpy()
    pc_data["xyzret"] = np.hstack([pc_data["xyzret"], columns])

A new data set is a :class:`~torchrg.datasets.folder.SceneDataset` in a file of its own, exported
here, and a test; a new folder of depth frames is a row of :data:`~torchrg.datasets.rgbd.LAYOUTS`.
"""

from torchrg.datasets.collate import collate_offset
from torchrg.datasets.folder import FolderOfClouds, SceneFiles, read_pointcept_area
from torchrg.datasets.nag import make_nag
from torchrg.datasets.pointcept import read_pointcept_scene, write_pointcept_scene
from torchrg.datasets.rgbd import RGBDFrame, RGBDFrames
from torchrg.datasets.rooms import CLASS_ORDERS, Room, read_room
from torchrg.datasets.s3dis import S3DIS
from torchrg.datasets.scannet import ScanNet, read_scannet_scan

__all__ = [
    "CLASS_ORDERS",
    "S3DIS",
    "FolderOfClouds",
    "RGBDFrame",
    "RGBDFrames",
    "Room",
    "ScanNet",
    "SceneFiles",
    "collate_offset",
    "make_nag",
    "read_pointcept_area",
    "read_pointcept_scene",
    "read_room",
    "read_scannet_scan",
    "write_pointcept_scene",
]
