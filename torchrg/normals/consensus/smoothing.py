"""Bilateral smoothing of normals, and plane choice among neighbors."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import (
    ROWS_AT_ONCE,
    ROWS_IN_CACHE,
    limit_rows,
    map_chunks,
    map_selected,
)
from torchrg.linalg.angles import signs
from torchrg.linalg.moments import (
    Columns,
    dot,
    fit_weighted_planes,
    project,
    residuals,
    sq_lengths,
    sum_neighbors,
)
from torchrg.linalg.precision import rounded_sqrt
from torchrg.neighbors.knn import gather_columns
from torchrg.normals.consensus import constants
from torchrg.normals.consensus.hypotheses import support_scores
from torchrg.normals.consensus.noise import NoiseEstimate
from torchrg.normals.consensus.surfaces import TangentPlanes
from torchrg.structures import Neighbors, NormalFit


def smooth_planes(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    noise: Tensor,
    errors: Tensor,
    rows: Tensor,
    *,
    chunk_size: int,
) -> TangentPlanes:
    """Smooth normals bilaterally: average the neighbors' planes that agree with the point's.

    Neighbor j agrees with point i if its plane passes within 2.5 times the noise of i. The chord
    ``c_ij`` between the normals must be within 4.2 times its standard error ``a_ij = (a_i^2 +
    a_j^2)^(1/2)``. The weights are ``(1 - (c_ij / 4.2 a_ij)^2)^2 (1 - (r_ij / 2.5 s_i)^2) (1 -
    d_ij^2 / (2 d_max^2)) / a_j^2``, each factor at least 0. On a curved surface a plain average
    would lean towards the denser side. The weights are therefore tilted by a linear function of the
    position so that the weighted mean position is the point (local linear regression). ``errors``
    are the ``a_i`` in radians, ``(N,)``, positive; ``rows`` are the points to smooth, ``(n,)``.
    Returns all planes.
    """
    are_served = kernels.serve(points, *neighbors, *planes, noise, k=neighbors.indices.shape[1])
    table = _table(points, planes, errors) if are_served else points
    limits = constants.SMOOTHING_AGREEMENT, constants.SMOOTHING_REACH, constants.FIT_FALLOFF
    tilt = constants.TILT_RIDGE, constants.MAX_TILT

    def find(chosen: Tensor) -> Sequence[Tensor]:
        if are_served:
            return kernels.call("smooth_planes", table, *neighbors, noise, chosen, *limits, *tilt)
        return _smooth_rows(points, neighbors, planes, noise, errors, chosen)

    return _replace_planes(planes, rows, chunk_size, find)


def _replace_planes(
    planes: TangentPlanes, rows: Tensor, chunk_size: int, find: Callable[[Tensor], Sequence[Tensor]]
) -> TangentPlanes:
    """Return all planes, with the normals and offsets of some ``rows`` replaced by ``find``."""
    replaced = TangentPlanes(*(scratch.store(values.clone()) for values in planes))

    def work(block: slice) -> None:
        replaced.normals[rows[block]], replaced.offsets[rows[block]] = find(rows[block])

    map_chunks(work, len(rows), chunk_size, rows.device)
    return replaced


def _table(points: Tensor, planes: TangentPlanes, values: Tensor) -> Tensor:
    """Return rows of point, normal, offset and value ``(N, 8)``, contiguous per point."""
    columns = points, planes.normals, planes.offsets[:, None], values[:, None]
    table = scratch.new_empty(points, (len(points), 8))

    def work(rows: slice) -> None:
        torch.cat([column[rows] for column in columns], dim=1, out=table[rows])

    map_chunks(work, len(points), ROWS_AT_ONCE, points.device)
    return table


def _smooth_rows(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    noise: Tensor,
    errors: Tensor,
    rows: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the smoothed planes of points."""
    near = neighbors.select(rows)
    columns, (normals, offsets) = gather_columns(points, near.indices), planes
    x, y, z = (near.gather(column) for column in normals.unbind(dim=1))
    a, b, c = normals[rows, :, None].unbind(dim=1)
    cosines = x * a + y * b + z * c
    sign = signs(cosines)
    distances = -(x * columns[0] + y * columns[1] + z * columns[2]) - near.gather(offsets)
    sq_chords = 2 * (1 - cosines.abs())
    sq_error = near.gather(errors).square()
    sq_angle = constants.SMOOTHING_AGREEMENT**2 * (sq_error + sq_error[:, :1])
    reach = constants.SMOOTHING_REACH * noise[rows][:, None]
    weights = (1 - sq_chords / sq_angle).clamp_(min=0).square_() * (sq_error[:, :1] / sq_error)
    weights *= (1 - (distances / reach).square_()).clamp_(min=0)
    weights *= _distance_weights(columns, constants.FIT_FALLOFF)
    if near.valid is not None:
        weights *= near.valid
    weights = _recenter_weights(columns, weights) * sign
    mean = torch.stack([sum_neighbors(weights * column) for column in (x, y, z)], dim=-1)
    length = rounded_sqrt(dot(mean, mean))
    has_mean = length > 0
    divisor = torch.where(has_mean, length, 1.0)
    smoothed = torch.where(has_mean[:, None], mean / divisor[:, None], normals[rows])
    total = torch.where(has_mean, sum_neighbors(weights * sign), 1.0)
    new_offsets = -sum_neighbors(weights * distances) / total
    return smoothed, torch.where(has_mean, new_offsets, offsets[rows])


