"""Initial sets of robust searches: deterministic scatters, planes and random sets."""

from functools import lru_cache
from itertools import chain, combinations
from math import comb
from statistics import NormalDist
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import ROWS_IN_CACHE, limit_rows, split_rows
from torchrg.linalg.precision import machine_epsilon, rounded_sqrt
from torchrg.robust.lanes import (
    covariance_entries,
    eigenvectors,
    is_in_kernels,
    map_values,
    median_points,
    smallest_points,
    sorted_points,
    sum_products,
    sum_squares,
    take_lanes,
)
from torchrg.robust.scale import (
    median_of_sorted,
    qn_factor,
    qn_of_sorted,
    sort_rows,
    sum_points,
    tau_of_sorted,
)

Starts = Literal["paper", "robustbase", "planes"]
MCDStarts = Literal[Starts, "more"]

_MIN_TAU_VALUES = 1000
"""Number of values from which tau replaces Qn, as in robustbase, because Qn needs all pairs."""
_NUM_PLANES = 64
"""Number of candidate planes."""
_NUM_PLANE_STARTS = 4
"""Number of planes used as starts."""


def initial_sets(columns: list[Tensor], size: int, starts: Starts) -> tuple[Tensor, int]:
    """Return the initial sets of the chosen starts as 0/1 masks ``(K, S, M)``, and their size."""
    if starts == "planes":
        return _plane_starts(columns, size), size
    if starts == "paper":
        size = -(-len(columns[0]) // 2)
    return _deterministic_starts(columns, size), size


def _deterministic_starts(columns: list[Tensor], size: int) -> Tensor:
    """Choose the six initial sets of each lane (Hubert, Rousseeuw, Verdonck 2012, section 3)."""
    center, scale = _centers_and_scales(torch.cat(columns, dim=1))
    parts = zip(columns, center.chunk(len(columns)), scale.chunk(len(columns)), strict=True)
    standard = [(column - median) / spread for column, median, spread in parts]
    if not is_in_kernels(columns):
        return _sphered_sets(standard, size)
    tables, factor = (*_bounded(standard), _scores(standard)), qn_factor(len(standard[0]))
    sets, undefined = kernels.call("deterministic_sets", *standard, *tables, factor, size)
    lanes = torch.nonzero(undefined).squeeze(1)
    if len(lanes):
        sets[..., lanes] = _sphered_sets(take_lanes(standard, lanes), size)
    return sets


def _centers_and_scales(column: Tensor) -> tuple[Tensor, Tensor]:
    """Return the median and the positive scale of each lane."""
    if not (len(column) > 1 and kernels.serve(column, k=len(column))):
        rows = sorted_points(column)
        center = median_of_sorted(rows)
        return center, _positive_scale(rows, center)
    center, difference = kernels.call("lane_scales", column)
    scale = qn_factor(len(column)) * difference
    lanes = torch.nonzero(~(scale > 0)).squeeze(1)
    if len(lanes):
        scale[lanes] = _positive_scale(sorted_points(column[:, lanes]), center[lanes])
    return center, scale


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
    lengths = rounded_sqrt(sum_squares(columns))
    lengths = torch.where(lengths > machine_epsilon(lengths.dtype), lengths, 1.0)
    ranks, scores = [_double_ranks(column) for column in columns], _scores(columns)
    half = smallest_points(sum_squares(columns), -(-len(lengths) // 2))
    ones = torch.ones_like(lengths)

    def covariance(columns: list[Tensor], weights: Tensor = ones) -> Tensor:
        means = [sum_points(weights * column) / sum_points(weights) for column in columns]
        return covariance_entries(columns, means, weights, 1.0)

    zeros = [torch.zeros_like(lengths[0]) for _ in columns]
    matrices = [
        covariance(_bounded(columns)),
        covariance([rank.to(lengths.dtype) for rank in ranks]),
        covariance([torch.take(scores, rank) for rank in ranks]),
        covariance_entries([column / lengths for column in columns], zeros, ones, 1.0),
        covariance(columns, half),
        _pairwise_qn(columns),
    ]
    return torch.stack([*map(_correlation, matrices[:3]), *matrices[3:]])


def _sphered_sets(columns: list[Tensor], size: int) -> Tensor:
    """Choose the points ``(K, S, M)`` nearest to the center after sphering.

    Points are sphered along the eigenvectors of each scatter matrix.
    """
    loadings = eigenvectors(_scatter_matrices(columns))
    axes = [[factor.flatten() for factor in axis.unbind(dim=2)] for axis in loadings.unbind(dim=3)]
    wide = [column.repeat(1, len(loadings)) for column in columns]
    parts = [sum_products(wide, axis) for axis in axes]
    parts = [part / _centers_and_scales(part)[1] for part in parts]
    sphered = [sum_products(parts, column) for column in zip(*axes, strict=True)]
    distances = sum_squares([values - median_points(values) for values in sphered])
    return smallest_points(distances, size).view(len(distances), *loadings.shape[:2])


def _bounded(columns: list[Tensor]) -> list[Tensor]:
    """Return the hyperbolic tangent of each coordinate."""
    return [map_values(np.tanh, torch.tanh, column) for column in columns]


def _correlation(scatter: Tensor) -> Tensor:
    """Turn covariances ``(*, P, P)`` into correlations; constant columns are uncorrelated."""
    spread = rounded_sqrt(scatter.diagonal(dim1=-2, dim2=-1))
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
    ascending = sort_rows(rows)
    first = torch.searchsorted(ascending, rows)
    return (first + torch.searchsorted(ascending, rows, right=True) + 1).t()


def _scores(columns: list[Tensor]) -> Tensor:
    """Return the normal scores of the doubled ranks 0 to 2 K of the points of columns ``(K, M)``.

    Rank r has the score ``Phi^-1((r - 1/3) / (K + 1/3))``.
    """
    ranks = [max(double, 1) / 2 for double in range(2 * len(columns[0]) + 1)]
    unit = len(columns[0]) + 1 / 3
    return columns[0].new_tensor([NormalDist().inv_cdf((r - 1 / 3) / unit) for r in ranks])


def _plane_starts(columns: list[Tensor], size: int) -> Tensor:
    """Choose the points nearest to the best of 64 planes, each through P points.

    The best planes have the smallest ``size``-th distance (least median of squares). With a
    minority of outliers, some planes pass through clean points only, wherever the outliers are.
    This needs only sums and one sort per plane, while the published starts need 27 Qn.
    """
    sets = elemental_sets(len(columns[0]), len(columns), _NUM_PLANES, seed=0)
    sets = sets.to(columns[0].device)
    score = torch.stack(
        [sorted_points(_sq_residuals(columns, plane[None, :, None]))[:, size - 1] for plane in sets]
    )
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
        normal = []
        for j in range(size):
            others = [i for i in range(size) if i != j]
            normal.append(torch.linalg.det(matrix[..., others]) * (-1) ** j)
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
