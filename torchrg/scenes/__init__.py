"""Synthetic indoor scenes with exact labels and normals, for demos, tests and benchmarks."""

from torchrg.scenes.rooms import RoomLayout, build_room, make_room
from torchrg.scenes.scene import Scene, SceneModel, sample_scene

__all__ = ["RoomLayout", "Scene", "SceneModel", "build_room", "make_room", "sample_scene"]
