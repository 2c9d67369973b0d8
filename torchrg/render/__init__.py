"""Rendering of clouds and segmentations as images and viewers, without a display."""

from torchrg.render.cameras import make_camera
from torchrg.render.colors import color_curvature, color_normals, color_planes, color_sharp
from torchrg.render.page import make_page, write_page
from torchrg.render.pictures import render_cloud, write_png

__all__ = [
    "color_curvature",
    "color_normals",
    "color_planes",
    "color_sharp",
    "make_camera",
    "make_page",
    "render_cloud",
    "write_page",
    "write_png",
]
__dir__ = __all__.copy
