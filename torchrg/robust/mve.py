"""Minimum volume ellipsoid."""

from math import comb

import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.robust.lanes import (
    covariance_entries,
    determinant,
    fit_ellipsoid,
    log_values,
    smallest_points,
    sorted_points,
    sq_distances,
)
from torchrg.robust.patches import RobustFit, fit_patchwise, patchwise
from torchrg.robust.starts import draw_seed, elemental_sets
from torchrg.robust.weights import (
    chi2_quantile,
    consistency_factor,
    quantile_factor,
    reweight,
)

_LANES_PER_CHUNK = 1024
"""Number of sets times patches processed at a time, so that their data fits into the cache."""
_MAX_SETS = 2**25
"""Maximum number of sets of an exhaustive search, 32 bytes each for P = 3: 170 points."""


@patchwise
def fit_mve(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    support_fraction: float = 0.5,
    quantile: float = 0.975,
    num_starts: int = 500,
    exhaustive: bool = False,
    min_dimension: int = 0,
    generator: torch.Generator | None = None,
    chunk_size: int = 64,
) -> RobustFit:
    r"""Fit to each patch the ellipsoid of minimum volume that covers h points.

    Each set of P + 1 points defines an ellipsoid by its mean and covariance; it is scaled until it
    covers h points, and the smallest wins [1].

    It is for P = 3, where most small sets are clean. At P = 10, of 40 samples with a fifth of the
    points shifted, 13 fits include shifted points, and none of :func:`torchrg.robust.fit_detmcd`.

    Random sets nearly always miss the minimum volume by a little; ``exhaustive`` uses all sets:
    230,300 for 50 points, a tenth of a second per patch. Other arguments are as in
    :func:`torchrg.robust.fit_fastmcd`; ``support_fraction`` is the fraction of covered points.

    Returns:
        The fits; ``log_det`` is the log determinant of the ellipsoid that just covers h points, and
        ``raw_support`` are these points. The raw covariance is consistent at the normal
        distribution.

    References:
        [1] P. J. Rousseeuw, A. M. Leroy. Robust Regression and Outlier Detection, chapter 7.
        Wiley, 1987.

    Example:
        >>> fit_mve(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """
    if num_starts < 1:
        raise ConfigError(f"fit_mve: expected num_starts of at least 1, got {num_starts!r}.")
    seed = draw_seed(generator)

    def estimator(columns: list[Tensor], floor: Tensor, size: int) -> RobustFit:
        num_points, num_coordinates = len(columns[0]), len(columns)
        corners = num_coordinates + 1
        number = comb(num_points, corners) if exhaustive else num_starts
        if exhaustive and number > _MAX_SETS:
            raise ConfigError(
                f"fit_mve: expected at most {_MAX_SETS:,} sets with exhaustive, got {number:,} of "
                f"{num_points:,} points; set num_starts instead."
            )
        sets = elemental_sets(num_points, corners, number, seed).to(floor.device)
        best, chosen = _smallest_ellipsoid(columns, sets, floor, size)
        weights = torch.zeros_like(columns[0]).scatter_(0, sets[chosen].t(), 1.0)
        ellipsoid = fit_ellipsoid(columns, weights, corners, floor)
        distances = sq_distances(ellipsoid, num_coordinates)
        covered = smallest_points(distances, size)
        if size < num_points:
            factor = quantile_factor(distances, size, num_coordinates)
        else:
            factor = distances.amax(dim=0) / chi2_quantile(quantile, num_coordinates)
        distances = distances / factor
        final_factor = consistency_factor(quantile, num_coordinates)
        final = reweight(columns, distances, quantile, final_factor)
        covariance = covariance_entries(columns, ellipsoid.means, weights, num_coordinates)
        return RobustFit(
            *final,
            sq_distances=distances.t(),
            raw_location=torch.stack(ellipsoid.means, dim=-1),
            raw_covariance=covariance * factor[:, None, None],
            raw_support=(covered > 0).t(),
            log_det=log_values(best),
            exact_fit=ellipsoid.singular,
            valid=torch.ones_like(ellipsoid.singular),
        )

    return fit_patchwise(
        "fit_mve", patches, mask, support_fraction, quantile, chunk_size, estimator, min_dimension
    )


def _smallest_ellipsoid(
    columns: list[Tensor], sets: Tensor, floor: Tensor, size: int
) -> tuple[Tensor, Tensor]:
    """Determinant of the smallest ellipsoid of each lane, float64, and the index of its set."""
    num_points, num_lanes = columns[0].shape
    num_coordinates = len(columns)
    best = torch.full_like(floor, torch.inf, dtype=torch.float64)
    chosen = torch.zeros_like(best, dtype=torch.int64)
    step = max(1, _LANES_PER_CHUNK // num_lanes)
    wide = [column.repeat(1, step) for column in columns]
    floors = floor.repeat(step)
    for first in range(0, len(sets), step):
        tried = sets[first : first + step]
        marks = columns[0].new_zeros(len(tried), num_points).scatter_(1, tried, 1.0)
        weights = marks.t()[:, :, None].expand(-1, -1, num_lanes).reshape(num_points, -1)
        lanes = len(tried) * num_lanes
        points = [column[:, :lanes] for column in wide]
        ellipsoid = fit_ellipsoid(points, weights, num_coordinates + 1, floors[:lanes])
        value = determinant(ellipsoid, num_coordinates)
        reach = sorted_points(sq_distances(ellipsoid, num_coordinates))[:, size - 1].double()
        for _ in range(num_coordinates):
            value = value * reach
        value = value.reshape(len(tried), num_lanes)
        index = value.argmin(dim=0)
        smallest = value.gather(0, index[None]).squeeze(0)
        better = smallest < best
        best = torch.where(better, smallest, best)
        chosen = torch.where(better, first + index, chosen)
    return best, chosen
