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
