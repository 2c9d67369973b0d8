"""Which surfaces to leave out so that one sees into a room from outside."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torchrg.report.grid import Cells
from torchrg.report.sideview import SideView

_SPREAD = math.cos(math.radians(12))  # of a group of parallel cells
_MIN_GROUP = 0.01  # share of the cells
_FACING = math.cos(math.radians(30))  # of the cells of an outer surface
_MIN_CEILING_DEPTH, _MIN_WALL_DEPTH = 0.4, 0.2  # of the extent: table tops are no ceilings
_MIN_CEILING_COVER, _MIN_WALL_COVER = 0.15, 0.35  # of what is seen from a side
_AROUND = 9  # pixels of the square that votes
_MIN_WIDTH = 0.27  # share of that square at about the same height


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

    A cell is outer if its plane faces that side, nothing is in front of it, and far behind it
    there is something: the floor below a ceiling, the opposite wall behind a wall. The cells around
    it at about its height vote, so that windows and recesses are no exceptions.

    Args:
        cells: Pieces of surface, at least one.
        direction: Unit vector from the inside to the outside, shape ``(3,)``.
        is_ceiling: Whether all that is above goes with the surface, as in a section of a building.

    Returns:
        The surface; None if it covers so little of the side that it does not close it.
    """
    thickness, view = 1.25 * cells.size, SideView(cells.centers, direction, 1.5 * cells.size)
    height, pixels = cells.centers @ direction, view.pixels(cells.centers)
    top = view.largest(pixels, height)
    low, high = height.quantile(height.new_tensor([0.02, 0.98])).tolist()
    share = _MIN_CEILING_DEPTH if is_ceiling else _MIN_WALL_DEPTH
    depth_below = top + view.largest_around(view.largest(pixels, -height), 5)
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
    """Return the normals of the largest groups of parallel cells.

    Args:
        cells: Pieces of surface.
        max_directions: Most groups.

    Returns:
        Unit vectors of arbitrary sign, the largest group first, shape ``(D, 3)``.
    """
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