def choose_planes(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    noise: Tensor,
    rows: Tensor,
    *,
    chunk_size: int,
) -> TangentPlanes:
    """Assign to points the neighboring plane with the most support in their neighborhood.

    The score is that of :func:`torchrg.normals.consensus.hypotheses.vote_planes` per weight, minus
    a tenth of the point's squared residual in units of the noise. Planes farther from the point
    than three times the noise are excluded. ``rows`` ``(n,)`` are the points to update. Returns all
    planes.
    """
    ranks = torch.arange(0, neighbors.indices.shape[1], constants.CHOICE_STEP, device=rows.device)
    are_served = kernels.serve(points, *neighbors, *planes, noise, k=neighbors.indices.shape[1])
    are_served = are_served and len(rows) > 0
    table = _table(points, planes, noise) if are_served else points
    vote = constants.CHOICE_STEP, constants.VOTE_REACH, constants.VOTE_FALLOFF
    limits = constants.INLIER_REACH, constants.CHOICE_COST

    def find(chosen: Tensor) -> Sequence[Tensor]:
        if are_served:
            arguments = table, *neighbors, points, chosen, *vote, *limits
            return kernels.call("choose_planes", *arguments)
        return _best_neighbor_planes(points, neighbors, planes, noise, chosen, ranks)

    at_once = ROWS_IN_CACHE // (1 if are_served else len(ranks))
    size = min(chunk_size, limit_rows(at_once, neighbors.indices.shape[1]))
    return _replace_planes(planes, rows, size, find)


