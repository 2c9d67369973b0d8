"""Pictures and pages of clouds and their segmentation, without a desktop."""

from torchrg.render.cameras import make_camera
from torchrg.render.colors import color_curvature, color_normals, color_planes, color_sharp
from torchrg.render.page import make_page, write_page
from torchrg.render.pictures import render_cloud, render_points, write_png

__all__ = [
    "color_curvature",
    "color_normals",
    "color_planes",
    "color_sharp",
    "make_camera",
    "make_page",
    "render_cloud",
    "render_points",
    "write_page",
    "write_png",
]
