"""Bridges: regions of several faces that only a few points join are split.

Which regions are mixed comes first (:func:`find_mixed_regions`). Within them growth goes on once
more, under stricter limits; what it finds are *cores* of faces. :func:`cut_bridges` decides which
cores are one surface, and gives the points between the others to the nearest.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, chunks_of
from torchrg.config import GrowingConfig
from torchrg.linalg import deg_to_sq_chord, sq_chords, unsigned_angle_deg
from torchrg.linalg.moments import Segments
from torchrg.regions.edges import GrowingCloud, accept_edges, within_angle
from torchrg.regions.fit import MOST_FITTED, RegionPlanes, fit_planes
from torchrg.regions.repair import misfit_of_pairs
from torchrg.structures import UNLABELED, Neighbors

_CORE_SHARE = 0.5
"""Share of the limits of angle and distance within which the core of a face is connected."""

_SMOOTH_ANGLE = 0.3
"""A surface is smooth where normals of neighbours differ by less than this share of the largest
angle."""

_LEAST_SMOOTH = 0.7
"""Cores grow only through points with at least 0.7 of the smooth neighbours that are usual (the
median) in their region; elsewhere noise may hide an edge."""

_MOST_OFF_PLANE = 0.1
"""Share of a region's points off its plane up to which the others are one face."""

_EXACT_REACH = 4.0
"""Points of exact faces lie within this many least thicknesses of the plane of their region."""

_LEAST_FLAT = 0.5
"""A region is made of faces if at least this share of its points is in flat cores: a noisy column
breaks into cores that are few, and curved."""

_LEAST_FACE = 0.05
"""A flat core beside curved ones is a face if it has at least this share of the points of the
region, as the panel that a moulding runs around. Smaller ones belong to the bend."""

_OPEN_SHARE = 0.1
"""A surface goes on between two cores if at least this share of the edges between them passes the
criteria; across a bridge few do."""

_LEAST_MISFIT = 2.0
"""Two cores lie on one plane if their misfit to it is below this many thicknesses, as it is for
parts of a face that noise has bent."""

_MOST_TURNED_DEG = 30.0
"""Largest angle between the planes of cores that are joined, degrees. ``_LEAST_MISFIT`` alone would
join narrow strips on both sides of an edge."""


class MixedRegions(NamedTuple):
    """Regions that do not lie on one plane, ``min_size`` points or more being off it.

    Attributes:
        rows: Points that may be of another face, ascending, shape ``(n,)``: those off the plane
            where nearly all points are on it, else all of the region.
        part: These points as a cloud with limits of a core; only those are valid where the surface
            bends no more than is usual in the region.
        near: Points on the plane of a region of which nearly all are, whose normals are within the
            largest angle of the plane's, shape ``(N,)``, bool.
        aligned: Those of them whose normals are within the limits of a core.
        on_plane: Regions of which nearly all points are on one plane, shape ``(M,)``, bool.
    """

    rows: Tensor
    part: GrowingCloud
    near: Tensor
    aligned: Tensor
    on_plane: Tensor


class _InnerEdges(NamedTuple):
    """Edges from rows ``(n,)`` to neighbours: if of the same region, and if within all limits."""

    rows: Tensor
    targets: Tensor
    inside: Tensor
    passed: Tensor


def find_mixed_regions(
    cloud: GrowingCloud,
    labels: Tensor,
    planes: RegionPlanes,
    config: GrowingConfig,
    chunk_size: int,
) -> MixedRegions | None:
    """Find the regions that may be several faces, None if there are none.

    ``labels`` ``(N,)`` are 0 to M-1 or :data:`torchrg.UNLABELED`, ``planes`` those of the regions.
    """
    limit = _EXACT_REACH * planes.floor
    limit = torch.where(planes.reach.isfinite(), torch.maximum(planes.reach, limit), limit)
    region, has_region = labels.clamp(min=0), labels >= 0
    off = has_region & (planes.distances(cloud.points, region) > limit[region])
    num_off = torch.bincount(labels[off], minlength=len(limit))
    on_plane = num_off <= _MOST_OFF_PLANE * planes.num_points
    mixed = num_off >= int(config.min_size)
    rows = (torch.where(on_plane[region], off, has_region) & mixed[region]).nonzero().squeeze(1)
    if len(rows) == 0:
        return None
    others = (has_region & ~off & (on_plane & mixed)[region]).nonzero().squeeze(1)
    turns = [
        sq_chords(
            cloud.normals[chunk].double().unbind(dim=1),
            planes.normal[labels[chunk]].unbind(dim=1),
        )
        for chunk in torch.split(others, ROWS_AT_ONCE)
    ]
    turn = torch.cat(turns)
    near, aligned = (
        torch.zeros_like(off).index_fill_(0, others[turn <= deg_to_sq_chord(limit)], True)
        for limit in (config.max_angle_deg, _CORE_SHARE * config.max_angle_deg)
    )
    faces = _part_of(cloud, labels, rows)
    smooth = _are_smooth(faces, labels[rows], _SMOOTH_ANGLE * config.max_angle_deg, chunk_size)
    faces = faces._replace(
        valid=faces.valid & smooth,
        reach=None if faces.reach is None else _CORE_SHARE * faces.reach,
        angle_share=_CORE_SHARE,
    )
    return MixedRegions(rows, faces, near, aligned, on_plane)


