"""Regions of a depth image: growth from pixel to pixel, then absorption, merging, sharp creases."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import DepthConfig, GrowingConfig
from torchrg.depth.normals import PixelPlanes, moved
from torchrg.linalg import unsigned_angle_deg
from torchrg.linalg.moments import Segments
from torchrg.regions import grow_regions
from torchrg.regions.adjacency import contact_neighbors
from torchrg.regions.growth import number_by_size
from torchrg.regions.planes import FittedPlanes, fit_planes
from torchrg.regions.refine import absorb_points, merge_coplanar, reach_of_planes
from torchrg.structures import Neighbors

_AROUND = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Steps in rows and columns to the pixels around one, the nearest first."""

_NUM_PASSES = 2
"""Absorption and merging go on twice: pixels that a region absorbed may make it touch another."""

_CURVED = 3.0
"""A region this many times thicker than its noise is no plane."""

_MOST_MOVES = 16
"""In pixels: no window reaches farther from its middle."""

_STRAIGHT = 0.85
"""Cosine of the largest angle between a step straight away from a crease and one that counts."""


class InverseCloud(NamedTuple):
    """A depth image as a cloud where planes stay planes and noise is the same near and far.

    Its coordinates are the slopes of the ray and the inverse depth, ``(x / z, y / z, c / z)`` with
    the median depth ``c``: a projective map of space. ``points`` ``(H * W, 3)`` are of float64,
    ``normals`` those of the pixels' planes in this cloud, ``noise`` ``(H * W,)`` is the standard
    deviation of the last coordinate, and ``seen`` are the pixels with depth.
    """

    points: Tensor
    normals: Tensor
    noise: Tensor
    seen: Tensor


def grow_pixels(
    cloud: InverseCloud,
    pixels: PixelPlanes,
    normals: Tensor,
    u: Tensor,
    v: Tensor,
    config: DepthConfig,
) -> tuple[Tensor, Tensor, Tensor]:
    """Grow regions over a depth image, and give border pixels and parts of one face to them.

    Two pixels side by side are neighbours if both have a flat window, their normals in space
    ``(H, W, 3)`` are within the angle, and at both pixels their two planes differ by at most
    ``max_step`` times the noise: no neighbourhood crosses a step. :func:`torchrg.grow_regions`
    grows along them, from the pixels with the flattest large windows.

    ``u`` ``(W,)`` and ``v`` ``(H, 1)`` count columns and rows from the optical axis.

    Returns:
        Labels ``(H * W,)``, 0 to M-1 by descending size or :data:`torchrg.UNLABELED`; unit normals
        of the regions' planes towards the camera, in space, ``(M, 3)``; and whether a region is
        thicker than noise can make it, ``(M,)``, bool.
    """
    joined = [_joins(pixels, normals, u, v, step, config) for step in _AROUND]
    size = pixels.radius.clamp(min=1).double()
    roughness = (pixels.planes.deviation / pixels.noise) / (size * size)
    labels = grow_regions(
        cloud.points,
        cloud.normals,
        torch.where(pixels.flat, roughness, 0.0).flatten(),
        _neighbors(joined),
        GrowingConfig(
            max_angle_deg=90.0,
            curvature_quantile=1.0,
            seed_rule="curvature",
            connectivity=None,
            coplanarity=False,
            min_size=config.min_size,
        ),
        valid=pixels.flat.flatten(),
        canonical=True,
    )
    if not bool((labels >= 0).any()):
        return labels, normals.new_empty(0, 3), pixels.flat.new_empty(0)
    image = cloud.seen.view(pixels.flat.shape)
    touching = _neighbors([image & moved(image, step, fill=False) for step in _AROUND])
    labels, fit = _refine(cloud, labels, touching, config)
    distance = (fit.normal * fit.center).sum(dim=1)
    away = torch.stack([-fit.normal[:, 0], -fit.normal[:, 1], distance], dim=1)
    away = torch.where(fit.normal[:, 2:] < 0, -away, away)
    return labels, -away / away.norm(dim=1, keepdim=True), fit.curved


def _joins(
    pixels: PixelPlanes,
    normals: Tensor,
    u: Tensor,
    v: Tensor,
    step: tuple[int, int],
    config: DepthConfig,
) -> Tensor:
    """Return whether each pixel and the one a step away are on one surface, shape ``(H, W)``."""
    theirs = type(pixels.planes)(*(moved(part, step, fill=0.0) for part in pixels.planes))
    down, right = step
    limit = config.max_step * pixels.noise
    here = (pixels.planes.at(u, v) - theirs.at(u, v)).abs() <= limit
    there_u, there_v = u + right, v + down
    there = (pixels.planes.at(there_u, there_v) - theirs.at(there_u, there_v)).abs() <= limit
    angle = unsigned_angle_deg(normals, moved(normals, step, fill=0.0))
    both = pixels.flat & moved(pixels.flat, step, fill=False)
    return both & here & there & (angle <= config.max_angle_deg)


