"""S- and MM-estimators of location and scatter with deterministic starts."""

from collections.abc import Callable
from functools import lru_cache
from math import exp, lgamma, log
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import check_choices
from torchrg.linalg.precision import machine_epsilon, smallest_normal
from torchrg.robust.lanes import (
    Ellipsoid,
    covariance_entries,
    determinant,
    fit_ellipsoid,
    log_values,
    map_values,
    median_points,
    smallest_points,
    sq_distances,
    take_lanes,
)
from torchrg.robust.patches import RobustFit, fit_patchwise, patchwise
from torchrg.robust.scale import half_size, sum_points
from torchrg.robust.starts import Starts, initial_sets
from torchrg.robust.weights import chi2_quantile, within_quantile

Target = Literal["shape", "location"]
"""Estimate to which the efficiency of 95 % at the normal distribution refers."""
_BREAKDOWN = 0.5
"""Fraction of points that may be arbitrary."""
_EFFICIENCY = 0.95
"""Efficiency of the MM-estimator for normal data."""
_MAX_STEPS = 300
"""Maximum number of reweightings, after which unconverged weights are kept."""
_CONVERGED = {torch.float32: 16, torch.float64: 4096}
"""Relative change of converged weights in one reweighting, in units of the machine epsilon."""
_CHECK_EVERY = 4
"""Number of reweightings between convergence checks."""


class _Shape(NamedTuple):
    """Weights ``(K, M)`` of lanes, scatter of determinant one, squared distances to it."""

    weights: Tensor
    ellipsoid: Ellipsoid
    distances: Tensor


@patchwise
def fit_dets(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    quantile: float = 0.975,
    starts: Starts = "robustbase",
    min_dimension: int = 0,
    chunk_size: int = 2048,
) -> RobustFit:
    """Fit location and scatter of each patch by the deterministic S-estimator.

    The scatter has minimum volume with a mean bisquare loss of the distances of half of its
    maximum. Half of the points may therefore be arbitrary. Each deterministic start is iterated to
    a local minimum, and the smallest wins [1]. Arguments and errors are as in
    :func:`torchrg.robust.fit_detmcd`; the ``"robustbase"`` starts are those of R's rrcov.

    Returns:
        The fits. Location and covariance are the estimate itself, without reweighting, and equal
        the raw ones. ``raw_support`` are the points with positive weight; ``log_det`` is the log
        determinant of the covariance. More than half of the points on one flat are an exact fit.

    References:
        [1] M. Hubert, P. Rousseeuw, D. Vanpaemel, T. Verdonck. The DetS and DetMM estimators for
        multivariate location and scatter. Computational Statistics & Data Analysis 81, 2015.

    Example:
        >>> fit_dets(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """
    check_choices("fit_dets", starts=(starts, Starts))
    return _fit_shapes("fit_dets", patches, mask, quantile, starts, min_dimension, chunk_size)


@patchwise
def fit_detmm(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    quantile: float = 0.975,
    tuned_for: Target = "shape",
    starts: Starts = "robustbase",
    min_dimension: int = 0,
    chunk_size: int = 2048,
) -> RobustFit:
    """Fit location and scatter of each patch by the deterministic MM-estimator.

    The scale of the S-estimate is kept, and location and shape are iterated with a wider bisquare
    that is 95 % efficient for normal data; see the reference of :func:`fit_dets`, which has the
    same arguments. ``tuned_for`` selects whether the efficiency applies to the ``"shape"`` (cutoff
    6.0963 for P = 3), suitable for normals and used by R's rrcov, or to the ``"location"``
    (5.4902).

    Returns:
        The fits. Location and covariance are the MM-estimate, ``raw_*`` the initial S-estimate;
        distances, ``support`` and ``log_det`` belong to the MM-estimate.

    Example:
        >>> fit_detmm(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """
    check_choices("fit_detmm", starts=(starts, Starts), tuned_for=(tuned_for, Target))
    return _fit_shapes(
        "fit_detmm", patches, mask, quantile, starts, min_dimension, chunk_size, tuned_for
    )


