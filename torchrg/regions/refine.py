"""What settings may ask for after growth: release, absorption, rims, merging."""

import heapq
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import GrowingConfig
from torchrg.linalg import deg_to_sq_chord, eigh3_of_few, sq_chords
from torchrg.linalg.moments import Segments
from torchrg.regions.adjacency import contact_neighbors, count_contacts
from torchrg.regions.criteria import GrowingCloud, neighborhood_radii
from torchrg.regions.planes import FittedPlanes, fit_planes
from torchrg.regions.rims import RimPlanes, settle_rims
from torchrg.structures import UNLABELED, Neighbors

_LEAST_CONTACTS = 3
"""Regions that touch in fewer points are not merged: one may be an outlier's."""

_BENT = 0.5
"""Reaches. A region thicker than this share of the reach that its points have bends a little, and
where it ends its plane does not say."""


def refine_regions(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> Tensor:
    """Apply the steps after growth that the settings ask for to a cloud in canonical order.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`; so are the regions returned,
    perhaps with gaps in their numbers.
    """
    if not bool((labels >= 0).any()):
        return labels
    if config.max_plane_residual is not None:
        fit, floor = fit_regions(cloud, labels, config)
        limit = config.max_plane_residual * torch.maximum(fit.thickness, floor)
        segments = Segments(labels)
        far = fit.residuals.abs() > segments.spread(limit)
        labels = labels.index_fill(0, segments.rows[far], UNLABELED)
    if config.absorb:
        fit, floor = fit_regions(cloud, labels, config)
        reach = reach_of_planes(fit, floor, config.absorb_reach)
        labels = absorb_points(
            cloud.points,
            cloud.normals,
            labels,
            cloud.neighbors,
            (fit.normal, fit.center, reach),
            valid=cloud.valid,
            max_angle_deg=config.absorb_angle_deg,
        )
    if config.merge_coplanar:
        fit, floor = fit_regions(cloud, labels, config)
        contacts = count_contacts(labels, cloud.neighbors)
        labels = merge_coplanar(labels, contacts, fit, floor, tolerance=config.merge_tolerance)
    if config.settle_rims:
        labels = torch.unique(labels, return_inverse=True)[1] - int((labels < 0).any())
        fit, floor = fit_regions(cloud, labels, config)
        reach = reach_of_planes(fit, floor, config.absorb_reach)
        thickness = torch.maximum(fit.thickness, floor)
        reach = torch.where(_is_bent(cloud, labels, thickness, floor), torch.nan, reach)
        labels = settle_rims(cloud, labels, RimPlanes(fit.normal, fit.center, thickness, reach))
    return labels


def fit_regions(
    cloud: GrowingCloud, labels: Tensor, config: GrowingConfig
) -> tuple[FittedPlanes, Tensor]:
    """Return the planes of the regions, and the least thickness of each, shape ``(M,)``.

    The least is the floor of the coplanarity test: a fraction of the median neighbourhood's radius.
    """
    segments = Segments(labels)
    fit = fit_planes(segments, cloud.points, cloud.normals)
    radii = neighborhood_radii(cloud.points, cloud.neighbors)
    radius = segments.median(segments.take(radii)).double()
    return fit, config.coplanarity_floor * radius


def _is_bent(cloud: GrowingCloud, labels: Tensor, thickness: Tensor, floor: Tensor) -> Tensor:
    """Tell which regions are twice as thick as the neighbourhoods in them: they bend a little."""
    if cloud.reach is None:
        return torch.zeros_like(thickness, dtype=torch.bool)
    segments = Segments(labels)
    usual = segments.median(segments.take(cloud.reach)).double()
    return thickness > torch.where(usual.isfinite(), torch.maximum(_BENT * usual, floor), floor)


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
    while len(waiting):
        near = torch.where(counted[waiting], labels[nearest[waiting]], UNLABELED)
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


def merge_coplanar(
    labels: Tensor,
    contacts: tuple[Tensor, Tensor],
    fit: FittedPlanes,
    floor: Tensor,
    *,
    tolerance: float,
) -> Tensor:
    """Merge flat regions that touch and lie on one plane, the pair that fits best first.

    Two regions are merged when one plane explains both: the root mean square distance of either to
    the plane through both is at most ``tolerance`` times what it is to its own. What is merged is
    one region from then on.

    ``contacts`` are those of :func:`torchrg.regions.adjacency.count_contacts`; ``floor`` ``(M,)``
    is the least distance to its own plane that counts for a region. A merged region has the
    smallest label of its parts.
    """
    pairs, num_contacts = contacts
    pairs = pairs[(num_contacts >= _LEAST_CONTACTS) & ~fit.curved[pairs].any(dim=1)]
    moments = _moments_of(fit, floor)
    owner = _merge_pairs(_Moments(*(part.cpu() for part in moments)), pairs.cpu(), tolerance)
    return torch.tensor([*owner, UNLABELED], device=labels.device)[labels]


def joint_misfits(fit: FittedPlanes, pairs: Tensor) -> Tensor:
    """Return how far from their joint plane the regions of each pair are, by the thicker's own."""
    moments = _moments_of(fit, fit.thickness)
    first, second = moments.at(pairs[:, 0]), moments.at(pairs[:, 1])
    scale = torch.maximum(first.scale, second.scale)
    return _misfit(first._replace(scale=scale), second._replace(scale=scale))


class _Moments(NamedTuple):
    """What merging reads of M regions, in float64.

    Number of points, their mean, about an origin near them, and covariance, and the distance from
    its plane that counts as lying on it.
    """

    weight: Tensor
    mean: Tensor
    covariance: Tensor
    scale: Tensor

    def at(self, rows: Tensor | slice) -> "_Moments":
        """Return those of some of the regions."""
        return _Moments(*(values[rows] for values in self))


def _moments_of(fit: FittedPlanes, floor: Tensor) -> _Moments:
    own = (fit.normal[:, None] @ fit.covariance @ fit.normal[:, :, None])[:, 0, 0]
    return _Moments(
        fit.num_points.double(),
        fit.center - fit.center[:1],
        fit.covariance,
        torch.maximum(own.clamp(min=0).sqrt(), floor),
    )


def _merge_pairs(moments: _Moments, pairs: Tensor, tolerance: float) -> list[int]:
    """Return for each region the smallest of those that it is merged with."""
    groups = _Moments(*(values.clone() for values in moments))
    touching: list[set[int]] = [set() for _ in groups.weight]
    owner, age = list(range(len(touching))), [0] * len(touching)
    queue: list[tuple[float, int, int, int, int]] = []

    def offer(pairs: Tensor) -> None:
        first, second = pairs.unbind(dim=1)
        misfits = _misfit(groups.at(first), groups.at(second)).tolist()
        for (a, b), misfit in zip(pairs.tolist(), misfits, strict=True):
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
    return [_root(owner, i) for i in range(len(owner))]


def _root(owner: list[int], i: int) -> int:
    """Return the region that region i has become part of."""
    while owner[i] != i:
        owner[i] = owner[owner[i]]
        i = owner[i]
    return i


def _joined(a: _Moments, b: _Moments) -> _Moments:
    """Return the moments of two sets of regions, taken together one by one."""
    weight = a.weight + b.weight
    share_a, share_b = (a.weight / weight)[:, None], (b.weight / weight)[:, None]
    mean = share_a * a.mean + share_b * b.mean
    covariance = torch.zeros_like(a.covariance)
    for part, share in ((a, share_a), (b, share_b)):
        shift = part.mean - mean
        spread = part.covariance + shift[:, :, None] * shift[:, None, :]
        covariance = covariance + share[:, :, None] * spread
    return _Moments(weight, mean, covariance, torch.maximum(a.scale, b.scale))


def _misfit(a: _Moments, b: _Moments) -> Tensor:
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
