"""Regions after growth: points at borders go where they belong, parts of one face are merged."""

import heapq
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, chunks_of, map_chunks, places_of
from torchrg.config import GrowingConfig
from torchrg.linalg import deg_to_sq_chord, eigh3_of_few, sq_chords, unsigned_angle_deg
from torchrg.linalg.moments import Segments
from torchrg.regions.adjacency import (
    MIN_CONTACTS,
    PARALLEL_DEG,
    NearestPoints,
    find_contacts,
)
from torchrg.regions.edges import GrowingCloud
from torchrg.regions.fit import MIN_FITTED, RegionFits, RegionPlanes
from torchrg.structures import UNLABELED, Neighbors

_AGREE = 0.3
"""Share of the largest angle. Regions too small before absorption whose normals are off by less,
root mean square, are faces: of a small one half is border. Others would
make many regions of clutter."""

_MAX_PASSES = 10
"""Passes over the borders at most. Points that moved lead to the next: narrow strips fill from
their ends."""

_ROUNDING = 0.01
"""Distances of less than this many thicknesses decide nothing."""

_MIN_STEP = 1.5
"""Parallel planes this many thicknesses apart are two levels, not pieces of one face."""

_LEVEL_REACH = 3.0
"""Thicknesses of the nearer plane beyond which a point is on neither level."""

_ONE_SIDED = 0.5
"""A face ends at another plane if the mean distance of its points from that, with signs, is this
share of the mean without; of a face that goes on behind the plane it is near 0."""


_FACET_TURN_DEG = 25.0
"""The plane through two facets of a flat face is not turned by more against either of them. Those
of ten points are turned most; the sides of a thin board are turned by 90."""

_FACET_TILT = 2 / 3
"""Largest root mean square distance, in tolerances, that the turn alone gives the points of a
facet. Without it a plane across the step between two shelves, 5 cm, explains both."""


class Beside(Protocol):
    """Who is beside whom: nearest points (:mod:`torchrg.regions.adjacency`), or pixels."""

    def around(self, rows: Tensor) -> Tensor:
        """Return the points beside some ``(n,)``, shape ``(n, 8)``."""

    def reached(self, waiting: Tensor, new: Tensor) -> Tensor:
        """Return those of the rows that have a new one beside them."""


def refine_regions(
    cloud: GrowingCloud, labels: Tensor, config: GrowingConfig, fits: RegionFits | None = None
) -> Tensor:
    """Apply the steps after growth that the settings ask for to a cloud in canonical order.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`; so are the regions returned,
    perhaps with gaps in their numbers. ``fits`` may know the planes of these labels already.
    """
    if not bool((labels >= 0).any()):
        return labels
    fits, beside = fits or RegionFits(cloud, config), NearestPoints(cloud.neighbors)
    if config.max_plane_residual is not None:
        planes = fits.of(labels)
        limit, region = config.max_plane_residual * planes.thickness, labels.clamp(min=0)
        far = planes.distances(cloud.points, region) > limit[region]
        labels = torch.where(far, UNLABELED, labels)
    if config.absorb:
        planes = fits.of(labels)
        labels = absorb_points(
            cloud.points,
            _drop_scattered(cloud, labels, planes.normal, config),
            beside,
            planes,
            planes.times_thickness(config.absorb_reach),
            valid=cloud.valid,
            normals=cloud.normals,
            # The normals of facets say little of the face; the distance decides.
            max_angle_deg=90.0 if config.faceted is True else config.absorb_angle_deg,
        )
        labels = _drop_small(labels, int(config.min_size))
    if config.merge_coplanar:
        planes = fits.of(labels)
        contacts = _contacts_to_merge(labels, beside, planes, cloud.neighbors)
        labels = merge_coplanar(labels, contacts, planes, tolerance=config.merge_tolerance)
    if config.refine_borders:
        labels = _drop_small(labels, 1)
        planes = fits.of(labels)
        # Where a bent face ends its plane does not say.
        vague = planes.bent | (planes.num_points < MIN_FITTED)
        reach = torch.where(vague, torch.nan, planes.times_thickness(config.absorb_reach))
        labels = refine_borders(cloud, labels, planes, reach)
        labels = assign_levels(cloud, labels, planes)
        if config.facet_tolerance is not None:
            # Something narrower than a neighborhood may part a face in facets.
            near = cloud.neighbors if config.faceted is True else beside.neighbors
            tolerance = float(config.facet_tolerance)
            contacts = find_contacts(labels, near)
            labels = merge_facets(labels, contacts, planes, tolerance=tolerance)
    return labels


