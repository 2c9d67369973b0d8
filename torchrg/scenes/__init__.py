"""Synthetic indoor scenes with exact labels and normals.

:func:`make_room` suffices for most uses. For other scenes, combine surfaces and solids in a
:class:`Part`, parts and scanner positions in a :class:`SceneModel`, and sample points with
:func:`sample_scene`. The submodules may change without notice.
"""

from torchrg.scenes.geometry import Array, Frame, unit
from torchrg.scenes.parts import block, passage, room_walls
from torchrg.scenes.rooms import RoomLayout, build_room, furnish, make_room, scanner_positions
from torchrg.scenes.scene import Part, Scene, SceneModel, label_points, sample_scene
from torchrg.scenes.surfaces import Flat, Solid, Surface, rectangle

__all__ = [
    "Array",
    "Flat",
    "Frame",
    "Part",
    "RoomLayout",
    "Scene",
    "SceneModel",
    "Solid",
    "Surface",
    "block",
    "build_room",
    "furnish",
    "label_points",
    "make_room",
    "passage",
    "rectangle",
    "room_walls",
    "sample_scene",
    "scanner_positions",
    "unit",
]
__dir__ = __all__.copy
