"""Concentration steps: from a set of points to one whose scatter has a smaller determinant."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._chunks import chunks_of
from torchrg.robust.lanes import smallest_points, sum_points, take_lanes
from torchrg.robust.scatter import determinant, fit_ellipsoid, sq_distances

MAX_STEPS = 100
_MAX_COMPARED = 16
_DIGITS = 24
"""Points whose membership one number holds exactly, as a binary digit each."""


class Concentrated(NamedTuple):
    """The sets that concentration ended with.

    Attributes:
        members: 1 for a point in the set, 0 for another, shape ``(K, S, M)``.
        determinants: Of their scatter over h - 1, shape ``(S, M)``, float64; inf for a start that
            repeats an earlier one of its lane.
        size: h, the number of points in each set.
    """

    members: Tensor
    determinants: Tensor
    size: int


def concentrate(
    columns: list[Tensor],
    initial: Tensor,
    initial_size: int,
    size: int,
    floor: Tensor,
    max_steps: int = MAX_STEPS,
) -> Concentrated:
    """Iterate concentration steps from each start of each lane until the set stays the same.

    A step takes mean and scatter of the set and keeps the ``size`` points nearest to them; the
    determinant never grows (Rousseeuw and Van Driessen 1999, theorem 1). Starts that have arrived
    leave the batch, and so do those whose set another one has.

    Args:
        columns: P coordinates of shape ``(K, M)``.
        initial: 1 for a point in the initial set, 0 for another, shape ``(K, S, M)``.
        initial_size: Number of points in each initial set.
        size: h, the number of points to keep.
        floor: Least variance in any direction, shape ``(M,)``.
        max_steps: Steps after the first; fewer for a quick look at many starts.

    Returns:
        The final sets and their determinants.
    """
    num_points, num_starts, num_lanes = initial.shape
    shape = (num_starts, num_lanes)
    members = initial.reshape(num_points, -1)
    final = torch.zeros_like(members)
    best = torch.full_like(floor, torch.inf, dtype=torch.float64).repeat(num_starts)
    places = torch.arange(num_starts * num_lanes, device=floor.device)
    distinct = _first_of_equal(members, places, shape)
    places, members = places[distinct], members.index_select(1, distinct)
    points, floors = take_lanes(columns, places % num_lanes), floor[places % num_lanes]
    ellipsoid = fit_ellipsoid(points, members, initial_size, floors)
    members = smallest_points(sq_distances(ellipsoid, initial_size - 1), size)
    moving, previous = _first_of_equal(members, places, shape), best[places]
    for step in range(max_steps + 1):
        points, members = take_lanes(points, moving), members.index_select(1, moving)
        floors, places, previous = floors[moving], places[moving], previous[moving]
        ellipsoid = fit_ellipsoid(points, members, size, floors)
        value = determinant(ellipsoid, size - 1)
        candidate = smallest_points(sq_distances(ellipsoid, size - 1), size)
        # Rounding may let the determinant grow, or two sets of tied points follow each other.
        settled = (sum_points(candidate * members) >= size) | ~(value < previous)
        settled |= step == max_steps
        done, moving = torch.nonzero(settled).squeeze(1), torch.nonzero(~settled).squeeze(1)
        final.index_copy_(1, places[done], members.index_select(1, done))
        best[places[done]] = value[done]
        if len(moving) == 0:
            break
        members, previous = candidate, value
    return Concentrated(final.reshape(num_points, *shape), best.reshape(shape), size)


def _first_of_equal(members: Tensor, places: Tensor, shape: tuple[int, int]) -> Tensor:
    """Choose of equal sets of one lane the first.

    Args:
        members: Sets, 1 for a point in it and 0 for another, shape ``(K, n)``.
        places: Where each is among starts and lanes, shape ``(n,)``.
        shape: Number of starts and of lanes.

    Returns:
        The chosen of the n sets, ascending.
    """
    num_starts, num_lanes = shape
    if not 1 < num_starts <= _MAX_COMPARED:
        return torch.arange(len(places), device=places.device)
    digits = 2.0 ** (torch.arange(len(members), device=members.device) % _DIGITS)
    weighted = members * digits.to(members.dtype)[:, None]
    parts = [sum_points(weighted[chunk]) for chunk in chunks_of(len(members), _DIGITS)]
    numbers = members.new_zeros(len(parts), num_starts * num_lanes)
    numbers[:, places] = torch.stack(parts)
    numbers = numbers.reshape(-1, num_starts, num_lanes)
    first = torch.ones(shape, dtype=torch.bool, device=members.device)
    for start in range(1, num_starts):
        same = (numbers[:, :start] == numbers[:, start : start + 1]).all(dim=0)
        first[start] = ~same.any(dim=0)
    return torch.nonzero(first.reshape(-1)[places]).squeeze(1)
