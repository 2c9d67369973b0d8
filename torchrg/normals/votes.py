"""The plane through a point that most of its neighbours vote for."""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchrg._chunks import chunks_of
from torchrg.linalg import above
from torchrg.normals.columns import Columns, along, fit_planes, residuals, sq_lengths

_NUM_PAIRS = 32
_THINNEST_TRIANGLE = 0.1
_VOTE_TOLERANCE = 2.0
_FIT_TOLERANCE = 3.5
_ROWS = 8192
"""Points times candidates that are scored in one step."""


def vote_planes(
    columns: Columns, noise: Tensor, start: Tensor, counted: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Find the plane through each point that the most neighbours support on one side.

    Candidates are the plane of normal ``start`` and 32 planes through the point and two neighbours
    of fixed ranks. With residuals ``r_j`` in units of twice the noise and weights
    ``w_j = 1 - 0.9 d_j^2 / d_max^2``, the score of a candidate is

    .. math:: \sum_j w_j \max(0, 1 - r_j^2) - \min\big(\sum_{r_j > 1} w_j,\ \sum_{r_j < -1} w_j\big)

    The second term prefers planes that have everything else on one side, as every face of an edge,
    of a corner and of a plate has. The best candidate is fitted anew to the neighbours within reach
    of it, first closely, then with the bisquare weights that use nearly all the points of a face.

    Args:
        columns: Coordinates of the neighbours about each point.
        noise: Standard deviation of the noise, shape ``(n,)``, positive.
        start: Normals to try first, shape ``(n, 3)``.
        counted: Weights 0 or 1, shape ``(n, K)``.

    Returns:
        Unit normals ``(n, 3)`` and offsets ``(n,)`` of the planes ``normal . q = offset``.

    Example:
        >>> from torchrg.normals.columns import split_columns
        >>> x, y = torch.arange(-2.0, 3), torch.arange(0.0, 4)
        >>> floor = torch.cartesian_prod(x, y, torch.zeros(1))
        >>> wall = floor[:, [0, 2, 1]]
        >>> corner = torch.cat([floor, wall]).sub_(torch.tensor([0.0, 1.0, 0.0]))[None]
        >>> up = torch.tensor([[0.0, 0.7071, 0.7071]])
        >>> columns, noise = split_columns(corner), torch.tensor([0.01])
        >>> vote_planes(columns, noise, up, torch.ones(1, 40))[0].abs()
        tensor([[0., 0., 1.]])
    """
    sq_distances = sq_lengths(columns)
    farthest = (sq_distances * counted).amax(dim=1, keepdim=True)
    nearness = sq_distances / torch.where(farthest > 0, farthest, 1.0)
    weights = (1 - 0.9 * nearness) * counted
    reach = _VOTE_TOLERANCE * noise
    best, normals = _score(columns, weights, start, reach), start
    candidates, broad = _planes_through(columns, _pairs(sq_distances.shape[1]))
    # Few points are scored for several candidates in one step.
    for some in chunks_of(len(candidates), max(1, _ROWS // max(len(noise), 1))):
        scores = _score(columns, weights, candidates[some], reach)
        scores = torch.where(broad[some], scores, -torch.inf)
        for candidate, score in zip(candidates[some], scores, strict=True):
            better = score > best
            best = torch.where(better, score, best)
            normals = torch.where(better[:, None], candidate, normals)
    offsets = torch.zeros_like(noise)
    for _ in range(2):
        near = _within(residuals(columns, normals, offsets), reach)
        normals, offsets = _refit(columns, weights * near, normals, offsets)
    weights = (1 - 0.5 * nearness) * counted
    for _ in range(2):
        near = _within(residuals(columns, normals, offsets), _FIT_TOLERANCE * noise).square_()
        normals, offsets = _refit(columns, weights * near, normals, offsets)
    return normals, offsets


def support_scores(rests: Tensor, weights: Tensor) -> Tensor:
    """Return the score of planes by their residuals in units of the reach.

    Args:
        rests: Residuals, shape ``(*, n, K)``.
        weights: Weights, shape ``(n, K)``.

    Returns:
        Shape ``(*, n)``.
    """
    support = (1 - rests * rests).clamp_(min=0).mul_(weights).sum(dim=-1)
    over = above(rests, 1).mul_(weights).sum(dim=-1)
    under = above(-rests, 1).mul_(weights).sum(dim=-1)
    return support - torch.minimum(over, under)


def _score(columns: Columns, weights: Tensor, normals: Tensor, reach: Tensor) -> Tensor:
    """Return the score of planes through the points."""
    scaled = normals / reach[:, None]
    return support_scores(along(columns, scaled), weights)


def _within(rests: Tensor, reach: Tensor) -> Tensor:
    """Return ``max(0, 1 - (r / reach)^2)``."""
    rests = rests / reach[:, None]
    return (1 - rests * rests).clamp_(min=0)


def _refit(
    columns: Columns, weights: Tensor, normals: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor]:
    """Return fitted planes; the given ones where the weighted points span none."""
    fitted, moved, values = fit_planes(columns, weights)
    spread = values[:, 1] > 1e-6 * values[:, 2]
    return (
        torch.where(spread[:, None], fitted, normals),
        torch.where(spread, moved, offsets),
    )


def _planes_through(columns: Columns, pairs: tuple[tuple[int, int], ...]) -> tuple[Tensor, Tensor]:
    """Return planes through the points and two neighbours, and whether the triangles are broad.

    Args:
        columns: Coordinates of the neighbours about each point.
        pairs: Ranks of the two neighbours.

    Returns:
        Unit normals ``(P, n, 3)`` and flags ``(P, n)``.
    """
    ranks = torch.tensor(pairs, dtype=torch.int64, device=columns[0].device).view(-1, 2)
    by_rank = [column.t() for column in columns]
    a, b, c = (column.index_select(0, ranks[:, 0]) for column in by_rank)
    d, e, f = (column.index_select(0, ranks[:, 1]) for column in by_rank)
    x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
    sq_area = x * x + y * y + z * z
    sq_sides = (a * a + b * b + c * c) * (d * d + e * e + f * f)
    broad = sq_area > _THINNEST_TRIANGLE**2 * sq_sides
    length = torch.where(broad, sq_area, 1.0).sqrt_()
    return torch.stack([x / length, y / length, z / length], dim=-1), broad


@cache
def _pairs(num_neighbors: int) -> tuple[tuple[int, int], ...]:
    """Return pairs of ranks: spread over all neighbours, the near ones more often."""
    last = num_neighbors - 1
    if last < 2:
        return ()
    # The plastic number's low-discrepancy sequence covers the square of pairs evenly.
    steps = np.arange(1, 8 * _NUM_PAIRS)[:, None] * np.array([0.7548776662466927, 0.569840290998])
    ranks = 1 + np.floor(last * (steps % 1.0) ** 1.5).astype(int)
    pairs = dict.fromkeys((min(a, b), max(a, b)) for a, b in ranks.tolist() if a != b)
    return tuple(pairs)[:_NUM_PAIRS]
