"""Which surfaces to leave out so that one sees into a room from outside."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

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
        """Return the share of pixels around each point that hold a point about as high.

        Args:
            pixels: Of the points, shape ``(N,)``, at least one.
            heights: Along the direction, shape ``(N,)``.
            counted: The points that are looked for, shape ``(N,)``, bool.
            size: Edge, odd, of the square of pixels around a point.
            step: What is about as high: in the same layer of this thickness, or in the next ones.

        Returns:
            Shape ``(N,)``, in [0, 1].
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
