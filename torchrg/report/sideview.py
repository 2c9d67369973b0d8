"""A coarse picture of a cloud seen along one direction, from far away."""

import torch
from torch import Tensor
from torch.nn import functional


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
        self._shape = (last[0] + 1, last[1] + 1)

    def pixels(self, points: Tensor) -> Tensor:
        """Return the pixel of each point, shape ``(N,)``; of points outside the nearest one."""
        place = ((points @ self._basis - self._low) / self._pitch).long()
        columns, rows = self._shape
        return place[:, 0].clamp(0, columns - 1) * rows + place[:, 1].clamp(0, rows - 1)

    def largest(self, pixels: Tensor, values: Tensor) -> Tensor:
        """Return the largest value in each pixel, -inf where there is none."""
        image: Tensor = values.new_full((self._shape[0] * self._shape[1],), -torch.inf)
        return torch.scatter_reduce(image, 0, pixels, values, "amax")

    def count(self, pixels: Tensor, values: Tensor) -> Tensor:
        """Return the sum of the values in each pixel."""
        image = torch.zeros(self._shape[0] * self._shape[1], device=values.device)
        return image.index_add_(0, pixels, values.float())

    def largest_around(self, image: Tensor, size: int) -> Tensor:
        """Return the largest value in the square of ``size`` pixels, odd, about each pixel."""
        square = image.view(1, 1, *self._shape)
        return functional.max_pool2d(square, size, 1, size // 2).flatten()

    def mean_around(self, image: Tensor, size: int) -> Tensor:
        """Return the mean over the square of ``size`` pixels, odd, about each pixel."""
        square = image.view(1, 1, *self._shape)
        return functional.avg_pool2d(square, size, 1, size // 2).flatten()
