"""Coordinates of neighbourhoods."""

import torch
from torch import Tensor


def gather_patches(points: Tensor, indices: Tensor) -> Tensor:
    """Return the coordinates of neighbours about the point itself.

    Args:
        points: Points, shape ``(N, 3)``.
        indices: Rows of the neighbours, shape ``(n, K)``; the first column is the point itself.

    Returns:
        Differences to the first neighbour, shape ``(n, K, 3)``. In memory each coordinate is
        contiguous, so that ``patches.unbind(-1)`` gives fast columns.

    Example:
        >>> points = torch.tensor([[5.0, 0, 0], [7, 1, 0]])
        >>> gather_patches(points, torch.tensor([[0, 1]])).tolist()
        [[[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]]]
    """
    flat = indices.reshape(-1)
    patches = points.new_empty((3, *indices.shape))
    for axis in range(3):
        column = points[:, axis].index_select(0, flat).view(indices.shape)
        torch.sub(column, column[:, :1], out=patches[axis])
    return patches.movedim(0, -1)