def _best_neighbor_planes(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    noise: Tensor,
    rows: Tensor,
    ranks: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the best planes of points among the planes of their neighbors at ``ranks``."""
    near = neighbors.select(rows)
    columns, (normals, offsets) = gather_columns(points, near.indices), planes
    weights = _distance_weights(columns, constants.VOTE_FALLOFF)
    if near.valid is not None:
        weights *= near.valid
    scale = noise[rows][:, None]
    other = near.indices.index_select(1, ranks).long()
    axes = normals[other]
    positions = torch.stack([column.index_select(1, ranks) for column in columns], dim=-1)
    new_offsets = offsets[other] + dot(axes, positions)
    reach = constants.VOTE_REACH * scale
    x, y, z = (column[:, None] for column in columns)
    distances = project((x, y, z), axes / reach[:, :, None]) - (new_offsets / reach)[:, :, None]
    offset_ratio = new_offsets / scale
    support = support_scores(distances, weights[:, None]) / sum_neighbors(weights)[:, None]
    score = support - constants.CHOICE_COST * offset_ratio * offset_ratio
    usable = (offset_ratio.abs() < constants.INLIER_REACH) & (dot(axes, axes) > 0)
    best = torch.where(usable, score, -torch.inf).argmax(dim=1, keepdim=True)
    has_choice = usable.gather(1, best)
    normal = axes.gather(1, best[:, :, None].expand(-1, 1, 3)).squeeze(1)
    offset = torch.where(has_choice, new_offsets.gather(1, best), offsets[rows][:, None])
    return torch.where(has_choice, normal, normals[rows]), offset.squeeze(1)


def standard_errors(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    survey: NoiseEstimate,
    sharp: Tensor,
    *,
    chunk_size: int,
) -> Tensor:
    """Return the standard error of the normals in radians, shape ``(N,)``.

    For a plane through ``n`` points it is the noise divided by ``(n l_1)^(1/2)``. Here ``l_1`` is
    the middle eigenvalue of their covariance, a quarter of the squared radius for a filled disk.
    """
    radius = torch.where(survey.radius > 0, survey.radius, 1.0)
    num_points: Tensor | int = neighbors.indices.shape[1]
    if neighbors.valid is not None:
        num_points = neighbors.valid.sum(dim=1).clamp_(min=1)
    errors: Tensor = 2 * survey.noise / (radius * num_points**0.5)

    def work(rows: Tensor) -> None:
        count, values = _inliers(points, neighbors, planes, survey.noise, rows)
        width = (count * values[:, 1].clamp(min=0)).sqrt_()
        error = survey.noise[rows] / torch.where(width > 0, width, survey.noise[rows])
        errors[rows] = torch.maximum(errors[rows], error)

    map_selected(work, sharp, chunk_size)
    return errors


def describe_inliers(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    noise: Tensor,
    fit: NormalFit,
    sharp: Tensor,
    *,
    chunk_size: int,
) -> tuple[Tensor, Tensor]:
    """Return curvature and residual of all points, at sharp points from the inliers only."""
    curvature, residual_rms = fit.curvature.clone(), fit.residual_rms.clone()

    def work(rows: Tensor) -> None:
        _, values = _inliers(points, neighbors, planes, noise, rows)
        smallest, total = values[:, 0].clamp(min=0), values.clamp(min=0).sum(dim=1)
        bent = (smallest - noise[rows].square()).clamp_(min=0)
        curvature[rows] = bent / torch.where(total > 0, total, 1.0)
        residual_rms[rows] = smallest.sqrt()

    map_selected(work, sharp, chunk_size)
    return curvature, residual_rms


def _inliers(
    points: Tensor, neighbors: Neighbors, planes: TangentPlanes, noise: Tensor, rows: Tensor
) -> tuple[Tensor, ...]:
    """Return the number and covariance eigenvalues of neighbors near the planes of points."""
    arguments = points, *neighbors, *planes, noise
    if kernels.serve(*arguments, k=neighbors.indices.shape[1]):
        return kernels.call("inliers", *arguments, rows, constants.INLIER_REACH)
    columns = gather_columns(points, neighbors.indices[rows])
    distances = residuals(columns, planes.normals[rows], planes.offsets[rows]).abs()
    near = distances <= (constants.INLIER_REACH * noise[rows])[:, None]
    weights = (near & neighbors.mask(rows)).to(points.dtype)
    return weights.sum(dim=1), fit_weighted_planes(columns, weights)[2]


def _distance_weights(columns: Columns, fraction: float) -> Tensor:
    """Return weights that decrease with the squared distance, by ``fraction`` at the farthest."""
    sq_distances = sq_lengths(columns)
    farthest = sq_distances.amax(dim=1, keepdim=True)
    return 1 - fraction * sq_distances / torch.where(farthest > 0, farthest, 1.0)


def _recenter_weights(columns: Columns, weights: Tensor) -> Tensor:
    """Return weights tilted so that the weighted mean position is nearly the point."""
    radius = rounded_sqrt(sq_lengths(columns).amax(dim=1, keepdim=True))
    x, y, z = (column / torch.where(radius > 0, radius, 1.0) for column in columns)
    wx, wy, wz = weights * x, weights * y, weights * z
    xx, xy, xz = sum_neighbors(wx * x), sum_neighbors(wx * y), sum_neighbors(wx * z)
    yy, yz, zz = sum_neighbors(wy * y), sum_neighbors(wy * z), sum_neighbors(wz * z)
    ridge = constants.TILT_RIDGE * (xx + yy + zz)
    xx, yy, zz = xx + ridge, yy + ridge, zz + ridge
    # Cramer's rule for a symmetric positive definite 3x3 system.
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    inverse = torch.where(determinant > 0, 1 / determinant, 0.0)
    mx, my, mz = sum_neighbors(wx), sum_neighbors(wy), sum_neighbors(wz)
    tilt_x = (a * mx + b * my + c * mz) * inverse
    tilt_y = (b * mx + d * my + e * mz) * inverse
    tilt_z = (c * mx + e * my + f * mz) * inverse
    tilt = x * tilt_x[:, None] + y * tilt_y[:, None] + z * tilt_z[:, None]
    return weights * (1 - tilt.clamp_(-constants.MAX_TILT, constants.MAX_TILT))
