"""Region refinement after growing: boundary reassignment and merging of coplanar regions."""

import heapq
import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg import scratch
from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, map_chunks, nonzero_rows
from torchrg.config import GrowingConfig
from torchrg.linalg import unsigned_angle_deg
from torchrg.linalg.angles import deg_to_sq_chord, sq_chords
from torchrg.linalg.moments import Segments, eigh3_lapack
from torchrg.regions.adjacency import MIN_CONTACTS, PARALLEL_DEG, KnnAdjacency, find_region_pairs
from torchrg.regions.edges import GrowingInput
from torchrg.regions.fit import MIN_FITTED, SQ_WIDTH, RegionFits, RegionPlanes
from torchrg.structures import UNLABELED, Neighbors

_NORMAL_AGREEMENT = 0.3
"""Fraction of ``max_angle_deg``. A region below ``min_size`` is kept before boundary assignment if
the RMS angle of its normals is smaller. About half of a small surface is boundary. Other small
regions are clutter."""
_MAX_PASSES = 10
"""Maximum number of boundary passes. Each pass revisits the neighbors of changed points, so narrow
strips are filled from their ends."""
_ROUNDING = 0.01
"""Distance differences below this many thicknesses are ignored."""
_MIN_STEP = 1.5
"""Minimum distance of two levels, in thicknesses; closer planes are parts of one surface."""
_LEVEL_REACH = 3.0
"""Maximum distance of a point to its level, in thicknesses of the nearer plane."""
_MIN_ONE_SIDED = 0.5
"""A region ends at another plane if the mean signed distance of its points to that plane is at
least this fraction of the mean absolute distance. It is near 0 for a region that continues behind
it."""
_MIN_FACET_COSINE = math.cos(math.radians(25.0))
"""Minimum cosine of the angle between either of two facets and their joint plane. Facets of ten
points come closest to it; the two sides of a thin board differ by 90 degrees."""
_MAX_FACET_TILT = 2 / 3
"""Maximum RMS distance, in tolerances, that tilting to the joint plane adds to the points of a
facet. Otherwise one plane across a 5 cm step would explain two shelves."""
_MAX_FACET_STEP = 2.0
"""Maximum distance of the mean of a facet to the joint plane, in median reaches of the regions. A
warp bends a surface, but does not double it, as a table top and its underside do."""


def refine_regions(
    cloud: GrowingInput, labels: Tensor, config: GrowingConfig, fits: RegionFits | None = None
) -> Tensor:
    """Apply the enabled refinement steps to a cloud in canonical order.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`; the returned labels may have
    gaps. ``fits`` may already hold the planes of these labels.
    """
    fits, adjacency = fits or RegionFits(cloud, config), KnnAdjacency(cloud.neighbors)
    if config.max_plane_residual is not None:
        planes = fits.get(labels)
        limit = value_of_points(config.max_plane_residual * planes.thickness, labels, torch.inf)
        far = planes.signed_distances(cloud.points, labels).abs_() > limit
        labels = torch.where(far, UNLABELED, labels)
    if config.absorb:
        planes = fits.get(labels)
        labels = assign_unlabeled(
            cloud.points,
            _remove_inconsistent(cloud, labels, planes.normal, config),
            adjacency.neighbor_rows,
            planes,
            planes.scale_thickness(config.absorb_reach),
            valid=cloud.valid,
            normals=cloud.normals,
            # Facet normals are unreliable; the distance decides.
            max_angle_deg=90.0 if config.faceted is True else config.absorb_angle_deg,
        )
        labels = remove_small(labels, int(config.min_size))
    if config.merge_coplanar:
        planes = fits.get(labels)
        # At the end of a strip narrower than a neighborhood, such as the rim of a table top, the
        # nearest points belong to the adjacent surfaces.
        width = (SQ_WIDTH * eigh3_lapack(planes.covariance)[0][:, 1].clamp(min=0)).sqrt()
        are_strips = ~planes.curved & (width <= planes.radius)
        contacts = [adjacency.contacts(labels)]
        if int(torch.count_nonzero(are_strips)) > 1:
            strips = labels.where(value_of_points(are_strips, labels, False), UNLABELED)
            contacts.append(find_region_pairs(strips, cloud.neighbors))
        pairs, counts = map(torch.cat, zip(*contacts, strict=True))
        labels = merge_coplanar(labels, (pairs, counts), planes, tolerance=config.merge_tolerance)
    if config.refine_borders:
        labels = remove_small(labels, 1)
        planes = fits.get(labels)
        # The plane of a bent region does not show where the region ends.
        vague = planes.bent | (planes.num_points < MIN_FITTED)
        reach = torch.where(vague, torch.nan, planes.scale_thickness(config.absorb_reach))
        labels = refine_borders(cloud, labels, planes, reach)
        labels = assign_levels(cloud, labels, planes)
        if config.facet_tolerance is not None:
            # A gap narrower than a neighborhood may divide a faceted surface. With white noise,
            # growth crosses it on one plane: regions still apart, such as cushions side by side,
            # are surfaces of their own. Results of rooms are equal with 4 to 16 neighbors.
            faceted = config.faceted is True
            near = find_region_pairs(labels, cloud.neighbors) if faceted else None
            labels = merge_facets(labels, near or adjacency.contacts(labels), planes, config)
    return labels


