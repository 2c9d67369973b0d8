"""Reweighting of raw fits: cutoffs, correction factors and scatter."""

from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.linalg.angles import at_most
from torchrg.robust.lanes import covariance_entries, fit_ellipsoid, sorted_points, sq_distances
from torchrg.robust.scale import sum_points

Scaling = Literal["consistency", "quantile"]
Inliers = Literal["raw", "reweighted"]


def subset_size(num_points: int, num_coordinates: int, support_fraction: float) -> int:
    """Return h, the number of points whose scatter the MCD minimizes, as R's ``h.alpha.n``.

    From the smallest size with the highest breakdown point, ``(n + p + 1) // 2``, at a support
    fraction of 0.5, to all n points at 1.
    """
    half = (num_points + num_coordinates + 1) // 2
    size = 2 * half - num_points + 2 * (num_points - half) * support_fraction
    # Products such as 2 * 23 * 0.7 may be a rounding error below an integer.
    return min(int(size + 1e-9), num_points)


@lru_cache(maxsize=1024)
def chi2_quantile(probability: float, degrees: int) -> float:
    """Quantile of the chi-square distribution; scipy.stats takes half a second to import."""
    from scipy.special import gammaincinv

    return 2 * float(gammaincinv(degrees / 2, probability))


@lru_cache(maxsize=4096)
def consistency_factor(fraction: float, num_coordinates: int) -> float:
    """Factor that makes the scatter of the innermost ``fraction`` of normal data consistent."""
    from scipy.special import gammainc

    if fraction >= 1:
        return 1.0
    inner = gammainc(num_coordinates / 2 + 1, chi2_quantile(fraction, num_coordinates) / 2)
    return fraction / float(inner)


_RAW_SMALL = (2.12777, 2.718898, 1.993509, 2.220433, 1.820585)
_FINAL_SMALL = (1.73511, 2.06681, 1.545905, 1.659655, 1.456835)
"""Small-sample factors of 6 to 10 points at a support fraction of 0.5, poorly fitted by the
published formula."""


def small_sample_factor(
    num_points: int, num_coordinates: int, support_fraction: float, *, reweighted: bool
) -> float:
    """Factor that removes the bias of the MCD scatter of few normal points (Pison et al. 2002).

    For the raw or the reweighted scatter. The factor is 1 where the published formula has its pole
    (up to five points) or is negative (six).
    """
    if num_coordinates != 3:
        raise ConfigError(
            "small_sample_factor: expected points with 3 coordinates, got "
            f"{num_coordinates}; leave small_sample off."
        )
    n = num_points
    if n <= 5:
        return 1.0
    half, wide = (3.629486, 0.802737), (2.666126, 1.034215)
    if reweighted:
        half, wide = (198.4535, 2.457974), (3.387764, 1.111373)
    at_half, at_wide = 1 - half[0] / n ** half[1], 1 - wide[0] / n ** wide[1]
    if n <= 10 and support_fraction == 0.5:
        return (_FINAL_SMALL if reweighted else _RAW_SMALL)[n - 6]
    if support_fraction <= 0.875:
        inverse = at_half + (at_wide - at_half) * (support_fraction - 0.5) / 0.375
    else:
        inverse = at_wide + (1 - at_wide) * (support_fraction - 0.875) / 0.125
    return 1 / inverse if inverse > 0 else 1.0


def quantile_factor(distances: Tensor, size: int, num_coordinates: int) -> Tensor:
    """Factor ``(M,)`` of a scatter, ``d2_(h) / chi2inv(h / n)`` of squared distances ``(K, M)``.

    For n normal points the h-th smallest, h below n, is about the quantile of level h / n.
    """
    reach = sorted_points(distances)[:, size - 1]
    return reach / chi2_quantile(size / len(distances), num_coordinates)


def within_quantile(distances: Tensor, quantile: float, num_coordinates: int) -> Tensor:
    """Return 1 where squared distances ``(K, M)`` are within a chi-square quantile, else 0."""
    return at_most(distances, distances.new_tensor([chi2_quantile(quantile, num_coordinates)]))


def reweight(
    columns: list[Tensor], distances: Tensor, quantile: float, factor: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return location, covariance and support ``(M, K)`` of points within a quantile of a raw fit.

    The covariance is multiplied by the factor unless all points are included.
    """
    weights = within_quantile(distances, quantile, len(columns))
    count = sum_points(weights)
    means = [sum_points(weights * column) / count.clamp(min=1) for column in columns]
    covariance = covariance_entries(columns, means, weights, (count - 1).clamp(min=1))
    whole = count == len(distances)
    covariance = torch.where(whole[:, None, None], covariance, covariance * factor)
    return torch.stack(means, dim=-1), covariance, (weights > 0).t()


def distances_to_support(
    columns: list[Tensor], support: Tensor, factor: float, floor: Tensor
) -> Tensor:
    """Squared distances ``(K, M)`` to the mean and covariance that :func:`reweight` returned."""
    weights = support.t().to(floor.dtype)
    count = sum_points(weights)
    ellipsoid = fit_ellipsoid(columns, weights, count.clamp(min=1), floor)
    scale = torch.where(count == len(weights), torch.ones_like(floor), factor)
    return sq_distances(ellipsoid, (count - 1).clamp(min=1) / scale)
