"""What is one face: regions that only a bridge joins are split, coplanar ones become one."""

import heapq
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, chunks_of
from torchrg.config import GrowingConfig
from torchrg.linalg import deg_to_sq_chord, eigh3_of_few, sq_chords
from torchrg.linalg.moments import Segments
from torchrg.regions.edges import GrowingCloud, accept_edges, within_angle
from torchrg.regions.planes import MOST_FITTED, FittedPlanes, fit_planes, fit_regions
from torchrg.structures import UNLABELED, Neighbors

_LEAST_CONTACTS = 3
"""Regions that touch in fewer points are not merged: one may be an outlier's."""

_STRICTER = 0.5
"""Share of the limits of angle and distance within which the core of a face holds together."""

_LEVEL_ANGLE = 0.3
_LEAST_LEVEL = 0.7
"""A core leads on where the share of neighbours within this share of the largest angle is this
share of what is usual in the region: less where two faces meet in noise, and normals turn from one
to the other by and by."""

_MOST_OFF_PLANE = 0.1
"""Share of a region's points off its plane up to which the others are one face."""

_EXACT_REACH = 4.0
"""Times the least thickness. Distance from a plane within which points of exact faces are on it."""

_LEAST_FLAT = 0.5
"""Share of a region's points in flat cores from which it is faces: a noisy column breaks into cores
that are few, and curved."""

_OPEN_SHARE = 0.1
"""Least share of the edges between two cores that pass the criteria where a surface goes on; where
a bridge joins them it is a few in a hundred."""

_LEAST_MISFIT = 2.0
"""Times the thickness. Two cores lie on one plane when they are nearer to it: parts of a face that
noise has bent are."""


class _Suspects(NamedTuple):
    """Points of regions that do not lie on one plane.

    Attributes:
        rows: Points that may be of another face, ascending: those off the plane where nearly all
            are on it, all others.
        near: Points on the plane of a region of which nearly all are, shape ``(N,)``, bool.
        sound: Those of them with its direction.
        on_plane: Regions of which nearly all points are on one plane, shape ``(M,)``, bool.
    """

    rows: Tensor
    near: Tensor
    sound: Tensor
    on_plane: Tensor


class _Edges(NamedTuple):
    """Edges from some points to neighbours of the same region, and which pass all limits.

    ``rows`` ``(n,)``, ``targets``, ``inside`` and ``passed`` ``(n, K)``.
    """

    rows: Tensor
    targets: Tensor
    inside: Tensor
    passed: Tensor


