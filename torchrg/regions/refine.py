"""What happens to regions after growth: release, absorption, merging."""

import heapq
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import GrowingConfig
from torchrg.linalg import deg_to_sq_chord, eigh3_of_few, sq_chords
from torchrg.linalg.moments import Segments
from torchrg.regions.adjacency import contact_neighbors, count_contacts
from torchrg.regions.criteria import neighborhood_radii
from torchrg.regions.edges import GrowingCloud
from torchrg.regions.planes import FittedPlanes, are_curved, fit_planes
from torchrg.structures import UNLABELED, Neighbors


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
    several regions it joins the one whose plane is nearest. Points that joined in one round are
    neighbours in the next.

    Args:
        points: Points, shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``.
        labels: Region of each point, shape ``(N,)``, or :data:`torchrg.UNLABELED`.
        neighbors: Neighbours of each point.
        planes: Unit normal ``(M, 3)``, a point ``(M, 3)`` and the reach ``(M,)`` of each region,
            in float64; reach 0 keeps all but the points exactly on the plane out, NaN all.
        valid: Points that may join, shape ``(N,)``, bool.
        max_angle_deg: See above.

    Returns:
        Labels, shape ``(N,)``.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0, 1]])
        >>> neighbors = Neighbors(torch.tensor([[0, 1], [1, 0], [2, 1], [3, 2]]))
        >>> plane = torch.tensor([[0.0, 0, 1]]).double()
        >>> planes = (plane, torch.zeros(1, 3).double(), torch.full((1,), 0.1).double())
        >>> absorb_points(
        ...     points, plane.float().expand(4, 3), torch.tensor([0, -1, -1, -1]), neighbors,
        ...     planes, valid=torch.ones(4).bool(), max_angle_deg=30.0,
        ... ).tolist()
        [0, 0, 0, -1]
    """
    normal, center, reach = planes
    labels = labels.clone()
    nearest, counted = contact_neighbors(neighbors)
    limit = deg_to_sq_chord(max_angle_deg)
    waiting = ((labels == UNLABELED) & valid).nonzero().squeeze(1)
    while len(waiting):
        near = labels[nearest[waiting]]
        near = torch.where(counted[waiting], near, UNLABELED)
        touches = (near >= 0).any(dim=1)
        rows, near = waiting[touches], near[touches]
        if len(rows) == 0:
            break
        region = near.clamp(min=0)
        away = points[rows].double()[:, None] - center[region]
        distance = (away * normal[region]).sum(dim=2).abs()
        own = normals[rows].double()[:, :, None].unbind(dim=1)
        fits = (near >= 0) & (distance <= reach[region])
        fits &= sq_chords(own, normal[region].unbind(dim=2)) <= limit
        distance = torch.where(fits, distance, torch.inf)
        least = distance.amin(dim=1, keepdim=True)
        joined = least.squeeze(1).isfinite()
        if not joined.any():
            break
        choice = torch.where(distance == least, near, len(normal)).amin(dim=1)
        labels[rows[joined]] = choice[joined]
        waiting = waiting[labels[waiting] == UNLABELED]
    return labels


_LEAST_CONTACTS = 3


class Moments(NamedTuple):
    """What merging reads of each of M regions.

    Attributes:
        weight: Number of points, shape ``(M,)``.
        mean: Mean of the points, shape ``(M, 3)``.
        covariance: Covariance of the points, shape ``(M, 3, 3)``.
        scale: Distance from its plane that counts as lying on it, shape ``(M,)``.
    """

    weight: Tensor
    mean: Tensor
    covariance: Tensor
    scale: Tensor


def merge_coplanar(
    moments: Moments, pairs: Tensor, num_contacts: Tensor, *, tolerance: float
) -> Tensor:
    """Merge regions pair by pair, the pair that fits best first.

    Two regions are merged when one plane explains both: the root mean square distance of either to
    the plane through both is at most ``tolerance`` times its own scale. What is merged is one
    region from then on.

    Args:
        moments: The regions, in float64, about an origin near them.
        pairs: Pairs of regions that touch, shape ``(E, 2)``.
        num_contacts: Number of points that touch, shape ``(E,)``; less than three do not count.
        tolerance: See above.

    Returns:
        For each region the smallest of those it is merged with, shape ``(M,)``, int64.

    Example:
        >>> flat = torch.diag(torch.tensor([1.0, 1, 1e-6]).double()).expand(3, 3, 3)
        >>> mean = torch.tensor([[0.0, 0, 0], [4, 0, 0], [8, 0, 1]]).double()
        >>> regions = Moments(torch.ones(3).double(), mean, flat, torch.full((3,), 1e-3).double())
        >>> pairs, contacts = torch.tensor([[0, 1], [1, 2]]), torch.tensor([9, 9])
        >>> merge_coplanar(regions, pairs, contacts, tolerance=1.2).tolist()
        [0, 0, 2]
    """
    groups = [_row(moments, i) for i in range(len(moments.weight))]
    touching: list[set[int]] = [set() for _ in groups]
    owner = list(range(len(groups)))
    pairs = pairs[num_contacts >= _LEAST_CONTACTS]
    misfits = _misfit(_select(moments, pairs[:, 0]), _select(moments, pairs[:, 1]))
    queue = []
    for (a, b), misfit in zip(pairs.tolist(), misfits.tolist(), strict=True):
        touching[a].add(b)
        touching[b].add(a)
        if misfit <= tolerance:
            queue.append((misfit, a, b, 0, 0))
    heapq.heapify(queue)
    age = [0] * len(groups)
    while queue:
        _, a, b, age_a, age_b = heapq.heappop(queue)
        if owner[a] != a or owner[b] != b or (age[a], age[b]) != (age_a, age_b):
            continue
        groups[a] = _joined(groups[a], groups[b])
        owner[b] = a
        age[a] += 1
        touching[a] |= touching[b]
        touching[a] = {_root(owner, c) for c in touching[a]} - {a}
        for c in touching[a]:
            touching[c].add(a)
            first, second = min(a, c), max(a, c)
            misfit = float(_misfit(groups[first], groups[second]))
            if misfit <= tolerance:
                heapq.heappush(queue, (misfit, first, second, age[first], age[second]))
    return torch.tensor([_root(owner, i) for i in range(len(owner))], dtype=torch.int64)


def _root(owner: list[int], i: int) -> int:
    while owner[i] != i:
        owner[i] = owner[owner[i]]
        i = owner[i]
    return i


def _select(moments: Moments, rows: Tensor) -> Moments:
    return Moments(*(values[rows] for values in moments))


def _row(moments: Moments, i: int) -> Moments:
    return Moments(*(values[i : i + 1] for values in moments))


def _joined(a: Moments, b: Moments) -> Moments:
    """Return the moments of two sets of regions, taken together one by one."""
    weight = a.weight + b.weight
    share_a, share_b = (a.weight / weight)[:, None], (b.weight / weight)[:, None]
    mean = share_a * a.mean + share_b * b.mean
    covariance = torch.zeros_like(a.covariance)
    for part, share in ((a, share_a), (b, share_b)):
        shift = part.mean - mean
        spread = part.covariance + shift[:, :, None] * shift[:, None, :]
        covariance = covariance + share[:, :, None] * spread
    return Moments(weight, mean, covariance, torch.maximum(a.scale, b.scale))


def _misfit(a: Moments, b: Moments) -> Tensor:
    """Return how far from the joint plane the worse of two regions is, in its own scales."""
    both = _joined(a, b)
    normal = eigh3_of_few(both.covariance)[1][:, :, 0]
    misfits = []
    for part in (a, b):
        own = (normal[:, None] @ part.covariance @ normal[:, :, None])[:, 0, 0]
        shift = ((part.mean - both.mean) * normal).sum(dim=1)
        rms = (own.clamp(min=0) + shift * shift).sqrt()
        misfits.append(torch.where(rms > 0, rms / part.scale, 0.0))
    return torch.maximum(*misfits)


def refine_regions(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> Tensor:
    """Apply the steps after growth that the settings ask for.

    Args:
        cloud: The cloud, in canonical order.
        labels: Region of each point, shape ``(N,)``: 0 to M-1 or :data:`torchrg.UNLABELED`.
        config: Settings.

    Returns:
        Regions, shape ``(N,)``, numbered below M, perhaps with gaps.
    """
    if not bool((labels >= 0).any()):
        return labels
    if config.max_plane_residual is not None:
        labels = _release(cloud, labels, config, config.max_plane_residual)
    if config.absorb:
        labels = _absorb(cloud, labels, config)
    if config.merge_coplanar:
        labels = _merge(cloud, labels, config)
    return labels


def _release(
    cloud: GrowingCloud, labels: Tensor, config: GrowingConfig, max_residual: float
) -> Tensor:
    """Take away the label of points far from the plane of their region."""
    segments, fit, floor = _planes_of(cloud, labels, config)
    scale = torch.maximum(fit.thickness, floor)
    far = fit.residuals.abs() > max_residual * segments.spread(scale)
    return labels.index_fill(0, segments.rows[far], UNLABELED)


def _absorb(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> Tensor:
    """Give unlabelled points to the flat regions that they touch and whose plane they are on."""
    segments, fit, floor = _planes_of(cloud, labels, config)
    reach = config.absorb_reach * torch.maximum(fit.thickness, floor)
    reach = torch.where(are_curved(segments, cloud.normals), torch.nan, reach)
    return absorb_points(
        cloud.points,
        cloud.normals,
        labels,
        cloud.neighbors,
        (fit.normal, fit.center, reach),
        valid=cloud.valid,
        max_angle_deg=config.absorb_angle_deg,
    )


def _merge(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> Tensor:
    """Merge flat regions that touch and lie on one plane."""
    segments, fit, floor = _planes_of(cloud, labels, config)
    pairs, num_contacts = count_contacts(labels, cloud.neighbors)
    curved = are_curved(segments, cloud.normals)
    flat = ~curved[pairs].any(dim=1)
    own = (fit.normal[:, None] @ fit.covariance @ fit.normal[:, :, None])[:, 0, 0]
    moments = Moments(
        segments.counts.double(),
        fit.center - fit.center[:1],
        fit.covariance,
        torch.maximum(own.clamp(min=0).sqrt(), floor),
    )
    owner = merge_coplanar(
        moments, pairs[flat], num_contacts[flat], tolerance=config.merge_tolerance
    )
    owner = torch.cat([owner.to(labels.device), labels.new_tensor([UNLABELED])])
    return owner[labels]


def _planes_of(
    cloud: GrowingCloud, labels: Tensor, config: GrowingConfig
) -> tuple[Segments, FittedPlanes, Tensor]:
    """Return regions, their planes, and the least thickness of each, shape ``(M,)``.

    The least is the floor of the coplanarity test: a fraction of the median neighbourhood's radius.
    """
    segments = Segments(labels)
    fit = fit_planes(segments, cloud.points, cloud.normals)
    radii = neighborhood_radii(cloud.points, cloud.neighbors)
    radius = segments.median(segments.take(radii)).double()
    return segments, fit, config.coplanarity_floor * radius