def _drop_scattered(
    cloud: GrowingCloud, labels: Tensor, normal: Tensor, config: GrowingConfig
) -> Tensor:
    """Return labels without small regions whose normals do not agree, with gaps."""
    small = torch.bincount(labels + 1, minlength=1)[1:] < int(config.min_size)
    small = torch.cat([small, small.new_zeros(1)])
    segments = Segments(torch.where(small[labels], labels, UNLABELED))
    ours, theirs = segments.take_columns(cloud.normals), segments.spread_columns(normal)
    agrees = segments.mean(sq_chords(ours, theirs)) <= deg_to_sq_chord(
        _AGREE * config.max_angle_deg
    )
    scattered = segments.rows[~segments.spread(agrees)]
    return labels.index_fill(0, scattered, UNLABELED)


def _drop_small(labels: Tensor, min_size: int) -> Tensor:
    """Return labels without regions of fewer points, and without gaps in their numbers."""
    is_large = torch.bincount(labels + 1, minlength=1)[1:] >= max(min_size, 1)
    return renumber(labels, torch.where(is_large, is_large.cumsum(0) - 1, UNLABELED))


def renumber(labels: Tensor, numbers: Tensor) -> Tensor:
    """Return labels with other numbers of regions ``(M,)``, those without a region as they are."""
    table = torch.cat([numbers, numbers.new_tensor([UNLABELED])])
    if table.device.type == "cpu":
        # Three times faster than torch's.
        return torch.from_numpy(np.take(table.numpy(), labels.numpy()))
    return table[labels]


def absorb_points(
    points: Tensor,
    labels: Tensor,
    beside: Beside,
    planes: RegionPlanes,
    reach: Tensor,
    *,
    valid: Tensor,
    normals: Tensor | None = None,
    max_angle_deg: float = 90.0,
) -> Tensor:
    """Give points without a region to regions they touch, until none can be given.

    A point may join a region when a point beside it belongs to it, its distance to the region's
    plane is within reach, and its normal, if there are normals ``(N, 3)``, is within the angle of
    the plane's. Of several regions it joins the one whose plane is nearest. Points that joined have
    the next beside them.

    ``points`` ``(N, 3)`` and ``labels`` ``(N,)`` are of a cloud or an image, as ``beside`` is.
    Reach ``(M,)`` 0 keeps all but the points exactly on the plane out, NaN all; ``valid`` ``(N,)``
    may join.
    """
    # Narrow numbers are gathered faster, and take half of the memory.
    labels = labels.to(torch.int32)
    limit = deg_to_sq_chord(max_angle_deg)
    rows = waiting = ((labels == UNLABELED) & valid).nonzero().squeeze(1)
    while len(rows):
        near = labels[beside.around(rows)]
        touches = (near >= 0).any(dim=1)
        rows, near = rows[touches], near[touches]
        region = near.clamp(min=0)
        distance = planes.signed_distances(points[rows], region).abs()
        fits = (near >= 0) & (distance <= reach[region])
        if normals is not None:
            ours = normals[rows].double()[:, :, None].unbind(dim=1)
            fits &= sq_chords(ours, planes.normal[region].unbind(dim=2)) <= limit
        choice, least = _least(torch.where(fits, distance, torch.inf), near)
        joined = least.isfinite()
        rows = rows[joined]
        labels[rows] = choice[joined]
        waiting = waiting[labels[waiting] == UNLABELED]
        # What did not fit does not fit later: only a new neighbour may change it.
        rows = beside.reached(waiting, rows)
    return labels.long()


def _least(cost: Tensor, options: Tensor) -> tuple[Tensor, Tensor]:
    """Return the option ``(n,)`` of the least cost, of equal ones the smallest, and its cost."""
    least = cost.amin(dim=1, keepdim=True)
    ranked = torch.where(cost == least, options, torch.iinfo(options.dtype).max)
    return ranked.amin(dim=1), least.squeeze(1)