def cut_bridges(
    cloud: GrowingCloud,
    labels: Tensor,
    config: GrowingConfig,
    grow: Callable[[GrowingCloud, float], Tensor],
    *,
    chunk_size: int,
) -> Tensor:
    """Split regions of several faces that only a few points join.

    Of a region that does not lie on one plane, ``min_size`` points or more being off it, the points
    that may be of another face are grown again, within half the limits and only from where the
    surface bends no more than is usual in the region. The *cores* that come of it, and the plane if
    nearly all points are on one, belong together where the surface goes on from one to the next, a
    tenth of the edges between them passing the whole limits, and where one plane explains both.
    Regions with cores that do not, and with most of their points in flat cores, are split: doubtful
    points follow the nearest neighbour that they have an edge to, and never lead.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`; so are the regions returned,
    perhaps with gaps in their numbers. ``grow`` returns the labels of a cloud within a share of the
    limits.
    """
    rows, near, sound, on_plane = _find_suspects(cloud, labels, config)
    if len(rows) == 0:
        return labels
    cores = torch.full_like(labels, UNLABELED)
    part, inside = _part_of(cloud, labels, rows)
    max_angle_deg = _LEVEL_ANGLE * config.max_angle_deg
    level = _are_level(part, inside, labels[rows], max_angle_deg, chunk_size)
    cores[rows] = grow(part._replace(valid=part.valid & level), _STRICTER)
    rows = rows[cores[rows] >= 0]
    if len(rows) == 0:
        return labels
    # The plane of a region is a core, too.
    others = torch.zeros(int(labels.max()) + 1, dtype=torch.bool, device=labels.device)
    others[labels[rows]] = True
    sound &= others[labels.clamp(min=0)] & (labels >= 0) & (cores < 0)
    cores = torch.where(sound, labels + int(cores.max()) + 1, cores)
    is_core = torch.bincount(cores + 1)[1:] > 0
    cores = torch.cat([is_core.cumsum(0) - 1, cores.new_tensor([UNLABELED])])[cores]
    around = cloud.neighbors.of(cores.to(torch.int32), rows)
    rows = rows[((around >= 0) & (around != cores[rows, None])).any(dim=1)]
    cores = _join_cores(cloud, cores, _find_edges(cloud, labels, config, rows, chunk_size))

    owner = torch.full((int(cores.max()) + 1,), UNLABELED, device=labels.device)
    owner[cores[cores >= 0]] = labels[cores >= 0]
    split = torch.bincount(owner, minlength=len(others)) > 1
    flat = ~fit_planes(Segments(cores, most=MOST_FITTED), cloud.points, cloud.normals).curved
    covered = torch.bincount(labels[(cores >= 0) & flat[cores.clamp(min=0)]], minlength=len(others))
    split &= on_plane | (covered >= _LEAST_FLAT * torch.bincount(labels[labels >= 0]))
    free = (labels >= 0) & split[labels.clamp(min=0)]
    # Of points on the plane only those with its direction tell which cores it meets.
    plane_of = torch.full_like(others, UNLABELED, dtype=torch.int64)
    plane_of[labels[sound]] = cores[sound]
    cores = torch.where(near & free & (cores < 0), plane_of[labels.clamp(min=0)], cores)
    waiting = (free & (cores < 0)).nonzero().squeeze(1)
    cores = _follow(cores, _find_edges(cloud, labels, config, waiting, chunk_size))
    new = torch.where(cores >= 0, cores + len(others), UNLABELED)
    return torch.where(free, new, labels)


