"""S and MM estimates of location and scatter from deterministic starts."""

import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.robust.bisquare import Target, bisquare_loss, breakdown_constant, efficiency_constant
from torchrg.robust.differences import half_size
from torchrg.robust.estimate import Estimate
from torchrg.robust.lanes import join_columns, smallest_points, sum_points
from torchrg.robust.mcd import Starts, check_starts, initial_sets
from torchrg.robust.patchwise import fit_patchwise
from torchrg.robust.result import RobustFit
from torchrg.robust.scatter import covariance_entries, fit_ellipsoid, sq_distances
from torchrg.robust.shape import Shape, choose_shape, m_scale, reweight_shape, shape_of, volume
from torchrg.robust.weights import chi2_quantile


def fit_dets(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    quantile: float = 0.975,
    starts: Starts = "robustbase",
    chunk_size: int = 2048,
) -> RobustFit:
    r"""Fit location and scatter of each patch by the deterministic S-estimator.

    The scatter is the one of least volume for which the mean bisquare loss of the distances is
    half of its maximum, so that half of the points may be arbitrary. Each deterministic start is
    iterated to a local minimum, and the smallest wins [1].

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, P)``, floating point.
        mask: Which points count, shape ``(*, K)``, bool. Default: all. Points with a non-finite
            coordinate never count.
        quantile: Points within this quantile of the chi-square distribution are inliers.
        starts: As in :func:`torchrg.robust.fit_detmcd`; ``"robustbase"`` are those of R's rrcov.
        chunk_size: Patches worked on together; bounds the memory, never changes the result.

    Returns:
        The fits. Location and covariance are the estimate itself, not reweighted, and the same as
        the raw ones; ``raw_support`` are the points with a weight above zero; ``log_det`` is that
        of the covariance. More than half of the points on one plane are an exact fit.

    Raises:
        ShapeError: If a shape, dtype or device is not as above.
        ConfigError: If a setting is out of range.

    References:
        [1] M. Hubert, P. Rousseeuw, D. Vanpaemel, T. Verdonck. The DetS and DetMM estimators for
        multivariate location and scatter. Computational Statistics & Data Analysis 81, 2015.

    Example:
        >>> points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
        >>> points[:, 2] *= 0.01
        >>> points[:20, 2] += 1.0
        >>> fit_dets(points).support[:20].any().item()
        False
    """
    check_starts("fit_dets", starts)

    def estimator(columns: list[Tensor], floor: Tensor, size: int) -> Estimate:
        shape, scale = _best_s_estimate(columns, floor, size, starts)
        return _estimate(columns, shape, shape, scale, quantile)

    return fit_patchwise(
        "fit_dets", patches, mask, 0.5, quantile, chunk_size, estimator, majority=half_size
    )