def _contacts_to_merge(
    labels: Tensor, beside: NearestPoints, planes: RegionPlanes, neighbors: Neighbors
) -> tuple[Tensor, Tensor]:
    """Return pairs of regions that touch, perhaps twice; of two strips all neighbours count.

    Around the end of a strip that is narrower than a neighbourhood, such as the rim of a table top,
    the nearest points are those of the faces beside it.
    """
    strips = torch.cat([planes.strips, planes.strips.new_zeros(1)])[labels]
    parts = (
        beside.contacts(labels),
        find_contacts(torch.where(strips, labels, UNLABELED), neighbors),
    )
    pairs, counts = (torch.cat(values) for values in zip(*parts, strict=True))
    return pairs, counts


def merge_coplanar(
    labels: Tensor,
    contacts: tuple[Tensor, Tensor],
    planes: RegionPlanes,
    *,
    tolerance: float,
) -> Tensor:
    """Merge regions that touch and lie on one plane, the pair that fits best first.

    Two regions are merged when one plane explains both: the root mean square distance of either to
    the plane through both is at most ``tolerance`` times what it is to its own, or the floor of the
    planes. Merged regions count with the mean square of the distances in their parts, so that a
    thick region across a step does not join its two sides. Of the smaller one the larger one's
    noise counts if that is more: what noise breaks off a face is thinner than the face, or curved.
    Otherwise curved regions have no plane.

    ``contacts`` are pairs of regions that touch ``(E, 2)``, and how many contacts each has, as
    :meth:`torchrg.regions.adjacency.NearestPoints.contacts` gives them. What is merged is one
    region from then on, with the smallest label of its parts.
    """
    pairs, num_contacts = contacts
    pairs = pairs[(num_contacts >= MIN_CONTACTS) & ~planes.curved[pairs].all(dim=1)]
    return _merge(labels, pairs, _moments_of(planes), tolerance)


def merge_facets(
    labels: Tensor,
    contacts: tuple[Tensor, Tensor],
    planes: RegionPlanes,
    *,
    tolerance: float,
) -> Tensor:
    """Merge regions that touch and lie within a distance of one plane, the nearest pair first.

    Reconstructed meshes show a flat face as facets: each is an exact plane, so that its own
    thickness does not say how far from the face it may be. Two regions are merged when the root
    mean square distance of either to the plane through both is at most ``tolerance``, in the unit
    of the cloud, and that plane is turned against neither by more than 25 degrees: a strip narrower
    than the tolerance lies near any plane that it touches. Nor may the turn alone lift the points
    of either by more than two thirds of the tolerance. So the facets of a bend join only as far as
    one plane goes. ``contacts`` and labels are those of :func:`merge_coplanar`.
    """
    pairs, num_contacts = contacts
    pairs = pairs[num_contacts >= MIN_CONTACTS]
    scale, noise = torch.full_like(planes.floor, tolerance), torch.zeros_like(planes.floor)
    moments = _moments_of(planes)._replace(scale=scale, noise=noise)
    return _merge(labels, pairs, moments, 1.0, max_tilt=_FACET_TILT * tolerance)


class _Moments(NamedTuple):
    """Moments of regions, the distance that counts as on their planes, and noise they lend.

    ``normal`` ``(M, 3)`` is the axis of the least variance ``(M,)``.
    """

    weight: Tensor
    mean: Tensor
    covariance: Tensor
    scale: Tensor
    noise: Tensor
    least: Tensor
    normal: Tensor

    def at(self, rows: Tensor | slice) -> "_Moments":
        """Return those of some of the regions."""
        return _Moments(*(values[rows] for values in self))


def _moments_of(planes: RegionPlanes) -> _Moments:
    normal = planes.normal
    variance = (normal[:, None] @ planes.covariance @ normal[:, :, None])[:, 0, 0]
    values, axes = eigh3_of_few(planes.covariance)
    return _Moments(
        planes.num_points.double(),
        planes.center - planes.center[:1],
        planes.covariance,
        torch.where(planes.curved, 0.0, torch.maximum(variance.clamp(min=0).sqrt(), planes.floor)),
        planes.noise,
        values[:, 0],
        axes[:, :, 0],
    )


