"""Hypotheses at a broken point: the voted plane, two meeting planes, and three."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import ROWS_IN_CACHE, limit_rows, rows_at_once, split_rows
from torchrg.linalg.angles import above, at_most
from torchrg.linalg.moments import (
    Columns,
    fit_planes_to_each,
    fit_weighted_planes,
    project,
    residuals,
    sq_lengths,
    sum_neighbors,
)
from torchrg.linalg.precision import rounded_sqrt
from torchrg.normals.consensus import constants

_PLANE_PARAMETERS = 3


def candidate_ranks(num_neighbors: int) -> Tensor:
    """Return the ranks ``(P, 2)`` of the neighbors that span candidates with the point.

    They are spread over all neighbors, near ones more often.
    """
    last, num_pairs = num_neighbors - 1, constants.NUM_CANDIDATES
    # The plastic number's low-discrepancy sequence covers the square of pairs evenly.
    steps = np.arange(1, 8 * num_pairs)[:, None] * np.array([0.7548776662466927, 0.569840290998])
    ranks = 1 + np.floor(last * (steps % 1.0) ** constants.CANDIDATE_POWER).astype(int)
    pairs = np.sort(ranks[ranks[:, 0] != ranks[:, 1]], axis=1)
    first = np.unique(pairs @ [num_neighbors, 1], return_index=True)[1]
    return torch.from_numpy(pairs[np.sort(first)[:num_pairs]])


def vote_planes(
    columns: Columns, noise: Tensor, start: Tensor, counted: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Find the plane through each point with the most one-sided support of its neighbors.

    Candidates are the plane of normal ``start`` and 32 planes through the point and two neighbors
    of fixed ranks. With residuals ``r_j`` in units of twice the noise and weights ``w_j = 1 - 0.9
    d_j^2 / d_max^2``, the score of a candidate is

    .. math:: \sum_j w_j \max(0, 1 - r_j^2) - \min\big(\sum_{r_j > 1} w_j,\ \sum_{r_j < -1} w_j\big)

    The second term prefers planes with all other points on one side, like every face of an edge, a
    corner and a plate. The best candidate is refitted to the neighbors within reach, first closely,
    then with bisquare weights that use nearly all the points of a face.

    The noise ``(n,)`` is positive, and ``counted`` ``(n, K)`` are weights 0 or 1 of the neighbors,
    in columns relative to each point. Returns unit normals ``(n, 3)`` and offsets ``(n,)`` of the
    planes ``normal . q = offset``.
    """
    sq_distances = sq_lengths(columns)
    farthest = (sq_distances * counted).amax(dim=1, keepdim=True)
    nearness = sq_distances / torch.where(farthest > 0, farthest, 1.0)
    weights = (1 - constants.VOTE_FALLOFF * nearness) * counted
    reach = constants.VOTE_REACH * noise
    ranks = candidate_ranks(sq_distances.shape[1]).to(noise.device)
    normals, offsets = torch.empty_like(start), torch.zeros_like(noise)
    at_once = limit_rows(ROWS_IN_CACHE // (1 + len(ranks)), sq_distances.shape[1])
    for chunk in split_rows(len(noise), rows_at_once(at_once, noise.device)):
        near = columns[0][chunk], columns[1][chunk], columns[2][chunk]
        normals[chunk] = _best_normals(near, weights[chunk], start[chunk], reach[chunk], ranks)
    for _ in range(constants.NUM_REFITS):
        normals, offsets = _refit(columns, weights, normals, offsets, reach)
    weights = (1 - constants.FIT_FALLOFF * nearness) * counted
    reach = constants.FIT_REACH * noise
    for _ in range(constants.NUM_REFITS):
        normals, offsets = _refit(columns, weights, normals, offsets, reach, bisquare=True)
    return normals, offsets


def support_scores(distances: Tensor, weights: Tensor) -> Tensor:
    """Return the scores ``(*, n)`` of planes from residuals ``(*, n, K)`` in units of the reach."""
    support = sum_neighbors((1 - distances * distances).clamp_(min=0).mul_(weights))
    over = sum_neighbors(above(distances, 1).mul_(weights))
    under = sum_neighbors(above(-distances, 1).mul_(weights))
    return support - torch.minimum(over, under)


def _best_normals(
    columns: Columns, weights: Tensor, start: Tensor, reach: Tensor, ranks: Tensor
) -> Tensor:
    """Return the normals of the best planes through the points: ``start``, or by ranks."""
    candidates, spanned = _planes_through(columns, ranks)
    candidates = torch.cat([start[:, None], candidates], dim=1)
    x, y, z = columns
    distances = project((x[:, None], y[:, None], z[:, None]), candidates / reach[:, None, None])
    scores = support_scores(distances, weights[:, None])
    spanned = torch.cat([torch.ones_like(spanned[:, :1]), spanned], dim=1)
    best = torch.where(spanned, scores, -torch.inf).argmax(dim=1, keepdim=True)
    return candidates.gather(1, best[:, :, None].expand(-1, 1, 3)).squeeze(1)


def _refit(
    columns: Columns,
    weights: Tensor,
    normals: Tensor,
    offsets: Tensor,
    reach: Tensor,
    *,
    bisquare: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return planes fitted to the points near planes; unchanged if these points span none."""
    distances = residuals(columns, normals, offsets) / reach[:, None]
    near = (1 - distances * distances).clamp_(min=0)
    if bisquare:
        near *= near
    fitted, shifted, values = fit_weighted_planes(columns, weights * near)
    spread = values[:, 1] > 1e-6 * values[:, 2]  # More than rounding.
    return torch.where(spread[:, None], fitted, normals), torch.where(spread, shifted, offsets)


def _planes_through(columns: Columns, ranks: Tensor) -> tuple[Tensor, Tensor]:
    """Return normals ``(n, P, 3)`` of planes through neighbors, and whether they span a plane."""
    a, b, c = (column.index_select(1, ranks[:, 0]) for column in columns)
    d, e, f = (column.index_select(1, ranks[:, 1]) for column in columns)
    x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
    sq_area = x * x + y * y + z * z
    spanned = sq_area > 0
    length = rounded_sqrt(torch.where(spanned, sq_area, 1.0))
    return torch.stack([x / length, y / length, z / length], dim=-1), spanned


class MeetingPlanes(NamedTuple):
    """The plane of each point among several planes that explain its neighborhood.

    Unit normals ``(n, 3)``, offsets ``(n,)`` of the planes ``normal . q = offset`` relative to the
    point, and the standard deviation over all neighbors ``(n,)``. The latter has three degrees of
    freedom less per plane and is infinite if a plane has fewer than five points.
    """

    normals: Tensor
    offsets: Tensor
    deviations: Tensor


def fit_meeting_planes(
    columns: Columns, normals: Tensor, offsets: Tensor, noise: Tensor
) -> MeetingPlanes:
    """Fit two meeting planes, and three if two do not explain the neighbors.

    Two planes start from one plane of each neighborhood, normal ``(n, 3)`` and offset ``(n,)``.
    Three planes have two starts: the two planes and the points off them; and that one plane with
    the voted planes of its outliers.
    """
    two, of_first, outer = fit_wedges(columns, normals, offsets, noise)
    rows = (two.deviations > constants.CORNER_LIMIT * noise).nonzero().squeeze(-1)
    corners = (columns[0][rows], columns[1][rows], columns[2][rows])
    start = MeetingPlanes(*(values[rows] for values in two))
    limit = constants.CORNER_FRACTION * start.deviations
    best = start._replace(deviations=limit)
    first, third = of_first[rows], _off_surface(outer[rows], noise[rows])
    for groups in (
        (first * (1 - third), (1 - first) * (1 - third), third),
        split_by_votes(corners, normals[rows], offsets[rows], noise[rows]),
    ):
        found = fit_corners(corners, groups)
        less = found.deviations < best.deviations
        best = MeetingPlanes(
            torch.where(less[:, None], found.normals, best.normals),
            torch.where(less, found.offsets, best.offsets),
            torch.where(less, found.deviations, best.deviations),
        )
    improved = best.deviations < limit
    rows = rows[improved]
    merged = [old.index_copy(0, rows, new[improved]) for old, new in zip(two, best, strict=True)]
    return MeetingPlanes(*merged)


def fit_wedges(
    columns: Columns, normals: Tensor, offsets: Tensor, noise: Tensor
) -> tuple[MeetingPlanes, Tensor, Tensor]:
    """Fit the surface of the intersection of two half-spaces to each neighborhood.

    Let ``e_1`` and ``e_2`` be the distances of a point inside the two planes, each towards the side
    with the points of the other plane. The solid between them has the signed distance ``min(e_1,
    e_2)``: each point belongs to the plane with the smaller one (for ridges and valleys, sharp or
    blunt). Planes and sides are fitted alternately, from one plane and the points off it by more
    than twice the noise on its fuller side. The point itself is assigned by the same rule. Unlike
    the nearest of two unbounded planes, this is correct for points that noise has moved out of the
    solid. For arguments see :func:`fit_meeting_planes`. Also returns the points of the first plane,
    weights 0 or 1, and the signed distances of the neighbors to the surface, both ``(n, K)``.
    """
    distances = residuals(columns, normals, offsets)
    second, first = _off_surface(distances, noise), _near(distances, noise)
    present = torch.ones_like(noise, dtype=torch.bool)
    for _ in range(constants.NUM_ALTERNATIONS):
        present = present & _all_present((first, second))
        planes = fit_planes_to_each(columns, (first, second))
        one, other = (residuals(columns, *plane) for plane in planes)
        inside = _inside(one, second), _inside(other, first)
        first = above(inside[1], inside[0])
        second, outer = 1 - first, torch.minimum(*inside)
    return _summary(planes, (first, second), outer, present), first, outer


def fit_corners(columns: Columns, groups: Sequence[Tensor]) -> MeetingPlanes:
    """Fit three half-spaces, from an initial assignment of points ``(n, K)``, 0 or 1.

    These are corners of three faces, rims of plates with both faces among the neighbors, steps and
    reveals. The first two planes are a wedge, see :func:`fit_wedges`. If the third group begins
    inside the wedge, its half-space cuts it, ``min(e_1, e_2, e_3)``. Otherwise it is added,
    ``max(min(e_1, e_2), -e_3)``. Here ``e_3`` is positive on the side of the first two groups.
    """
    first, second, third = groups
    present = torch.ones_like(first[:, 0], dtype=torch.bool)
    # 1 if the third plane cuts the wedge, -1 if it is added, 0 if undetermined.
    side = torch.zeros_like(columns[0][:, 0])
    for _ in range(constants.NUM_ALTERNATIONS):
        present = present & _all_present((first, second, third))
        planes = fit_planes_to_each(columns, (first, second, third))
        distances = [residuals(columns, *plane) for plane in planes]
        inside = _inside(distances[0], second), _inside(distances[1], first)
        wedge, added = torch.minimum(*inside), _inside(distances[2], first + second)
        side = torch.where(side == 0, _side(sum_neighbors(wedge * third)).squeeze(1), side)
        wedge *= side[:, None]
        outer = torch.minimum(added, wedge) * side[:, None]
        third = above(wedge, added)
        first = above(inside[1], inside[0]).mul_(1 - third)
        second = 1 - third - first
    return _summary(planes, (first, second, third), outer, present)


def split_by_votes(
    columns: Columns, normals: Tensor, offsets: Tensor, noise: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return points near a plane, near the voted plane of the remaining ones, and outliers.

    The voted plane passes through the nearest of the remaining points.
    """
    first = _near(residuals(columns, normals, offsets), noise)
    remaining = 1 - first
    anchor = remaining.argmax(dim=1, keepdim=True)
    shifted = tuple(column - column.gather(1, anchor) for column in columns)
    about: Columns = (shifted[0], shifted[1], shifted[2])
    plane = vote_planes(about, noise, fit_weighted_planes(about, remaining)[0], remaining)
    second = _near(residuals(about, *plane), noise) * remaining
    return first, second, remaining - second


def _near(distances: Tensor, noise: Tensor) -> Tensor:
    """Return a mask of points within twice the noise of a plane, as 0 or 1."""
    return at_most(distances.abs(), (constants.MEETING_GAP * noise)[:, None])


def _off_surface(distances: Tensor, noise: Tensor) -> Tensor:
    """Return the points off a surface by more than twice the noise, on the side with more."""
    gap = constants.MEETING_GAP * noise[:, None]
    over, under = above(distances, gap), above(-distances, gap)
    more = at_most(under.sum(dim=1), over.sum(dim=1))[:, None]
    return over.mul_(more).add_(under.mul_(1 - more))


def _inside(distances: Tensor, others: Tensor) -> Tensor:
    """Return distances to a plane, positive on the side of ``others``."""
    return distances * _side(sum_neighbors(distances * others))


def _side(totals: Tensor) -> Tensor:
    """Return 1 or, for a negative total, -1, shape ``(n, 1)``."""
    return torch.where(totals >= 0, 1.0, -1.0).to(totals.dtype)[:, None]


def _all_present(groups: Sequence[Tensor]) -> Tensor:
    """Return whether every group has enough points for a plane."""
    smallest = torch.stack([group.sum(dim=1) for group in groups]).amin(dim=0)
    return smallest >= constants.MIN_PLANE_POINTS


def _summary(
    planes: Sequence[tuple[Tensor, Tensor]],
    groups: Sequence[Tensor],
    outer: Tensor,
    present: Tensor,
) -> MeetingPlanes:
    """Return the plane of each point's group, and the deviation from all planes."""
    normals, offsets = planes[0]
    for (normal, offset), group in zip(planes[1:], groups[1:], strict=True):
        has_group = group[:, 0] > 0
        normals = torch.where(has_group[:, None], normal, normals)
        offsets = torch.where(has_group, offset, offsets)
    freedom = max(outer.shape[1] - _PLANE_PARAMETERS * len(planes), 1)
    deviations = rounded_sqrt(sum_neighbors(outer * outer) / freedom)
    deviations = torch.where(present & _all_present(groups), deviations, torch.inf)
    return MeetingPlanes(normals, offsets, deviations)
