"""Synthetic indoor scenes with exact labels and normals, for demos, tests and benchmarks."""

from torchrg.scenes.cameras import Camera, cameras_around
from torchrg.scenes.depth import DepthFrame, render_depth
from torchrg.scenes.halls import HALL_LAYOUT, make_hall
from torchrg.scenes.kinect import KINECT_LAYOUT, fuse_frames, make_kinect_room
from torchrg.scenes.layout import BENT_LAYOUT, CURVED_LAYOUT, THIN_LAYOUT, RoomLayout
from torchrg.scenes.rooms import build_room, make_room
from torchrg.scenes.sampling import sample_scene
from torchrg.scenes.scene import Scene, SceneModel
from torchrg.scenes.shapes import SHAPES, make_shape
from torchrg.scenes.storey_layout import StoreyLayout
from torchrg.scenes.storeys import build_storey, make_storey

__all__ = [
    "BENT_LAYOUT",
    "CURVED_LAYOUT",
    "HALL_LAYOUT",
    "KINECT_LAYOUT",
    "SHAPES",
    "THIN_LAYOUT",
    "Camera",
    "DepthFrame",
    "RoomLayout",
    "Scene",
    "SceneModel",
    "StoreyLayout",
    "build_room",
    "build_storey",
    "cameras_around",
    "fuse_frames",
    "make_hall",
    "make_kinect_room",
    "make_room",
    "make_shape",
    "make_storey",
    "render_depth",
    "sample_scene",
]
