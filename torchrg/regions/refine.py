"""Regions after growth: faces told apart and merged, and points at borders where they belong."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, chunks_of, map_chunks, places_of
from torchrg.config import GrowingConfig
from torchrg.linalg import deg_to_sq_chord, sq_chords, unsigned_angle_deg
from torchrg.linalg.moments import Segments
from torchrg.regions.adjacency import contact_neighbors, count_contacts
from torchrg.regions.edges import GrowingCloud
from torchrg.regions.faces import merge_coplanar
from torchrg.regions.planes import LEAST_FITTED, FittedPlanes, fit_regions
from torchrg.structures import UNLABELED, Neighbors

_AGREE = 0.3
"""Share of the largest angle. Regions too small before absorption whose normals are off by less,
root mean square, are faces: of a small one half is border. Without this a cluttered office has 490
regions instead of 306."""

_MAX_PASSES = 10
"""Times. Points that moved are neighbours of the next: narrow strips fill from their ends."""

_ROUNDING = 0.01
"""Thicknesses. Smaller distances decide nothing."""

_PARALLEL_DEG = 15.0
"""At a smaller angle the line in which two planes cross may be far from where the faces end."""

_ONE_SIDED = 0.5
"""A face ends at another plane if the mean distance of its points from that, with signs, is this
share of the mean without; of a face that goes on behind the plane it is near 0."""


def refine_regions(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> Tensor:
    """Apply the steps after growth that the settings ask for to a cloud in canonical order.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`; so are the regions returned,
    perhaps with gaps in their numbers.
    """
    if not bool((labels >= 0).any()):
        return labels
    if config.max_plane_residual is not None:
        planes = fit_regions(cloud, labels, config)
        limit, region = config.max_plane_residual * planes.thickness, labels.clamp(min=0)
        far = planes.distances(cloud.points, region) > limit[region]
        labels = torch.where(far, UNLABELED, labels)
    if config.absorb:
        planes = fit_regions(cloud, labels, config)
        fit = planes.fit
        labels = _drop_doubtful(cloud, labels, fit.normal, config)
        labels = absorb_points(
            cloud.points,
            cloud.normals,
            labels,
            cloud.neighbors,
            (fit.normal, fit.center, reach_of_planes(fit, planes.floor, config.absorb_reach)),
            valid=cloud.valid,
            max_angle_deg=config.absorb_angle_deg,
        )
        labels = _drop_small(labels, config.min_size)
    if config.merge_coplanar:
        planes = fit_regions(cloud, labels, config)
        labels = merge_coplanar(
            labels,
            count_contacts(labels, cloud.neighbors),
            planes.fit,
            planes.floor,
            planes.noise,
            tolerance=config.merge_tolerance,
        )
    if config.settle_rims:
        labels = _drop_small(labels, 1)
        planes = fit_regions(cloud, labels, config)
        fit = planes.fit
        reach = reach_of_planes(fit, planes.floor, config.absorb_reach)
        # Where a bent face ends its plane does not say.
        vague = planes.bent | (fit.num_points < LEAST_FITTED)
        reach = torch.where(vague, torch.nan, reach)
        rims = RimPlanes(fit.normal, fit.center, planes.thickness, reach)
        labels = settle_rims(cloud, labels, rims)
    return labels


def _drop_doubtful(
    cloud: GrowingCloud, labels: Tensor, normal: Tensor, config: GrowingConfig
) -> Tensor:
    """Return labels without regions that are too small and whose normals do not agree.

    Those that agree may be large enough with the points at their borders. Numbers have gaps then.
    """
    small = torch.bincount(labels + 1, minlength=1)[1:] < config.min_size
    small = torch.cat([small, small.new_zeros(1)])
    segments = Segments(torch.where(small[labels], labels, UNLABELED))
    own, theirs = segments.take_columns(cloud.normals), segments.spread_columns(normal)
    turn = sq_chords(own, theirs)
    agrees = segments.mean(turn) <= deg_to_sq_chord(_AGREE * config.max_angle_deg)
    doubtful = segments.rows[~segments.spread(agrees)]
    return labels.index_fill(0, doubtful, UNLABELED)


def _drop_small(labels: Tensor, min_size: int) -> Tensor:
    """Return labels without regions of fewer points, and without gaps in their numbers."""
    kept = torch.bincount(labels + 1, minlength=1)[1:] >= max(min_size, 1)
    numbers = torch.where(kept, kept.cumsum(0) - 1, UNLABELED)
    return torch.cat([numbers, numbers.new_tensor([UNLABELED])])[labels]


def reach_of_planes(fit: FittedPlanes, floor: Tensor, factor: float) -> Tensor:
    """Return how far from its plane a point may join a region: NaN, not at all, if it is curved.

    ``factor`` times its thickness, which is at least ``floor``, shape ``(M,)``.
    """
    return torch.where(fit.curved, torch.nan, factor * torch.maximum(fit.thickness, floor))


def absorb_points(
    points: Tensor,
    normals: Tensor,
    labels: Tensor,
    neighbors: Neighbors,
    planes: tuple[Tensor, Tensor, Tensor],
    *,
    valid: Tensor,
    max_angle_deg: float,
) -> Tensor:
    """Give points without a region to regions they touch, until none can be given.

    A point may join a region when one of its 8 nearest neighbours belongs to it, its distance to
    the region's plane is within reach, and its normal is within the angle of the plane's. Of
    several regions it joins the one whose plane is nearest. Points that joined are neighbours of
    the next.

    ``planes`` are unit normal ``(M, 3)``, a point ``(M, 3)`` and the reach ``(M,)`` of each region,
    in float64; reach 0 keeps all but the points exactly on the plane out, NaN all. ``valid`` tells
    which points may join.
    """
    normal, center, reach = planes
    labels = labels.clone()
    nearest, counted = contact_neighbors(neighbors)
    limit = deg_to_sq_chord(max_angle_deg)
    waiting = ((labels == UNLABELED) & valid).nonzero().squeeze(1)
    new = labels != UNLABELED
    while len(waiting):
        # What did not fit does not fit later: only new neighbours may change it.
        rows = waiting[(new[nearest[waiting]] & counted[waiting]).any(dim=1)]
        if len(rows) == 0:
            break
        near = torch.where(counted[rows], labels[nearest[rows]], UNLABELED)
        region = near.clamp(min=0)
        away = points[rows].double()[:, None] - center[region]
        distance = (away * normal[region]).sum(dim=2).abs()
        own = normals[rows].double()[:, :, None].unbind(dim=1)
        fits = (near >= 0) & (distance <= reach[region])
        fits &= sq_chords(own, normal[region].unbind(dim=2)) <= limit
        distance = torch.where(fits, distance, torch.inf)
        least = distance.amin(dim=1, keepdim=True)
        joined = least.squeeze(1).isfinite()
        choice = torch.where(distance == least, near, len(normal)).amin(dim=1)
        rows = rows[joined]
        labels[rows] = choice[joined]
        new = torch.zeros_like(new).index_fill_(0, rows, True)
        waiting = waiting[labels[waiting] == UNLABELED]
    return labels


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
    and their neighbours are decided again in the next pass.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`; so are those returned.
    """
    nearest, counted = contact_neighbors(cloud.neighbors)
    flat = torch.cat([planes.reach.isfinite(), planes.reach.new_ones(1, dtype=torch.bool)])
    labels = labels.clone()
    rows = _touching(labels, nearest, counted)
    for _ in range(_MAX_PASSES):
        rows = rows[cloud.valid[rows] & flat[labels[rows]]]
        near = torch.where(counted[rows], labels[nearest[rows]], UNLABELED)
        chosen = labels[rows]

        def work(
            block: slice, rows: Tensor = rows, near: Tensor = near, chosen: Tensor = chosen
        ) -> None:
            chosen[block] = _choose(cloud, labels, planes, rows[block], near[block])

        map_chunks(work, len(rows), ROWS_IN_CACHE, labels.device)
        moved = chosen != labels[rows]
        if not bool(moved.any()):
            break
        rows = rows[moved]
        labels[rows] = chosen[moved]
        rows = torch.unique(torch.cat([rows, nearest[rows][counted[rows]]]))
    return labels


def _touching(labels: Tensor, nearest: Tensor, counted: Tensor) -> Tensor:
    """Return the points that have one of another region among their nearest neighbours."""
    # Narrow numbers are gathered three times as fast.
    narrow = labels.to(torch.int32)
    found = []
    for some in chunks_of(len(labels), ROWS_AT_ONCE):
        near = narrow.index_select(0, nearest[some].reshape(-1)).view(nearest[some].shape)
        touches = (near != narrow[some, None]) & (near >= 0) & counted[some]
        found.append(some.start + places_of(touches.any(dim=1)))
    return torch.cat(found)


def _choose(
    cloud: GrowingCloud, labels: Tensor, planes: RimPlanes, rows: Tensor, near: Tensor
) -> Tensor:
    """Return the region of some points, of labels ``near`` ``(n, 8)`` and their own."""
    own, place = labels[rows], cloud.points[rows].double()
    options = torch.cat([own[:, None], near], dim=1)
    known = options.clamp(min=0)
    distance = planes.distances(place, known).abs()
    usable = (options >= 0) & (distance <= planes.reach[known])
    cost = (distance / planes.thickness[known]).square() + _ROUNDING**2 * (options != own[:, None])
    cost = torch.where(usable, cost, torch.inf)
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
    rounding = _ROUNDING * planes.thickness[own] * inside.sum(dim=1)
    one_sided = total.abs() > (_ONE_SIDED * away.abs().sum(dim=1)).clamp(min=rounding)
    foot = place - planes.distances(place, own[:, None]) * planes.normal[own]
    over = -total.sign() * planes.distances(foot, other[:, None]).squeeze(1)
    return torch.where(one_sided, over.clamp(min=0), 0.0)
