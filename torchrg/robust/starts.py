"""Initial sets of robust searches: deterministic scatters, planes and random sets."""

from functools import lru_cache
from itertools import chain, combinations
from math import comb
from statistics import NormalDist
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import ROWS_IN_CACHE, limit_rows, split_rows
from torchrg.linalg.precision import machine_epsilon
from torchrg.robust.lanes import (
    covariance_entries,
    eigenvectors,
    map_values,
    median_points,
    smallest_points,
    sorted_points,
    sum_products,
    sum_squares,
)
from torchrg.robust.scale import (
    median_of_sorted,
    qn_of_sorted,
    sort_rows,
    sum_points,
    tau_of_sorted,
)

Starts = Literal["paper", "robustbase", "planes"]
MCDStarts = Literal[Starts, "more"]

_MIN_TAU_VALUES = 1000
"""Number of values from which tau replaces Qn, as in robustbase, because Qn needs all pairs."""
_LANES_PER_CHUNK = 12288
"""Number of starts times axes times lanes processed at a time, so that their data fits into the
cache."""
_NUM_PLANES = 64
"""Number of candidate planes."""
_NUM_PLANE_STARTS = 4
"""Number of planes used as starts."""
_PLANES_PER_CHUNK = 8
"""Number of planes processed at a time, so that their data fits into the cache."""