def misfit_of_pairs(planes: RegionPlanes, pairs: Tensor) -> Tensor:
    """Return how far from the joint plane the worse of two regions is, shape ``(E,)``.

    In thicknesses of the thicker one, whether it is curved or not; nothing is known of the noise.
    """
    thickness = planes.thickness[pairs].amax(dim=1)
    moments = _moments_of(planes)
    first, second = (moments.at(side)._replace(scale=thickness) for side in pairs.unbind(dim=1))
    return _misfit(first, second, _joined(first, second))


def _merge(
    labels: Tensor,
    pairs: Tensor,
    moments: _Moments,
    tolerance: float,
    *,
    max_tilt: float | None = None,
) -> Tensor:
    """Return labels of merged regions, the smallest of each, within a largest tilt."""
    pairs, groups = pairs.cpu(), _Moments(*(values.cpu().clone() for values in moments))
    touching: list[set[int]] = [set() for _ in groups.weight]
    owner, age = list(range(len(touching))), [0] * len(touching)
    queue: list[tuple[float, int, int, int, int]] = []

    def offer(pairs: Tensor) -> None:
        first, second = pairs.unbind(dim=1)
        sides = groups.at(first), groups.at(second)
        both = _joined(*sides)
        misfits = _misfit(*sides, both)
        if max_tilt is not None:
            misfits = torch.where(_are_turned(*sides, both, max_tilt), torch.inf, misfits)
        for (a, b), misfit in zip(pairs.tolist(), misfits.tolist(), strict=True):
            if misfit <= tolerance:
                heapq.heappush(queue, (misfit, a, b, age[a], age[b]))

    for a, b in pairs.tolist():
        touching[a].add(b)
        touching[b].add(a)
    offer(pairs)
    while queue:
        _, a, b, age_a, age_b = heapq.heappop(queue)
        if owner[a] != a or owner[b] != b or (age[a], age[b]) != (age_a, age_b):
            continue
        both = _joined(groups.at(slice(a, a + 1)), groups.at(slice(b, b + 1)))
        for values, joined in zip(groups, both, strict=True):
            values[a] = joined[0]
        owner[b] = a
        age[a] += 1
        touching[a] = {_root(owner, c) for c in touching[a] | touching[b]} - {a}
        for c in touching[a]:
            touching[c].add(a)
        beside = [(min(a, c), max(a, c)) for c in touching[a]]
        offer(torch.tensor(beside, dtype=torch.int64).view(-1, 2))
    roots = [_root(owner, i) for i in range(len(owner))]
    return renumber(labels, torch.tensor(roots, dtype=torch.int64, device=labels.device))


def _root(owner: list[int], i: int) -> int:
    """Return the region that region i has become part of."""
    while owner[i] != i:
        owner[i] = owner[owner[i]]
        i = owner[i]
    return i


def _joined(a: _Moments, b: _Moments) -> _Moments:
    """Return the moments of two sets of regions, taken together one by one."""
    weight = a.weight + b.weight
    fraction_a, fraction_b = (a.weight / weight)[:, None], (b.weight / weight)[:, None]
    mean = fraction_a * a.mean + fraction_b * b.mean
    covariance = torch.zeros_like(a.covariance)
    for side, fraction in ((a, fraction_a), (b, fraction_b)):
        shift = side.mean - mean
        spread = side.covariance + shift[:, :, None] * shift[:, None, :]
        covariance = covariance + fraction[:, :, None] * spread
    noise = torch.where(a.weight >= b.weight, a.noise, b.noise)
    scale = (fraction_a[:, 0] * a.scale.square() + fraction_b[:, 0] * b.scale.square()).sqrt()
    values, axes = eigh3_of_few(covariance)
    return _Moments(weight, mean, covariance, scale, noise, values[:, 0], axes[:, :, 0])


def _misfit(a: _Moments, b: _Moments, both: _Moments) -> Tensor:
    """Return the RMS distance to the joint plane of the worse of two regions, by its scale."""
    misfits, normal = [], both.normal
    for side, other in ((a, b), (b, a)):
        variance = (normal[:, None] @ side.covariance @ normal[:, :, None])[:, 0, 0]
        shift = ((side.mean - both.mean) * normal).sum(dim=1)
        rms = (variance.clamp(min=0) + shift * shift).sqrt()
        lent = torch.where(other.weight > side.weight, other.noise, 0.0)
        misfits.append(torch.where(rms > 0, rms / torch.maximum(side.scale, lent), 0.0))
    return torch.maximum(*misfits)


