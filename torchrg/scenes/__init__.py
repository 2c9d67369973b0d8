"""Synthetic indoor scenes with exact labels and normals, for demos, tests and benchmarks."""

from torchrg.scenes.rooms import (
    BENT_LAYOUT,
    CURVED_LAYOUT,
    THIN_LAYOUT,
    RoomLayout,
    build_room,
    make_room,
)
from torchrg.scenes.sampling import sample_scene
from torchrg.scenes.scene import Scene, SceneModel

__all__ = [
    "BENT_LAYOUT",
    "CURVED_LAYOUT",
    "THIN_LAYOUT",
    "RoomLayout",
    "Scene",
    "SceneModel",
    "build_room",
    "make_room",
    "sample_scene",
]
