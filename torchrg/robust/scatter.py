"""Mean and scatter of weighted points, and distances to them, for many patches side by side."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.robust.lanes import sum_points


class Ellipsoid(NamedTuple):
    """Weighted mean and scatter of each lane, in a factored form.

    Attributes:
        means: P means of shape ``(M,)``.
        residuals: P columns ``(K, M)``: each centered coordinate less its regression on those
            before it, so that they are uncorrelated under the weights.
        squares: P weighted sums of squares of the residuals, shape ``(M,)``, at least the floor.
        singular: Whether the floor was needed, shape ``(M,)``, bool.
    """

    means: list[Tensor]
    residuals: list[Tensor]
    squares: list[Tensor]
    singular: Tensor


def fit_ellipsoid(
    columns: list[Tensor], weights: Tensor, total: Tensor | float, floor: Tensor
) -> Ellipsoid:
    """Factor the weighted scatter of each lane by modified Gram-Schmidt.

    The squares are those of a Cholesky factor of the scatter matrix, but each is a sum of squares
    of residuals instead of a difference of large numbers: the error in a thin direction grows
    with the ratio of extent to thickness, not with its square, which float32 could not bear.

    Args:
        columns: P coordinates of shape ``(K, M)``.
        weights: Weights of the points, shape ``(K, M)``, at least 0.
        total: Sum of the weights, number or shape ``(M,)``.
        floor: Least variance in any direction, shape ``(M,)``, above 0: what rounding leaves of
            an exact plane. It keeps distances finite.

    Returns:
        The factored scatter of each lane.
    """
    means = [sum_points(weights * column) / total for column in columns]
    residuals = [column - mean for column, mean in zip(columns, means, strict=True)]
    least = floor * total
    squares: list[Tensor] = []
    singular = torch.zeros_like(floor, dtype=torch.bool)
    for j, pivot in enumerate(residuals):
        weighted = weights * pivot
        square = sum_points(weighted * pivot)
        singular = singular | (square <= least)
        squares.append(torch.maximum(square, least))
        for k in range(j + 1, len(residuals)):
            slope = sum_points(weighted * residuals[k]) / squares[j]
            residuals[k] = residuals[k].sub_(slope * pivot)
    return Ellipsoid(means, residuals, squares, singular)


def determinant(ellipsoid: Ellipsoid, denominator: float) -> Tensor:
    """Determinant of the scatter over ``denominator``, shape ``(M,)``, float64."""
    product = torch.ones_like(ellipsoid.squares[0], dtype=torch.float64)
    for square in ellipsoid.squares:
        product = product * (square.double() / denominator)
    return product


def sq_distances(ellipsoid: Ellipsoid, denominator: Tensor | float) -> Tensor:
    """Squared Mahalanobis distances to the scatter over ``denominator``, shape ``(K, M)``."""
    distances = torch.zeros_like(ellipsoid.residuals[0])
    for residual, square in zip(ellipsoid.residuals, ellipsoid.squares, strict=True):
        term = residual * residual
        distances += term.mul_(denominator / square)
    return distances


def covariance_entries(
    columns: list[Tensor], means: list[Tensor], weights: Tensor, denominator: Tensor | float
) -> Tensor:
    """Weighted covariance about the means, shape ``(M, P, P)``."""
    size = len(columns)
    centered = [column - mean for column, mean in zip(columns, means, strict=True)]
    entries: dict[tuple[int, int], Tensor] = {}
    for i in range(size):
        weighted = weights * centered[i]
        for j in range(i, size):
            entries[i, j] = entries[j, i] = sum_points(weighted * centered[j]) / denominator
    rows = [torch.stack([entries[i, j] for j in range(size)], dim=-1) for i in range(size)]
    return torch.stack(rows, dim=-2)