def _are_turned(a: _Moments, b: _Moments, both: _Moments, max_tilt: float) -> Tensor:
    """Return whether the joint plane is turned too far against that of either."""
    joint = both.normal
    turned = torch.zeros(len(joint), dtype=torch.bool)
    for side in (a, b):
        variance = (joint[:, None] @ side.covariance @ joint[:, :, None])[:, 0, 0]
        turned |= unsigned_angle_deg(side.normal, joint) > _FACET_TURN_DEG
        turned |= variance - side.least > max_tilt**2
    return turned


def refine_borders(
    cloud: GrowingCloud, labels: Tensor, planes: RegionPlanes, reach: Tensor
) -> Tensor:
    """Give points where regions touch to the one that explains them best.

    Of the flat regions of a point's 8 nearest neighbours and its own, the two with the nearest
    planes, by their thickness, count if they are within reach. With the distances :math:`r` from a
    plane and :math:`e` of the point's foot on it beyond the line in which it meets the other plane,
    the point joins the region of the smaller :math:`r^2 + e^2`: noise moves points off their plane,
    not along it. A region ends at the other plane where its points among the point's neighbours are
    on one side of that. Points of nearly parallel planes stay where they are. Points that moved
    and their neighbours are decided again in the next pass.

    ``reach`` ``(M,)`` is the distance up to which points may be on a plane, NaN for regions that
    are not flat and keep what they have.
    """
    beside = NearestPoints(cloud.neighbors)
    flat = torch.cat([reach.isfinite(), reach.new_ones(1, dtype=torch.bool)])
    labels = labels.clone()
    rows = _touching(labels, beside)
    for _ in range(_MAX_PASSES):
        rows = rows[cloud.valid[rows] & flat[labels[rows]]]
        around, chosen = beside.around(rows), labels[rows]
        near = labels[around]

        def work(
            block: slice, rows: Tensor = rows, near: Tensor = near, chosen: Tensor = chosen
        ) -> None:
            chosen[block] = _choose(cloud, labels, planes, reach, rows[block], near[block])

        map_chunks(work, len(rows), ROWS_IN_CACHE, labels.device)
        moved = chosen != labels[rows]
        if not bool(moved.any()):
            break
        rows = rows[moved]
        labels[rows] = chosen[moved]
        rows = torch.unique(torch.cat([rows, around[moved].flatten()]))
    return labels


def assign_levels(cloud: GrowingCloud, labels: Tensor, planes: RegionPlanes) -> Tensor:
    """Give points where parallel regions touch to the nearer plane.

    The planes must be 1.5 thicknesses apart at the point, so that pieces of one face stay as they
    are. The point moves if it is nearer to the other plane, and so are the points of both regions
    among its 8 nearest on average: a single residual is noise. Points that moved and their
    neighbors are decided again in the next pass.
    """
    beside = NearestPoints(cloud.neighbors)
    flat = ~planes.curved & (planes.num_points >= MIN_FITTED)
    flat = torch.cat([flat, flat.new_zeros(1)])
    labels = labels.clone()
    rows = _touching(labels, beside)
    for _ in range(_MAX_PASSES):
        rows = rows[flat[labels[rows]]]
        near, label = beside.around(rows).long(), labels[rows]
        options = labels[near]
        turn = unsigned_angle_deg(planes.normal[options], planes.normal[label][:, None])
        usable = flat[options] & (options != label[:, None]) & (turn <= PARALLEL_DEG)
        place = cloud.points[rows].double()
        distance = planes.signed_distances(place, options).abs()
        other, least = _least(torch.where(usable, distance, torch.inf), options)
        both = least.isfinite()
        rows, near, pair = rows[both], near[both], torch.stack([label, other], dim=1)[both]
        if not len(rows):
            break
        group = torch.cat([rows[:, None], near], dim=1)
        members = (labels[group][:, :, None] == pair[:, None]).any(dim=2, keepdim=True)
        normal, center = planes.normal[pair], planes.center[pair]
        normal = torch.where((normal[:, :1] * normal).sum(dim=2, keepdim=True) < 0, -normal, normal)
        away = cloud.points[group].double()[:, :, None] - center[:, None]
        away = (away * normal[:, None]).sum(dim=3)
        thickness = planes.thickness[pair].amax(dim=1)
        apart = (away[:, 0, 0] - away[:, 0, 1]).abs() >= _MIN_STEP * thickness
        mean, first = (away * members).sum(dim=1).abs(), away[:, 0].abs()
        moved = apart & (mean[:, 1] < mean[:, 0]) & (first[:, 1] < first[:, 0])
        moved &= first[:, 1] <= _LEVEL_REACH * planes.thickness[pair[:, 1]]
        if not bool(moved.any()):
            break
        rows = rows[moved]
        labels[rows] = pair[moved, 1]
        rows = torch.unique(group[moved])
    return labels


