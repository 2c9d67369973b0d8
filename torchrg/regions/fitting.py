"""A plane through the points of each region, by robust total least squares."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import eigh3_of_few
from torchrg.regions.segments import Segments
from torchrg.robust.scale import MAD_FACTOR

_BISQUARE_CUT = 4.685
"""Residuals of this many standard deviations have weight 0: 95 % efficiency for normal data."""

_NUM_ROUNDS = 4
_FLAT_RATIO = 4.0
"""Where one variance is not this many times the next smaller one, rounding and noise decide between
their directions."""


_SAME_MAGNITUDE = 1e-6
"""Components of a normal that differ by less than this share are equal but for rounding."""


class FittedPlanes(NamedTuple):
    """Planes of M regions, in float64.

    Attributes:
        normal: Unit normals, shape ``(M, 3)``.
        center: A point of each plane, the weighted mean, shape ``(M, 3)``.
        along: Unit direction of largest variance in the plane, shape ``(M, 3)``.
        covariance: Weighted covariance, shape ``(M, 3, 3)``.
        thickness: Robust standard deviation of the points from the plane, shape ``(M,)``.
        residuals: Signed distance of each point, in the order of :meth:`Segments.take`.
    """

    normal: Tensor
    center: Tensor
    along: Tensor
    covariance: Tensor
    thickness: Tensor
    residuals: Tensor


def fit_planes(segments: Segments, points: Tensor, normals: Tensor) -> FittedPlanes:
    r"""Fit planes by total least squares, iteratively reweighted with Tukey's bisquare [1].

    The weight of a point falls to 0 at 4.685 times the robust standard deviation of the residuals
    (1.4826 times their median), so that points of another surface do not tilt the plane.

    Args:
        segments: The regions.
        points: Points, shape ``(N, 3)``.
        normals: Unit normals of any sign, shape ``(N, 3)``: they decide where points do not, in
            regions of one or two points or along a line.

    Returns:
        The planes. The normal's component of largest magnitude, of equal ones the last, is
        positive.

    References:
        [1] P. Huber, E. Ronchetti. Robust Statistics, 2nd edition. Wiley, 2009.

    Example:
        >>> points = torch.tensor([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 2], [0.5, 0.5, 2.5]])
        >>> segments = Segments(torch.zeros(5, dtype=torch.int64))
        >>> fit_planes(segments, points, torch.eye(3)[[2] * 5]).normal.tolist()
        [[0.0, 0.0, 1.0]]
    """
    usual = shared_moments(segments, normals)[1][:, :, 2]
    origin = segments.first(points).double()
    starts = segments.spread_columns(origin)
    local = [x - start for x, start in zip(segments.take_columns(points), starts, strict=True)]
    resolution = origin.abs().amax(dim=1) * (4 * torch.finfo(points.dtype).eps)
    weights = torch.ones_like(local[0])
    for last in range(_NUM_ROUNDS):
        mean = _means(segments, local, weights)
        middle = segments.spread_columns(mean)
        centered = [x - m for x, m in zip(local, middle, strict=True)]
        covariance = _covariances(segments, centered, weights)
        variances, axes = eigh3_of_few(covariance)
        normal = _with_sign(_plane_normals(variances, axes, usual))
        residuals = sum_of_products(centered, segments.spread_columns(normal))
        thickness = MAD_FACTOR * segments.median(residuals.abs())
        if last == _NUM_ROUNDS - 1:
            break
        cut = _BISQUARE_CUT * torch.maximum(thickness, resolution)
        # A region of one place at the origin has cut 0: its residuals are 0 too.
        ratio = residuals / segments.spread(torch.where(cut > 0, cut, 1.0))
        weights = (1 - ratio * ratio).clamp(min=0).square()
    along = axes[:, :, 2]
    return FittedPlanes(normal, origin + mean, along, covariance, thickness, residuals)


def sum_of_products(first: list[Tensor], second: list[Tensor]) -> Tensor:
    """Return the scalar products of vectors given by columns."""
    (a, b, c), (x, y, z) = first, second
    return a * x + b * y + c * z


def shared_moments(segments: Segments, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvalues and eigenvectors of the normals' second moments, in ascending order.

    The last eigenvector is the direction that the normals of a region share, signs aside.
    """
    columns = segments.take_columns(normals)
    return eigh3_of_few(_covariances(segments, columns, torch.ones_like(columns[0])))


def _means(segments: Segments, columns: list[Tensor], weights: Tensor) -> Tensor:
    """Return weighted means, shape ``(M, 3)``."""
    total = segments.sum(weights)
    return torch.stack([segments.sum(column * weights) / total for column in columns], dim=1)


def _covariances(segments: Segments, columns: list[Tensor], weights: Tensor) -> Tensor:
    """Return weighted second moments about zero, shape ``(M, 3, 3)``."""
    total = segments.sum(weights)
    weighted = [column * weights for column in columns]
    entry = {
        (i, j): segments.sum(weighted[i] * columns[j]) / total
        for i in range(3)
        for j in range(i, 3)
    }
    rows = [torch.stack([entry[min(i, j), max(i, j)] for j in range(3)], 1) for i in range(3)]
    return torch.stack(rows, dim=1)


def _plane_normals(variances: Tensor, axes: Tensor, usual: Tensor) -> Tensor:
    """Return the normals of planes, from the points' own normals where the points give none."""
    low, middle, high = variances.unbind(dim=1)
    along = axes[:, :, 2]
    is_line = high > _FLAT_RATIO * middle
    component = (usual * along).sum(dim=1, keepdim=True) * along
    across = usual - torch.where(is_line[:, None], component, 0.0)
    length = across.norm(dim=1, keepdim=True)
    across = torch.where(length > 0, across / length, axes[:, :, 0])
    is_flat = middle > _FLAT_RATIO * low
    return torch.where(is_flat[:, None], axes[:, :, 0], across)


def _with_sign(normals: Tensor) -> Tensor:
    """Return normals whose component of largest magnitude, of equal ones the last, is positive."""
    magnitudes = normals.abs()
    near = magnitudes >= (1 - _SAME_MAGNITUDE) * magnitudes.amax(dim=1, keepdim=True)
    last = 2 - near.flip(1).to(torch.uint8).argmax(dim=1, keepdim=True)
    return torch.where(normals.gather(1, last) < 0, -normals, normals)
