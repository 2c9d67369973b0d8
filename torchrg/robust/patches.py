"""Application of robust estimators to batches of patches."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._checks import Arguments, as_tensor, check_floating, check_shapes
from torchrg._opaque import opaque
from torchrg._parallel import limit_rows, map_chunks
from torchrg.errors import ConfigError, warn
from torchrg.linalg import second_moments
from torchrg.linalg.precision import flatness_tolerance, smallest_normal
from torchrg.robust.exact import find_flats, refine_flat
from torchrg.robust.lanes import (
    columns_of_points,
    covariance_entries,
    log_values,
    median_points,
    take_lanes,
)
from torchrg.robust.scale import sum_points
from torchrg.robust.weights import subset_size

PATCHES_IN_CACHE = 4096
"""Number of patches processed at a time, so that their data fits into the cache."""
_MIN_PATCHES = 64
"""Minimum number of patches per thread."""


class RobustFit(NamedTuple):
    """Robust location and scatter of each patch.

    Every estimator takes floating-point patches, and a mask of the points to use; points with a
    non-finite coordinate are ignored. ``quantile`` is the level of the chi-square distribution
    within which points are inliers: 0.975 means a squared distance of 9.3484 for P = 3.
    ``chunk_size`` bounds the memory and does not change the result. An invalid shape, dtype or
    device raises :class:`torchrg.errors.ShapeError`, a setting out of range
    :class:`torchrg.errors.ConfigError`. Patches of fewer than 2 P points cause a warning, unless
    ``min_dimension`` is set.

    If a majority of the points lies exactly on a flat, such as a plane, a line or a point, the flat
    of lowest dimension is the fit: the limit of fits to points approaching it. Its covariance is
    singular. A normal needs a plane: with ``min_dimension=2`` points on a line or at one position
    are excluded, and the remaining points of the patch are fitted.
    :func:`torchrg.normals.fit_normals_robust` and the normals of a cloud use this.

    ``location`` and ``covariance`` have gradients: those of the weighted mean ``m = sum w_i x_i /
    sum w_i`` and of ``c sum w_i (x_i - m) (x_i - m)^T``, with fixed weights ``w`` (1 for the chosen
    points; the last step's for DetS and DetMM) and factor ``c``. The other fields have none.

    Attributes:
        location: Mean of the points in ``support``, shape ``(*, P)``.
        covariance: Their covariance with its consistency factor, shape ``(*, P, P)``. For an exact
            fit: the singular covariance of the points on the flat.
        support: Points that are not outliers, shape ``(*, K)``, bool.
        sq_distances: Squared Mahalanobis distances to the raw fit, shape ``(*, K)``, which
            determine ``support``. For an exact fit: 0 on the flat and inf off it. Ignored points,
            and all points of an invalid patch: inf.
        raw_location: Location before reweighting, shape ``(*, P)``.
        raw_covariance: Scatter before reweighting with its consistency factor, ``(*, P, P)``.
        raw_support: Points used for ``raw_location`` and ``raw_covariance``, ``(*, K)``.
        log_det: Objective of the estimator, shape ``(*)``; see its function. -inf for an exact fit,
            NaN if not valid.
        exact_fit: Whether the points in ``support`` lie exactly on one flat, of dimension P - 1 or
            less, and are a majority, shape ``(*)``, bool.
        valid: Whether there is a fit, shape ``(*)``, bool. Otherwise the other fields are zero. A
            covariance beyond the largest number of the dtype is not valid.
    """

    location: Tensor
    covariance: Tensor
    support: Tensor
    sq_distances: Tensor
    raw_location: Tensor
    raw_covariance: Tensor
    raw_support: Tensor
    log_det: Tensor
    exact_fit: Tensor
    valid: Tensor

    def __repr__(self) -> str:
        *batch, num_points = self.support.shape
        size = self.location.shape[-1]
        return f"RobustFit({tuple(batch)} patches, {num_points} points, {size} coordinates)"


LaneEstimator = Callable[[list[Tensor], Tensor, int], RobustFit]
"""Estimator of lanes in general position: columns ``(K, M)``, minimum variance ``(M,)``, h.

The fits are in the units of the lanes, with ``log_det`` in float64. Exact fits are those whose
``raw_support`` lies on a hyperplane."""


class _Frame(NamedTuple):
    """Transform from lanes to patches: ``point = (lane / zoom + offset) / unit``.

    The factors are powers of two, which preserve all digits.
    """

    offset: Tensor
    unit: Tensor
    zoom: Tensor

    def select(self, rows: Tensor) -> "_Frame":
        """Select the frames of patches."""
        return _Frame(*(field[rows] for field in self))

    def point(self, lanes: Tensor) -> Tensor:
        """Transform points ``(B, P)`` to the coordinates of their patches."""
        return (lanes / self.zoom[:, None] + self.offset) / self.unit[:, None]

    def matrix(self, lanes: Tensor) -> Tensor:
        """Transform scatter matrices ``(B, P, P)`` to the units of their patches."""
        length = (self.zoom * self.unit)[:, None, None]
        return lanes / length / length

    def fit(self, lanes: RobustFit) -> RobustFit:
        """Transform fits of lanes in general position to the coordinates of their patches."""
        units = 2 * lanes.location.shape[1] * log_values(self.zoom.double() * self.unit.double())
        return lanes._replace(
            location=self.point(lanes.location),
            covariance=self.matrix(lanes.covariance),
            raw_location=self.point(lanes.raw_location),
            raw_covariance=self.matrix(lanes.raw_covariance),
            log_det=(lanes.log_det - units).to(lanes.location.dtype),
            exact_fit=~lanes.valid,
        )


def patchwise(function: Callable[Arguments, RobustFit]) -> Callable[Arguments, RobustFit]:
    """Make a robust fit of patches opaque to compilers, ``vmap`` and ``torch.func``."""
    return opaque(_no_fit, differentiable=(0, 1))(function)


def fit_patchwise(
    caller: str,
    patches: Tensor,
    mask: Tensor | None,
    support_fraction: float,
    quantile: float,
    chunk_size: int,
    estimator: LaneEstimator,
    min_dimension: int,
    majority: Callable[[int], int] | None = None,
    weigh: Callable[[RobustFit, Tensor], Tensor] = lambda fit, points: fit.support,
) -> RobustFit:
    """Apply an estimator to every patch, and handle degenerate ones.

    Patches are grouped by their number of used points. Points on one flat are an exact fit if they
    are at least ``majority(n)`` of n, by default h. ``weigh`` returns the weights ``(*, K)`` of the
    points in a fit, for gradients only.
    """
    patches = as_tensor(caller, "patches", patches)
    check_floating(caller, patches=patches)
    check_shapes(caller, patches=(patches, "* K P"), mask=(mask, "* K"))
    if not 0.5 <= support_fraction <= 1:
        raise ConfigError(
            f"{caller}: expected support_fraction from 0.5 to 1, got {support_fraction!r}."
        )
    if not 0 < quantile < 1:
        raise ConfigError(f"{caller}: expected quantile above 0 and below 1, got {quantile!r}.")
    if chunk_size < 1:
        raise ConfigError(f"{caller}: expected chunk_size of at least 1, got {chunk_size!r}.")
    batch, (num_points, size) = patches.shape[:-2], patches.shape[-2:]
    if not 0 <= min_dimension < max(size, 1):
        raise ConfigError(
            f"{caller}: expected min_dimension from 0 to {size - 1} for points with {size} "
            f"coordinates, got {min_dimension!r}."
        )
    # R's robustbase warns below the same number. Normals, which need planes only, have `valid`.
    if batch.numel() and num_points < 2 * size and min_dimension == 0:
        repair = "; pass patches.mT if points are columns" * (num_points <= size)
        warn(
            f"{caller}: expected at least {2 * size} points per patch for {size} coordinates, got "
            f"{num_points}: too few to trust the covariance{repair}."
        )
    dense = patches.detach().reshape(batch.numel(), num_points, size)
    counted = torch.ones_like(dense[..., 0], dtype=torch.bool)
    if not dense.sum().isfinite():
        counted = dense.isfinite().all(dim=-1)
    if mask is not None:
        counted &= mask.reshape(-1, num_points)

    def fit_dense(chunk: Tensor) -> RobustFit:
        return _fit_chunk(chunk, support_fraction, estimator, min_dimension, majority)

    fields = _fit_groups(dense, counted, chunk_size, fit_dense)
    finite = fields.covariance.isfinite() & fields.raw_covariance.isfinite()
    rows = torch.nonzero(~finite.flatten(1).all(dim=1)).squeeze(1)
    _store(fields, rows, _no_fit(dense[rows]))
    fit = RobustFit(*(field.reshape((*batch, *field.shape[1:])) for field in fields))
    if patches.requires_grad and torch.is_grad_enabled():
        weights = torch.where(fit.exact_fit[..., None], fit.support, weigh(fit, patches.detach()))
        return _with_gradients(fit, patches, weights.to(patches.dtype))
    return fit


def _with_gradients(fit: RobustFit, patches: Tensor, weights: Tensor) -> RobustFit:
    """Attach the gradients of weighted points to location and covariance of a fit."""
    total = weights.sum(dim=-1, keepdim=True)
    fractions = (weights / torch.where(total > 0, total, 1.0))[..., None]
    points = torch.where(fractions > 0, patches, 0.0)
    mean = (fractions * points).sum(dim=-2, keepdim=True)
    offsets = (points - mean).unbind(dim=-1)
    scatter = second_moments(offsets, fractions.squeeze(-1))
    size, size_of_scatter = (
        m.detach().diagonal(dim1=-2, dim2=-1).sum(dim=-1) for m in (fit.covariance, scatter)
    )
    covariance = (size / torch.where(size_of_scatter > 0, size_of_scatter, 1.0))[
        ..., None, None
    ] * scatter
    mean = mean.squeeze(-2)
    return fit._replace(
        location=fit.location + (mean - mean.detach()),
        covariance=fit.covariance + (covariance - covariance.detach()),
    )


def _fit_groups(
    patches: Tensor, counted: Tensor, chunk_size: int, fit: Callable[[Tensor], RobustFit]
) -> RobustFit:
    """Fit patches ``(B, K, P)`` in groups with the same number of used points ``(B, K)``."""
    num_points, size = patches.shape[1:]
    out = _no_fit(patches)
    counts = counted.sum(dim=1)
    for count in sorted(set(counts.tolist())):
        if count == 0:
            continue
        rows = torch.nonzero(counts == count).squeeze(1)

        def work(
            chunk: slice, rows: Tensor = rows, whole: bool = count == num_points, count: int = count
        ) -> None:
            chosen = rows[chunk]
            block = patches.index_select(0, chosen)
            if whole:
                _store(out, chosen, fit(block))
                return
            # Move the used points to the front, in their order.
            order = torch.argsort((~counted[chosen]).to(torch.uint8), dim=1, stable=True)[:, :count]
            block = block.gather(1, order[..., None].expand(-1, -1, size))
            _store(out, chosen, _spread(fit(block), order, num_points))

        # Typical points have three coordinates.
        at_once = limit_rows(chunk_size, count * size // 3)
        map_chunks(work, len(rows), at_once, patches.device, min_rows=_MIN_PATCHES)
    return out


def _spread(fit: RobustFit, order: Tensor, num_points: int) -> RobustFit:
    """Scatter the points of a fit to their indices ``order (B, n)`` among K."""
    shape = (len(order), num_points)
    flags = fit.support.new_zeros(shape)
    far = fit.sq_distances.new_full(shape, torch.inf)
    return fit._replace(
        support=flags.scatter(1, order, fit.support),
        raw_support=flags.scatter(1, order, fit.raw_support),
        sq_distances=far.scatter(1, order, fit.sq_distances),
    )


def _store(out: RobustFit, rows: Tensor, fit: RobustFit) -> None:
    for target, source in zip(out, fit, strict=True):
        target.index_copy_(0, rows, source)


def _fit_chunk(
    patches: Tensor,
    support_fraction: float,
    estimator: LaneEstimator,
    min_dimension: int,
    majority: Callable[[int], int] | None,
) -> RobustFit:
    """Fit finite patches ``(B, n, P)``."""
    num_patches, num_points, size = patches.shape
    subset = subset_size(num_points, size, support_fraction)
    enough = subset if majority is None else majority(num_points)
    columns, frame, tolerance = _to_lanes(patches)
    dimension, members = find_flats(columns, tolerance, enough)
    out = _no_fit(patches)

    def lanes_of(rows: Tensor) -> list[Tensor]:
        return columns if len(rows) == num_patches else take_lanes(columns, rows)

    def store_exact(rows: Tensor, members: Tensor) -> None:
        _store(out, rows, _exact_fit(lanes_of(rows), members, frame.select(rows)))

    regular = torch.nonzero(dimension == size).squeeze(1)
    if len(regular):
        estimate = estimator(lanes_of(regular), tolerance[regular] ** 2, subset)
        _store(out, regular, frame.select(regular).fit(estimate))
        # Concentration may find a plane that no simplex lies on.
        thin = torch.nonzero(estimate.exact_fit).squeeze(1)
        if len(thin):
            rows, chosen = regular[thin], estimate.raw_support[thin].t()
            on_plane = refine_flat(lanes_of(rows), chosen, tolerance[rows], size - 1)
            is_exact = on_plane.sum(dim=0) >= enough
            store_exact(rows[is_exact], on_plane[:, is_exact])
    exact = torch.nonzero((dimension < size) & (dimension >= min_dimension)).squeeze(1)
    if len(exact):
        store_exact(exact, members[:, exact])
    lower = torch.nonzero(dimension < min_dimension).squeeze(1)
    if len(lower):
        outside = ~members[:, lower].t()
        fit = _fit_groups(
            patches[lower],
            outside,
            PATCHES_IN_CACHE,
            lambda chunk: _fit_chunk(chunk, support_fraction, estimator, min_dimension, majority),
        )
        _store(out, lower, fit)
        lower = lower[~fit.valid]
        lanes, every = lanes_of(lower), members[:, lower] | True
        flat = refine_flat(lanes, every, tolerance[lower], size - 1).all(dim=0)
        small = refine_flat(lanes, every, tolerance[lower], min_dimension - 1).all(dim=0)
        rows = lower[flat & ~small]
        store_exact(rows, members[:, rows] | True)
    return out


def _exact_fit(columns: list[Tensor], members: Tensor, frame: _Frame) -> RobustFit:
    """Fit lanes whose inliers ``members (K, M)`` lie on a flat."""
    dtype = columns[0].dtype
    weights = members.double()
    count = sum_points(weights)
    wide = [column.double() for column in columns]
    means = [sum_points(weights * column) / count for column in wide]
    covariance = covariance_entries(wide, means, weights, (count - 1).clamp(min=1)).to(dtype)
    location, covariance = (
        frame.point(torch.stack(means, dim=-1).to(dtype)),
        frame.matrix(covariance),
    )
    support = members.t()
    valid = torch.ones(len(support), dtype=torch.bool, device=support.device)
    return RobustFit(
        location=location,
        covariance=covariance,
        support=support,
        sq_distances=torch.where(support, 0.0, torch.inf).to(dtype),
        raw_location=location,
        raw_covariance=covariance,
        raw_support=support,
        log_det=torch.full((len(support),), -torch.inf, dtype=dtype, device=support.device),
        exact_fit=valid,
        valid=valid,
    )


def _no_fit(patches: Tensor) -> RobustFit:
    """Return invalid fits of patches ``(*, K, P)``."""
    *batch, num_points, size = patches.shape
    points = patches.new_zeros((*batch, num_points), dtype=torch.bool)
    flag = patches.new_zeros(batch, dtype=torch.bool)
    return RobustFit(
        location=patches.new_zeros((*batch, size)),
        covariance=patches.new_zeros((*batch, size, size)),
        support=points,
        sq_distances=patches.new_full(points.shape, torch.inf),
        raw_location=patches.new_zeros((*batch, size)),
        raw_covariance=patches.new_zeros((*batch, size, size)),
        raw_support=points.clone(),
        log_det=patches.new_full(flag.shape, torch.nan),
        exact_fit=flag,
        valid=flag.clone(),
    )


def _to_lanes(patches: Tensor) -> tuple[list[Tensor], _Frame, Tensor]:
    """Return columns relative to the patch median, scaled to 1/2 to 1, with frame and tolerance."""
    unit = _power_of_two(patches.abs().amax(dim=(1, 2)))
    patches = patches * unit[:, None, None]
    columns = columns_of_points(patches)
    offset = [median_points(column) for column in columns]
    columns = [column - center for column, center in zip(columns, offset, strict=True)]
    extent = torch.stack([column.abs().amax(dim=0) for column in columns]).amax(dim=0)
    zoom = _power_of_two(extent)
    tolerance = flatness_tolerance(patches, extent) * zoom
    columns = [column * zoom for column in columns]
    return columns, _Frame(torch.stack(offset, dim=-1), unit, zoom), tolerance


def _power_of_two(length: Tensor) -> Tensor:
    """Return the power of two that scales a length to [1/2, 1); a finite one for zero."""
    length = length.clamp(min=4 * smallest_normal(length.dtype))
    return torch.frexp(length).mantissa / length
