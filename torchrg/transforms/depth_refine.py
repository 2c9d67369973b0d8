"""What happens to regions of a depth image after growth: absorption, merging, sharp creases."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.regions.absorb import absorb_points
from torchrg.regions.contacts import count_contacts
from torchrg.regions.fitting import FittedPlanes, fit_planes
from torchrg.regions.grow import number_by_size
from torchrg.regions.merge import Moments, merge_coplanar
from torchrg.regions.segments import Segments
from torchrg.structures import UNLABELED, Neighbors
from torchrg.transforms.depth_config import DepthConfig
from torchrg.transforms.depth_creases import move_to_creases

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