def _fit_shapes(
    caller: str,
    patches: Tensor,
    mask: Tensor | None,
    quantile: float,
    starts: Starts,
    min_dimension: int,
    chunk_size: int,
    tuned_for: Target | None = None,
) -> RobustFit:
    """Fit patches by the S-estimator, or by the MM-estimator tuned for an efficiency."""

    def cutoff_of(size: int) -> float:
        return efficiency_constant(size, tuned_for) if tuned_for else breakdown_constant(size)

    def estimator(columns: list[Tensor], floor: Tensor, size: int) -> RobustFit:
        first, scale = _best_s_estimate(columns, floor, size, starts)
        if tuned_for is None:
            return _estimate(columns, first, first, scale, quantile)
        cutoff = cutoff_of(len(columns))
        weights, _ = _reweight(columns, first, scale, floor, cutoff, adapt_scale=False)
        final = _fit_shape(columns, weights, floor)
        sq_unit = cutoff * cutoff * scale * scale
        before = sum_points(_bisquare_loss(first.distances / sq_unit))
        after = sum_points(_bisquare_loss(final.distances / sq_unit))
        final = _fit_shape(columns, torch.where(after <= before, weights, first.weights), floor)
        return _estimate(columns, first, final, scale, quantile)

    def weigh(fit: RobustFit, points: Tensor) -> Tensor:
        return _bisquare_weights(fit.sq_distances / cutoff_of(points.shape[-1]) ** 2)

    return fit_patchwise(
        caller,
        patches,
        mask,
        0.5,
        quantile,
        chunk_size,
        estimator,
        min_dimension,
        majority=half_size,
        weigh=weigh,
    )


def _best_s_estimate(
    columns: list[Tensor], floor: Tensor, size: int, starts: Starts
) -> tuple[_Shape, Tensor]:
    """Iterate every start of each lane to an S-estimate, and keep the one of smallest scale."""
    num_points, num_lanes = columns[0].shape
    cutoff = breakdown_constant(len(columns))
    initial, count = initial_sets(columns, size, starts)
    num_starts = initial.shape[1]
    points = [column.repeat(1, num_starts) for column in columns]
    floors = floor.repeat(num_starts)
    members = initial.reshape(num_points, -1)
    ellipsoid = fit_ellipsoid(points, members, count, floors)
    members = smallest_points(sq_distances(ellipsoid, count), size)
    shape = _fit_shape(points, members, floors)
    scale = _m_scale(shape.distances, cutoff)
    weights, scale = _reweight(points, shape, scale, floors, cutoff, adapt_scale=True)
    weights = weights.reshape(num_points, num_starts, num_lanes)
    scale = scale.reshape(num_starts, num_lanes)
    best = scale.argmin(dim=0)
    chosen = weights.gather(1, best.expand(num_points, 1, -1)).squeeze(1)
    return _fit_shape(columns, chosen, floor), scale.gather(0, best[None]).squeeze(0)


def _estimate(
    columns: list[Tensor], raw: _Shape, final: _Shape, scale: Tensor, quantile: float
) -> RobustFit:
    """Create the fit of a shape at a scale."""
    size = len(columns)
    sq_scale = scale * scale
    distances = final.distances / sq_scale

    def scatter(shape: _Shape) -> Tensor:
        denominator = _volume(shape.ellipsoid) / sq_scale
        return covariance_entries(columns, shape.ellipsoid.means, shape.weights, denominator)

    return RobustFit(
        location=torch.stack(final.ellipsoid.means, dim=-1),
        covariance=scatter(final),
        support=(within_quantile(distances, quantile, size) > 0).t(),
        sq_distances=distances.t(),
        raw_location=torch.stack(raw.ellipsoid.means, dim=-1),
        raw_covariance=scatter(raw),
        raw_support=(raw.weights > 0).t(),
        log_det=log_values(sq_scale.double() ** size),
        exact_fit=raw.ellipsoid.singular,
        valid=torch.ones_like(raw.ellipsoid.singular),
    )


def _reweight(
    columns: list[Tensor],
    start: _Shape,
    scale: Tensor,
    floor: Tensor,
    cutoff: float,
    *,
    adapt_scale: bool,
) -> tuple[Tensor, Tensor]:
    """Reweight until the weights converge, and return weights and scale.

    Converged lanes leave the batch. With ``adapt_scale`` the scale takes one step toward the
    M-scale before each reweighting; solving for it completely can lead to another local minimum.
    """
    eps = machine_epsilon(scale.dtype)
    enough = _CONVERGED[scale.dtype] * eps
    weights, scales = start.weights.clone(), scale.clone()
    indices = torch.arange(len(scale), device=scale.device)
    points, floors = columns, floor
    distances, previous = start.distances, start.weights
    for step in range(1, _MAX_STEPS + 1):
        if adapt_scale:
            scale = _m_scale_step(distances, scale, cutoff)
        current = _bisquare_weights(distances / (cutoff * scale) ** 2)
        distances = _fit_shape(points, current, floors).distances
        if step % _CHECK_EVERY and step != _MAX_STEPS:
            previous = current
            continue
        change = sum_points((current - previous).abs())
        converged = change <= enough * sum_points(current)
        if step == _MAX_STEPS:
            converged |= True
        done, moving = torch.nonzero(converged).squeeze(1), torch.nonzero(~converged).squeeze(1)
        if len(done):
            weights.index_copy_(1, indices[done], current.index_select(1, done))
            scales[indices[done]] = scale[done]
            if len(moving) == 0:
                break
            points = take_lanes(points, moving)
            indices, scale, floors = indices[moving], scale[moving], floors[moving]
            distances, current = take_lanes([distances, current], moving)
        previous = current
    return weights, scales


