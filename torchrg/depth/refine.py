"""What happens to regions of a depth image after growth: absorption, merging, sharp creases."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import DepthConfig
from torchrg.linalg.moments import Segments
from torchrg.regions.adjacency import contact_neighbors
from torchrg.regions.growth import number_by_size
from torchrg.regions.planes import FittedPlanes, fit_planes
from torchrg.regions.refine import absorb_points, merge_coplanar, reach_of_planes
from torchrg.structures import Neighbors

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
    the median depth ``c``: a projective map of space.

    Attributes:
        points: Shape ``(H * W, 3)``, float64.
        normals: Unit normals of the pixels' planes in this cloud, shape ``(H * W, 3)``.
        noise: Standard deviation of the last coordinate, shape ``(H * W,)``.
        seen: Pixels with depth, shape ``(H * W,)``, bool.
    """

    points: Tensor
    normals: Tensor
    noise: Tensor
    seen: Tensor


def refine_pixels(
    cloud: InverseCloud, labels: Tensor, touching: Neighbors, config: DepthConfig
) -> tuple[Tensor, FittedPlanes]:
    """Settle borders and parts of the regions of a depth image.

    Twice, pixels without a region join the one beside them whose plane they are on, and flat
    regions that touch and lie on one plane are merged. Then borders between regions move to the
    lines where their planes meet.

    Args:
        cloud: The image as a cloud.
        labels: Region of each pixel, shape ``(H * W,)``, at least one.
        touching: The pixels with depth around each pixel, itself first.
        config: Settings.

    Returns:
        Labels by descending size, and the planes of the regions in the cloud; curved are those
        thicker than noise can make them.
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