def cut_bridges(
    cloud: GrowingCloud,
    labels: Tensor,
    mixed: MixedRegions,
    grown: Tensor,
    config: GrowingConfig,
    chunk_size: int,
) -> Tensor:
    """Split regions of several faces that only a few points join.

    ``grown`` ``(n,)`` are the cores in the ``part`` of the mixed regions, 0 to C-1 or
    :data:`torchrg.UNLABELED`. They, and the plane if nearly all points are on one, belong together
    where the surface goes on from one to the next, a tenth of the edges between them passing the
    whole limits, and where one plane explains both. Regions with cores that do not are split: the
    other points join the core of the nearest neighbour that they have an edge to, and no core grows
    through them. Where most points are in curved cores, all that is no large flat one is one core.
    The regions returned may have gaps in their numbers.
    """
    rows = mixed.rows[grown >= 0]
    if len(rows) == 0:
        return labels
    cores = torch.full_like(labels, UNLABELED).index_copy_(0, mixed.rows, grown)
    cores, on_core_plane = _add_planes(labels, cores, mixed)
    around = cloud.neighbors.of(cores.to(torch.int32), rows)
    rows = rows[((around >= 0) & (around != cores[rows, None])).any(dim=1)]
    cores = _join_cores(cloud, cores, _find_edges(cloud, labels, config, rows, chunk_size))
    cores = _join_curved(cloud, labels, cores, mixed.on_plane)
    split = torch.bincount(_owners(labels, cores), minlength=len(mixed.on_plane)) > 1
    free = (labels >= 0) & split[labels.clamp(min=0)]
    # Of points on the plane only those with its direction tell which cores it meets.
    plane_of = torch.full_like(split, UNLABELED, dtype=torch.int64)
    plane_of[labels[on_core_plane]] = cores[on_core_plane]
    cores = torch.where(mixed.near & free & (cores < 0), plane_of[labels.clamp(min=0)], cores)
    waiting = (free & (cores < 0)).nonzero().squeeze(1)
    cores = _propagate(cores, _find_edges(cloud, labels, config, waiting, chunk_size))
    new = torch.where(cores >= 0, cores + len(split), UNLABELED)
    return torch.where(free, new, labels)


def _add_planes(labels: Tensor, cores: Tensor, mixed: MixedRegions) -> tuple[Tensor, Tensor]:
    """Make cores of the planes of regions that have other cores; tell their points."""
    has_core = torch.zeros_like(mixed.on_plane)
    has_core[labels[cores >= 0]] = True
    on_plane = mixed.aligned & has_core[labels.clamp(min=0)] & (labels >= 0) & (cores < 0)
    cores = torch.where(on_plane, labels + int(cores.max()) + 1, cores)
    is_core = torch.bincount(cores + 1)[1:] > 0
    return torch.cat([is_core.cumsum(0) - 1, cores.new_tensor([UNLABELED])])[cores], on_plane


def _join_curved(cloud: GrowingCloud, labels: Tensor, cores: Tensor, on_plane: Tensor) -> Tensor:
    """Return cores ``(N,)`` where those of a curved region that are no faces are one."""
    flat, owner = ~_planes_of(cloud, cores).curved, _owners(labels, cores)
    num_points = torch.bincount(cores[cores >= 0], minlength=len(owner))
    of_region = torch.bincount(labels[labels >= 0], minlength=len(on_plane))
    covered = torch.zeros_like(of_region).index_add_(0, owner, num_points * flat)
    curved = ~(on_plane | (covered >= _LEAST_FLAT * of_region))
    is_face = flat & (num_points >= _LEAST_FACE * of_region[owner])
    joined = curved[owner] & ~is_face
    numbers = torch.arange(len(owner) + 1, device=cores.device)
    numbers[-1] = UNLABELED
    first = torch.full_like(of_region, len(owner))
    first.scatter_reduce_(0, owner[joined], numbers[:-1][joined], "amin")
    numbers[:-1][joined] = first[owner[joined]]
    return numbers[cores]


def _owners(labels: Tensor, cores: Tensor) -> Tensor:
    """Return the region of each core, in ascending order of the cores that have points."""
    points = (cores >= 0).nonzero().squeeze(1)
    numbers, rows = torch.unique(cores[points], return_inverse=True)
    return labels.new_zeros(len(numbers)).index_copy_(0, rows, labels[points])


def _planes_of(cloud: GrowingCloud, cores: Tensor) -> RegionPlanes:
    """Return the planes of cores."""
    return fit_planes(Segments(cores, most=MOST_FITTED), cloud.points, cloud.normals)