def _fit_shape(columns: list[Tensor], weights: Tensor, floor: Tensor) -> _Shape:
    """Fit the weighted points of each lane, and scale the scatter to determinant one."""
    total = sum_points(weights)
    ellipsoid = fit_ellipsoid(columns, weights, total, floor)
    return _Shape(weights, ellipsoid, sq_distances(ellipsoid, _volume(ellipsoid)))


def _volume(ellipsoid: Ellipsoid) -> Tensor:
    """The P-th root of the determinant of each lane's sums of squares."""
    product = map_values(
        np.power, torch.pow, determinant(ellipsoid, 1.0), 1 / len(ellipsoid.squares)
    )
    return product.to(ellipsoid.squares[0].dtype)


def _m_scale(distances: Tensor, cutoff: float) -> Tensor:
    """Scale at which the mean loss of the distances of each lane is half of its maximum."""
    scale = (median_points(distances) / chi2_quantile(0.5, 1)).sqrt()
    scale = scale.clamp(min=smallest_normal(scale.dtype))
    for _ in range(50):
        scale = _m_scale_step(distances, scale, cutoff)
    return scale


def _m_scale_step(distances: Tensor, scale: Tensor, cutoff: float) -> Tensor:
    loss = sum_points(_bisquare_loss(distances / (cutoff * scale) ** 2)) / len(distances)
    return scale * (loss / _BREAKDOWN).sqrt()


def _bisquare_weights(sq_ratios: Tensor) -> Tensor:
    """Weights ``(1 - t)^2`` of squared distances in units of the cutoff, 0 beyond it."""
    inside = 1 - sq_ratios.clamp(max=1)
    return inside * inside


def _bisquare_loss(sq_ratios: Tensor) -> Tensor:
    """Loss ``1 - (1 - t)^3`` of squared distances in units of the cutoff, 1 beyond it."""
    inside = 1 - sq_ratios.clamp(max=1)
    return 1 - inside * inside * inside


@lru_cache(maxsize=64)
def breakdown_constant(num_coordinates: int) -> float:
    """Cutoff with a breakdown point of one half, for unit scale at the normal distribution."""

    def excess(cutoff: float) -> float:
        moments = [_moment(m, num_coordinates, cutoff) / cutoff**m for m in (0, 2, 4, 6)]
        inside = 3 * moments[1] - 3 * moments[2] + moments[3]
        return inside + 1 - moments[0] - _BREAKDOWN

    return _root(excess)


@lru_cache(maxsize=64)
def efficiency_constant(num_coordinates: int, target: Target) -> float:
    """Cutoff with 95 % efficiency at the normal distribution.

    For the shape of the scatter (Tyler 1983) or for the location (Lopuhaä 1989).
    """
    p = num_coordinates

    def excess(cutoff: float) -> float:
        def mean(coefficients: dict[int, float]) -> float:
            """Mean of a polynomial in d / cutoff over d < cutoff."""
            return sum(a * _moment(m, p, cutoff) / cutoff**m for m, a in coefficients.items())

        # With u = d / cutoff: psi(d) = d (1 - u^2)^2 and psi'(d) = (1 - u^2) (1 - 5 u^2).
        if target == "location":
            spread = cutoff**2 * mean({2: 1, 4: -4, 6: 6, 8: -4, 10: 1}) / p
            slope = mean({0: 1, 2: -2 - 4 / p, 4: 1 + 4 / p})
        else:
            spread = p * (p + 2) * cutoff**4 * mean({4: 1, 6: -4, 8: 6, 10: -4, 12: 1})
            slope = cutoff**2 * mean({2: p + 2, 4: -2 * (p + 4), 6: p + 6})
        return slope**2 / spread - _EFFICIENCY

    return _root(excess)


def _moment(power: int, num_coordinates: int, cutoff: float) -> float:
    """Mean of d^power, d below the cutoff, where d is the length of a standard normal."""
    from scipy.special import gammainc

    half = num_coordinates / 2
    factor = exp(lgamma(half + power / 2) - lgamma(half) + power / 2 * log(2))
    return factor * float(gammainc(half + power / 2, cutoff * cutoff / 2))


def _root(excess: Callable[[float], float]) -> float:
    from scipy.optimize import brentq

    return float(brentq(excess, 0.1, 100.0, xtol=1e-13))