def _remove_inconsistent(
    cloud: GrowingInput, labels: Tensor, normal: Tensor, config: GrowingConfig
) -> Tensor:
    """Remove small regions with inconsistent normals; the labels may then have gaps."""
    small = torch.bincount(labels + 1, minlength=1)[1:] < int(config.min_size)
    if not bool(small.any()):
        return labels
    segments = Segments(torch.where(value_of_points(small, labels, False), labels, UNLABELED))
    ours = segments.gather_columns(cloud.normals)
    theirs = [segments.broadcast(column) for column in normal.unbind(dim=1)]
    is_consistent = segments.mean(sq_chords(ours, theirs)) <= deg_to_sq_chord(
        _NORMAL_AGREEMENT * config.max_angle_deg
    )
    inconsistent = segments.rows[~segments.broadcast(is_consistent)]
    return labels.index_fill(0, inconsistent, UNLABELED)


def remove_small(labels: Tensor, min_size: int) -> Tensor:
    """Remove regions smaller than ``min_size`` and make the labels consecutive."""
    return keep_regions(labels, torch.bincount(labels + 1, minlength=1)[1:] >= max(min_size, 1))


def keep_regions(labels: Tensor, kept: Tensor) -> Tensor:
    """Unlabel the points of other regions than the ``kept`` ``(M,)``, and renumber these."""
    if bool(kept.all()):
        return labels
    return remap_labels(labels, torch.where(kept, kept.cumsum(0) - 1, UNLABELED))


def remap_labels(labels: Tensor, mapping: Tensor) -> Tensor:
    """Map the labels of regions to ``mapping`` ``(M,)``; unlabeled points stay unlabeled."""
    return scratch.store(value_of_points(mapping, labels, UNLABELED))


def value_of_points(values: Tensor, labels: Tensor, unlabeled: float) -> Tensor:
    """Return the value of each point's region, given values ``(M,)`` and labels of any shape."""
    table = torch.cat([values.new_tensor([unlabeled]), values])
    # Four times faster than indexing.
    return table.index_select(0, (labels + 1).reshape(-1)).view(labels.shape)


def assign_unlabeled(
    points: Tensor,
    labels: Tensor,
    neighbor_rows: Callable[[Tensor], Tensor],
    planes: RegionPlanes,
    reach: Tensor,
    *,
    valid: Tensor,
    normals: Tensor | None = None,
    max_angle_deg: float = 90.0,
) -> Tensor:
    """Assign unlabeled points to adjacent regions until nothing changes.

    A point joins an adjacent region if its distance to the region's plane is at most ``reach``. The
    angle between its normal, if any, and the plane normal must be at most ``max_angle_deg``. The
    nearest plane wins. Newly labeled points can admit their neighbors.

    ``points`` ``(N, 3)`` and ``labels`` ``(N,)`` belong to a cloud or an image; ``neighbor_rows``
    returns the adjacent points ``(n, 8)`` of given ones ``(n,)``. A ``reach`` ``(M,)`` of 0 admits
    only points exactly on the plane, NaN none. Only ``valid`` points ``(N,)`` are assigned.
    """
    # int32 is faster to index and halves the memory.
    labels = labels.to(torch.int32)
    limit = deg_to_sq_chord(max_angle_deg)
    rows = candidates = ((labels == UNLABELED) & valid).nonzero().squeeze(1)
    while len(rows):
        joining = []
        for part in torch.split(rows, ROWS_AT_ONCE):
            near = Neighbors(neighbor_rows(part).T).gather(labels)
            is_adjacent = nonzero_rows((near >= 0).any(dim=0))
            part, near = part[is_adjacent], near[:, is_adjacent]
            distance = planes.signed_distances(points[part], near).abs_()
            fits = distance <= value_of_points(reach, near, torch.nan)
            if normals is not None:
                ours, theirs = normals[part].double(), planes.normal[near]
                fits &= sq_chords(ours.unbind(dim=1), theirs.unbind(dim=2)) <= limit
            choice, min_cost = _lowest(torch.where(fits, distance, torch.inf), near)
            joining.append(torch.stack([part, choice])[:, min_cost.isfinite()])
        rows, choice = torch.cat(joining, dim=1)
        labels[rows] = choice.to(labels)
        is_new = torch.zeros_like(valid).index_fill_(0, rows, True)
        candidates = candidates[labels[candidates] == UNLABELED]
        # A rejected point is reconsidered only if one of its neighbors was labeled.
        rows = candidates[Neighbors(neighbor_rows(candidates)).gather(is_new).any(dim=1)]
    return labels.long()


