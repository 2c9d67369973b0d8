"""Pictures of clouds and their segmentation, without a desktop."""

from torchrg.report.cameras import make_camera
from torchrg.report.pictures import render_cloud, render_points
from torchrg.report.plane_colors import color_planes
from torchrg.report.png import write_png
from torchrg.report.point_colors import color_curvature, color_normals, color_sharp
from torchrg.report.tiles import tile_pictures

__all__ = [
    "color_curvature",
    "color_normals",
    "color_planes",
    "color_sharp",
    "make_camera",
    "render_cloud",
    "render_points",
    "tile_pictures",
    "write_png",
]
