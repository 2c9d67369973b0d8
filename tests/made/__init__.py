"""Scenes in addition to furnished rooms: curved rooms, storeys, scans, depth frames, shapes.

To add a scene, return a :class:`torchrg.scenes.SceneModel` from a function here: parts (surfaces,
each a face, and solids that hide what is inside them), or a ``scanners.ScannedModel``, with places
where a scanner may stand.
:func:`torchrg.scenes.sample_scene` turns it into a cloud with truth. A new kind of surface has the
properties and methods of ``scenes.surfaces.Surface``, and a function in ``rays`` if it is
scanned. A part of the report takes it once it has a key in ``reproduction.clouds``, or in
``shapes.SHAPES``.
"""

from tests.made.cameras import (
    KINECT_LAYOUT,
    Camera,
    DepthFrame,
    cameras_around,
    fuse_frames,
    make_kinect_room,
    make_mapped_room,
    render_depth,
)
from tests.made.curved import CURVED_LAYOUT, CurvedLayout
from tests.made.rays import cast_rays, scan_scene
from tests.made.samples import (
    OUTLIERS,
    contaminated,
    drawn_from_triangles,
    in_pieces,
    objects_of,
    on_voxels,
    quantised_frame,
)
from tests.made.scanners import ScannedLayout, build_scanned_room
from tests.made.shapes import SHAPES, make_shape
from tests.made.storeys import (
    HALL_LAYOUT,
    build_storey,
    make_storey,
)

__all__ = [
    "CURVED_LAYOUT",
    "HALL_LAYOUT",
    "KINECT_LAYOUT",
    "OUTLIERS",
    "SHAPES",
    "Camera",
    "CurvedLayout",
    "DepthFrame",
    "ScannedLayout",
    "build_scanned_room",
    "build_storey",
    "cameras_around",
    "cast_rays",
    "contaminated",
    "drawn_from_triangles",
    "fuse_frames",
    "in_pieces",
    "make_kinect_room",
    "make_mapped_room",
    "make_shape",
    "make_storey",
    "objects_of",
    "on_voxels",
    "quantised_frame",
    "render_depth",
    "scan_scene",
]
