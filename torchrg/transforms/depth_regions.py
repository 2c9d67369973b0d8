"""Regions of a depth image: growth from pixel to pixel, then borders and parts of one face."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import GrowingConfig
from torchrg.linalg import unsigned_angle_deg
from torchrg.regions import grow_regions
from torchrg.regions.absorb import absorb_points
from torchrg.regions.contacts import count_contacts
from torchrg.regions.fitting import FittedPlanes, fit_planes
from torchrg.regions.grow import number_by_size
from torchrg.regions.merge import Moments, merge_coplanar
from torchrg.regions.segments import Segments
from torchrg.structures import UNLABELED, Neighbors
from torchrg.transforms.depth_config import DepthConfig
from torchrg.transforms.depth_normals import PixelPlanes
from torchrg.transforms.depth_windows import moved

AROUND = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Steps in rows and columns to the pixels around one, the nearest first."""

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


class PixelRegions(NamedTuple):
    """Regions of a depth image.

    Attributes:
        labels: Shape ``(H * W,)``: 0 to M-1 by descending size, or :data:`torchrg.UNLABELED`.
        normals: Unit normals of their planes towards the camera, in space, shape ``(M, 3)``.
        curved: Whether a region is thicker than noise can make it, shape ``(M,)``, bool.
    """

    labels: Tensor
    normals: Tensor
    curved: Tensor


def grow_pixels(
    cloud: InverseCloud,
    pixels: PixelPlanes,
    normals: Tensor,
    u: Tensor,
    v: Tensor,
    config: DepthConfig,
) -> PixelRegions:
    """Grow regions over a depth image, and give border pixels and parts of one face to them.

    Two pixels side by side are neighbours if both have a flat window, their normals are within the
    angle, and at both pixels their two planes differ by at most ``max_step`` times the noise: no
    neighbourhood crosses a step. :func:`torchrg.grow_regions` grows along them, from the pixels
    with the flattest large windows. Then, twice, pixels without a region join the one beside them
    whose plane they are on, and flat regions that touch and lie on one plane are merged.

    Args:
        cloud: The image as a cloud.
        pixels: The pixels' planes.
        normals: Their normals in space, shape ``(H, W, 3)``.
        u: Columns from the optical axis, shape ``(W,)``.
        v: Rows from the optical axis, shape ``(H, 1)``.
        config: Settings.

    Returns:
        The regions.
    """
    rows = _rows_around(pixels.flat)
    joined = torch.stack([_joins(pixels, normals, u, v, step, config) for step in AROUND], dim=-1)
    size = pixels.radius.clamp(min=1).double()
    roughness = (pixels.planes.deviation / pixels.noise) / (size * size)
    labels = grow_regions(
        cloud.points,
        cloud.normals,
        torch.where(pixels.flat, roughness, 0.0).flatten(),
        Neighbors(rows, _with_self(joined)),
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
        return PixelRegions(labels, normals.new_empty(0, 3), pixels.flat.new_empty(0))
    image = cloud.seen.view(pixels.flat.shape)
    beside = torch.stack([image & moved(image, step, fill=False) for step in AROUND], dim=-1)
    touching = Neighbors(rows, _with_self(beside))
    for _ in range(_NUM_ROUNDS):
        labels = _absorb(cloud, labels, touching, config)
        labels = _merge(cloud, labels, touching, config)
    _, fit, _, curved = _planes_of(cloud, labels)
    distance = (fit.normal * fit.center).sum(dim=1)
    away = torch.stack([-fit.normal[:, 0], -fit.normal[:, 1], distance], dim=1)
    away = torch.where(fit.normal[:, 2:] < 0, -away, away)
    return PixelRegions(labels, -away / away.norm(dim=1, keepdim=True), curved)


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


def _rows_around(image: Tensor) -> Tensor:
    """Return the rows of each pixel and of those around it, shape ``(H * W, 9)``, int32."""
    rows = torch.arange(image.numel(), dtype=torch.int32, device=image.device).view(image.shape)
    return torch.stack([rows, *(moved(rows, step, fill=0) for step in AROUND)], dim=-1).view(-1, 9)


def _with_self(around: Tensor) -> Tensor:
    """Return a mask ``(H, W, 8)`` of the pixels around as one of neighbours, ``(H * W, 9)``."""
    itself = torch.ones_like(around[..., :1])
    return torch.cat([itself, around], dim=-1).view(-1, 9)


def _planes_of(
    cloud: InverseCloud, labels: Tensor
) -> tuple[Segments, FittedPlanes, Tensor, Tensor]:
    """Return regions, planes, the noise of each, and whether it is curved, both ``(M,)``."""
    segments = Segments(labels)
    fit = fit_planes(segments, cloud.points, cloud.normals)
    noise = segments.median(segments.take(cloud.noise))
    return segments, fit, noise, fit.thickness > _CURVED * noise


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
    merged = number_by_size(owner[labels.cpu()].numpy(), config.min_size)
    return torch.from_numpy(merged).to(labels.device)
