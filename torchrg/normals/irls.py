"""Iteratively weighted PCA: an M-estimator of planes whose scale shrinks."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._checks import check_floating, check_shapes
from torchrg.errors import ConfigError
from torchrg.normals.annealing import HEAVY, Surroundings, anneal, start_plane, weigh
from torchrg.normals.pca import check_patches, fit_normals_pca
from torchrg.normals.query import about_query
from torchrg.normals.staged import replace_rows
from torchrg.structures import NormalFit

_CLOSE_TO_PCA = 0.996
_SAME_SOLUTION = 0.95
_SECOND_START = 0.35
_LEAST_SHARE = 0.1
_LEAST_NOISE = 1e-4


def fit_normals_irls(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    noise: Tensor,
    mu_decay: float = 1.05,
    resolution: Tensor | None = None,
) -> NormalFit:
    r"""Fit a plane to each patch by iteratively weighted PCA [1], eqs. (3) and (5).

    1. Where the plane of PCA fits within the noise, it is the answer.
    2. Elsewhere the normal is the smallest eigenvector of the covariance about the query point
       with weights ``(mu / (mu + r^2))^2`` (Geman-McClure) of the distances ``r`` to the plane
       through it; ``mu`` shrinks by ``mu_decay`` from the largest ``r^2`` of PCA to
       ``(noise / 2)^2``.
    3. The same once more from a quarter of that, now with the plane shifted along its normal to
       the weighted mean of the points of weight above 1/4, so that noise of the query itself
       matters less.
    4. If that turned the normal by more than 5 degrees, there is an edge: a second solution starts
       across the first, and the one closer to the query with more than a tenth of the points wins.

    Convention:
        The query point is the first point of the patch that counts; it takes no part in the fit.
        The authors' ``mu_decay`` is 1.01. (The paper prints eq. (5) without the square of ``r``;
        the authors square it.) Their surface may be curved by a known radius; here it is flat.
        Gradients are those of the steps as taken, and are recomputed step by step to save memory.

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``, the query point first.
        mask: Which points count, shape ``(*, K)``, bool; the others may hold anything, NaN
            included. Default: all.
        noise: Standard deviation of the noise, shape ``(*)``, in the unit of the cloud. At least
            1e-4 of the distance to the farthest point is assumed.
        mu_decay: Factor above 1 by which ``mu`` shrinks in a step.
        resolution: Size below which a coordinate difference is rounding, shape ``(*)``.

    Returns:
        The fit. Curvature and residual are those of PCA on the query and the points of weight
        above 1/4, or on all points where these span no plane; so is ``valid``.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    References:
        [1] J. Sanchez, F. Denis, D. Coeurjolly, F. Dupont, L. Trassoudaine, P. Checchin. Robust
        normal vector estimation in 3D point clouds through iterative principal component analysis.
        ISPRS Journal of Photogrammetry and Remote Sensing 163, 2020.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1))
        >>> wall = floor[5:15, [2, 1, 0]]
        >>> edge = torch.cat([floor, wall]).roll(-12, dims=0)
        >>> fit_normals_irls(edge, noise=torch.tensor(0.01)).normals.abs().round(decimals=2)
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_irls", patches, mask, resolution)
    check_shapes("fit_normals_irls", patches=(patches[..., 0, 0], "*"), noise=(noise, "*"))
    check_floating("fit_normals_irls", patches=patches, noise=noise)
    if mu_decay <= 1:
        raise ConfigError(f"fit_normals_irls: expected mu_decay > 1, got {mu_decay}.")
    leading, size = patches.shape[:-2], patches.shape[-2]
    mask = torch.ones_like(patches[..., 0], dtype=torch.bool) if mask is None else mask
    fit = _fit_rows(
        patches.reshape(-1, size, 3),
        mask.reshape(-1, size),
        noise.reshape(-1),
        mu_decay,
        None if resolution is None else resolution.reshape(-1),
    )
    return fit.each(lambda part: part.reshape(leading + part.shape[1:]))


