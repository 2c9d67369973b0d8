"""Minimum covariance determinant by concentration steps."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._checks import check_choices
from torchrg.errors import ConfigError
from torchrg.robust.lanes import (
    Ellipsoid,
    covariance_entries,
    determinant,
    fit_ellipsoid,
    is_in_kernels,
    log_values,
    smallest_points,
    sq_distances,
    take_lanes,
)
from torchrg.robust.patches import PATCHES_IN_CACHE, RobustFit, fit_patchwise, patchwise
from torchrg.robust.scale import sum_points
from torchrg.robust.starts import MCDStarts, draw_seed, elemental_sets, initial_sets, random_subsets
from torchrg.robust.weights import (
    Inliers,
    Scaling,
    chi2_quantile,
    consistency_factor,
    distances_to_support,
    quantile_factor,
    reweight,
    small_sample_factor,
    within_quantile,
)

_MAX_STEPS = 100
"""Maximum number of concentration steps, after which alternating sets of tied points are kept."""
_NUM_BEST = 10
"""Number of random starts that are concentrated to convergence, as published."""
_NUM_MORE, _NUM_BEST_MORE = 24, 4
"""The same for ``starts="more"``: random starts, and those concentrated to convergence."""
_NUM_RESAMPLED, _NUM_SUBSETS = 2, 4
"""Number of best sets from which ``starts="more"`` draws further starts, and of draws from each."""
_LANES_IN_CACHE = 8192
"""Number of random starts processed at a time, so that their data fits into the cache."""


class _Settings(NamedTuple):
    """Settings of :func:`fit_detmcd`."""

    support_fraction: float
    quantile: float
    small_sample: bool
    scaling: Scaling = "consistency"
    inliers: Inliers = "raw"


class _Concentrated(NamedTuple):
    """Sets after concentration: masks ``(K, S, M)`` of 1 and 0.

    The determinants ``(S, M)`` of their scatter over h - 1 are float64.
    """

    members: Tensor
    determinants: Tensor


@patchwise
def fit_detmcd(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    support_fraction: float = 0.5,
    quantile: float = 0.975,
    starts: MCDStarts = "paper",
    small_sample: bool = False,
    scaling: Scaling = "consistency",
    inliers: Inliers = "raw",
    min_dimension: int = 0,
    chunk_size: int = PATCHES_IN_CACHE,
) -> RobustFit:
    """Fit location and scatter to the majority of each patch by the deterministic MCD.

    Six fast robust scatter estimates each select an initial set of points. Concentration steps lead
    from each to a set of h points with a small covariance determinant; the smallest wins [1].
    Points within the chi-square quantile of its scatter are then fitted together.

    Convention:
        The defaults are the publication's. Small-sample factors are off, because normals do not
        depend on them: they only widen the cutoff (by 19 % at K = 50).

        Other implementations of DetMCD differ in four settings. R's robustbase [2]:
        ``starts="robustbase"``, ``small_sample=True``, and ``inliers="reweighted"`` for its
        ``mcd.wt`` after reweighting (robustbase since 0.99-0; earlier versions have another final
        factor). MATLAB's LIBRA [3]: ``support_fraction=0.75``, ``scaling="quantile"``,
        ``inliers="reweighted"``; it stops at exact fits. The guide to estimators lists the
        covariances of all, and of scikit-learn.

        The published starts use the coordinate axes: rotating a patch changes the final set of
        every second one, and a compact minority can mislead all six. On synthetic patches near
        edges of 90 degrees, the fraction of normals more than 10 degrees off is 21 % with them
        and 4.6 % with ``"planes"``; with 30 % of outliers in one cluster 54 % and 0.

    Args:
        patches: Points of each neighborhood, shape ``(*, K, P)``; see :class:`RobustFit`.
        mask: Mask of points to use, shape ``(*, K)``, bool. Default: all.
        support_fraction: Fraction of points to trust, from 0.5 (h = 27 of 50) to 1.
        quantile: Level of the chi-square distribution within which points are inliers.
        starts: ``"paper"``: sets of ceil(K / 2) points, as published. ``"robustbase"``: of h
            points, as in R. ``"planes"``: the h points nearest to the best four of 64 planes
            through P points; a third of the cost, rotation invariant, and robust against clusters
            near flat patches of P = 3. Other data break it: if a fifth of 50 normal points shifts
            by 10 in each coordinate, 7 % of the fits at P = 3; at P = 10 most if the axes differ.
            ``"more"``: these, 24 fixed random sets of P + 1 points, and subsets of the best sets
            found so far. It reaches the best known minimum in 47 of 53 reference patches,
            :func:`fit_fastmcd` in 51 and ``"paper"`` in 19, at three times the cost of ``"paper"``.
        small_sample: Apply the small-sample factors (P = 3 only).
        scaling: Factors of the scatters. ``"consistency"``: consistent for normal points.
            ``"quantile"``: ``d2_(h) / chi2inv(h/n)`` for the raw scatter, that is the h-th smallest
            squared distance over its expected quantile, and 1 for the final one. The cutoff is
            wider, the less the h points resemble the inner part of a normal sample. 1 if h is all
            points.
        inliers: Distances to which the cutoff applies. ``"raw"``: distances to the raw fit.
            ``"reweighted"``: first these, then the distances to the reweighted fit, which become
            ``sq_distances``; location and covariance stay the same.
        min_dimension: Minimum dimension of a flat that is an exact fit: 0 for a point, 1 for a
            line, 2 for a plane. Points on smaller flats are excluded; see :class:`RobustFit`.
        chunk_size: Number of patches processed at a time.

    Returns:
        The fits; ``log_det`` is the log determinant of the covariance of the h points, without
        factors.

    References:
        [1] M. Hubert, P. J. Rousseeuw, T. Verdonck. A deterministic algorithm for robust location
        and scatter. Journal of Computational and Graphical Statistics 21, 2012.
        [2] M. Maechler et al. robustbase: Basic Robust Statistics. R package, ``covMcd``.
        [3] S. Verboven, M. Hubert. LIBRA: a MATLAB library for robust analysis. Chemometrics and
        Intelligent Laboratory Systems 75, 2005; ``DetMCD.m`` of 2011.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0))
        >>> plane = torch.cat([grid, torch.zeros(25, 1)], dim=1)
        >>> fit = fit_detmcd(torch.cat([plane, torch.tensor([[2.0, 2.0, 9.0]])]))
        >>> fit.exact_fit.item(), fit.support.sum().item()
        (True, 25)
    """
    check_choices(
        "fit_detmcd",
        starts=(starts, MCDStarts),
        scaling=(scaling, Scaling),
        inliers=(inliers, Inliers),
    )
    if small_sample and scaling == "quantile":
        raise ConfigError(
            "fit_detmcd: expected small_sample=False with scaling='quantile', which has no "
            "small-sample factors, got True."
        )

    def search(columns: list[Tensor], floor: Tensor, size: int) -> _Concentrated:
        if starts == "more":
            return _search_more(columns, floor, size)
        return _concentrate(columns, *initial_sets(columns, size, starts), size, floor)

    settings = _Settings(support_fraction, quantile, small_sample, scaling, inliers)
    return _fit_mcd("fit_detmcd", patches, mask, settings, min_dimension, chunk_size, search)


@patchwise
def fit_fastmcd(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    support_fraction: float = 0.5,
    quantile: float = 0.975,
    num_starts: int = 500,
    small_sample: bool = False,
    min_dimension: int = 0,
    generator: torch.Generator | None = None,
    chunk_size: int = 16,
) -> RobustFit:
    r"""Fit location and scatter to the majority of each patch by the MCD with random starts.

    Two concentration steps from each of many sets of P + 1 random points; the ten best distinct
    sets are concentrated to convergence, and the smallest determinant wins [1]. Unlike DetMCD it is
    affine equivariant, and it nearly always finds the best set, at a hundred times the cost.

    Every patch gets the same ``num_starts`` random sets, from ``generator`` or a fixed seed. If
    there are at most five times that number, it gets all sets (up to 17 points of P = 3 with 500).
    Other arguments, errors and results are as in :func:`fit_detmcd`.

    References:
        [1] P. J. Rousseeuw, K. Van Driessen. A fast algorithm for the minimum covariance
        determinant estimator. Technometrics 41, 1999.

    Example:
        >>> points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
        >>> points[:, 2] *= 0.01
        >>> points[:20, 2] += 1.0
        >>> fit_fastmcd(points).support[:20].any().item()
        False
    """
    if num_starts < 1:
        raise ConfigError(f"fit_fastmcd: expected num_starts of at least 1, got {num_starts!r}.")
    seed = draw_seed(generator)

    def search(columns: list[Tensor], floor: Tensor, size: int) -> _Concentrated:
        return _search_random(columns, floor, size, num_starts, _NUM_BEST, seed)

    settings = _Settings(support_fraction, quantile, small_sample)
    return _fit_mcd("fit_fastmcd", patches, mask, settings, min_dimension, chunk_size, search)


def _fit_mcd(
    caller: str,
    patches: Tensor,
    mask: Tensor | None,
    settings: _Settings,
    min_dimension: int,
    chunk_size: int,
    search: Callable[[list[Tensor], Tensor, int], _Concentrated],
) -> RobustFit:
    """Use the best set of a search as raw fit, and reweight by the distances to it."""

    def estimator(columns: list[Tensor], floor: Tensor, size: int) -> RobustFit:
        sets = search(columns, floor, size)
        best = sets.determinants.argmin(dim=0)
        members = sets.members.gather(1, best.expand(len(sets.members), 1, -1)).squeeze(1)
        ellipsoid = fit_ellipsoid(columns, members, size, floor)
        raw_factor, factor = _factors(ellipsoid, size, settings)
        distances = sq_distances(ellipsoid, (size - 1) / raw_factor)
        covariance = covariance_entries(columns, ellipsoid.means, members, size - 1)
        location, final, support = reweight(columns, distances, settings.quantile, factor)
        if settings.inliers == "reweighted":
            distances = distances_to_support(columns, support, factor, floor)
            support = (within_quantile(distances, settings.quantile, len(columns)) > 0).t()
        return RobustFit(
            location,
            final,
            support,
            sq_distances=distances.t(),
            raw_location=torch.stack(ellipsoid.means, dim=-1),
            raw_covariance=covariance * raw_factor[:, None, None],
            raw_support=(members > 0).t(),
            log_det=log_values(sets.determinants.gather(0, best[None]).squeeze(0)),
            exact_fit=ellipsoid.singular,
            valid=torch.ones_like(ellipsoid.singular),
        )

    def weigh(fit: RobustFit, points: Tensor) -> Tensor:
        if settings.inliers == "raw":
            return fit.support
        # The second cutoff keeps location and covariance: the weights are those of the first.
        offsets = (points.nan_to_num(0.0, 0.0, 0.0) - fit.raw_location[..., None, :]).mT
        # Singular scatters have no inverse, and lstsq on CUDA takes none of them.
        solved = torch.linalg.pinv(fit.raw_covariance.double(), hermitian=True) @ offsets.double()
        bound = chi2_quantile(settings.quantile, points.shape[-1])
        within: Tensor = (offsets * solved).sum(dim=-2) <= bound
        return within & fit.sq_distances.isfinite()

    return fit_patchwise(
        caller,
        patches,
        mask,
        settings.support_fraction,
        settings.quantile,
        chunk_size,
        estimator,
        min_dimension,
        weigh=weigh,
    )


def _factors(ellipsoid: Ellipsoid, size: int, settings: _Settings) -> tuple[Tensor, float]:
    """Return the factors of the raw scatter ``(M,)`` and of the final one."""
    num_points, num_coordinates = len(ellipsoid.residuals[0]), len(ellipsoid.residuals)
    if settings.scaling == "quantile":
        if size == num_points:
            return torch.ones_like(ellipsoid.squares[0]), 1.0
        distances = sq_distances(ellipsoid, size - 1)
        return quantile_factor(distances, size, num_coordinates), 1.0
    raw = consistency_factor(size / num_points, num_coordinates)
    final = consistency_factor(settings.quantile, num_coordinates)
    if settings.small_sample:
        sizes = (num_points, num_coordinates, settings.support_fraction)
        raw *= small_sample_factor(*sizes, reweighted=False)
        final *= small_sample_factor(*sizes, reweighted=True)
    return torch.full_like(ellipsoid.squares[0], raw), final


def _search_random(
    columns: list[Tensor], floor: Tensor, size: int, num_starts: int, num_best: int, seed: int
) -> _Concentrated:
    """Concentrate random sets of P + 1 points twice, and the best of them to convergence."""
    num_points, set_size = len(columns[0]), len(columns) + 1
    sets = elemental_sets(num_points, set_size, num_starts, seed).to(floor.device)
    best: list[_Concentrated] = []
    for part in torch.split(sets, max(_LANES_IN_CACHE // len(floor), 1)):
        marks = columns[0].new_zeros(len(part), num_points).scatter_(1, part, 1.0)
        initial = marks.t()[:, :, None].expand(-1, -1, len(floor))
        quick = _concentrate(columns, initial, set_size, size, floor, max_steps=1)
        best = [_distinct_best(_join(*best, quick), num_best)]
    return _concentrate(columns, best[0].members, size, size, floor)


def _search_more(columns: list[Tensor], floor: Tensor, size: int) -> _Concentrated:
    """Search from planes, from random sets, and from subsets of the best sets of both."""
    planes = _concentrate(columns, *initial_sets(columns, size, "planes"), size, floor)
    random = _search_random(columns, floor, size, _NUM_MORE, _NUM_BEST_MORE, seed=0)
    found = _join(planes, random)
    best = _distinct_best(found, _NUM_RESAMPLED).members.repeat(1, _NUM_SUBSETS, 1)
    subset_size = min(2 * len(columns), size)
    subsets = random_subsets(best, subset_size, seed=0)
    return _join(found, _concentrate(columns, subsets, subset_size, size, floor))


def _join(*parts: _Concentrated) -> _Concentrated:
    members, determinants = zip(*parts, strict=True)
    return _Concentrated(torch.cat(members, dim=1), torch.cat(determinants))


def _distinct_best(sets: _Concentrated, number: int) -> _Concentrated:
    """Return the best ``number`` sets of each lane, duplicates last."""
    values, order = sets.determinants.sort(dim=0, stable=True)
    repeated = torch.zeros_like(values, dtype=torch.bool)
    repeated[1:] = values[1:] == values[:-1]
    ranks = torch.where(repeated, torch.inf, values).argsort(dim=0, stable=True)[:number]
    chosen = order.gather(0, ranks)
    members = sets.members.gather(1, chosen.expand(len(sets.members), -1, -1))
    return _Concentrated(members, sets.determinants.gather(0, chosen))


def _concentrate(
    columns: list[Tensor],
    initial: Tensor,
    initial_size: int,
    size: int,
    floor: Tensor,
    max_steps: int = _MAX_STEPS,
) -> _Concentrated:
    """Iterate concentration steps from each start of each lane until the set is stable.

    A step computes mean and scatter of the set, and keeps the ``size`` nearest points; the
    determinant never grows (Rousseeuw and Van Driessen 1999, theorem 1). Starts are sets of
    ``initial_size`` points, in the form of :class:`_Concentrated`.
    """
    if is_in_kernels(columns):
        sizes = initial_size, size, max_steps
        return _Concentrated(*kernels.call("concentrate", *columns, initial, floor, *sizes))
    num_starts = initial.shape[1]
    columns, floor = [column.repeat(1, num_starts) for column in columns], floor.repeat(num_starts)
    fit = fit_ellipsoid(columns, initial.flatten(1), initial_size, floor)
    members = smallest_points(sq_distances(fit, initial_size - 1), size)
    best = previous = torch.full_like(floor, torch.inf, dtype=torch.float64)
    final, sets = members.clone(), torch.arange(len(floor), device=floor.device)
    for step in range(max_steps + 1):
        fit = fit_ellipsoid(columns, members, size, floor)
        value = determinant(fit, size - 1)
        candidate = smallest_points(sq_distances(fit, size - 1), size)
        final, best = final.index_copy(1, sets, members), best.index_copy(0, sets, value)
        # Rounding may increase the determinant, or make two sets of tied points alternate.
        moving = (
            ((sum_points(candidate * members) < size) & (value < previous)).nonzero().squeeze(1)
        )
        if step == max_steps or len(moving) == 0:
            break
        columns, sets, floor = take_lanes(columns, moving), sets[moving], floor[moving]
        members, previous = candidate.index_select(1, moving), value[moving]
    return _Concentrated(final.view_as(initial), best.view(num_starts, -1))