def _are_smooth(
    cloud: GrowingCloud, regions: Tensor, max_angle_deg: float, chunk_size: int
) -> Tensor:
    """Tell at which points the surface bends no more than is usual in their region."""
    shares = torch.zeros_like(cloud.curvature, dtype=torch.float64)
    rows, limit = torch.arange(len(shares), device=shares.device), deg_to_sq_chord(max_angle_deg)
    for chunk in chunks_of(len(shares), chunk_size):
        near, counted = cloud.neighbors.at(chunk), cloud.neighbors.counted(chunk)
        alike = within_angle(near, rows[chunk], cloud.normals.T, limit, signed=False) & counted
        shares[chunk] = alike.sum(dim=1).double() / counted.sum(dim=1).clamp(min=1)
    regions = torch.unique(regions, return_inverse=True)[1]
    segments = Segments(regions)
    usual = segments.median(segments.take(shares))
    return shares >= _LEAST_SMOOTH * usual[regions]


def _part_of(cloud: GrowingCloud, labels: Tensor, rows: Tensor) -> GrowingCloud:
    """Return some points as a cloud, where those of one region are neighbours."""
    row_of = torch.full((len(labels),), -1, dtype=torch.int32, device=rows.device)
    row_of[rows] = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
    near = cloud.neighbors.at(rows)
    places = near.of(row_of)
    counted = (near.of(labels.to(torch.int32)) == labels[rows, None]) & (places >= 0)
    counted &= near.counted()
    itself = torch.arange(len(rows), dtype=torch.int32, device=rows.device)[:, None]
    return cloud._replace(
        points=cloud.points.T[:, rows].T,
        normals=cloud.normals.T[:, rows].T,
        curvature=cloud.curvature[rows],
        neighbors=Neighbors(torch.where(counted, places, itself), counted),
        valid=cloud.valid[rows],
        reach=None if cloud.reach is None else cloud.reach[rows],
        colors=None if cloud.colors is None else cloud.colors[rows],
    )


def _find_edges(
    cloud: GrowingCloud, labels: Tensor, config: GrowingConfig, rows: Tensor, chunk_size: int
) -> _InnerEdges:
    """Return the edges of some points."""
    near = cloud.neighbors.at(rows)
    inside = (near.of(labels) == labels[rows, None]) & near.counted()
    passed = torch.zeros_like(inside)
    for chunk in chunks_of(len(rows), chunk_size):
        passed[chunk] = accept_edges(cloud, config, rows[chunk], None)[0]
    return _InnerEdges(rows, near.indices.long(), inside, passed & inside)


def _join_cores(cloud: GrowingCloud, cores: Tensor, edges: _InnerEdges) -> Tensor:
    """Return the cores ``(N,)`` with those of one surface as one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    num_cores = int(cores.max()) + 1
    ours, theirs = cores[edges.rows, None].expand_as(edges.targets), cores[edges.targets]
    between = edges.inside & (theirs >= 0) & (theirs != ours)
    first, second = ours[between], theirs[between]
    keys = torch.minimum(first, second) * num_cores + torch.maximum(first, second)
    keys, numbers = torch.unique(keys, return_inverse=True)
    pairs = torch.stack([keys // num_cores, keys % num_cores], dim=1)
    num_edges = torch.bincount(numbers, minlength=len(pairs))
    num_open = torch.bincount(numbers[edges.passed[between]], minlength=len(pairs))
    planes = _planes_of(cloud, cores)
    one, other = planes.normal[pairs].unbind(dim=1)
    turn = unsigned_angle_deg(one, other)
    joined = (misfit_of_pairs(planes, pairs) < _LEAST_MISFIT) & (turn <= _MOST_TURNED_DEG)
    joined |= num_open >= _OPEN_SHARE * num_edges
    ends = pairs[joined].T.cpu().numpy()
    ones = np.ones(ends.shape[1], dtype=np.int8)
    graph = coo_array((ones, (ends[0], ends[1])), shape=(num_cores, num_cores))
    _, owner = connected_components(graph, directed=False)
    return torch.from_numpy(np.append(owner, UNLABELED)).to(cores)[cores]


def _propagate(cores: Tensor, edges: _InnerEdges) -> Tensor:
    """Give points between the cores to that of the nearest neighbour they have an edge to."""
    cores = cores.clone()
    waiting = torch.arange(len(edges.rows), device=cores.device)
    while len(waiting):
        targets = edges.targets[waiting]
        reached = edges.passed[waiting] & (cores[targets] >= 0)
        nearest = reached.to(torch.uint8).argmax(dim=1, keepdim=True)
        joined = reached.any(dim=1)
        if not bool(joined.any()):
            break
        cores[edges.rows[waiting[joined]]] = cores[targets.gather(1, nearest).squeeze(1)][joined]
        waiting = waiting[~joined]
    return cores
