"""Noise estimation from neighborhoods of several sizes."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import CHUNK_SIZE, ROWS_IN_CACHE, limit_rows, map_chunks, nonzero_rows
from torchrg.linalg.angles import above
from torchrg.linalg.moments import (
    Columns,
    dot,
    fit_parallel_planes,
    fit_weighted_planes,
    project,
    residuals,
    sq_lengths,
    sum_neighbors,
    unbind_columns,
)
from torchrg.linalg.precision import coordinate_resolution, rounded_sqrt
from torchrg.neighbors.knn import gather_columns, gather_patches
from torchrg.normals.consensus import constants
from torchrg.structures import Neighbors, NormalFit

_LAYER_PARAMETERS = 4


class NoiseEstimate(NamedTuple):
    """Plane residuals and noise of each neighborhood, each of shape ``(N,)``.

    Fields: the distance of the plane from the point along the normal; the standard deviation of the
    residuals (3 degrees of freedom less); the noise, infinite if too few neighbors have a plane;
    and the distance of the farthest neighbor.
    """

    offsets: Tensor
    deviations: Tensor
    noise: Tensor
    radius: Tensor


def estimate_noise(
    points: Tensor, neighbors: Neighbors, fit: NormalFit, *, chunk_size: int = CHUNK_SIZE
) -> NoiseEstimate:
    """Estimate the local noise, also at edges and on curved surfaces.

    The deviation ``T_m`` of the ``m`` nearest points from their plane is noise if these points lie
    on one smooth face, and larger otherwise. Small neighborhoods lie on one face more often, so the
    estimate is the minimum of three, for m = 8, 16 and all neighbors, of ``s_m = c_m q(T_m) /
    sqrt(1 - (c_m q(T_m) / (a_m R_m))^2)``. Here ``q`` is the 35th percentile over the neighbors,
    and the factor ``c_m`` makes it unbiased for a plane. The root corrects for planes of few
    points, which turn with their noise. Their radius is ``R_m = R (m / K)^(1/2)``, from the radius
    of all, and ``a_m`` was measured on noisy planes.

    Duplicates count once, and nearly collinear neighborhoods, such as scan lines, do not count. At
    corners, where none of the three finds a face, the noise is at most 3 times the 15th percentile
    of the neighbors' noise. Points may be so sparse that even the nearest lie on both faces of a
    plate. Two parallel planes then replace the plane of all neighbors if they leave at most 0.35 of
    its deviation. ``fit`` are the planes of all neighbors; noise is at least the coordinate
    rounding.
    """
    points = points.contiguous()
    offsets, radius = torch.empty_like(points[:, 0]), torch.empty_like(points[:, 0])
    deviations = scratch.new_empty(points, (len(points), 2 + len(constants.NOISE_COUNTS)))

    def work(block: slice) -> None:
        near = neighbors.select(block)
        offsets[block], radius[block], single, layered, repeats, *nearest = _measure_neighborhoods(
            points, near, fit.normals[block], fit.valid[block]
        )
        if len(rows := nonzero_rows(repeats)):
            patches, counted = _move_duplicates(points, near.select(rows))
            for values, size in zip(nearest, constants.NOISE_COUNTS, strict=True):
                values[rows] = _small_deviations(patches, counted, size)
        torch.stack([single, layered, *nearest], dim=1, out=deviations[block])

    map_chunks(work, len(points), chunk_size, points.device)
    floor = torch.maximum(coordinate_resolution(points), coordinate_resolution(radius[:, None]))
    quantiles = _neighbor_quantiles(deviations, neighbors, constants.NOISE_QUANTILE)
    single, layered, *small = quantiles.unbind(dim=1)
    noise = constants.NOISE_FACTOR_OF_ALL * torch.minimum(single, layered)
    counts: Tensor | int = neighbors.indices.shape[1]
    if neighbors.valid is not None:
        counts = neighbors.valid.sum(dim=1)
    counts = torch.as_tensor(counts, dtype=radius.dtype, device=radius.device)
    sizes = constants.NOISE_COUNTS, constants.NOISE_FACTORS, constants.NOISE_LIMITS
    for size, factor, limit, values in zip(*sizes, small, strict=True):
        noise_of_size, near = factor * values, radius * (size / counts).sqrt()
        fraction = noise_of_size / torch.where(radius > 0, limit * near, 1.0)
        below = (1 - fraction * fraction).clamp_(min=0)
        scaled = noise_of_size / torch.where(below > 0, below, 1.0).sqrt_()
        noise = torch.minimum(noise, torch.where(below > 0, scaled, torch.inf))
    common = _neighbor_quantiles(noise[:, None], neighbors, constants.COMMON_QUANTILE)[:, 0]
    noise = torch.minimum(noise, constants.MAX_ABOVE_COMMON * common)
    survey = offsets, deviations[:, 0].contiguous(), torch.maximum(noise, floor), radius
    return NoiseEstimate(*map(scratch.store, survey))


def regional_noise(noise: Tensor, neighbors: Neighbors) -> Tensor:
    """Return the noise ``(N,)`` of the region around each point from point-wise noise.

    A reconstruction may round the step between two parallel faces into a ramp. No neighborhood on
    the ramp lies on one face, and all of them mistake the step for noise. Neighborhoods next to the
    ramp do not. The regional noise is a low quantile over the neighbors, iterated: each step
    extends the region by one neighborhood.

    For scanner noise, which is independent per point, estimates scatter, and this is about three
    quarters of the noise.
    """
    for _ in range(constants.REGIONAL_STEPS):
        noise = _neighbor_quantiles(noise[:, None], neighbors, constants.REGIONAL_QUANTILE)[:, 0]
    return noise


def _measure_neighborhoods(
    points: Tensor, near: Neighbors, normals: Tensor, valid: Tensor
) -> tuple[Tensor, ...]:
    """Return survey parts, deviations from two layers, a duplicate mask, and small deviations.

    The last ones are those of the nearest neighbors, for each of the counts.
    """
    counts = constants.NOISE_COUNTS
    if kernels.serve(points, *near, normals, valid, k=near.indices.shape[1]):
        layers = constants.MAX_LAYERED_KURTOSIS, constants.MAX_LAYERED_FRACTION
        numbers = constants.NUM_REFITS, constants.MIN_PLANE_POINTS
        limits = *counts, constants.MIN_BREADTH, *layers, *numbers
        return kernels.call("survey", points, *near, normals, valid, *limits)
    columns = gather_columns(points, near.indices)
    counted = near.mask().to(points.dtype)
    count, offsets, distances = _center_planes(columns, counted, normals)
    squares = distances * distances * counted
    second, fourth = sum_neighbors(squares), sum_neighbors(squares.square())
    deviations = rounded_sqrt(second / (count - 3).clamp(min=1))
    single = torch.where(valid & (count > 3), deviations, torch.inf)
    radius = rounded_sqrt((sq_lengths(columns) * counted).amax(dim=1))
    low = fourth * count < constants.MAX_LAYERED_KURTOSIS * second * second
    layered = torch.full_like(single, torch.inf)
    if len(rows := nonzero_rows(low & single.isfinite())):
        layered[rows] = _layered_deviations(points, near.select(rows), normals[rows], single[rows])
    patches = torch.stack(columns, dim=-1)
    repeats = (patches[:, 1:] == patches[:, :-1]).all(dim=-1).any(dim=1)
    small = [_small_deviations(patches, counted, size) for size in counts]
    return offsets, radius, single, layered, repeats, *small


def _center_planes(columns: Columns, counted: Tensor, normals: Tensor) -> tuple[Tensor, ...]:
    """Return neighbor counts, offsets of planes through the mean neighbor, and residuals."""
    count = counted.sum(dim=1)
    center = [sum_neighbors(column * counted) / count.clamp(min=1) for column in columns]
    offsets = dot(normals, torch.stack(center, dim=-1))
    return count, offsets, residuals(columns, normals, offsets)


def _layered_deviations(points: Tensor, near: Neighbors, normals: Tensor, single: Tensor) -> Tensor:
    """Return deviations from two parallel planes, the faces of a plate; inf if there are none."""
    columns = gather_columns(points, near.indices)
    counted = near.mask().to(points.dtype)
    count, _, distances = _center_planes(columns, counted, normals)
    upper = above(distances, 0) * counted
    for _ in range(constants.NUM_REFITS):
        normals, two, squares = fit_parallel_planes(columns, (upper, counted - upper))
        upper = above(project(columns, normals), two.mean(dim=0)[:, None]) * counted
    num_upper = upper.sum(dim=1)
    deviations = rounded_sqrt(squares * count / (count - _LAYER_PARAMETERS).clamp_(min=1))
    layered = torch.minimum(num_upper, count - num_upper) >= constants.MIN_PLANE_POINTS
    layered &= deviations <= constants.MAX_LAYERED_FRACTION * single
    return torch.where(layered, deviations, torch.inf)


def _move_duplicates(points: Tensor, near: Neighbors) -> tuple[Tensor, Tensor]:
    """Move duplicates of the previous neighbor to the end, where they do not count."""
    patches, counted = gather_patches(points, near.indices), near.mask()
    repeats = torch.zeros_like(counted)
    repeats[:, 1:] = (patches[:, 1:] == patches[:, :-1]).all(dim=-1)
    order = repeats.to(torch.uint8).argsort(dim=1, stable=True)
    once = (counted & ~repeats).gather(1, order).to(points.dtype)
    return patches.gather(1, order[:, :, None].expand(-1, -1, 3)), once


def _small_deviations(patches: Tensor, counted: Tensor, count: int) -> Tensor:
    """Return deviations of the nearest points from their plane.

    Infinite if these points do not span a plane, or the last of them does not count.
    """
    if patches.shape[1] < count:
        return patches.new_full(patches.shape[:1], torch.inf)
    columns = unbind_columns(patches[:, :count])
    counted = counted[:, :count]
    normals, offsets, values = fit_weighted_planes(columns, counted)
    distances = residuals(columns, normals, offsets)
    spread = sum_neighbors(distances * distances) / (count - 3)
    broad = (values[:, 1] > constants.MIN_BREADTH * values[:, 2]) & (counted[:, -1] > 0)
    return torch.where(broad, rounded_sqrt(spread), torch.inf)


def _neighbor_quantiles(values: Tensor, neighbors: Neighbors, quantile: float) -> Tensor:
    """Return quantiles over the neighbors of each point, for each column of values ``(N, C)``."""
    k, quantiles = neighbors.indices.shape[1], scratch.new_empty(values, values.shape)
    rank = max(math.ceil(quantile * k), 1)

    def work(block: slice) -> None:
        near = neighbors.select(block)
        if kernels.serve(values, *near, k=k):
            (quantiles[block],) = kernels.call("neighbor_quantiles", values, *near, quantile, rank)
            return
        for column, out in zip(values.unbind(dim=1), quantiles[block].unbind(dim=1), strict=True):
            near_values = near.gather(column)
            if near.valid is None:
                out[:] = near_values.kthvalue(rank, dim=1).values
                continue
            ranks = (quantile * near.valid.sum(dim=1, keepdim=True)).ceil().clamp(min=1)
            ascending = torch.where(near.valid, near_values, torch.inf).sort(dim=1).values
            out[:] = ascending.gather(1, ranks.long() - 1).squeeze(1)

    map_chunks(work, len(values), limit_rows(ROWS_IN_CACHE, k), values.device)
    return quantiles