def _neighbors(joined: list[Tensor]) -> Neighbors:
    """Return the pixels around each pixel, itself first, from which of them count, ``(H, W)``."""
    first = joined[0]
    rows = torch.arange(first.numel(), dtype=torch.int32, device=first.device).view(first.shape)
    indices = torch.stack([rows, *(moved(rows, step, fill=0) for step in _AROUND)], dim=-1)
    counted = torch.stack([torch.ones_like(first), *joined], dim=-1)
    return Neighbors(indices.view(-1, 9), counted.view(-1, 9))


def _refine(
    cloud: InverseCloud, labels: Tensor, touching: Neighbors, config: DepthConfig
) -> tuple[Tensor, FittedPlanes]:
    """Settle borders and parts of the regions of a depth image.

    Twice, pixels without a region join the one beside them whose plane they are on, and flat
    regions that touch and lie on one plane are merged. Then borders between regions move to the
    lines where their planes meet.

    At least one pixel has a label; ``touching`` are the pixels with depth around each pixel, itself
    first. Returns labels by descending size, and the planes of the regions in the cloud; curved are
    those thicker than noise can make them.
    """
    for _ in range(_NUM_PASSES):
        fit, noise = _fit(cloud, labels)
        labels = absorb_points(
            cloud.points,
            cloud.normals,
            labels,
            touching,
            (fit.normal, fit.center, reach_of_planes(fit, noise, config.absorb_reach)),
            valid=cloud.seen,
            max_angle_deg=90.0,
        )
        fit, noise = _fit(cloud, labels)
        merged = merge_coplanar(labels, touching, fit, noise, tolerance=config.merge_tolerance)
        labels = number_by_size(merged, config.min_size)
    fit, noise = _fit(cloud, labels)
    reach = reach_of_planes(fit, noise, config.absorb_reach)
    moved = move_to_creases(cloud.points, labels, touching, fit, reach)
    labels = number_by_size(moved, config.min_size)
    return labels, _fit(cloud, labels)[0]


def _fit(cloud: InverseCloud, labels: Tensor) -> tuple[FittedPlanes, Tensor]:
    """Return the planes of the regions, and the noise of each, shape ``(M,)``."""
    segments = Segments(labels)
    fit = fit_planes(segments, cloud.points, cloud.normals)
    noise = segments.median(segments.take(cloud.noise))
    return fit._replace(curved=fit.thickness > _CURVED * noise), noise


def move_to_creases(
    points: Tensor, labels: Tensor, touching: Neighbors, fit: FittedPlanes, reach: Tensor
) -> Tensor:
    """Move borders between flat regions to where their planes meet.

    Within the noise of a crease a pixel lies on both planes, and which region took it is chance.
    Where the middles of two regions are on opposite sides of the line in which their planes meet,
    each off the other's plane, a pixel on the other's side goes to the other region, if it is on
    its plane and next to a pixel of it that is straight behind, as seen from the crease: borders
    move across to the crease, never along it. Pixels that went are followed by those beside them.

    ``points`` are an image as a cloud, ``touching`` the pixels around each pixel, itself first, and
    ``reach`` the distance along the last coordinate that counts as on the plane, shape ``(M,)``.
    """
    offset = (fit.normal * fit.center).sum(dim=1, keepdim=True)
    planes = torch.cat([-fit.normal[:, :2], offset], dim=1) / fit.normal[:, 2:]
    middles = torch.cat([fit.center[:, :2], torch.ones_like(offset)], dim=1)
    around, counted = contact_neighbors(touching)
    rays = torch.cat([points[:, :2], torch.ones_like(points[:, :1])], dim=1)
    labels = labels.clone()
    rows = (labels >= 0).nonzero().squeeze(1)
    for _ in range(_MOST_MOVES):
        near = labels[around[rows]]
        other = counted[rows] & (near >= 0) & (near != labels[rows][:, None])
        at_border = other.any(dim=1)
        rows, near, other = rows[at_border], near[at_border].clamp(min=0), other[at_border]
        own = labels[rows][:, None]
        around_rays = rays[around[rows]]
        ray = rays[rows][:, None]
        apart = planes[own] - planes[near]
        here, there = (apart * ray).sum(dim=2), (apart * around_rays).sum(dim=2)
        mine, theirs = (apart * middles[own]).sum(dim=2), (apart * middles[near]).sum(dim=2)
        slope, step = apart[..., :2].norm(dim=2), (around_rays - ray)[..., :2].norm(dim=2)
        straight = there.abs() - here.abs() >= _STRAIGHT * slope * step
        away = (points[rows, 2:] - (planes[near] * ray).sum(dim=2)).abs()
        goes = other & straight & (here * mine < 0) & (mine * theirs < 0) & (away <= reach[near])
        goes &= (mine.abs() > reach[near]) & (theirs.abs() > reach[own])
        away = torch.where(goes, away, torch.inf)
        least = away.amin(dim=1, keepdim=True)
        moved = goes.any(dim=1)
        if not bool(moved.any()):
            break
        choice = torch.where(away == least, near, len(planes)).amin(dim=1)
        labels[rows[moved]] = choice[moved]
        rows = torch.unique(torch.cat([rows[moved], around[rows[moved]].flatten()]))
        rows = rows[labels[rows] >= 0]
    return labels
