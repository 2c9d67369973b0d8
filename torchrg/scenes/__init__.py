"""Synthetic indoor scenes with exact labels and normals, for demos, tests and benchmarks."""

from torchrg.scenes.cameras import Camera, cameras_around
from torchrg.scenes.depth import DepthFrame, render_depth
from torchrg.scenes.layout import RoomLayout
from torchrg.scenes.rooms import build_room, make_room
from torchrg.scenes.sampling import sample_scene
from torchrg.scenes.scene import Scene, SceneModel
from torchrg.scenes.shapes import SHAPES, make_shape

__all__ = [
    "SHAPES",
    "Camera",
    "DepthFrame",
    "RoomLayout",
    "Scene",
    "SceneModel",
    "build_room",
    "cameras_around",
    "make_room",
    "make_shape",
    "render_depth",
    "sample_scene",
]