def _find_suspects(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> _Suspects:
    """Return the doubtful and the sound points of regions with many points off their plane."""
    planes = fit_regions(cloud, labels, config)
    limit = _EXACT_REACH * planes.floor
    limit = torch.where(planes.reach.isfinite(), torch.maximum(planes.reach, limit), limit)
    region, has_region = labels.clamp(min=0), labels >= 0
    off = has_region & (planes.distances(cloud.points, region) > limit[region])
    num_off = torch.bincount(labels[off], minlength=len(limit))
    on_plane = num_off <= _MOST_OFF_PLANE * planes.fit.num_points
    mixed = num_off >= config.min_size
    doubtful = torch.where(on_plane[region], off, has_region) & mixed[region]
    rows = doubtful.nonzero().squeeze(1)
    near = has_region & ~off & (on_plane & mixed)[region]
    others = near.nonzero().squeeze(1)
    turns = [
        sq_chords(
            cloud.normals[some].double().unbind(dim=1),
            planes.fit.normal[labels[some]].unbind(dim=1),
        )
        for some in torch.split(others, ROWS_AT_ONCE)
    ]
    turn = torch.cat(turns)
    near, sound = (
        torch.zeros_like(off).index_fill_(0, others[turn <= deg_to_sq_chord(limit)], True)
        for limit in (config.max_angle_deg, _STRICTER * config.max_angle_deg)
    )
    return _Suspects(rows, near, sound, on_plane)


def _are_level(
    part: GrowingCloud, inside: Tensor, regions: Tensor, max_angle_deg: float, chunk_size: int
) -> Tensor:
    """Tell at which points the surface bends no more than is usual in their region."""
    shares = torch.zeros_like(part.curvature, dtype=torch.float64)
    for some in chunks_of(len(shares), chunk_size):
        counted = part.neighbors.counted(some)
        alike = within_angle(part, some, max_angle_deg, signed=False) & counted
        shares[some] = alike.sum(dim=1).double() / counted.sum(dim=1).clamp(min=1)
    regions = torch.unique(regions, return_inverse=True)[1]
    segments = Segments(regions)
    usual = segments.median(segments.take(shares))
    return shares >= _LEAST_LEVEL * usual[regions]


def _part_of(cloud: GrowingCloud, labels: Tensor, rows: Tensor) -> tuple[GrowingCloud, Tensor]:
    """Return some points as a cloud, and which neighbours are in it and of the point's region."""
    row_of = torch.full((len(labels),), -1, dtype=torch.int32, device=rows.device)
    row_of[rows] = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
    near = cloud.neighbors.at(rows)
    places = near.of(row_of)
    counted = (near.of(labels.to(torch.int32)) == labels[rows, None]) & (places >= 0)
    counted &= near.counted()
    own = torch.arange(len(rows), dtype=torch.int32, device=rows.device)[:, None]
    part = cloud._replace(
        points=cloud.points[rows],
        normals=cloud.normals[rows],
        curvature=cloud.curvature[rows],
        neighbors=Neighbors(torch.where(counted, places, own), counted),
        valid=cloud.valid[rows],
        reach=None if cloud.reach is None else cloud.reach[rows],
        colors=None if cloud.colors is None else cloud.colors[rows],
    )
    return part, counted


def _find_edges(
    cloud: GrowingCloud, labels: Tensor, config: GrowingConfig, rows: Tensor, chunk_size: int
) -> _Edges:
    """Return the edges of some points."""
    near = cloud.neighbors.at(rows)
    inside = (near.of(labels) == labels[rows, None]) & near.counted()
    passed = torch.zeros_like(inside)
    for some in chunks_of(len(rows), chunk_size):
        passed[some] = accept_edges(cloud, config, rows[some], None)[0]
    return _Edges(rows, near.indices.long(), inside, passed & inside)


def _join_cores(cloud: GrowingCloud, cores: Tensor, edges: _Edges) -> Tensor:
    """Return the cores ``(N,)`` with those of one surface as one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    num_cores = int(cores.max()) + 1
    own, theirs = cores[edges.rows, None].expand_as(edges.targets), cores[edges.targets]
    between = edges.inside & (theirs >= 0) & (theirs != own)
    first, second = own[between], theirs[between]
    keys = torch.minimum(first, second) * num_cores + torch.maximum(first, second)
    keys, numbers = torch.unique(keys, return_inverse=True)
    pairs = torch.stack([keys // num_cores, keys % num_cores], dim=1)
    num_edges = torch.bincount(numbers, minlength=len(pairs))
    num_open = torch.bincount(numbers[edges.passed[between]], minlength=len(pairs))
    fit = fit_planes(Segments(cores, most=MOST_FITTED), cloud.points, cloud.normals)
    joined = _explains_both(fit, pairs)
    joined |= num_open >= _OPEN_SHARE * num_edges
    ends = pairs[joined].T.cpu().numpy()
    ones = np.ones(ends.shape[1], dtype=np.int8)
    graph = coo_array((ones, (ends[0], ends[1])), shape=(num_cores, num_cores))
    _, owner = connected_components(graph, directed=False)
    return torch.from_numpy(np.append(owner, UNLABELED)).to(cores)[cores]


def _follow(cores: Tensor, edges: _Edges) -> Tensor:
    """Give points between the cores to that of the nearest neighbour they have an edge to."""
    cores = cores.clone()
    waiting = torch.arange(len(edges.rows), device=cores.device)
    while len(waiting):
        targets = edges.targets[waiting]
        known = edges.passed[waiting] & (cores[targets] >= 0)
        nearest = known.to(torch.uint8).argmax(dim=1, keepdim=True)
        joined = known.any(dim=1)
        if not bool(joined.any()):
            break
        cores[edges.rows[waiting[joined]]] = cores[targets.gather(1, nearest).squeeze(1)][joined]
        waiting = waiting[~joined]
    return cores


def merge_coplanar(
    labels: Tensor,
    contacts: tuple[Tensor, Tensor],
    fit: FittedPlanes,
    floor: Tensor,
    noise: Tensor | None = None,
    *,
    tolerance: float,
) -> Tensor:
    """Merge regions that touch and lie on one plane, the pair that fits best first.

    Two regions are merged when one plane explains both: the root mean square distance of either to
    the plane through both is at most ``tolerance`` times what it is to its own. Of the smaller one
    the larger one's noise counts if that is more: what noise breaks off a face is thinner than the
    face, or curved. Otherwise curved regions have no plane. What is merged is one region from then
    on.

    ``contacts`` are those of :func:`torchrg.regions.adjacency.count_contacts`; ``floor`` ``(M,)``
    is the least distance to its own plane that counts for a region, ``noise``
    ``(M,)`` that of the points around it, 0 where that is not known. A merged region has the
    smallest label of its parts.
    """
    pairs, num_contacts = contacts
    pairs = pairs[(num_contacts >= _LEAST_CONTACTS) & ~fit.curved[pairs].all(dim=1)]
    moments = _moments_of(fit, floor, noise)
    owner = _merge_pairs(_Moments(*(part.cpu() for part in moments)), pairs.cpu(), tolerance)
    return torch.tensor([*owner, UNLABELED], device=labels.device)[labels]


class _Moments(NamedTuple):
    """What merging reads of M regions, in float64.

    Number of points, their mean, about an origin near them, and covariance, the distance from its
    plane that counts as lying on it (none from that of a curved one), and the noise it lends.
    """

    weight: Tensor
    mean: Tensor
    covariance: Tensor
    scale: Tensor
    noise: Tensor

    def at(self, rows: Tensor | slice) -> "_Moments":
        """Return those of some of the regions."""
        return _Moments(*(values[rows] for values in self))


def _moments_of(fit: FittedPlanes, floor: Tensor, noise: Tensor | None) -> _Moments:
    own = (fit.normal[:, None] @ fit.covariance @ fit.normal[:, :, None])[:, 0, 0]
    return _Moments(
        fit.num_points.double(),
        fit.center - fit.center[:1],
        fit.covariance,
        torch.where(fit.curved, 0.0, torch.maximum(own.clamp(min=0).sqrt(), floor)),
        torch.zeros_like(own) if noise is None else noise,
    )


def _explains_both(fit: FittedPlanes, pairs: Tensor) -> Tensor:
    """Tell which pairs of regions one plane explains, by the thickness of the thicker one."""
    moments = _moments_of(fit, fit.thickness, None)
    thickness = fit.thickness[pairs].amax(dim=1)
    first, second = (moments.at(side)._replace(scale=thickness) for side in pairs.unbind(dim=1))
    return _misfit(first, second) < _LEAST_MISFIT


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
    noise = torch.where(a.weight >= b.weight, a.noise, b.noise)
    return _Moments(weight, mean, covariance, torch.maximum(a.scale, b.scale), noise)


def _misfit(a: _Moments, b: _Moments) -> Tensor:
    """Return how far from the joint plane the worse of two regions is, in its own scales."""
    both = _joined(a, b)
    normal = eigh3_of_few(both.covariance)[1][:, :, 0]
    misfits = []
    for part, other in ((a, b), (b, a)):
        own = (normal[:, None] @ part.covariance @ normal[:, :, None])[:, 0, 0]
        shift = ((part.mean - both.mean) * normal).sum(dim=1)
        rms = (own.clamp(min=0) + shift * shift).sqrt()
        lent = torch.where(other.weight > part.weight, other.noise, 0.0)
        misfits.append(torch.where(rms > 0, rms / torch.maximum(part.scale, lent), 0.0))
    return torch.maximum(*misfits)