def fit_detmm(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    quantile: float = 0.975,
    tuned_for: Target = "shape",
    starts: Starts = "robustbase",
    chunk_size: int = 2048,
) -> RobustFit:
    r"""Fit location and scatter of each patch by the deterministic MM-estimator.

    The scale of the S-estimate is kept, and location and shape are iterated on with a wider
    bisquare that is 95 % efficient for normal data [1].

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, P)``, floating point.
        mask: Which points count, shape ``(*, K)``, bool. Default: all. Points with a non-finite
            coordinate never count.
        quantile: Points within this quantile of the chi-square distribution are inliers.
        tuned_for: Whether the efficiency is that of the ``"shape"`` (cut-off 6.0963 for P = 3),
            as normals want and R's rrcov has it, or of the ``"location"`` (5.4902).
        starts: As in :func:`torchrg.robust.fit_detmcd`; ``"robustbase"`` are those of R's rrcov.
        chunk_size: Patches worked on together; bounds the memory, never changes the result.

    Returns:
        The fits. Location and covariance are the MM-estimate, ``raw_*`` the S-estimate it started
        from; distances and ``support`` belong to the MM-estimate; ``log_det`` is that of its
        covariance. More than half of the points on one plane are an exact fit.

    Raises:
        ShapeError: If a shape, dtype or device is not as above.
        ConfigError: If a setting is out of range.

    References:
        [1] M. Hubert, P. Rousseeuw, D. Vanpaemel, T. Verdonck. The DetS and DetMM estimators for
        multivariate location and scatter. Computational Statistics & Data Analysis 81, 2015.

    Example:
        >>> points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
        >>> points[:, 2] *= 0.01
        >>> points[:20, 2] += 1.0
        >>> fit_detmm(points).support[:20].any().item()
        False
    """
    check_starts("fit_detmm", starts)
    if tuned_for not in ("shape", "location"):
        raise ConfigError(
            f"fit_detmm: expected tuned_for to be shape or location, got {tuned_for!r}."
        )

    def estimator(columns: list[Tensor], floor: Tensor, size: int) -> Estimate:
        first, scale = _best_s_estimate(columns, floor, size, starts)
        cutoff = efficiency_constant(len(columns), tuned_for)
        final, _ = reweight_shape(columns, first, scale, floor, cutoff, adapt_scale=False)
        sq_unit = cutoff * cutoff * scale * scale
        before = sum_points(bisquare_loss(first.distances / sq_unit))
        after = sum_points(bisquare_loss(final.distances / sq_unit))
        final = choose_shape(after <= before, final, first)
        return _estimate(columns, first, final, scale, quantile)

    return fit_patchwise(
        "fit_detmm", patches, mask, 0.5, quantile, chunk_size, estimator, majority=half_size
    )


def _best_s_estimate(
    columns: list[Tensor], floor: Tensor, size: int, starts: Starts
) -> tuple[Shape, Tensor]:
    """Iterate every start of each lane to an S-estimate, and keep that of the smallest scale."""
    num_points, num_lanes = columns[0].shape
    cutoff = breakdown_constant(len(columns))
    shapes, scales = [], []
    for initial, count in initial_sets(columns, size, starts):
        num_starts = initial.shape[1]
        points = [column.repeat(1, num_starts) for column in columns]
        floors = floor.repeat(num_starts)
        members = initial.reshape(num_points, -1)
        ellipsoid = fit_ellipsoid(points, members, count, floors)
        members = smallest_points(sq_distances(ellipsoid, count), size)
        shape = shape_of(points, members, floors)
        scale = m_scale(shape.distances, cutoff)
        shape, scale = reweight_shape(points, shape, scale, floors, cutoff, adapt_scale=True)
        shapes.append(shape)
        scales.append(scale.reshape(num_starts, num_lanes))
    scale = torch.cat(scales)
    best = scale.argmin(dim=0)
    lane = torch.arange(num_lanes, device=best.device)
    weights = torch.cat(
        [shape.weights.reshape(num_points, -1, num_lanes) for shape in shapes], dim=1
    )
    return shape_of(
        columns, weights.gather(1, best.expand(num_points, 1, -1)).squeeze(1), floor
    ), scale[best, lane]


def _estimate(
    columns: list[Tensor], raw: Shape, final: Shape, scale: Tensor, quantile: float
) -> Estimate:
    """Location, covariance, distances and inliers of a shape at a scale."""
    size = len(columns)
    sq_scale = scale * scale
    distances = final.distances / sq_scale
    bound = distances.new_tensor([chi2_quantile(quantile, size)])

    def scatter(shape: Shape) -> Tensor:
        denominator = volume(shape.ellipsoid) / sq_scale
        return covariance_entries(columns, shape.ellipsoid.means, shape.weights, denominator)

    return Estimate(
        location=join_columns(final.ellipsoid.means),
        covariance=scatter(final),
        support=distances <= bound,
        sq_distances=distances,
        raw_location=join_columns(raw.ellipsoid.means),
        raw_covariance=scatter(raw),
        raw_support=raw.weights > 0,
        objective=sq_scale.double() ** size,
        singular=raw.ellipsoid.singular,
    )