def _touching(labels: Tensor, beside: NearestPoints) -> Tensor:
    """Return the points that have one of another region among their nearest neighbours."""
    # Narrow numbers are gathered three times as fast.
    narrow = labels.to(torch.int32)
    rows_of_chunks = []
    for chunk in chunks_of(len(labels), ROWS_AT_ONCE):
        near = Neighbors(beside.around(chunk)).of(narrow)
        touches = (near != narrow[chunk, None]) & (near >= 0)
        rows_of_chunks.append(chunk.start + places_of(touches.any(dim=1)))
    return torch.cat(rows_of_chunks)


def _choose(
    cloud: GrowingCloud,
    labels: Tensor,
    planes: RegionPlanes,
    reach: Tensor,
    rows: Tensor,
    near: Tensor,
) -> Tensor:
    """Return the region of some points, of labels ``near`` ``(n, 8)`` and their own."""
    label, place = labels[rows], cloud.points[rows].double()
    options = torch.cat([label[:, None], near], dim=1)
    region = options.clamp(min=0)
    distance = planes.signed_distances(place, region).abs()
    usable = (options >= 0) & (distance <= reach[region])
    cost = (distance / planes.thickness[region]).square() + _ROUNDING**2 * (
        options != label[:, None]
    )
    cost = torch.where(usable, cost, torch.inf)
    first, first_cost = _least(cost, options)
    second, second_cost = _least(torch.where(options == first[:, None], torch.inf, cost), options)
    # A region that the point is far from is growth's choice.
    remains = ((label >= 0) & ~usable[:, 0]) | first_cost.isinf()
    choice = torch.where(remains, label, first)

    both = (second_cost.isfinite() & ~remains).nonzero().squeeze(1)
    first, second, place = first[both], second[both], place[both]
    scale = torch.maximum(planes.thickness[first], planes.thickness[second])
    beyond = (
        (_beyond(cloud, labels, planes, rows[both], place, *pair) / scale).square()
        for pair in ((first, second), (second, first))
    )
    first_cost, second_cost = first_cost[both] + next(beyond), second_cost[both] + next(beyond)
    better = torch.where(second_cost < first_cost, second, first)
    angle = unsigned_angle_deg(planes.normal[first], planes.normal[second])
    stays = (angle <= PARALLEL_DEG) & (label[both] >= 0)
    choice[both] = torch.where(stays, label[both], better)
    return choice


def _beyond(
    cloud: GrowingCloud,
    labels: Tensor,
    planes: RegionPlanes,
    rows: Tensor,
    place: Tensor,
    label: Tensor,
    other: Tensor,
) -> Tensor:
    """Return how far beyond another plane the feet of points on their own are, where that ends."""
    near = cloud.neighbors.at(rows)
    indices = near.indices.long()
    inside = (labels[indices] == label[:, None]) & near.counted()
    away = torch.zeros_like(inside, dtype=torch.float64)
    columns = (cloud.points, planes.center[other], planes.normal[other])
    for x, start, slope in zip(*(values.unbind(dim=1) for values in columns), strict=True):
        away += (x[indices].double() - start[:, None]) * slope[:, None]
    away *= inside
    total = away.sum(dim=1)
    rounding = _ROUNDING * planes.thickness[label] * inside.sum(dim=1)
    one_sided = total.abs() > (_ONE_SIDED * away.abs().sum(dim=1)).clamp(min=rounding)
    foot = place - planes.signed_distances(place, label[:, None]) * planes.normal[label]
    over = -total.sign() * planes.signed_distances(foot, other[:, None]).squeeze(1)
    return torch.where(one_sided, over.clamp(min=0), 0.0)
