"""Shapes, halls, storeys and depth cameras: the scenes that only the reproduction needs."""

from reproduction.scenes.cameras import (
    KINECT_LAYOUT,
    Camera,
    DepthFrame,
    cameras_around,
    fuse_frames,
    make_kinect_room,
    render_depth,
)
from reproduction.scenes.shapes import SHAPES, make_shape
from reproduction.scenes.storeys import (
    HALL_LAYOUT,
    StoreyLayout,
    build_storey,
    make_hall,
    make_storey,
)

__all__ = [
    "HALL_LAYOUT",
    "KINECT_LAYOUT",
    "SHAPES",
    "Camera",
    "DepthFrame",
    "StoreyLayout",
    "build_storey",
    "cameras_around",
    "fuse_frames",
    "make_hall",
    "make_kinect_room",
    "make_shape",
    "make_storey",
    "render_depth",
]