def _fit_rows(
    patches: Tensor, mask: Tensor, noise: Tensor, decay: float, resolution: Tensor | None
) -> NormalFit:
    """Fit patches with one leading axis."""
    query = mask & (mask.cumsum(dim=-1) == 1)
    others = mask & ~query
    plane = fit_normals_pca(patches, mask, resolution=resolution)
    start = fit_normals_pca(patches, others, resolution=resolution)
    _, offsets = about_query(patches, mask)
    radius = (offsets * offsets).sum(dim=-1).amax(dim=-1).detach().sqrt()
    noise = torch.maximum(noise, _LEAST_NOISE * radius)
    flat = start.valid & (start.residual_rms <= noise)
    plane = NormalFit(*(_select(flat, *pair) for pair in zip(start[:4], plane[:4], strict=True)))

    rows = (start.valid & ~flat).nonzero().squeeze(-1)
    x, y, z = offsets[rows].unbind(dim=-1)
    points = Surroundings(x, y, z, others[rows].to(patches.dtype))
    normals, heavy = _fit_edges(points, start.normals[rows], noise[rows, None], decay)
    resolution = None if resolution is None else resolution[rows]
    inliers = fit_normals_pca(patches[rows], heavy | query[rows], resolution=resolution)
    known = zip(inliers[1:4], plane[1:4], strict=True)
    rest = (_select(inliers.valid, new, old[rows]) for new, old in known)
    return replace_rows(plane, rows, NormalFit(normals, *rest))


class _Solution(NamedTuple):
    """A plane for each edge, the distance of the query point to it, and its points."""

    normal: Tensor
    through: Tensor
    error: Tensor
    heavy: Tensor


def _fit_edges(
    points: Surroundings, start: Tensor, noise: Tensor, decay: float
) -> tuple[Tensor, Tensor]:
    """Return normals and heavy points of the better of two solutions."""
    limit = noise * noise / 4
    largest = _sq_distances(points, start).amax(dim=-1, keepdim=True)
    first = _anneal_twice(points, start, largest, largest / 4, limit, decay)
    normals, heavy = first.normal, first.heavy

    rows = (_cosine(start, normals) < _CLOSE_TO_PCA).nonzero().squeeze(-1)
    part, ours, limit = points.take(rows), normals[rows], limit[rows]
    axis = torch.linalg.cross(torch.linalg.cross(start[rows], ours), ours)
    across = axis / (axis * axis).sum(dim=-1, keepdim=True).sqrt()
    mu = _low_quantile(_sq_distances(part, across), part.counted)
    second = _anneal_twice(part, across, mu, mu / 2, limit, decay)
    known = _Solution(*(field[rows] for field in first))
    better = (_cosine(known.through, second.through) < _SAME_SOLUTION) & ~_first_wins(
        known, second, part
    )
    rows = rows[better]
    return (
        normals.index_copy(0, rows, second.normal[better]),
        heavy.index_copy(0, rows, second.heavy[better]),
    )


def _anneal_twice(
    points: Surroundings,
    start: Tensor,
    mu: Tensor,
    restart: Tensor,
    limit: Tensor,
    decay: float,
) -> _Solution:
    """Return planes fitted through the query points, then near them."""
    through = anneal(points, start_plane(start, mu), limit, decay, shift=False)
    restarted = through._replace(
        mu=torch.maximum(restart, limit),
        weighed_normal=through.normal,
        weighed_mu=through.mu,
    )
    near = anneal(points, restarted, limit, decay, shift=True)
    points = points.about(near.center)
    weights = weigh(points.distances(near.weighed_normal), near.weighed_mu, points.counted)
    height = (near.center * near.normal).sum(dim=-1)
    above = (points.distances(near.normal) * points.counted).sum(dim=-1) > 0
    error = torch.where(above, -height, height)
    return _Solution(near.normal, through.normal, error, weights > HEAVY)


def _first_wins(first: _Solution, second: _Solution, points: Surroundings) -> Tensor:
    """Return whether the first of two solutions is to be taken, shape ``(n,)``."""
    nearer = first.error < second.error
    many_first, many_second = (
        solution.heavy.sum(dim=-1) > _LEAST_SHARE * points.counted.sum(dim=-1)
        for solution in (first, second)
    )
    return torch.where(many_second, nearer & many_first, nearer | many_first)


def _sq_distances(points: Surroundings, normal: Tensor) -> Tensor:
    """Return squared distances to planes through the query points, 0 if not counted."""
    distances = points.distances(normal)
    return distances * distances * points.counted


def _low_quantile(values: Tensor, counted: Tensor) -> Tensor:
    """Return the 35th percentile of the values that count, shape ``(n, 1)``."""
    ordered = torch.where(counted > 0, values, torch.inf).sort(dim=-1).values
    rank = (_SECOND_START * counted.sum(dim=-1, keepdim=True)).long()
    return ordered.gather(-1, rank)


def _cosine(a: Tensor, b: Tensor) -> Tensor:
    """Return the cosine of the angle between directions without sign."""
    return (a * b).sum(dim=-1).abs()


def _select(condition: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """Return rows of one tensor where a condition holds, of another elsewhere."""
    return torch.where(condition.reshape(-1, *[1] * (yes.ndim - 1)), yes, no)