def _lowest(cost: Tensor, options: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cheapest of options ``(C, n)`` and its cost; ties go to the smaller option."""
    min_cost = cost.amin(dim=0)
    ranked = torch.where(cost == min_cost, options, torch.iinfo(options.dtype).max)
    return ranked.amin(dim=0), min_cost


def merge_coplanar(
    labels: Tensor, contacts: tuple[Tensor, Tensor], planes: RegionPlanes, *, tolerance: float
) -> Tensor:
    """Greedily merge adjacent coplanar regions, best fit first.

    Two regions are merged if the RMS distance of each to their joint plane is at most ``tolerance``
    times that to its plane (or the floor). Merged regions use the mean square distance of their
    parts, so a thick region across a step does not join both sides. For the smaller region, the
    noise of the larger one is used if it is higher. Fragments that noise splits off a surface are
    thinner than the surface, or curved. Other curved regions are not merged.

    ``contacts`` are adjacent pairs ``(E, 2)`` and their edge counts, as returned by
    :meth:`torchrg.regions.adjacency.KnnAdjacency.contacts`. A merged region takes the smallest
    label of its parts.
    """
    pairs, num_contacts = contacts
    flat = ~planes.curved[pairs].all(dim=1)
    return _merge(labels, (pairs[flat], num_contacts[flat]), _region_moments(planes), tolerance)


def merge_facets(
    labels: Tensor, contacts: tuple[Tensor, Tensor], planes: RegionPlanes, config: GrowingConfig
) -> Tensor:
    """Greedily merge adjacent regions within a fixed distance of one plane.

    A reconstructed mesh represents a flat surface by facets. Each facet is exactly planar, so its
    thickness does not show how far it may be from the surface. Two regions are merged, smallest
    distance first, if the RMS distance of each to their joint plane is at most the
    ``facet_tolerance`` (in coordinate units). The joint plane must be tilted by at most 25 degrees
    against both, since a strip narrower than the tolerance is close to any adjacent plane. If
    surfaces are ``faceted``, the tilt alone must not move the points of either by more than two
    thirds of the tolerance, so the facets of a bend are merged only if they are nearly coplanar.
    Nor may the mean of either move by more than the noise of nearby points explains. For
    ``contacts`` and labels see :func:`merge_coplanar`.
    """
    tolerance, bounds = float(config.facet_tolerance or 0.0), (torch.inf, torch.inf)
    limit = torch.full_like(planes.floor, tolerance)
    moments = _region_moments(planes)._replace(scale=limit, noise=0 * limit)
    if config.faceted is True:
        bounds = _MAX_FACET_TILT * tolerance, _MAX_FACET_STEP * float(planes.reach.median())
    return _merge(labels, contacts, moments, 1.0, bounds)


class _Moments(NamedTuple):
    """Moments of regions, their coplanarity scale, and the noise they lend to smaller regions."""

    weight: Tensor
    mean: Tensor
    covariance: Tensor
    scale: Tensor
    noise: Tensor

    def select(self, rows: Tensor | slice) -> "_Moments":
        """Return the moments of the given regions."""
        return _Moments(*(values[rows] for values in self))


def _region_moments(planes: RegionPlanes) -> _Moments:
    normal = planes.normal
    variance = (normal[:, None] @ planes.covariance @ normal[:, :, None])[:, 0, 0]
    return _Moments(
        planes.num_points.double(),
        planes.center - planes.center[:1],
        planes.covariance,
        torch.where(planes.curved, 0.0, torch.maximum(variance.clamp(min=0).sqrt(), planes.floor)),
        planes.noise,
    )


def pairwise_misfit(planes: RegionPlanes, pairs: Tensor) -> Tensor:
    """Return the larger of both regions' RMS distances to their joint plane, shape ``(E,)``.

    In thicknesses of the thicker region, curved or not; noise is ignored.
    """
    thickness = planes.thickness[pairs].amax(dim=1)
    moments = _region_moments(planes)
    first, second = (moments.select(side)._replace(scale=thickness) for side in pairs.unbind(dim=1))
    return _misfit(first, second)


def _merge(
    labels: Tensor,
    contacts: tuple[Tensor, Tensor],
    moments: _Moments,
    tolerance: float,
    bounds: tuple[float, float] | None = None,
) -> Tensor:
    """Merge regions in contact whose :func:`_misfit` is at most ``tolerance``."""
    pairs = contacts[0][contacts[1] >= MIN_CONTACTS].cpu()
    groups = _Moments(*(values.cpu() for values in moments))
    adjacent: list[set[int]] = [set() for _ in range(len(groups.weight))]
    owner, age = torch.arange(len(adjacent)), [0] * len(adjacent)
    queue: list[tuple[float, int, int, int, int]] = []

    def offer(pairs: Tensor) -> None:
        pairs = pairs.sort(dim=1).values
        first, second = (groups.select(side) for side in pairs.unbind(dim=1))
        misfits = _misfit(first, second, bounds)
        for (a, b), misfit in zip(pairs.tolist(), misfits.tolist(), strict=True):
            adjacent[a].add(b)
            adjacent[b].add(a)
            if misfit <= tolerance:
                heapq.heappush(queue, (misfit, a, b, age[a], age[b]))

    offer(pairs)
    if not queue:
        return labels
    groups = _Moments(*(values.clone() for values in groups))
    while queue:
        _, a, b, *ages = heapq.heappop(queue)
        if [age[a], age[b]] != ages:
            continue
        both = _combined(groups.select(slice(a, a + 1)), groups.select(slice(b, b + 1)))
        for values, joined in zip(groups, both, strict=True):
            values[a] = joined[0]
        owner[b] = a
        age[a] += 1
        age[b] += 1
        for c in adjacent[b]:
            adjacent[c].remove(b)
        joined_pairs = [(a, c) for c in (adjacent[a] | adjacent[b]) - {a}]
        offer(torch.tensor(joined_pairs, dtype=torch.int64).view(-1, 2))
    # Regions join regions with smaller labels, whose owner is known first.
    for b, a in enumerate(owner.tolist()):
        owner[b] = owner[a]
    return remap_labels(labels, owner.to(labels.device))


def _combined(a: _Moments, b: _Moments) -> _Moments:
    """Return the pairwise joint moments of two sets of regions."""
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
    return _Moments(weight, mean, covariance, scale, noise)


def _misfit(a: _Moments, b: _Moments, bounds: tuple[float, float] | None = None) -> Tensor:
    """Return the larger of both regions' RMS distances to the joint plane, in their own scales.

    With ``bounds`` it is infinite if the joint plane is tilted too far against the plane of either
    region, or too far from its mean: the maximum RMS distance by the tilt, and that of the mean.
    """
    both, misfits = _combined(a, b), []
    variances, axes = eigh3_lapack(torch.stack([m.covariance for m in (both, a, b)]))
    normal, *normals = axes[..., 0].unbind()
    for side, other, lowest, axis in zip((a, b), (b, a), variances[1:, :, 0], normals, strict=True):
        variance = (normal[:, None] @ side.covariance @ normal[:, :, None])[:, 0, 0]
        shift = ((side.mean - both.mean) * normal).sum(dim=1)
        rms = (variance.clamp(min=0) + shift * shift).sqrt()
        lent = torch.where(other.weight > side.weight, other.noise, 0.0)
        misfits.append(torch.where(rms > 0, rms / torch.maximum(side.scale, lent), 0.0))
        if bounds is not None:
            apart = (axis * normal).sum(dim=1).abs() < _MIN_FACET_COSINE
            apart |= variance - lowest > bounds[0] ** 2
            misfits[-1].masked_fill_(apart | (shift.abs() > bounds[1]), torch.inf)
    return torch.maximum(*misfits)


def refine_borders(
    cloud: GrowingInput, labels: Tensor, planes: RegionPlanes, reach: Tensor
) -> Tensor:
    """Reassign boundary points to the region that explains them best.

    Candidates are the flat regions of a point and of its 8 nearest neighbors within ``reach``. The
    two with the smallest distance in units of their thickness are compared. Let :math:`r` be the
    point-to-plane distance and :math:`e` the distance by which the projected point lies beyond the
    intersection line with the other plane. The point goes to the region with the smaller :math:`r^2
    + e^2`, because noise moves points off their plane, not along it. A region is taken to end at
    the other plane if its points in the neighborhood lie on one side of that plane. Points of
    nearly parallel planes keep their label, and points beyond the reach of their region move only
    to a nearer plane.

    ``reach`` ``(M,)`` is the maximum point-to-plane distance, NaN for regions that are not flat,
    which are left unchanged.
    """
    flat = torch.cat([reach.isfinite(), reach.new_ones(1, dtype=torch.bool)])
    return _reassign(cloud, labels, planes, flat, partial(_choose_regions, cloud, planes, reach))


def _reassign(
    cloud: GrowingInput,
    labels: Tensor,
    planes: RegionPlanes,
    movable: Tensor,
    choose: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
) -> Tensor:
    """Reassign boundary points; changed points and their neighbors are revisited.

    ``choose`` returns new labels ``(n,)``, given all labels, and the rows of points and of their 8
    nearest neighbors ``(9, n)``, their labels, and the distances of the points to these planes.
    Only valid points of ``movable`` regions are passed, ``(M + 1,)``, the last entry for unlabeled
    points.
    """
    adjacency = KnnAdjacency(cloud.neighbors)
    # int32 is faster to index and to compare.
    labels = labels.to(torch.int32, copy=True)
    rows = adjacency.boundary(labels)
    for _ in range(_MAX_PASSES):
        rows = rows[movable[labels[rows]] & cloud.valid[rows]]
        near = adjacency.neighbor_rows(rows)

        def work(block: slice, rows: Tensor = rows, near: Tensor = near) -> Tensor:
            group = torch.cat([rows[block][None], near[block].T])
            options = Neighbors(group).gather(labels)
            distance = planes.signed_distances(cloud.points[rows[block]], options).abs_()
            return choose(labels, group, options, distance)

        chosen = torch.cat(map_chunks(work, len(rows), ROWS_IN_CACHE, labels.device))
        moved = chosen != labels[rows]
        if not bool(moved.any()):
            break
        rows = rows[moved]
        labels[rows] = chosen[moved]
        rows = torch.unique(torch.cat([rows, near[moved].flatten()]))
    return labels.long()


def assign_levels(cloud: GrowingInput, labels: Tensor, planes: RegionPlanes) -> Tensor:
    """Reassign boundary points of parallel regions to the nearer plane.

    The planes must be 1.5 thicknesses apart at the point, so that parts of one surface are
    unchanged. A point moves if it is nearer to the other plane, and so is the mean of the points of
    both regions among its 8 nearest. A single residual is noise.
    """
    flat = ~planes.curved & (planes.num_points >= MIN_FITTED)
    flat = torch.cat([flat, flat.new_zeros(1)])

    def choose(labels: Tensor, group: Tensor, options: Tensor, distance: Tensor) -> Tensor:
        label, usable = options[0], (distance < distance[0]) & flat[options]
        both = nonzero_rows(usable.any(dim=0))
        options = options[:, both]
        turn = unsigned_angle_deg(planes.normal[options], planes.normal[options[0]])
        usable = usable[:, both] & (turn <= PARALLEL_DEG)
        other, min_cost = _lowest(torch.where(usable, distance[:, both], torch.inf), options)
        found = nonzero_rows(min_cost.isfinite())
        if len(found) == 0:
            return label
        both, other = both[found], other[found]
        pair = torch.stack([label[both], other], dim=1)
        group = group[:, both].T.contiguous()
        members = (labels[group][:, :, None] == pair[:, None]).any(dim=2, keepdim=True)
        normal, center = planes.normal[pair], planes.center[pair]
        normal = torch.where((normal[:, :1] * normal).sum(dim=2, keepdim=True) < 0, -normal, normal)
        offset = cloud.points[group].double()[:, :, None] - center[:, None]
        offset = (offset * normal[:, None]).sum(dim=3)
        thickness = planes.thickness[pair].amax(dim=1)
        apart = (offset[:, 0, 0] - offset[:, 0, 1]).abs() >= _MIN_STEP * thickness
        mean = (offset * members).sum(dim=1).abs()
        moved = apart & (mean[:, 1] < mean[:, 0])
        moved &= offset[:, 0, 1].abs() <= _LEVEL_REACH * planes.thickness[other]
        return label.index_copy(0, both[moved], other[moved])

    return _reassign(cloud, labels, planes, flat, choose)


def _choose_regions(
    cloud: GrowingInput,
    planes: RegionPlanes,
    reach: Tensor,
    labels: Tensor,
    group: Tensor,
    options: Tensor,
    distance: Tensor,
) -> Tensor:
    """Choose a region for each point among the ``options`` ``(9, n)``; see :func:`_reassign`."""
    label, rows = options[0], group[0]
    usable = distance <= value_of_points(reach, options, torch.nan)
    cost = (distance / value_of_points(planes.thickness, options, 1.0)).square()
    cost = torch.where(usable, cost + _ROUNDING**2 * (options != label), torch.inf)
    first, first_cost = _lowest(cost, options)
    second, second_cost = _lowest(torch.where(options == first, torch.inf, cost), options)
    # Beyond the reach of its region, a point keeps the label of growth unless another is nearer.
    remains, away = first_cost.isinf(), nonzero_rows((label >= 0) & ~usable[0])
    others = torch.where(usable[:, away], distance[:, away], torch.inf)
    remains[away] |= others.amin(dim=0) >= distance[0, away]
    choice = torch.where(remains, label, first)

    both = nonzero_rows(second_cost.isfinite() & ~remains)
    angle = unsigned_angle_deg(planes.normal[first[both]], planes.normal[second[both]])
    is_kept = (angle <= PARALLEL_DEG) & (label[both] >= 0)
    choice[both] = torch.where(is_kept, label[both], choice[both])
    both = both[~is_kept]
    if len(both) == 0:
        return choice
    rows, label, pair = rows[both], label[both], (first[both], second[both])
    position, lists = cloud.points[rows], cloud.neighbors.select(rows)
    members = torch.where(lists.mask(), lists.gather(labels), UNLABELED)
    columns = [lists.gather(column).double() for column in cloud.points.unbind(dim=1)]
    # A rounded edge is as far from a precise plane as from a rough one: both have one unit.
    sq_scale = torch.maximum(planes.thickness[pair[0]], planes.thickness[pair[1]]).square()
    costs = []
    for one, other in (pair, pair[::-1]):
        excess = _excess(planes, position, columns, members == one[:, None], (one, other))
        costs.append(excess / sq_scale + _ROUNDING**2 * (one != label))
    return choice.index_copy(0, both, torch.where(costs[1] < costs[0], pair[1], pair[0]))


def _excess(
    planes: RegionPlanes,
    position: Tensor,
    columns: list[Tensor],
    inside: Tensor,
    pair: tuple[Tensor, Tensor],
) -> Tensor:
    """Return the sum of the squared distance to a plane and the squared overshoot.

    The latter is how far the projection of a point lies beyond the plane at which its region ends.
    ``columns`` are the coordinates of the neighbors ``(n, K)``, ``inside`` masks those in the
    region. A ``pair`` is the region and the other plane.
    """
    (label, other), offset = pair, torch.zeros_like(columns[0])
    plane = planes.center[other].T, planes.normal[other].T
    for x, start, slope in zip(columns, *plane, strict=True):
        offset += (x - start[:, None]).mul_(slope[:, None])
    offset *= inside
    total = offset.sum(dim=1)
    rounding = _ROUNDING * planes.thickness[label] * inside.sum(dim=1)
    one_sided = total.abs() > (_MIN_ONE_SIDED * offset.abs().sum(dim=1)).clamp(min=rounding)
    height = planes.signed_distances(position, label)
    foot = position - height[:, None] * planes.normal[label]
    over = -total.sign() * planes.signed_distances(foot, other)
    return height.square() + torch.where(one_sided, over.clamp(min=0), 0.0).square()
