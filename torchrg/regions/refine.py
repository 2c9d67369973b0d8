"""What happens to regions after growth: release, absorption, merging."""

import torch
from torch import Tensor

from torchrg.config import GrowingConfig
from torchrg.regions.absorb import absorb_points
from torchrg.regions.cloud import GrowingCloud
from torchrg.regions.contacts import count_contacts
from torchrg.regions.criteria import neighborhood_radii
from torchrg.regions.fitting import FittedPlanes, fit_planes
from torchrg.regions.merge import Moments, merge_coplanar
from torchrg.regions.planes import are_curved
from torchrg.regions.segments import Segments
from torchrg.structures import UNLABELED


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
