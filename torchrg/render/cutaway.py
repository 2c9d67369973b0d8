"""From where to look at a cloud, and which surfaces to leave out so that one sees into a room."""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torchrg.errors import ConfigError
from torchrg.render.grid import Cells


class SideView:
    """The plane across a direction, cut into pixels over the extent of a cloud.

    Args:
        points: Shape ``(N, 3)``, at least one.
        direction: Unit vector toward the viewer, shape ``(3,)``.
        pitch: Edge of a pixel, in the unit of the cloud.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [0, 0, 3], [5, 0, 1]])
        >>> view = SideView(points, torch.tensor([0.0, 0, 1]), 1.0)
        >>> view.largest(view.pixels(points), points[:, 2])[view.pixels(points)]
        tensor([3., 3., 1.])
    """

    def __init__(self, points: Tensor, direction: Tensor, pitch: float) -> None:
        other = torch.zeros_like(direction)
        other[direction.abs().argmin()] = 1
        side = functional.normalize(torch.linalg.cross(direction, other), dim=0)
        self._basis = torch.stack([side, torch.linalg.cross(direction, side)], dim=-1)
        self._pitch = pitch if pitch > 0 else 1.0
        across = points @ self._basis
        self._low = across.amin(dim=0)
        last = ((across.amax(dim=0) - self._low) / self._pitch).long().tolist()
        self._shape: tuple[int, int] = (last[0] + 1, last[1] + 1)

    def pixels(self, points: Tensor) -> Tensor:
        """Return the pixel of each point, shape ``(N,)``; of points outside the nearest one."""
        place = ((points @ self._basis - self._low) / self._pitch).long()
        columns, rows = self._shape
        return place[:, 0].clamp(0, columns - 1) * rows + place[:, 1].clamp(0, rows - 1)

    def largest(self, pixels: Tensor, values: Tensor) -> Tensor:
        """Return the largest value in each pixel, -inf where there is none."""
        image = values.new_full((self._shape[0] * self._shape[1],), -torch.inf)
        return image.scatter_reduce(0, pixels, values, "amax")

    def count(self, pixels: Tensor, values: Tensor) -> Tensor:
        """Return the sum of the values in each pixel."""
        image = torch.zeros(self._shape[0] * self._shape[1], device=values.device)
        return image.index_add_(0, pixels, values.float())

    def share_at_height(
        self, pixels: Tensor, heights: Tensor, counted: Tensor, *, size: int, step: float
    ) -> Tensor:
        """Return the share of pixels around each point that hold a counted point about as high.

        Around is a square of ``size`` pixels, odd; about as high is what lies in the same layer of
        thickness ``step``, or in the next ones.
        """
        layers = ((heights - heights.amin()) / step).long()
        stack = torch.zeros(int(layers.amax()) + 3, self._shape[0] * self._shape[1])
        stack = stack.to(heights.device)
        for shift in range(3):
            stack[layers[counted] + shift, pixels[counted]] = 1
        around = self.mean_around(stack, size).view(stack.shape)
        return around[layers + 1, pixels]

    def largest_around(self, image: Tensor, size: int) -> Tensor:
        """Return the largest value in the square of ``size`` pixels, odd, about each pixel."""
        square = image.view(1, 1, *self._shape)
        return functional.max_pool2d(square, size, 1, size // 2).flatten()

    def mean_around(self, image: Tensor, size: int) -> Tensor:
        """Return the mean over the square of ``size`` pixels, odd, about each pixel ``(*, P)``."""
        square = image.view(-1, 1, *self._shape)
        rows = functional.avg_pool2d(square, (size, 1), 1, (size // 2, 0))
        return functional.avg_pool2d(rows, (1, size), 1, (0, size // 2)).view(image.shape)


_SPREAD = math.cos(math.radians(12))
"""Least cosine between the normal of a cell and the direction of its group. 12 degrees keep the
cells of a noisy wall in one group."""
_MIN_GROUP = 0.01
"""Least share of all cells that makes a group of parallel cells. Smaller groups are furniture."""
_FACING = math.cos(math.radians(30))
"""Least cosine between the normal of an outer cell and the side that it closes. 30 degrees keep a
wall that is slightly bent in one piece."""
_MIN_CEILING_DEPTH = 0.4
"""Least share of the cloud's height that lies below a ceiling. Below a table top there is less."""
_MIN_WALL_DEPTH = 0.2
"""Least share of the cloud's extent that lies between a wall and what is opposite to it. It is less
than for a ceiling, because rooms have narrow parts."""
_MIN_CEILING_COVER = 0.15
"""Least share of what is seen from above that a ceiling covers. With less of it one looks into the
rooms anyway."""
_MIN_WALL_COVER = 0.35
"""Least share of what is seen from a side that the walls there cover. With less of them one looks
into the rooms anyway."""
_AROUND = 9
"""Side of the square of pixels in which outer cells vote. A pixel is one and a half cells wide, so
that the square is wider than most windows and recesses."""
_MIN_WIDTH = 0.27
"""Least share of that square at about the same height for a vote to count. It is a strip of two and
a half of its nine pixels; what is narrower, as a ledge, closes no side."""
_BEHIND = 5
"""Side, in pixels, of the square in which the farthest point behind a cell is looked for."""


class OuterSurface(NamedTuple):
    """What closes a cloud toward one side: walls, or the ceiling.

    Attributes:
        direction: Unit vector from the inside to the outside, shape ``(3,)``.
        view: The cloud as seen from there.
        highest: Along the direction, in and next to each pixel of the view; -inf: no surface.
        lowest: The same for the lowest; inf: no surface.
        thickness: What is as near as this belongs to the surface.
        section: What is above belongs to it, too.
    """

    direction: Tensor
    view: SideView
    highest: Tensor
    lowest: Tensor
    thickness: float
    section: float

    def covers(self, points: Tensor) -> Tensor:
        """Return which points belong to the surface, shape ``(N,)``, bool."""
        height, pixels = points @ self.direction, self.view.pixels(points)
        near = height <= self.highest[pixels] + self.thickness
        near &= height >= self.lowest[pixels] - self.thickness
        return near | (height >= self.section - self.thickness)


def find_outer_surface(cells: Cells, direction: Tensor, *, is_ceiling: bool) -> OuterSurface | None:
    """Find the walls or the ceiling that close a cloud toward one side.

    A cell is outer if its plane faces that side, nothing is in front of it, and there is something
    far behind it: the floor below a ceiling, or the opposite wall behind a wall. The cells around
    it at about its height vote, so that windows and recesses are no exceptions. All that is above a
    ceiling goes with it, as in a section of a building. The result is None if what is found covers
    so little of the side that it does not close it.

    The shader and the picking of ``page.js`` cut by the same rule, from the bits that
    :func:`torchrg.render.content.sides_of_planes` gives each plane.
    """
    thickness, view = 1.25 * cells.size, SideView(cells.centers, direction, 1.5 * cells.size)
    height, pixels = cells.centers @ direction, view.pixels(cells.centers)
    top = view.largest(pixels, height)
    low, high = height.quantile(height.new_tensor([0.02, 0.98])).tolist()
    share = _MIN_CEILING_DEPTH if is_ceiling else _MIN_WALL_DEPTH
    depth_below = top + view.largest_around(view.largest(pixels, -height), _BEHIND)
    first = ((cells.normals @ direction).abs() > _FACING) & (height >= top[pixels] - thickness)
    outer = first & (depth_below >= share * (high - low))[pixels]
    if not bool(first.any()):
        return None
    pixels, height, outer = pixels[first], height[first], outer[first]
    votes, voters = (
        view.share_at_height(pixels, height, of, size=_AROUND, step=thickness)
        for of in (outer, torch.ones_like(outer))
    )
    elected = (voters > _MIN_WIDTH) & (2 * votes > voters)
    pixels, height = pixels[elected], height[elected]
    min_cover = _MIN_CEILING_COVER if is_ceiling else _MIN_WALL_COVER
    if len(torch.unique(pixels)) < max(1, min_cover * int(top.isfinite().sum())):
        return None
    highest, lowest = (
        sign * view.largest_around(view.largest(pixels, sign * height), 3) for sign in (1, -1)
    )
    section = float(height.median()) if is_ceiling else math.inf
    return OuterSurface(direction, view, highest, lowest, thickness, section)


def main_directions(cells: Cells, *, max_directions: int = 10) -> Tensor:
    """Return the normals ``(D, 3)`` of the largest groups of parallel cells, the largest first."""
    normals = cells.normals[(cells.normals != 0).any(dim=-1)]
    bins = _hemisphere(200).to(normals)
    near = (normals @ bins.T).abs() > _SPREAD
    free = torch.ones_like(normals[:, 0], dtype=torch.bool)
    counts = near.sum(dim=0)
    found = [normals.new_zeros((0, 3))]
    while len(found) <= max_directions and int(counts.amax()) > _MIN_GROUP * len(normals):
        axis = bins[counts.argmax()]
        for _ in range(3):
            along = normals @ axis
            axis = functional.normalize(
                (along.sign() * (free & (along.abs() > _SPREAD))) @ normals, dim=0
            )
        group = free & ((normals @ axis).abs() > _SPREAD)
        if not bool(group.any()):
            break
        found.append(axis[None])
        counts = counts - near[group].sum(dim=0)
        free &= ~group
    return torch.cat(found)


def _hemisphere(count: int) -> Tensor:
    """Return directions spread evenly over half of the sphere, shape ``(count, 3)``."""
    step = torch.arange(count, dtype=torch.float64) + 0.5
    height = step / count
    turn = step * (math.pi * (3 - math.sqrt(5)))
    radius = (1 - height * height).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], dim=-1)


View = Literal["cutaway", "above", "outside", "sensor"]

_AZIMUTHS_DEG = (30.0, 60.0, 120.0, 150.0, 210.0, 240.0, 300.0, 330.0)
"""Angles from the normal of the largest walls, in degrees, that are tried. None looks straight at a
wall, so that two walls of a corner are always seen."""
LEAST_FACING = {"cutaway": 0.1, "above": 0.7}
"""Least cosine between the direction of an outer surface and that toward the viewer for it to be
cut away, by the view. From above only what lies nearly flat is in the way."""


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

    The azimuth is the angle about ``up`` from the normal of the largest walls: by default the best
    of eight, equal ones decided by the angle, and from above the one that lays the cloud across the
    picture. The elevation is the angle over the horizon: by default 35, from above 90.
    """
    for name, angle in (("azimuth_deg", azimuth_deg), ("elevation_deg", elevation_deg)):
        if angle is not None and not math.isfinite(angle):
            raise ConfigError(f"choose_viewpoint: expected {name} to be finite, got {angle}.")
    directions = main_directions(cells)
    heading = _heading(directions, up)
    if elevation_deg is None:
        elevation_deg = 90.0 if view == "above" else 35.0
    azimuths = _AZIMUTHS_DEG if azimuth_deg is None else (azimuth_deg,)
    if azimuth_deg is None and view == "above":
        azimuths = (-90.0,) if _is_longer(cells.centers, heading, up) else (0.0,)
    surfaces = find_outer_surfaces(cells, up) if view in LEAST_FACING else ()
    viewpoints = []
    for azimuth in azimuths:
        toward = _turned(heading, up, azimuth, elevation_deg)
        cut = tuple(s for s in surfaces if float(s.direction @ toward) > LEAST_FACING[view])
        picture_up = _turned(heading, up, azimuth + 180, 90 - elevation_deg)
        viewpoints.append(Viewpoint(toward, picture_up, cut))
    if len(viewpoints) == 1:
        return viewpoints[0]
    return max(viewpoints, key=lambda viewpoint: _count_seen(cells, viewpoint))


def find_outer_surfaces(cells: Cells, up: Tensor) -> tuple[OuterSurface, ...]:
    """Find the walls and the ceiling that close a cloud, as far as it is closed."""
    directions = main_directions(cells)
    sides = torch.stack([directions, -directions], dim=1).flatten(0, 1)
    found = (find_outer_surface(cells, side, is_ceiling=float(side @ up) > 0.9) for side in sides)
    return tuple(surface for surface in found if surface is not None)


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
    across = torch.linalg.cross(up, heading)
    horizontal = math.cos(azimuth) * heading + math.sin(azimuth) * across
    turned: Tensor = math.cos(elevation) * horizontal + math.sin(elevation) * up
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
