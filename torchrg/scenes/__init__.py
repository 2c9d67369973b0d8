"""Synthetic indoor scenes with exact labels and normals.

:func:`make_room` suffices for most uses. Other scenes combine surfaces and solids of the submodules
in a :class:`SceneModel`, which :func:`sample_scene` samples. The submodules may change.
"""

from torchrg.scenes.rooms import RoomLayout, build_room, make_room
from torchrg.scenes.scene import Scene, SceneModel, sample_scene

__all__ = ["RoomLayout", "Scene", "SceneModel", "build_room", "make_room", "sample_scene"]
__dir__ = __all__.copy