def initial_sets(columns: list[Tensor], size: int, starts: Starts) -> tuple[Tensor, int]:
    """Return the initial sets of the chosen starts as 0/1 masks ``(K, S, M)``, and their size."""
    if starts == "planes":
        return _plane_starts(columns, size), size
    if starts == "paper":
        size = -(-len(columns[0]) // 2)
    return _deterministic_starts(columns, size), size


def _deterministic_starts(columns: list[Tensor], size: int) -> Tensor:
    """Choose the six initial sets of each lane (Hubert, Rousseeuw, Verdonck 2012, section 3)."""
    num_lanes = columns[0].shape[1]
    together = _standardize(torch.cat(columns, dim=1))
    standard = [part.contiguous() for part in torch.split(together, num_lanes, dim=1)]
    starts_per_chunk = max(_LANES_PER_CHUNK // (len(columns) * num_lanes), 1)
    distances = [
        _sphered_distances(standard, eigenvectors(matrices))
        for matrices in torch.split(_scatter_matrices(standard), starts_per_chunk)
    ]
    sets = [smallest_points(group.flatten(1), size).view_as(group) for group in distances]
    return torch.cat(sets, dim=1)


def _standardize(column: Tensor) -> Tensor:
    """Subtract the median of each lane and divide by its Qn."""
    rows = sorted_points(column)
    center = median_of_sorted(rows)
    return (column - center) / _positive_scale(rows, center)


def _scale(rows: Tensor) -> Tensor:
    """Qn of sorted rows with its finite-sample factor; tau for long rows, as in robustbase."""
    if rows.shape[1] >= _MIN_TAU_VALUES:
        return tau_of_sorted(rows)
    return qn_of_sorted(rows, finite_sample=True)


def _positive_scale(rows: Tensor, center: Tensor) -> Tensor:
    """Scale of sorted rows; if zero, the first positive quantile of the deviations.

    The scale is zero if most values are equal. The quantiles, at levels 0.5, 0.55, ..., 0.95,
    0.9875, are divided by those of a normal distribution; a constant row has scale 1.
    """
    scale = _scale(rows)
    zero = torch.nonzero(~(scale > 0)).squeeze(1)
    if len(zero) == 0:
        return scale
    deviations = sort_rows((rows[zero] - center[zero, None]).abs().contiguous())
    positive = torch.ones_like(scale[zero])
    last = deviations.shape[1] - 1
    for level in (0.9875, *(level / 100 for level in range(95, 49, -5))):
        low = int(level * last)
        high, weight = min(low + 1, last), level * last - low
        quantile = deviations[:, low] * (1 - weight) + deviations[:, high] * weight
        quantile = quantile / NormalDist().inv_cdf((level + 1) / 2)
        positive = torch.where(quantile > 0, quantile, positive)
    return scale.index_copy(0, zero, positive)


def _scatter_matrices(columns: list[Tensor]) -> Tensor:
    """Stack the six scatter matrices of standardized columns into ``(6, M, P, P)``.

    Hyperbolic tangent, Spearman, normal scores, spatial sign, inner half, OGK; in this order.
    """
    ranks = [_double_ranks(column) for column in columns]
    norms = sum_squares(columns)
    scores = norms.new_tensor(_score_table(len(norms)))
    half = smallest_points(norms, -(-len(norms) // 2))
    lengths = norms.sqrt()
    lengths = torch.where(lengths > machine_epsilon(norms.dtype), lengths, 1.0)
    ones = torch.ones_like(norms)
    zeros = [torch.zeros_like(norms[0]) for _ in columns]
    inner = [sum_points(half * column) / sum_points(half) for column in columns]
    return torch.stack(
        [
            _correlation([map_values(np.tanh, torch.tanh, column) for column in columns]),
            _correlation([rank.to(norms.dtype) for rank in ranks]),
            _correlation([torch.take(scores, rank) for rank in ranks]),
            covariance_entries([column / lengths for column in columns], zeros, ones, 1.0),
            covariance_entries(columns, inner, half, 1.0),
            _pairwise_qn(columns),
        ]
    )


def _sphered_distances(columns: list[Tensor], loadings: Tensor) -> Tensor:
    """Squared distances ``(K, S, M)`` of points sphered by the eigenvectors ``(S, M, P, P)``."""
    shape = (len(columns[0]), *loadings.shape[:2])
    wide = [column[:, None] for column in columns]
    axes = [
        [factor.contiguous() for factor in axis.unbind(dim=2)] for axis in loadings.unbind(dim=3)
    ]
    scores = torch.cat([sum_products(wide, axis).flatten(1) for axis in axes], dim=1)
    rows = sorted_points(scores)
    scores /= _positive_scale(rows, median_of_sorted(rows))
    parts = scores.chunk(len(axes), dim=1)
    sphered = [
        sum_products(parts, [factors.flatten() for factors in column])
        for column in zip(*axes, strict=True)
    ]
    return sum_squares([values - median_points(values) for values in sphered]).view(shape)


def _correlation(columns: list[Tensor]) -> Tensor:
    """Correlation matrices ``(M, P, P)``; a constant column is uncorrelated with the others."""
    means = [sum_points(column) / len(column) for column in columns]
    scatter = covariance_entries(columns, means, torch.ones_like(columns[0]), 1.0)
    spread = scatter.diagonal(dim1=-2, dim2=-1).sqrt()
    spread = torch.where(spread > 0, spread, 1.0)
    correlation = scatter / (spread[..., :, None] * spread[..., None, :])
    correlation.diagonal(dim1=-2, dim2=-1).fill_(1.0)
    return correlation


def _pairwise_qn(columns: list[Tensor]) -> Tensor:
    """Raw orthogonalized Gnanadesikan-Kettenring matrix: (Qn(a + b)^2 - Qn(a - b)^2) / 4."""
    size = len(columns)
    matrix = columns[0].new_zeros(columns[0].shape[1], size, size)
    matrix.diagonal(dim1=-2, dim2=-1).fill_(1.0)
    for i, column in enumerate(columns[:-1]):
        others = columns[i + 1 :]
        sums = [sorted_points(column + other) for other in others]
        differences = [sorted_points(column - other) for other in others]
        total, difference = _scale(torch.cat(sums + differences)).view(2, len(others), -1)
        matrix[:, i, i + 1 :] = ((total * total - difference * difference) / 4).t()
        matrix[:, i + 1 :, i] = matrix[:, i, i + 1 :]
    return matrix


def _double_ranks(column: Tensor) -> Tensor:
    """Twice the rank of each point within its lane, ties averaged, shape ``(K, M)``, int64."""
    rows = column.t().contiguous()
    if rows.device.type == "cpu":
        order = torch.from_numpy(np.argsort(rows.numpy(), axis=1))
    else:
        order = rows.argsort(dim=1)
    ascending = rows.gather(1, order)
    count = rows.shape[1]
    first = torch.arange(count, device=rows.device).expand(rows.shape)
    last = first
    starts_run = ascending[:, 1:] != ascending[:, :-1]
    tied = torch.nonzero(~starts_run.all(dim=1)).squeeze(1)
    if len(tied):
        edge = torch.ones(len(tied), 1, dtype=torch.bool, device=rows.device)
        begins = torch.cat([edge, starts_run[tied]], dim=1)
        ends = torch.cat([starts_run[tied], edge], dim=1)
        low = torch.where(begins, first[tied], 0).cummax(dim=1).values
        high = torch.where(ends, first[tied], count).flip(1).cummin(dim=1).values.flip(1)
        first, last = first.index_copy(0, tied, low), last.index_copy(0, tied, high)
    return torch.empty_like(order).scatter_(1, order, first + last + 2).t()


@lru_cache(maxsize=256)
def _score_table(count: int) -> tuple[float, ...]:
    """Normal scores of the doubled ranks 0 to 2 n; rank r has Phi^-1((r - 1/3) / (n + 1/3))."""
    scores = [
        NormalDist().inv_cdf((double / 2 - 1 / 3) / (count + 1 / 3))
        for double in range(1, 2 * count + 1)
    ]
    return (scores[0], *scores)


def _plane_starts(columns: list[Tensor], size: int) -> Tensor:
    """Choose the points nearest to the best of 64 planes, each through P points.

    The best planes have the smallest ``size``-th distance (least median of squares). With a
    minority of outliers, some planes pass through clean points only, wherever the outliers are.
    This needs only sums and one sort per plane, while the published starts need 27 Qn.
    """
    num_points, num_lanes = columns[0].shape
    sets = elemental_sets(num_points, len(columns), _NUM_PLANES, seed=0).to(columns[0].device)
    scores = []
    for first in range(0, len(sets), _PLANES_PER_CHUNK):
        tried = sets[first : first + _PLANES_PER_CHUNK]
        nearest = sorted_points(_sq_residuals(columns, tried[:, :, None]))[:, size - 1]
        scores.append(nearest.reshape(len(tried), num_lanes))
    score = torch.cat(scores)
    starts = []
    for _ in range(min(_NUM_PLANE_STARTS, len(sets))):
        best = score.argmin(dim=0)
        score.scatter_(0, best[None], torch.inf)
        residuals = _sq_residuals(columns, sets[best].t()[None])
        starts.append(smallest_points(residuals, size))
    return torch.stack(starts, dim=1)


def _sq_residuals(columns: list[Tensor], sets: Tensor) -> Tensor:
    """Squared distances ``(K, S * M)`` to the hyperplanes through ``sets (S, P, M or 1)``."""
    num_points, num_lanes = columns[0].shape
    corners = [
        [column.gather(0, sets[:, k].expand(-1, num_lanes)) for column in columns]
        for k in range(len(columns))
    ]
    edges = [[a - b for a, b in zip(corner, corners[0], strict=True)] for corner in corners[1:]]
    normal = _orthogonal_direction(edges, corners[0])
    residual = sum_products([column[:, None] for column in columns], normal)
    # Points that span no hyperplane get an infinite distance.
    residual -= torch.where(sum_squares(normal) > 0, sum_products(corners[0], normal), torch.inf)
    return (residual * residual).reshape(num_points, -1)


def _orthogonal_direction(edges: list[list[Tensor]], like: list[Tensor]) -> list[Tensor]:
    """Unit vectors orthogonal to P - 1 edges; zero if these do not span a hyperplane."""
    size = len(like)
    if size == 1:
        return [torch.ones_like(like[0])]
    if size == 3:
        (u0, u1, u2), (v0, v1, v2) = edges
        normal = [u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0]
    else:
        matrix = torch.stack([torch.stack(edge, dim=-1) for edge in edges], dim=-2)
        minors = []
        for j in range(size):
            others = [i for i in range(size) if i != j]
            minors.append(torch.linalg.det(matrix[..., others]) * (-1) ** j)
        normal = minors
    length = sum_squares(normal).sqrt()
    length = torch.where(length > 0, length, 1.0)
    return [component / length for component in normal]


@lru_cache(maxsize=64)
def elemental_sets(num_points: int, size: int, num_sets: int, seed: int) -> Tensor:
    """Choose random sets of ``size`` among ``num_points`` points, or all sets if there are few.

    All patches share the sets, so the result of a patch depends only on the seed, not on its batch.
    Returns point indices ``(S, size)``: all sets if there are at most ``5 * num_sets``, otherwise
    ``num_sets`` of them.
    """
    number = comb(num_points, size)
    if number <= 5 * num_sets:
        indices = chain.from_iterable(combinations(range(num_points), size))
        return torch.from_numpy(np.fromiter(indices, np.int64, number * size)).view(-1, size)
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for rows in split_rows(num_sets, limit_rows(ROWS_IN_CACHE, num_points)):
        shape = rows.stop - rows.start, num_points
        draws = torch.rand(shape, generator=generator, device="cpu")
        parts.append(draws.argsort(dim=1, stable=True)[:, :size].clone())
    return torch.cat(parts)


def random_subsets(sets: Tensor, size: int, seed: int) -> Tensor:
    """Choose ``size`` random points of each set ``(K, S, M)``; all lanes share the draws."""
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(*sets.shape[:2], 1, generator=generator, device="cpu").to(sets)
    return smallest_points(torch.where(sets > 0, draws, 2.0).flatten(1), size).view_as(sets)


def draw_seed(generator: torch.Generator | None) -> int:
    """Draw a seed from a generator; 0 without a generator."""
    if generator is None:
        return 0
    return int(torch.randint(2**62, (), generator=generator, device=generator.device))
