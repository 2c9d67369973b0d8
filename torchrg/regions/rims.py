"""Where faces end: points within the noise of two planes go by the line in which these meet."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import ROWS_IN_CACHE, map_chunks
from torchrg.linalg import unsigned_angle_deg
from torchrg.regions.adjacency import contact_neighbors
from torchrg.regions.criteria import GrowingCloud
from torchrg.structures import UNLABELED

_MAX_PASSES = 10
"""Times. Points that moved are neighbours of the next: narrow strips fill from their ends."""

_PARALLEL_DEG = 15.0
"""At a smaller angle the line in which two planes cross may be far from where the faces end."""

_ONE_SIDED = 0.5
"""A face ends at another plane if the mean distance of its points from that, with signs, is this
share of the mean without; of a face that goes on behind the plane it is near 0."""


class RimPlanes(NamedTuple):
    """The planes of M regions, in float64.

    Attributes:
        normal: Unit normals, shape ``(M, 3)``.
        center: A point of each, shape ``(M, 3)``.
        thickness: Standard deviation of the points from the plane, positive, shape ``(M,)``.
        reach: Distance up to which points may be on it, NaN for regions that are not flat and keep
            what they have, shape ``(M,)``.
    """

    normal: Tensor
    center: Tensor
    thickness: Tensor
    reach: Tensor

    def distances(self, points: Tensor, regions: Tensor) -> Tensor:
        """Return signed distances of points ``(n, 3)`` from planes of regions ``(n, C)``."""
        away = points[:, None] - self.center[regions]
        return (away * self.normal[regions]).sum(dim=2)


def settle_rims(cloud: GrowingCloud, labels: Tensor, planes: RimPlanes) -> Tensor:
    r"""Give points where regions touch to the one that explains them best.

    Of the flat regions of a point's 8 nearest neighbours and its own, the two with the nearest
    planes, by their thickness, count if they are within reach. With the distances :math:`r` from a
    plane and :math:`e` of the point's foot on it beyond the line in which it meets the other plane,
    the point joins the region of the smaller :math:`r^2 + e^2`: noise moves points off their plane,
    not along it. A region ends at the other plane where its points among the point's neighbours are
    on one side of that. Points of nearly parallel planes stay where they are. Points that moved
    count for their neighbours in the next pass.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`; so are those returned.
    """
    nearest, counted = contact_neighbors(cloud.neighbors)
    open_ = torch.cat([planes.reach.isfinite(), planes.reach.new_ones(1, dtype=torch.bool)])
    active = cloud.valid
    for _ in range(_MAX_PASSES):
        before = labels
        rows = (active & open_[before]).nonzero().squeeze(1)
        near = torch.where(counted[rows], before[nearest[rows]], UNLABELED)
        touches = ((near != before[rows, None]) & (near >= 0)).any(dim=1)
        rows, near = rows[touches], near[touches]
        chosen = before[rows]

        def work(
            block: slice,
            rows: Tensor = rows,
            near: Tensor = near,
            before: Tensor = before,
            chosen: Tensor = chosen,
        ) -> None:
            chosen[block] = _choose(cloud, before, planes, rows[block], near[block])

        map_chunks(work, len(rows), ROWS_IN_CACHE, labels.device)
        moved = torch.zeros_like(active)
        moved[rows] = chosen != before[rows]
        if not bool(moved.any()):
            break
        labels = before.index_copy(0, rows, chosen)
        active = cloud.valid & (moved[nearest] & counted).any(dim=1)
    return labels


def _choose(
    cloud: GrowingCloud, labels: Tensor, planes: RimPlanes, rows: Tensor, near: Tensor
) -> Tensor:
    """Return the region of some points, of labels ``near`` ``(n, 8)`` and their own."""
    own, place = labels[rows], cloud.points[rows].double()
    options = torch.cat([own[:, None], near], dim=1)
    known = options.clamp(min=0)
    distance = planes.distances(place, known).abs()
    usable = (options >= 0) & (distance <= planes.reach[known])
    cost = torch.where(usable, (distance / planes.thickness[known]).square(), torch.inf)
    first, first_cost = _least(cost, options)
    second, second_cost = _least(torch.where(options == first[:, None], torch.inf, cost), options)
    # A region that the point is far from is growth's choice.
    kept = ((own >= 0) & ~usable[:, 0]) | first_cost.isinf()
    choice = torch.where(kept, own, first)

    both = (second_cost.isfinite() & ~kept).nonzero().squeeze(1)
    first, second, place = first[both], second[both], place[both]
    scale = torch.maximum(planes.thickness[first], planes.thickness[second])
    beyond = (
        (_beyond(cloud, labels, planes, rows[both], place, *pair) / scale).square()
        for pair in ((first, second), (second, first))
    )
    first_cost, second_cost = first_cost[both] + next(beyond), second_cost[both] + next(beyond)
    better = torch.where(second_cost < first_cost, second, first)
    angle = unsigned_angle_deg(planes.normal[first], planes.normal[second])
    stays = (angle <= _PARALLEL_DEG) & (own[both] >= 0)
    choice[both] = torch.where(stays, own[both], better)
    return choice


def _least(cost: Tensor, options: Tensor) -> tuple[Tensor, Tensor]:
    """Return the option ``(n,)`` of the least cost, of equal ones the smallest, and its cost."""
    least = cost.amin(dim=1, keepdim=True)
    ranked = torch.where(cost == least, options, torch.iinfo(options.dtype).max)
    return ranked.amin(dim=1), least.squeeze(1)


def _beyond(
    cloud: GrowingCloud,
    labels: Tensor,
    planes: RimPlanes,
    rows: Tensor,
    place: Tensor,
    own: Tensor,
    other: Tensor,
) -> Tensor:
    """Return how far beyond another plane the feet of points on their own are, where that ends."""
    indices, counted = cloud.neighbors
    indices = indices[rows].long()
    inside = labels[indices] == own[:, None]
    if counted is not None:
        inside &= counted[rows]
    away = torch.zeros_like(inside, dtype=torch.float64)
    columns = (cloud.points, planes.center[other], planes.normal[other])
    for x, start, part in zip(*(values.unbind(dim=1) for values in columns), strict=True):
        away += (x[indices].double() - start[:, None]) * part[:, None]
    away *= inside
    total = away.sum(dim=1)
    one_sided = total.abs() > _ONE_SIDED * away.abs().sum(dim=1)
    foot = place - planes.distances(place, own[:, None]) * planes.normal[own]
    over = -total.sign() * planes.distances(foot, other[:, None]).squeeze(1)
    return torch.where(one_sided, over.clamp(min=0), 0.0)
