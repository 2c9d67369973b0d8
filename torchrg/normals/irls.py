"""Iteratively reweighted PCA: a plane M-estimator by graduated non-convexity."""

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchrg._checks import check_floating, check_shapes
from torchrg._opaque import opaque
from torchrg.config import NormalsConfig
from torchrg.errors import ConfigError
from torchrg.linalg import second_moments
from torchrg.linalg.eigen import principal_frame
from torchrg.normals.consensus.noise import estimate_noise
from torchrg.normals.pca import (
    center_on_first,
    check_patches,
    fit_normals_pca,
    fit_points,
    replace_rows,
)
from torchrg.structures import Neighbors, NormalFit

_MIN_HEAVY_WEIGHT = 0.25
"""Weight above which a point belongs to the plane."""
_MIN_STEPS = 5
"""Minimum number of steps, even if the start is close to the limit."""
_UNTURNED_COSINE = 0.996
"""Cosine of 5 degrees. A normal within this angle of the PCA normal has no nearby edge."""
_SAME_COSINE = 0.95
"""Cosine of 18 degrees. Two solutions with normals within this angle are one."""
_SECOND_START = 0.35
"""Quantile of the squared distances at which the second solution starts."""
_MIN_FRACTION = 0.1
"""Minimum fraction of the points explained by a solution; otherwise the other one wins."""
_MIN_NOISE = 1e-4
"""Fraction of the distance to the farthest point. Exact planes have no noise, and without a minimum
the steps would never end. All constants above are those of the authors' program."""


class _Offsets(NamedTuple):
    """Neighbors relative to each point: coordinates, and 1 if counted, shape ``(n, K)``."""

    x: Tensor
    y: Tensor
    z: Tensor
    counted: Tensor

    def select(self, rows: Tensor | slice) -> "_Offsets":
        """Return the given rows."""
        return _Offsets(*(column[rows] for column in self))

    def relative_to(self, centers: Tensor) -> "_Offsets":
        """Return the points relative to other centers, shape ``(n, 3)``."""
        x, y, z = (
            column - center for column, center in zip(self[:3], centers.T[..., None], strict=True)
        )
        return _Offsets(x, y, z, self.counted)

    def distances(self, normals: Tensor) -> Tensor:
        """Return signed distances to planes through the centers, shape ``(n, K)``."""
        x, y, z = (column * n for column, n in zip(self[:3], normals.T[..., None], strict=True))
        total: Tensor = x + y + z
        return total


class _Plane(NamedTuple):
    """Unit normals and centers ``(n, 3)``, weight scale ``(n, 1)``, and their last used values."""

    normal: Tensor
    center: Tensor
    mu: Tensor
    weighed_normal: Tensor
    weighed_mu: Tensor

    def select(self, rows: Tensor | slice) -> "_Plane":
        """Return the given rows."""
        return _Plane(*(column[rows] for column in self))


class _Solution(NamedTuple):
    """A plane per point, the distance of the point to it, and a mask of the plane's points."""

    normal: Tensor
    through: Tensor
    error: Tensor
    heavy: Tensor


def _no_fit(patches: Tensor) -> NormalFit:
    """Return invalid fits of patches ``(*, K, 3)``."""
    first = patches[..., 0, 0]
    return NormalFit(
        patches.new_zeros((*first.shape, 3)),
        first.new_zeros(first.shape),
        first.new_zeros(first.shape, dtype=torch.bool),
        first.new_zeros(first.shape),
    )


