"""Arithmetic on many patches in parallel: axis 0 holds the points, axis 1 the patches (lanes).

Every lane is computed by the same operations in the same order at any position, so results are
bit-identical for any chunk size.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg.linalg import second_moments
from torchrg.linalg.eigen import rounded_eigenvectors3
from torchrg.robust.scale import median_of_sorted, sort_rows, sum_points


def columns_of_points(patches: Tensor) -> list[Tensor]:
    """Lay patches ``(B, K, P)`` out as P contiguous columns of shape ``(K, B)``."""
    return list(patches.permute(2, 1, 0).contiguous().unbind(0))


def take_lanes(columns: list[Tensor], lanes: Tensor) -> list[Tensor]:
    """Select lanes of each ``(K, M)``; much faster than ``column[:, lanes]``."""
    return [column.index_select(1, lanes) for column in columns]


def sorted_points(values: Tensor) -> Tensor:
    """Sort each lane of ``(K, M)`` and return the lanes as rows ``(M, K)``."""
    return sort_rows(values.t().contiguous())


def is_in_kernels(columns: list[Tensor]) -> bool:
    """Return whether kernels support columns ``(K, M)``: three of at least two points."""
    return len(columns) == 3 and len(columns[0]) > 1 and kernels.serve(*columns, k=len(columns[0]))


def median_points(values: Tensor) -> Tensor:
    """Median of each lane of ``(K, M)``, shape ``(M,)``."""
    return median_of_sorted(sorted_points(values))


def smallest_points(distances: Tensor, size: int) -> Tensor:
    """Mark exactly ``size`` smallest values of each lane; ties go to the first points.

    The values ``(K, M)`` are nonnegative. Returns 1 for marked points and 0 for others.
    """
    if kernels.serve(distances, k=len(distances)):
        (marked,) = kernels.call("smallest_points", distances, size)
        return marked
    nearest = distances.argsort(dim=0, stable=True)[:size]
    return torch.zeros_like(distances).scatter_(0, nearest, 1.0)


def sum_products(parts: Sequence[Tensor], factors: Sequence[Tensor]) -> Tensor:
    """Sum of the products of P tensors and P matching tensors."""
    total = parts[0] * factors[0]
    for column, factor in zip(parts[1:], factors[1:], strict=True):
        total += column * factor
    return total


def sum_squares(parts: Sequence[Tensor]) -> Tensor:
    """Sum of the squares of P tensors of one shape: squared lengths from coordinates."""
    return sum_products(parts, parts)


def eigenvectors(matrices: Tensor) -> Tensor:
    """Eigenvectors of symmetric ``(*, P, P)``, as columns by ascending eigenvalue."""
    if matrices.shape[-1] == 3:
        return rounded_eigenvectors3(matrices)
    vectors: Tensor = torch.linalg.eigh(matrices)[1]
    return vectors


def map_values(
    on_cpu: Callable[..., NDArray[np.floating]],
    in_torch: Callable[..., Tensor],
    values: Tensor,
    *more: float,
) -> Tensor:
    """Apply NumPy's function on a CPU, which is independent of the position, unlike torch's."""
    if values.device.type == "cpu":
        return torch.from_numpy(on_cpu(values.numpy(), *more))
    return in_torch(values, *more)


def log_values(values: Tensor) -> Tensor:
    """Return natural logarithms that do not depend on the position of a value."""
    return map_values(np.log, torch.log, values)


class Ellipsoid(NamedTuple):
    """Weighted mean and scatter of each lane, in a factored form.

    P means ``(M,)``; P columns ``(K, M)`` of residuals, each centered coordinate minus its
    regression on the previous ones; P weighted sums of their squares ``(M,)``, at least the floor;
    and a mask ``(M,)`` of lanes where the floor was applied.
    """

    means: list[Tensor]
    residuals: list[Tensor]
    squares: list[Tensor]
    singular: Tensor


def fit_ellipsoid(
    columns: list[Tensor], weights: Tensor, total: Tensor | float, floor: Tensor
) -> Ellipsoid:
    """Factor the weighted scatter of each lane by modified Gram-Schmidt.

    The squares equal those of a Cholesky factor of the scatter matrix, but each is a sum of squared
    residuals instead of a difference of large numbers. The error in a thin direction grows with the
    ratio of extent to thickness, not with its square, which float32 could not represent.

    ``total`` is the sum of the weights ``(K, M)``. ``floor`` is the minimum variance in any
    direction, shape ``(M,)``, above 0: the rounding error of an exact plane.
    """
    means = [sum_points(weights * column) / total for column in columns]
    residuals = [column - mean for column, mean in zip(columns, means, strict=True)]
    min_square = floor * total
    squares: list[Tensor] = []
    singular = torch.zeros_like(floor, dtype=torch.bool)
    for j, pivot in enumerate(residuals):
        weighted = weights * pivot
        square = sum_points(weighted * pivot)
        singular = singular | (square <= min_square)
        squares.append(torch.maximum(square, min_square))
        for k in range(j + 1, len(residuals)):
            slope = sum_points(weighted * residuals[k]) / squares[j]
            residuals[k] = residuals[k].sub_(slope * pivot)
    return Ellipsoid(means, residuals, squares, singular)


def determinant(ellipsoid: Ellipsoid, denominator: Tensor | float) -> Tensor:
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
        distances += term.mul_(square.reciprocal() * denominator)
    return distances


def covariance_entries(
    columns: list[Tensor], means: list[Tensor], weights: Tensor, denominator: Tensor | float
) -> Tensor:
    """Weighted covariance about the means, shape ``(M, P, P)``."""
    centered = [column - mean for column, mean in zip(columns, means, strict=True)]
    return second_moments(centered, weights, sum_points, denominator)
