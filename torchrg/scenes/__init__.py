"""Synthetic indoor scenes with exact labels and normals, for demos, tests and benchmarks.

:func:`make_room` is all that most need. To build a scene of your own, put surfaces and the bodies
behind them into :class:`Part`, parts and places for a scanner into :class:`SceneModel`, and draw
points from it by :func:`sample_scene`. The modules below this one may change without notice.
"""

from torchrg.scenes.geometry import Array, Frame, unit
from torchrg.scenes.parts import block, passage, room_walls
from torchrg.scenes.rooms import RoomLayout, build_room, free_places, furnish, make_room
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
    "free_places",
    "furnish",
    "label_points",
    "make_room",
    "passage",
    "rectangle",
    "room_walls",
    "sample_scene",
    "unit",
]
