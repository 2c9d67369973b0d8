"""Viewpoints, and the walls and ceilings to hide for a view into rooms.

Walls and ceilings come from the plane table, or from a segmentation of voxels if a cloud has no
labels. The shader and the picking of ``page.js`` use the same bits per point.
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.metrics.contingency import number_labels
from torchrg.regions.classes import classify_planes
from torchrg.regions.directions import find_heading, horizontal_toward, unit_axis
from torchrg.regions.table import summarize_planes
from torchrg.render.creases import segment_surface
from torchrg.render.surface import VisibleSurface
from torchrg.structures import PLANE_KINDS, UNLABELED, Planes

View = Literal["cutaway", "above", "outside", "sensor"]

MIN_FACING = {"cutaway": 0.1, "above": 0.7}
"""Minimum cosine between the outward direction of a side and the direction to the viewer for the
side to be hidden, by view. From above only nearly horizontal sides obstruct the view."""
MAX_SIDES = 7
"""Maximum number of outer sides: bits of a byte but the last, which hides planes in a viewer."""
_MAX_WALLS = 60
"""Maximum number of candidate walls and ceilings, the largest ones; bounds the memory."""
_MIN_SIDE_COSINE = 0.9
"""Minimum cosine between the directions of walls that are hidden together."""
_MAX_BEYOND_FRACTION = 0.03
"""Maximum fraction of the cloud beyond an outer wall: scanners see through doors and windows."""
_MIN_INSIDE_FRACTION = 0.05
"""Minimum fraction of the cloud on the inner side of an outer wall."""
_THICKNESS = 1.5
"""Distance to a wall, in voxel edges plus twice its noise, up to which voxels belong to it."""
_CEILING_DEPTH = 0.15
"""Depth hidden with a ceiling, as a fraction of the cloud height, for lamps and beams."""
_MAX_PIXELS = 500
"""Maximum side of the image for measuring how much a view shows, in pixels."""
_AZIMUTHS_DEG = (30.0, 60.0, 120.0, 150.0, 210.0, 240.0, 300.0, 330.0)
"""Candidate azimuths, in degrees. None is perpendicular to a wall: both of a corner are visible."""


class Sides(NamedTuple):
    """Outer sides of a cloud: ceilings, and walls grouped by direction.

    Attributes:
        directions: Outward unit vectors, shape ``(S, 3)``.
        of_voxels: Bits of the sides of each voxel, shape ``(V,)``, uint8.
        of_points: The same for each point, shape ``(n,)``. Labeled points have the bits of their
            plane, so that furniture and the floor along a wall do not belong to the wall.
        heading: Horizontal reference direction of azimuths, shape ``(3,)``.
    """

    directions: Tensor
    of_voxels: Tensor
    of_points: Tensor
    heading: Tensor

    def bits_toward(self, toward: Tensor, view: View) -> int:
        """Return the bits of the sides hidden in a view from a direction."""
        facing = self.directions @ toward > MIN_FACING.get(view, math.inf)
        return sum(1 << side for side, cut in enumerate(facing.tolist()) if cut)


def find_sides(surface: VisibleSurface, labels: Tensor | None, up: Tensor) -> Sides:
    """Find the walls and ceilings that enclose a cloud.

    A wall is outer if almost nothing lies beyond its bounding rectangle. Points in the rectangle
    that are not on the inner side belong to the wall, such as windows and handles; so do planes
    that mostly consist of such points.

    Args:
        surface: Surface of at least one finite point.
        labels: Plane of each of its n points, shape ``(n,)``, or negative. Default: from voxels.
        up: Up direction, a unit vector of shape ``(3,)``.
    """
    centers = surface.centers
    if len(centers) == 0:
        nothing = torch.zeros(0, dtype=torch.uint8, device=centers.device)
        return Sides(centers, nothing, nothing, horizontal_toward(unit_axis(up), up))
    if labels is None:
        labels = segment_surface(surface)
    present, of_points = number_labels(labels.clamp(min=UNLABELED))
    of_voxels = of_points[surface.first]
    numbers = number_labels(of_voxels)[1]
    planes = summarize_planes(centers, surface.normals, numbers)
    altitude = centers @ up
    low, high = altitude.quantile(altitude.new_tensor([0.02, 0.98])).tolist()
    kind = classify_planes(planes, centers, numbers, up)
    walls, ceilings = (kind == PLANE_KINDS.index(name) for name in ("wall", "ceiling"))
    directions, covered = _find_outer_sides(surface, planes, walls, ceilings, up, high - low)
    powers = 1 << torch.arange(MAX_SIDES, device=centers.device)
    bits_by_position = (covered * powers).sum(dim=1)
    is_labeled = of_points >= 0
    inside = torch.zeros(len(present) + 1, MAX_SIDES, device=centers.device)
    inside.index_add_(0, of_points[is_labeled], covered[surface.voxel_of[is_labeled]].float())
    counts = torch.bincount(of_points[is_labeled], minlength=len(inside))
    of_planes = ((2 * inside > counts[:, None]) * powers).sum(dim=1)
    voxels = torch.where(of_voxels < 0, bits_by_position, of_planes[of_voxels])
    points = torch.where(of_points < 0, bits_by_position[surface.voxel_of], of_planes[of_points])
    heading = find_heading(planes.normal[walls], planes.area[walls], up)
    heading = horizontal_toward(unit_axis(up), up) if heading is None else heading
    return Sides(directions, voxels.to(torch.uint8), points.to(torch.uint8), heading)


def _find_outer_sides(
    surface: VisibleSurface,
    planes: Planes,
    walls: Tensor,
    ceilings: Tensor,
    up: Tensor,
    height: float,
) -> tuple[Tensor, Tensor]:
    """Return the directions of outer sides, and the mask of voxels in each, ``(V, MAX_SIDES)``."""
    rows = (walls | ceilings).nonzero().squeeze(1)
    rows = rows[planes.area[rows].argsort(descending=True, stable=True)][:_MAX_WALLS]
    local = surface.centers[:, None] - planes.center[rows]
    across = torch.einsum("vmi,mji->vmj", local, planes.axes[rows]).abs()
    thickness = _THICKNESS * surface.size + 2 * planes.rms[rows]
    depth = torch.where(ceilings[rows], thickness.clamp(min=_CEILING_DEPTH * height), thickness)
    in_rectangle = (across <= (planes.extent[rows] / 2 + thickness[:, None])).all(dim=2)
    heights = (local * planes.normal[rows]).sum(dim=2)
    directions: list[Tensor] = []
    covered = torch.zeros(len(local), MAX_SIDES, dtype=torch.bool, device=local.device)
    for column, row in enumerate(rows.tolist()):
        for sign in (1, -1):
            outward, above = sign * planes.normal[row], sign * heights[:, column]
            beyond = (in_rectangle[:, column] & (above > thickness[column])).float().mean()
            inside = (above < -thickness[column]).float().mean()
            is_outer = bool((beyond <= _MAX_BEYOND_FRACTION) & (inside >= _MIN_INSIDE_FRACTION))
            if not is_outer or (ceilings[row] and outward @ up < 0):
                continue
            similar = [n for n, each in enumerate(directions) if each @ outward > _MIN_SIDE_COSINE]
            if not similar and len(directions) < MAX_SIDES:
                similar = [len(directions)]
                directions.append(outward)
            for side in similar[:1]:
                covered[:, side] |= in_rectangle[:, column] & (above > -depth[column])
    return torch.stack([up.new_zeros(3), *directions])[1:], covered


class Viewpoint(NamedTuple):
    """Direction of a camera.

    Attributes:
        toward: Direction from the cloud to the viewer, shape ``(3,)``.
        up: Up direction of the image, shape ``(3,)``.
        cut: Bits of the hidden sides.
    """

    toward: Tensor
    up: Tensor
    cut: int


def choose_viewpoint(
    surface: VisibleSurface,
    sides: Sides,
    view: View,
    up: Tensor,
    *,
    azimuth_deg: float | None = None,
    elevation_deg: float | None = None,
) -> Viewpoint:
    """Choose the direction from which most surface is visible.

    The azimuth is measured about ``up``, from the direction of most walls nearest to x. Default:
    the best of eight, ties broken by angle; from above, the longer side of the cloud is horizontal.
    The elevation is the angle above the horizon. Default: 35, from above 90.
    """
    for name, angle in (("azimuth_deg", azimuth_deg), ("elevation_deg", elevation_deg)):
        if angle is not None and not math.isfinite(angle):
            raise ConfigError(f"choose_viewpoint: expected {name} to be finite, got {angle}.")
    if elevation_deg is None:
        elevation_deg = 90.0 if view == "above" else 35.0
    azimuths = _AZIMUTHS_DEG if azimuth_deg is None else (azimuth_deg,)
    if azimuth_deg is None and view == "above":
        along, across = (
            surface.centers @ side
            for side in (sides.heading, torch.linalg.cross(up, sides.heading))
        )
        is_long = along.amax() - along.amin() > across.amax() - across.amin()
        azimuths = (-90.0,) if is_long else (0.0,)
    viewpoints = []
    for azimuth in azimuths:
        toward = _turned(sides.heading, up, azimuth, elevation_deg)
        picture_up = _turned(sides.heading, up, azimuth + 180, 90 - elevation_deg)
        viewpoints.append(Viewpoint(toward, picture_up, sides.bits_toward(toward, view)))
    if len(viewpoints) == 1:
        return viewpoints[0]
    return max(viewpoints, key=lambda viewpoint: _count_visible(surface, sides, viewpoint))


def _turned(heading: Tensor, up: Tensor, azimuth_deg: float, elevation_deg: float) -> Tensor:
    """Return the direction with the given azimuth and elevation."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    across = torch.linalg.cross(up, heading)
    horizontal = math.cos(azimuth) * heading + math.sin(azimuth) * across
    turned: Tensor = math.cos(elevation) * horizontal + math.sin(elevation) * up
    return turned


def _count_visible(surface: VisibleSurface, sides: Sides, viewpoint: Viewpoint) -> int:
    """Return the number of visible voxels, in an orthographic view without the hidden sides."""
    centers = surface.centers[(sides.of_voxels & viewpoint.cut) == 0]
    if len(centers) == 0 or surface.size == 0:
        return 0
    right = torch.linalg.cross(viewpoint.up, viewpoint.toward)
    positions = centers @ torch.stack([right, viewpoint.up], dim=1)
    positions -= positions.amin(dim=0)
    pitch = max(1.5 * surface.size, float(positions.amax()) / _MAX_PIXELS)
    column, row = (positions / pitch).long().unbind(dim=1)
    pixels, height = column * (int(row.amax()) + 1) + row, centers @ viewpoint.toward
    front = height.new_full((int(pixels.amax()) + 1,), -torch.inf)
    front.scatter_reduce_(0, pixels, height, "amax")
    return int((height >= front[pixels] - 2 * surface.size).sum())
