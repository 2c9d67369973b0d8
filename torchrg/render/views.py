"""From where to look at a cloud, and what to leave out there."""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torchrg.render.cutaway import OuterSurface, SideView, find_outer_surface, main_directions
from torchrg.render.grid import Cells

View = Literal["cutaway", "above", "outside", "sensor"]

_AZIMUTHS_DEG = (30.0, 60.0, 120.0, 150.0, 210.0, 240.0, 300.0, 330.0)
_FACING = {"cutaway": 0.1, "above": 0.7}  # least cosine to the viewer of what is cut away


class Viewpoint(NamedTuple):
    """A direction to look from.

    Attributes:
        toward: From the cloud to the viewer, shape ``(3,)``.
        up: Up in the picture, shape ``(3,)``.
        cut: What is left out.
    """

    toward: Tensor
    up: Tensor
    cut: tuple[OuterSurface, ...]

    def keeps(self, points: Tensor) -> Tensor:
        """Return which points are not left out, shape ``(N,)``, bool."""
        kept = torch.ones_like(points[:, 0], dtype=torch.bool)
        for surface in self.cut:
            kept &= ~surface.covers(points)
        return kept


def choose_viewpoint(
    cells: Cells,
    view: View,
    up: Tensor,
    *,
    azimuth_deg: float | None = None,
    elevation_deg: float | None = None,
) -> Viewpoint:
    """Choose the direction from which most surface is seen.

    Args:
        cells: Pieces of surface, at least one.
        view: ``"cutaway"``, ``"above"`` or ``"outside"``.
        up: Unit vector, shape ``(3,)``.
        azimuth_deg: Angle about ``up``, from the normal of the largest walls. Default: the best of
            eight; from above, the one that lays the cloud across the picture.
        elevation_deg: Angle over the horizon. Default: 35, from above 90.

    Returns:
        The viewpoint. Equal ones are decided by the angle.
    """
    directions = main_directions(cells)
    heading = _heading(directions, up)
    if elevation_deg is None:
        elevation_deg = 90.0 if view == "above" else 35.0
    azimuths = _AZIMUTHS_DEG if azimuth_deg is None else (azimuth_deg,)
    if azimuth_deg is None and view == "above":
        azimuths = (-90.0,) if _is_longer(cells.centers, heading, up) else (0.0,)
    surfaces = []
    if view in _FACING:
        sides = torch.stack([directions, -directions], dim=1).flatten(0, 1)
        found = [
            find_outer_surface(cells, side, is_ceiling=float(side @ up) > 0.9) for side in sides
        ]
        surfaces = [surface for surface in found if surface is not None]
    viewpoints = []
    for azimuth in azimuths:
        toward = _turned(heading, up, azimuth, elevation_deg)
        cut = tuple(s for s in surfaces if float(s.direction @ toward) > _FACING[view])
        picture_up = _turned(heading, up, azimuth + 180, 90 - elevation_deg)
        viewpoints.append(Viewpoint(toward, picture_up, cut))
    if len(viewpoints) == 1:
        return viewpoints[0]
    return max(viewpoints, key=lambda viewpoint: _count_seen(cells, viewpoint))


def _heading(directions: Tensor, up: Tensor) -> Tensor:
    """Return the horizontal normal of the largest walls, or any direction if there are none."""
    walls = directions[(directions @ up).abs() < 0.3]
    if len(walls):
        axis = walls[0]
    else:
        axis = torch.zeros_like(up)
        axis[up.abs().argmin()] = 1
    return functional.normalize(axis - (axis @ up) * up, dim=0)


def _is_longer(centers: Tensor, heading: Tensor, up: Tensor) -> bool:
    """Return whether a cloud is longer along its heading than across it."""
    along, across = centers @ heading, centers @ torch.linalg.cross(up, heading)
    return float(along.amax() - along.amin()) > float(across.amax() - across.amin())


def _turned(heading: Tensor, up: Tensor, azimuth_deg: float, elevation_deg: float) -> Tensor:
    """Return the direction at angles about the upward axis and over the horizon."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(azimuth) * heading + math.sin(azimuth) * torch.linalg.cross(up, heading)
    turned: Tensor = math.cos(elevation) * level + math.sin(elevation) * up
    return turned


def _count_seen(cells: Cells, viewpoint: Viewpoint) -> int:
    """Return how many of the kept cells nothing hides from far away."""
    centers = cells.centers[viewpoint.keeps(cells.centers)]
    if len(centers) == 0:
        return 0
    picture = SideView(centers, viewpoint.toward, 1.5 * cells.size)
    pixels, height = picture.pixels(centers), centers @ viewpoint.toward
    front = picture.largest(pixels, height)
    return int((height >= front[pixels] - 2 * cells.size).sum())
