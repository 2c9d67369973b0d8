"""From patches of any shape to lanes and back: masks, units, exact planes, chunks, threads."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._chunks import chunks_of, run_chunks
from torchrg.errors import ConfigError
from torchrg.robust.estimate import Estimate
from torchrg.robust.flats import find_flats, refine_flat
from torchrg.robust.frame import Frame, to_lanes
from torchrg.robust.lanes import join_columns, sum_points, take_lanes
from torchrg.robust.result import RobustFit, no_fit
from torchrg.robust.scatter import covariance_entries
from torchrg.robust.weights import subset_size

Estimator = Callable[[list[Tensor], Tensor, int], Estimate]
"""Fit lanes in general position: columns ``(K, M)``, least variance ``(M,)``, h."""

CHUNK_SIZE = 4096
"""Patches worked on together; what they need has to fit the processor's cache."""

_MIN_SHARE = 64


def fit_patchwise(
    caller: str,
    patches: Tensor,
    mask: Tensor | None,
    support_fraction: float,
    quantile: float,
    chunk_size: int,
    estimator: Estimator,
    majority: Callable[[int], int] | None = None,
) -> RobustFit:
    """Apply an estimator to every patch, and answer the degenerate ones.

    Patches are grouped by their number of points that count, so that every group is dense. The
    points on one plane are an exact fit where they are ``majority(n)`` of n, by default h.
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
    dense = patches.detach().reshape(batch.numel(), num_points, size)
    counted = torch.isfinite(dense).all(dim=-1)
    if mask is not None:
        counted &= mask.reshape(-1, num_points)

    def fit_dense(chunk: Tensor) -> RobustFit:
        return _fit_chunk(chunk, support_fraction, estimator, majority)

    fit = _fit_groups(dense, counted, chunk_size, fit_dense)
    return RobustFit(*(field.reshape((*batch, *field.shape[1:])) for field in fit))


def _fit_groups(
    patches: Tensor, counted: Tensor, chunk_size: int, fit: Callable[[Tensor], RobustFit]
) -> RobustFit:
    """Fit patches ``(B, K, P)`` group by group of equally many points that count ``(B, K)``."""
    num_patches, num_points, size = patches.shape
    out = no_fit(torch.Size([num_patches]), num_points, size, patches)
    counts = counted.sum(dim=1)
    for count in sorted(set(counts.tolist())):
        if count == 0:
            continue
        rows = torch.nonzero(counts == count).squeeze(1)
        share = min(chunk_size, max(_MIN_SHARE, -(-len(rows) // torch.get_num_threads())))

        def work(
            chunk: slice, rows: Tensor = rows, whole: bool = count == num_points, count: int = count
        ) -> None:
            chosen = rows[chunk]
            block = patches[chosen]
            if whole:
                _store(out, chosen, fit(block))
                return
            # The points that count move to the front, in their order.
            order = torch.argsort((~counted[chosen]).to(torch.uint8), dim=1, stable=True)
            order = order[:, :count]
            block = block.gather(1, order[..., None].expand(-1, -1, size))
            _store(out, chosen, _spread(fit(block), order, num_points))

        run_chunks(work, chunks_of(len(rows), share), patches.device)
    return out


def _store(out: RobustFit, rows: Tensor, fit: RobustFit) -> None:
    for target, source in zip(out, fit, strict=True):
        target[rows] = source


def _spread(fit: RobustFit, order: Tensor, num_points: int) -> RobustFit:
    """Put the points of a fit back to their places ``order (B, n)`` among K."""
    shape = (len(order), num_points)
    flags = fit.support.new_zeros(shape)
    far = fit.sq_distances.new_full(shape, torch.inf)
    return fit._replace(
        support=flags.scatter(1, order, fit.support),
        raw_support=flags.scatter(1, order, fit.raw_support),
        sq_distances=far.scatter(1, order, fit.sq_distances),
    )


def _fit_chunk(
    patches: Tensor,
    support_fraction: float,
    estimator: Estimator,
    majority: Callable[[int], int] | None,
) -> RobustFit:
    """Fit finite patches ``(B, n, P)``."""
    num_patches, num_points, size = patches.shape
    subset = subset_size(num_points, size, support_fraction)
    enough = subset if majority is None else majority(num_points)
    columns, frame, tolerance = to_lanes(patches)
    flats = find_flats(columns, tolerance, enough)
    out = no_fit(torch.Size([num_patches]), num_points, size, patches)

    def lanes_of(rows: Tensor) -> list[Tensor]:
        return columns if len(rows) == num_patches else take_lanes(columns, rows)

    regular = torch.nonzero(flats.dimension == size).squeeze(1)
    if len(regular):
        estimate = estimator(lanes_of(regular), tolerance[regular] ** 2, subset)
        _store(out, regular, _general_fit(estimate, frame.of(regular)))
        # A plane that no simplex lay on may have been found by concentration.
        thin = torch.nonzero(estimate.singular).squeeze(1)
        if len(thin):
            rows, chosen = regular[thin], estimate.raw_support[:, thin]
            members = refine_flat(lanes_of(rows), chosen, tolerance[rows], size - 1)
            found = members.sum(dim=0) >= enough
            rows, members = rows[found], members[:, found]
            _store(out, rows, _exact_fit(lanes_of(rows), members, frame.of(rows)))
    exact = torch.nonzero(flats.dimension == size - 1).squeeze(1)
    if len(exact):
        members = flats.members[:, exact]
        _store(out, exact, _exact_fit(lanes_of(exact), members, frame.of(exact)))
    lower = torch.nonzero(flats.dimension < size - 1).squeeze(1)
    if len(lower):
        rest = ~flats.members[:, lower].t()
        fit = _fit_groups(
            patches[lower],
            rest,
            CHUNK_SIZE,
            lambda chunk: _fit_chunk(chunk, support_fraction, estimator, majority),
        )
        _store(out, lower, fit)
        lower = lower[~fit.valid]
        lanes, every = lanes_of(lower), flats.members[:, lower] | True
        plane = refine_flat(lanes, every, tolerance[lower], size - 1).all(dim=0)
        line = refine_flat(lanes, every, tolerance[lower], size - 2).all(dim=0)
        rows = lower[plane & ~line]
        members = flats.members[:, rows] | True
        _store(out, rows, _exact_fit(lanes_of(rows), members, frame.of(rows)))
    return out


def _general_fit(estimate: Estimate, frame: Frame) -> RobustFit:
    """The fit of lanes in general position, back in the patches' own coordinates."""
    size = estimate.location.shape[1]
    units = 2 * size * _log(frame.zoom.double() * frame.unit.double())
    valid = torch.ones_like(estimate.singular)
    return RobustFit(
        location=frame.point(estimate.location),
        covariance=frame.matrix(estimate.covariance),
        support=estimate.support.t(),
        sq_distances=estimate.sq_distances.t(),
        raw_location=frame.point(estimate.raw_location),
        raw_covariance=frame.matrix(estimate.raw_covariance),
        raw_support=estimate.raw_support.t(),
        log_det=(_log(estimate.objective) - units).to(estimate.location.dtype),
        exact_fit=~valid,
        valid=valid,
    )


def _exact_fit(columns: list[Tensor], members: Tensor, frame: Frame) -> RobustFit:
    """The fit of lanes whose ``members (K, M)`` lie on a plane; these are the inliers."""
    dtype = columns[0].dtype
    weights = members.double()
    count = sum_points(weights)
    wide = [column.double() for column in columns]
    means = [sum_points(weights * column) / count for column in wide]
    covariance = covariance_entries(wide, means, weights, (count - 1).clamp(min=1)).to(dtype)
    location = frame.point(join_columns(means).to(dtype))
    covariance = frame.matrix(covariance)
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


def _log(values: Tensor) -> Tensor:
    """Natural logarithm, the same for a value wherever it stands; torch's on a CPU is not."""
    if values.device.type == "cpu":
        return torch.from_numpy(np.log(values.numpy()))
    return values.log()
