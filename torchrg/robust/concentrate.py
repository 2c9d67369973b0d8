"""Concentration steps: from a set of points to one whose scatter has a smaller determinant."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.robust.lanes import smallest_points, sum_points, take_lanes
from torchrg.robust.scatter import determinant, fit_ellipsoid, sq_distances

MAX_STEPS = 100
_MAX_COMPARED = 16


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
    leave the batch.

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
    points = [column.repeat(1, num_starts) for column in columns]
    floors = floor.repeat(num_starts)
    members = initial.reshape(num_points, -1)
    ellipsoid = fit_ellipsoid(points, members, initial_size, floors)
    members = smallest_points(sq_distances(ellipsoid, initial_size - 1), size)
    final = torch.empty_like(members)
    best = torch.full_like(floors, torch.inf, dtype=torch.float64)
    places, previous = torch.arange(len(floors), device=floor.device), best
    for step in range(max_steps + 1):
        ellipsoid = fit_ellipsoid(points, members, size, floors)
        value = determinant(ellipsoid, size - 1)
        candidate = smallest_points(sq_distances(ellipsoid, size - 1), size)
        # Rounding may let the determinant grow, or two sets of tied points follow each other.
        settled = (sum_points(candidate * members) >= size) | ~(value < previous)
        if step == 0:
            repeats = _repeats(ellipsoid.means, value, num_starts, num_lanes)
            value = torch.where(repeats, torch.inf, value)
            settled |= repeats
        if step == max_steps:
            settled |= True
        done, moving = torch.nonzero(settled).squeeze(1), torch.nonzero(~settled).squeeze(1)
        final.index_copy_(1, places[done], members.index_select(1, done))
        best[places[done]] = value[done]
        if len(moving) == 0:
            break
        points, members = take_lanes(points, moving), candidate.index_select(1, moving)
        floors, places, previous = floors[moving], places[moving], value[moving]
    shape = (num_starts, num_lanes)
    return Concentrated(final.reshape(num_points, *shape), best.reshape(shape), size)


def _repeats(means: list[Tensor], value: Tensor, num_starts: int, num_lanes: int) -> Tensor:
    """Starts whose set has exactly the determinant and the mean of an earlier start's set."""
    keys = torch.stack([value, *(mean.double() for mean in means)]).reshape(
        -1, num_starts, num_lanes
    )
    repeats = torch.zeros(num_starts, num_lanes, dtype=torch.bool, device=value.device)
    if num_starts > _MAX_COMPARED:
        return repeats.reshape(-1)
    for start in range(1, num_starts):
        same = (keys[:, :start] == keys[:, start : start + 1]).all(dim=0)
        repeats[start] = same.any(dim=0)
    return repeats.reshape(-1)
