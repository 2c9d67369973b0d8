"""What happens to regions of a depth image after growth: absorption, merging, sharp creases."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import DepthConfig
from torchrg.linalg.moments import Segments
from torchrg.regions.adjacency import count_contacts
from torchrg.regions.growth import number_by_size
from torchrg.regions.planes import FittedPlanes, fit_planes
from torchrg.regions.refine import Moments, absorb_points, merge_coplanar
from torchrg.structures import UNLABELED, Neighbors

# In pixels: no window reaches farther from its middle.
_MOST_ROUNDS = 16
_STRAIGHT = 0.85


def move_to_creases(
    points: Tensor, labels: Tensor, touching: Neighbors, fit: FittedPlanes, reach: Tensor
) -> Tensor:
    """Move borders between flat regions to where their planes meet.

    Within the noise of a crease a pixel lies on both planes, and which region took it is chance.
    Where the middles of two regions are on opposite sides of the line in which their planes meet,
    each off the other's plane, a pixel on the other's side goes to the other region, if it is on
    its plane and next to a pixel of it that is straight behind, as seen from the crease: borders
    move across to the crease, never along it. Pixels that went are followed by those beside them.

    Args:
        points: An image as a cloud whose first two coordinates are the slopes of the rays, shape
            ``(N, 3)``, float64.
        labels: Region of each pixel, shape ``(N,)``, negative for none.
        touching: The pixels around each pixel, itself first.
        fit: Planes of the regions in that cloud.
        reach: Distance along the last coordinate that counts as on the plane, shape ``(M,)``; NaN
            for regions that are no planes.

    Returns:
        Labels, shape ``(N,)``.

    Example:
        >>> x = torch.arange(-4.0, 5).double()
        >>> points = torch.stack([x, torch.zeros(9).double(), x.abs()], dim=1)
        >>> rows = torch.arange(9)[:, None]
        >>> touching = Neighbors(torch.cat([rows, rows - 1, rows + 1], dim=1).clamp(0, 8))
        >>> normal = torch.tensor([[1.0, 0, 1], [-1, 0, 1]]).double()
        >>> center = torch.tensor([[-2.0, 0, 2], [2, 0, 2]]).double()
        >>> fit = FittedPlanes(normal, center, *[normal] * 4)
        >>> labels = torch.tensor([0, 0, 0, 0, 0, 0, 0, 1, 1])
        >>> move_to_creases(points, labels, touching, fit, torch.ones(2)).tolist()
        [0, 0, 0, 0, 0, 1, 1, 1, 1]
    """
    offset = (fit.normal * fit.center).sum(dim=1, keepdim=True)
    planes = torch.cat([-fit.normal[:, :2], offset], dim=1) / fit.normal[:, 2:]
    middles = torch.cat([fit.center[:, :2], torch.ones_like(offset)], dim=1)
    around = touching.indices[:, 1:].long()
    counted = None if touching.valid is None else touching.valid[:, 1:]
    rays = torch.cat([points[:, :2], torch.ones_like(points[:, :1])], dim=1)
    labels = labels.clone()
    rows = (labels >= 0).nonzero().squeeze(1)
    for _ in range(_MOST_ROUNDS):
        near = labels[around[rows]]
        other = (near >= 0) & (near != labels[rows][:, None])
        if counted is not None:
            other &= counted[rows]
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


_NUM_ROUNDS = 2
_CURVED = 3.0


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
) -> tuple[Tensor, FittedPlanes, Tensor]:
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
        Labels by descending size, the planes of the regions in the cloud, and whether a region is
        thicker than noise can make it, shape ``(M,)``.
    """
    for _ in range(_NUM_ROUNDS):
        labels = _absorb(cloud, labels, touching, config)
        labels = _merge(cloud, labels, touching, config)
    labels = _sharpen(cloud, labels, touching, config)
    _, fit, _, curved = _planes_of(cloud, labels)
    return labels, fit, curved


def _absorb(
    cloud: InverseCloud, labels: Tensor, touching: Neighbors, config: DepthConfig
) -> Tensor:
    """Give pixels without a region to the flat regions beside them whose plane they are on."""
    _, fit, noise, curved = _planes_of(cloud, labels)
    reach = config.absorb_reach * torch.maximum(fit.thickness, noise)
    return absorb_points(
        cloud.points,
        cloud.normals,
        labels,
        touching,
        (fit.normal, fit.center, torch.where(curved, torch.nan, reach)),
        valid=cloud.seen,
        max_angle_deg=90.0,
    )


def _merge(cloud: InverseCloud, labels: Tensor, touching: Neighbors, config: DepthConfig) -> Tensor:
    """Merge flat regions that touch and lie on one plane, and number them by size."""
    segments, fit, noise, curved = _planes_of(cloud, labels)
    pairs, num_contacts = count_contacts(labels, touching)
    flat = ~curved[pairs].any(dim=1)
    own = (fit.normal[:, None] @ fit.covariance @ fit.normal[:, :, None])[:, 0, 0]
    moments = Moments(
        segments.counts.double(),
        fit.center - fit.center[:1],
        fit.covariance,
        torch.maximum(own.clamp(min=0).sqrt(), noise),
    )
    owner = merge_coplanar(
        moments, pairs[flat], num_contacts[flat], tolerance=config.merge_tolerance
    )
    owner = torch.cat([owner, torch.tensor([UNLABELED])])
    merged: Tensor = owner[labels.cpu()].to(labels.device)
    return _numbered(merged, config)


def _sharpen(
    cloud: InverseCloud, labels: Tensor, touching: Neighbors, config: DepthConfig
) -> Tensor:
    """Move borders of flat regions to where their planes meet."""
    _, fit, noise, curved = _planes_of(cloud, labels)
    reach = config.absorb_reach * torch.maximum(fit.thickness, noise)
    reach = torch.where(curved, torch.nan, reach)
    return _numbered(move_to_creases(cloud.points, labels, touching, fit, reach), config)


def _numbered(labels: Tensor, config: DepthConfig) -> Tensor:
    """Return labels numbered by size; regions that are too small have none."""
    numbers = number_by_size(labels.cpu().numpy(), config.min_size)
    return torch.from_numpy(numbers).to(labels.device)


def _planes_of(
    cloud: InverseCloud, labels: Tensor
) -> tuple[Segments, FittedPlanes, Tensor, Tensor]:
    """Return regions, planes, the noise of each, and whether it is curved, both ``(M,)``."""
    segments = Segments(labels)
    fit = fit_planes(segments, cloud.points, cloud.normals)
    noise = segments.median(segments.take(cloud.noise))
    return segments, fit, noise, fit.thickness > _CURVED * noise