@opaque(_no_fit, differentiable=(0, 1, 3))
def fit_normals_irls(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    noise: Tensor,
    mu_decay: float = 1.05,
    resolution: Tensor | None = None,
) -> NormalFit:
    """Fit a plane to each patch by iteratively weighted PCA [1], eqs. (3) and (5).

    1. If the PCA plane fits within the noise, it is the result.
    2. Otherwise the normal is the smallest eigenvector of the covariance about the point itself
       with weights ``(mu / (mu + r^2))^2`` (Geman-McClure) of the distances ``r`` to the plane
       through it. ``mu`` shrinks by ``mu_decay`` from the largest ``r^2`` of PCA to ``(noise /
       2)^2`` (graduated non-convexity [2]).
    3. This is repeated from a quarter of that ``mu``. The plane is now shifted along its normal to
       the weighted mean of the points with weight above 1/4, to reduce the effect of the point's
       noise.
    4. If the normal turned by more than 5 degrees, there is an edge: a second solution starts
       perpendicular to the first. The solution closer to the point wins if it explains more than a
       tenth of the neighbors.

    The point itself, the first counted one of the patch, is excluded from the fit. The authors use
    a ``mu_decay`` of 1.01; 1.05 takes a fifth of the time, with mean squared errors 4 to 11 %
    larger on solids with edges. (The paper prints eq. (5) without the square of ``r``; the authors
    square it.) Their surface may be curved with a known radius; here it is flat. Gradients are
    those of the steps as taken.

    For arguments and errors see :func:`torchrg.normals.fit_normals_pca`. ``noise`` is a standard
    deviation, shape ``(*)``, in coordinate units, clamped to at least 1e-4 of the distance to the
    farthest point. ``mu_decay`` is above 1.

    Returns:
        The fit. Curvature, residual and ``valid`` are from PCA on the point itself and the points
        with weight above 1/4, or on all points if these span no plane.

    References:
        [1] J. Sanchez, F. Denis, D. Coeurjolly, F. Dupont, L. Trassoudaine, P. Checchin. Robust
        normal vector estimation in 3D point clouds through iterative principal component analysis.
        ISPRS Journal of Photogrammetry and Remote Sensing 163, 2020.
        [2] A. Blake, A. Zisserman. Visual Reconstruction. MIT Press, 1987.

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
    return fit.map(lambda values: values.reshape(leading + values.shape[1:]))


def estimate_irls(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    """Estimate normals by iteratively weighted PCA.

    The authors require the noise as input; here it is estimated from the PCA planes.
    """
    fixed = points.detach()
    planes = fit_points(fixed, neighbors, fit_normals_pca, chunk_size=chunk_size)
    noise = estimate_noise(fixed, neighbors, planes, chunk_size=chunk_size).noise
    fit = partial(fit_normals_irls, mu_decay=config.irls_decay)
    return fit_points(points, neighbors, fit, chunk_size=chunk_size, noise=noise)


def _fit_rows(
    patches: Tensor, mask: Tensor, noise: Tensor, decay: float, resolution: Tensor | None
) -> NormalFit:
    """Fit patches with one leading axis."""
    itself = mask & (mask.cumsum(dim=-1) == 1)
    neighbor_mask = mask & ~itself
    plane = fit_normals_pca(patches, mask, resolution=resolution)
    start = fit_normals_pca(patches, neighbor_mask, resolution=resolution)
    _, offsets = center_on_first(patches, mask)
    radius = (offsets * offsets).sum(dim=-1).amax(dim=-1).detach().sqrt()
    noise = torch.maximum(noise, _MIN_NOISE * radius)
    is_flat = start.residual_rms <= noise
    flat = (start.valid & is_flat).nonzero().squeeze(-1)
    plane = replace_rows(plane, flat, start.map(lambda values: values[flat]))

    rows = (start.valid & ~is_flat).nonzero().squeeze(-1)
    x, y, z = offsets[rows].unbind(dim=-1)
    points = _Offsets(x, y, z, neighbor_mask[rows].to(patches.dtype))
    normals, heavy = _fit_edges(points, start.normals[rows], noise[rows, None], decay)
    resolution = None if resolution is None else resolution[rows]
    inliers = fit_normals_pca(patches[rows], heavy | itself[rows], resolution=resolution)
    pairs = zip(inliers[1:4], plane[1:4], strict=True)
    values = (torch.where(inliers.valid, new, old[rows]) for new, old in pairs)
    return replace_rows(plane, rows, NormalFit(normals, *values))


def _fit_edges(
    points: _Offsets, start: Tensor, noise: Tensor, decay: float
) -> tuple[Tensor, Tensor]:
    """Return normals and inlier masks of the better of two solutions."""
    limit = noise * noise / 4
    largest = _sq_distances(points, start).amax(dim=-1, keepdim=True)
    first = _fit_twice(points, start, largest, largest / 4, limit, decay)
    normals, heavy = first.normal, first.heavy

    rows = (_cosine(start, normals) < _UNTURNED_COSINE).nonzero().squeeze(-1)
    turned, current, limit = points.select(rows), normals[rows], limit[rows]
    axis = torch.linalg.cross(torch.linalg.cross(start[rows], current), current)
    across = axis / (axis * axis).sum(dim=-1, keepdim=True).sqrt()
    sq_distances = _sq_distances(turned, across).where(turned.counted > 0, torch.inf)
    rank = (_SECOND_START * turned.counted.sum(dim=-1, keepdim=True)).long()
    mu = sq_distances.sort(dim=-1).values.gather(-1, rank)
    second = _fit_twice(turned, across, mu, mu / 2, limit, decay)
    firsts = _Solution(*(field[rows] for field in first))
    few = _MIN_FRACTION * turned.counted.sum(dim=-1)
    many_first, many_second = (found.heavy.sum(dim=-1) > few for found in (firsts, second))
    nearer = firsts.error < second.error
    first_wins = torch.where(many_second, nearer & many_first, nearer | many_first)
    better = (_cosine(firsts.through, second.through) < _SAME_COSINE) & ~first_wins
    rows = rows[better]
    return (
        normals.index_copy(0, rows, second.normal[better]),
        heavy.index_copy(0, rows, second.heavy[better]),
    )


def _fit_twice(
    points: _Offsets, start: Tensor, mu: Tensor, restart: Tensor, limit: Tensor, decay: float
) -> _Solution:
    """Return planes fitted through the points themselves, then near them."""
    plane = _Plane(start, torch.zeros_like(start), mu, start, mu)
    through = _fit_graduated(points, plane, limit, decay, shift=False)
    restarted = through._replace(
        mu=torch.maximum(restart, limit), weighed_normal=through.normal, weighed_mu=through.mu
    )
    near = _fit_graduated(points, restarted, limit, decay, shift=True)
    points = points.relative_to(near.center)
    weights = _weigh(points.distances(near.weighed_normal), near.weighed_mu, points.counted)
    height = (near.center * near.normal).sum(dim=-1)
    above = (points.distances(near.normal) * points.counted).sum(dim=-1) > 0
    error = torch.where(above, -height, height)
    return _Solution(near.normal, through.normal, error, weights > _MIN_HEAVY_WEIGHT)


def _sq_distances(points: _Offsets, normal: Tensor) -> Tensor:
    """Return squared distances to planes through the points themselves, 0 if not counted."""
    distances = points.distances(normal)
    return distances * distances * points.counted


def _cosine(a: Tensor, b: Tensor) -> Tensor:
    """Return the cosine of the angle between unsigned directions."""
    return (a * b).sum(dim=-1).abs()


def _fit_graduated(
    points: _Offsets, plane: _Plane, limit: Tensor, decay: float, *, shift: bool
) -> _Plane:
    """Reweight and refit planes while ``mu`` shrinks to a limit: graduated non-convexity.

    Each step divides ``mu`` by ``decay``, weights every point by its distance, and takes the
    direction in which the weighted points are flattest about the center. With ``shift`` the center
    first moves along the normal to the weighted mean of the heavy points, using the weights of the
    previous step. ``mu`` ends at the first value at or below the limit, with ``shift`` at the last
    one at or above. Patches leave the batch when they are done. For gradients each step stores only
    its input and is recomputed.
    """
    differentiable = torch.is_grad_enabled() and plane.normal.requires_grad
    step = partial(checkpoint, _step, use_reentrant=False) if differentiable else _step
    num_steps = _count_steps(plane.mu.detach(), limit, decay, stay_above=shift)
    order = num_steps.argsort(descending=True, stable=True)
    remaining = num_steps[order].tolist()
    points, plane = points.select(order), plane.select(order)
    active = len(remaining)
    for done in range(remaining[0] if remaining else 0):
        while remaining[active - 1] <= done:
            active -= 1
        active_rows = slice(0, active)
        updated = step(points.select(active_rows), plane.select(active_rows), decay, shift)
        finished = plane.select(slice(active, None))
        plane = _Plane(*map(torch.cat, zip(updated, finished, strict=True)))
    return plane.select(order.argsort())


def _weigh(distances: Tensor, mu: Tensor, counted: Tensor) -> Tensor:
    """Return Geman-McClure weights ``(mu / (mu + r^2))^2``, 0 if not counted."""
    weights = mu / (mu + distances * distances)
    return weights * weights * counted


def _step(points: _Offsets, plane: _Plane, decay: float, shift: bool) -> _Plane:
    """Return the next plane, with the normal along which the weighted points are flattest."""
    center = plane.center
    if shift:
        points = points.relative_to(center)
        weights = _weigh(points.distances(plane.weighed_normal), plane.weighed_mu, points.counted)
        heavy = weights * (weights > _MIN_HEAVY_WEIGHT)
        total = heavy.sum(dim=-1, keepdim=True)
        heights = (heavy * points.distances(plane.normal)).sum(dim=-1, keepdim=True)
        move = plane.normal * (heights / torch.where(total > 0, total, 1.0))
        points, center = points.relative_to(move), center + move
    mu = plane.mu / decay
    weights = _weigh(points.distances(plane.normal), mu, points.counted)
    matrix = second_moments(points[:3], weights)
    return _Plane(principal_frame(matrix).normals, center, mu, plane.normal, mu)


def _count_steps(mu: Tensor, limit: Tensor, decay: float, *, stay_above: bool) -> Tensor:
    """Return the number of divisions that bring ``mu`` to the limit, shape ``(n,)``.

    Computed by division, not by a logarithm, whose last bit depends on the element's position.
    """
    device = mu.device
    # Each step looks at all values, which a device would wait for.
    mu, limit = mu.cpu(), limit.cpu()
    num_steps = torch.zeros(len(mu), dtype=torch.int64, device="cpu")
    while True:
        following = mu / decay
        continues = following >= limit if stay_above else mu > limit
        if not bool(continues.any()):
            return num_steps.clamp(min=_MIN_STEPS).to(device)
        num_steps += continues.squeeze(-1)
        mu = torch.where(continues, following, mu)
