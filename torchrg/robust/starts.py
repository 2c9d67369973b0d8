"""The six deterministic starts of DetMCD, DetS and DetMM."""

from functools import lru_cache
from statistics import NormalDist

import numpy as np
import torch
from torch import Tensor

from torchrg.robust.differences import majority_difference
from torchrg.robust.lanes import (
    eigenvectors,
    median_of_sorted,
    median_points,
    smallest_points,
    sort_rows,
    sorted_points,
    sum_points,
    sum_squares,
)
from torchrg.robust.scale import QN_REVISED_FACTOR, qn_sample_factor, tau_of_sorted
from torchrg.robust.scatter import covariance_entries

NUM_STARTS = 6
"""Hyperbolic tangent, Spearman, normal scores, spatial sign, inner half, OGK; in this order."""

_LONG = 1000
_STARTS_AT_ONCE = 3
"""Starts worked on together."""


def deterministic_starts(columns: list[Tensor], size: int) -> Tensor:
    """Choose the six initial sets of each lane (Hubert, Rousseeuw, Verdonck 2012, section 3).

    Args:
        columns: P coordinates of shape ``(K, M)``, K >= 2.
        size: Number of points of an initial set.

    Returns:
        1 for a point in the set, 0 for another, shape ``(K, 6, M)``.
    """
    standard = [_standardize(column) for column in columns]
    # Some starts after the others: what they need fits the cache.
    distances = [
        _sphered_distances(standard, eigenvectors(matrices))
        for matrices in torch.split(_scatter_matrices(standard), _STARTS_AT_ONCE)
    ]
    sets = [smallest_points(part.flatten(1), size).view_as(part) for part in distances]
    return torch.cat(sets, dim=1)


def _standardize(column: Tensor) -> Tensor:
    """Subtract the median of each lane and divide by its Qn."""
    rows = sorted_points(column)
    center = median_of_sorted(rows)
    return (column - center) / _positive_scale(rows, center)


def _scale(rows: Tensor) -> Tensor:
    """Qn of sorted rows with its finite-sample factor; tau of long ones, as robustbase has it."""
    count = rows.shape[1]
    if count >= _LONG:
        return tau_of_sorted(rows)
    return QN_REVISED_FACTOR * qn_sample_factor(count) * majority_difference(rows)


def _positive_scale(rows: Tensor, center: Tensor) -> Tensor:
    """Scale of sorted rows; where that is zero, the first positive quantile of the deviations.

    It is zero where most values are equal. The quantiles, at levels 0.5, 0.55, ..., 0.95, 0.9875,
    are divided by those of a normal distribution; a constant row has scale 1.
    """
    scale = _scale(rows)
    zero = torch.nonzero(~(scale > 0)).squeeze(1)
    if len(zero) == 0:
        return scale
    deviations = sort_rows((rows[zero] - center[zero, None]).abs().contiguous())
    found = torch.ones_like(scale[zero])
    last = deviations.shape[1] - 1
    for level in (0.9875, *(level / 100 for level in range(95, 49, -5))):
        low = int(level * last)
        high, part = min(low + 1, last), level * last - low
        quantile = deviations[:, low] * (1 - part) + deviations[:, high] * part
        quantile = quantile / NormalDist().inv_cdf((level + 1) / 2)
        found = torch.where(quantile > 0, quantile, found)
    return scale.index_copy(0, zero, found)


def _scatter_matrices(columns: list[Tensor]) -> Tensor:
    """Stack the six scatter matrices of standardised columns into ``(6, M, P, P)``."""
    ranks = [_double_ranks(column) for column in columns]
    scores = _normal_scores(len(columns[0]), columns[0])
    norms = sum_squares(columns)
    half = smallest_points(norms, -(-len(norms) // 2))
    lengths = norms.sqrt()
    lengths = torch.where(lengths > torch.finfo(norms.dtype).eps, lengths, 1.0)
    ones = torch.ones_like(norms)
    zeros = [torch.zeros_like(norms[0]) for _ in columns]
    inner = [sum_points(half * column) / sum_points(half) for column in columns]
    return torch.stack(
        [
            _correlation([_tanh(column) for column in columns]),
            _correlation([rank.to(norms.dtype) for rank in ranks]),
            _correlation([torch.take(scores, rank) for rank in ranks]),
            covariance_entries([column / lengths for column in columns], zeros, ones, 1.0),
            covariance_entries(columns, inner, half, 1.0),
            _pairwise_qn(columns),
        ]
    )


def _sphered_distances(columns: list[Tensor], loadings: Tensor) -> Tensor:
    """Squared distances of the points after sphering by each start's scatter, ``(K, S, M)``.

    Args:
        columns: P coordinates of shape ``(K, M)``.
        loadings: Eigenvectors of the scatters, as columns, shape ``(S, M, P, P)``.
    """
    shape = (len(columns[0]), *loadings.shape[:2])
    sphered: list[Tensor] = []
    for directions in loadings.unbind(dim=3):
        axis = [part.contiguous() for part in directions.unbind(dim=2)]
        score = _combine(columns, axis).flatten(1)
        rows = sorted_points(score)
        score /= _positive_scale(rows, median_of_sorted(rows))
        for i, factor in enumerate(axis):
            part = score * factor.flatten()
            if i == len(sphered):
                sphered.append(part)
            else:
                sphered[i] += part
    return sum_squares([part - median_points(part) for part in sphered]).view(shape)


def _combine(columns: list[Tensor], factors: list[Tensor]) -> Tensor:
    """Sum of the columns ``(K, M)`` times factors ``(S, M)``, shape ``(K, S, M)``."""
    total = columns[0][:, None] * factors[0]
    for column, factor in zip(columns[1:], factors[1:], strict=True):
        total += column[:, None] * factor
    return total


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
    """Raw orthogonalised Gnanadesikan-Kettenring matrix: (Qn(a + b)^2 - Qn(a - b)^2) / 4."""
    size = len(columns)
    matrix = columns[0].new_zeros(columns[0].shape[1], size, size)
    matrix.diagonal(dim1=-2, dim2=-1).fill_(1.0)
    for i in range(size):
        for j in range(i + 1, size):
            total = _scale(sorted_points(columns[i] + columns[j]))
            rest = _scale(sorted_points(columns[i] - columns[j]))
            matrix[:, i, j] = matrix[:, j, i] = (total * total - rest * rest) / 4
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


def _normal_scores(count: int, like: Tensor) -> Tensor:
    return torch.tensor(_score_table(count), dtype=like.dtype, device=like.device)


def _tanh(values: Tensor) -> Tensor:
    """Hyperbolic tangent, the same for a value wherever it stands; torch's on a CPU is not."""
    if values.device.type == "cpu":
        return torch.from_numpy(np.tanh(values.numpy()))
    return values.tanh()
