"""Weighted planes of many neighbourhoods at once, coordinate by coordinate.

A neighbourhood is three columns ``(n, K)`` of coordinates about its point. Whole columns in plain
arithmetic run at the speed of the cache, and give the same bits for any number of rows.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrg.linalg import smallest_eigenvector3

Columns = tuple[Tensor, Tensor, Tensor]


def split_columns(patches: Tensor) -> Columns:
    """Return the coordinates of patches ``(n, K, 3)`` as contiguous columns ``(n, K)``."""
    x, y, z = patches.unbind(dim=-1)
    return x.contiguous(), y.contiguous(), z.contiguous()


def sq_lengths(columns: Columns) -> Tensor:
    """Return the squared distance of each neighbour, shape ``(n, K)``."""
    x, y, z = columns
    return x * x + y * y + z * z


def residuals(columns: Columns, normals: Tensor, offsets: Tensor) -> Tensor:
    """Return signed distances of the neighbours to planes ``normal . q = offset``, ``(n, K)``.

    Example:
        >>> columns = split_columns(torch.tensor([[[0.0, 0, 0], [1, 2, 3]]]))
        >>> residuals(columns, torch.tensor([[0.0, 0, 1]]), torch.tensor([1.0]))
        tensor([[-1.,  2.]])
    """
    return along(columns, normals).sub_(offsets[:, None])


def along(columns: Columns, axes: Tensor) -> Tensor:
    """Return coordinates of the neighbours along axes ``(*, n, 3)``, shape ``(*, n, K)``."""
    x, y, z = columns
    a, b, c = (part[..., None] for part in axes.unbind(dim=-1))
    # Products and sums apart: a fused multiply-add may round differently at the end of a block.
    return (x * a).add_(y * b).add_(z * c)


def fit_planes(columns: Columns, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a plane to each weighted neighbourhood by least squares.

    Args:
        columns: Coordinates about each point.
        weights: Weights, shape ``(n, K)``, not negative.

    Returns:
        Unit normals ``(n, 3)``, offsets ``(n,)`` of the planes ``normal . q = offset``, and the
        eigenvalues of the weighted covariance ``(n, 3)``, ascending.

    Example:
        >>> square = torch.tensor([[[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [5, 5, 5]]])
        >>> normals, offsets, _ = fit_planes(
        ...     split_columns(square), torch.tensor([[1.0, 1, 1, 0]])
        ... )
        >>> normals.abs(), offsets.abs()
        (tensor([[0., 0., 1.]]), tensor([1.]))
    """
    means, covariance = _moments(columns, weights)
    values, normals = smallest_eigenvector3(covariance)
    return normals, (normals * means).sum(dim=-1), values


def fit_planes_to_each(columns: Columns, groups: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
    """Fit a plane to each of several groups of the neighbours; see :func:`fit_planes`.

    Args:
        columns: Coordinates about each point.
        groups: Weights of each group, shape ``(n, K)``.

    Returns:
        Unit normals ``(n, 3)`` and offsets ``(n,)`` for each group.

    Example:
        >>> square = torch.tensor([[[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 0, 2]]])
        >>> groups = torch.tensor([[1.0, 1, 1, 0]]), torch.tensor([[1.0, 1, 0, 1]])
        >>> [normals.abs() for normals, _ in fit_planes_to_each(split_columns(square), groups)]
        [tensor([[0., 0., 1.]]), tensor([[0., 1., 0.]])]
    """
    means, covariances = zip(*(_moments(columns, weights) for weights in groups), strict=True)
    normals = smallest_eigenvector3(torch.stack(covariances))[1]
    offsets = (normals * torch.stack(means)).sum(dim=-1)
    return list(zip(normals.unbind(), offsets.unbind(), strict=True))


def _moments(columns: Columns, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted mean ``(n, 3)`` and covariance ``(n, 3, 3)`` of each neighbourhood."""
    total = weights.sum(dim=1)
    share = weights / torch.where(total > 0, total, 1.0)[:, None]
    means = [(share * column).sum(dim=1) for column in columns]
    x, y, z = (column - mean[:, None] for column, mean in zip(columns, means, strict=True))
    sx, sy, sz = share * x, share * y, share * z
    xx, xy, xz = (sx * x).sum(dim=1), (sx * y).sum(dim=1), (sx * z).sum(dim=1)
    yy, yz, zz = (sy * y).sum(dim=1), (sy * z).sum(dim=1), (sz * z).sum(dim=1)
    rows = [torch.stack(row, dim=-1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
    return torch.stack(means, dim=-1), torch.stack(rows, dim=-2)
