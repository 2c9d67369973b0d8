"""Regions of a depth image: growth from pixel to pixel, then borders and parts of one face."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import DepthConfig, GrowingConfig
from torchrg.depth.normals import PixelPlanes
from torchrg.depth.refine import InverseCloud, refine_pixels
from torchrg.depth.windows import moved
from torchrg.linalg import unsigned_angle_deg
from torchrg.regions import grow_regions
from torchrg.structures import Neighbors

_AROUND = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Steps in rows and columns to the pixels around one, the nearest first."""


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
    with the flattest large windows, and :func:`refine_pixels` settles the rest.

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
        return PixelRegions(labels, normals.new_empty(0, 3), pixels.flat.new_empty(0))
    image = cloud.seen.view(pixels.flat.shape)
    touching = _neighbors([image & moved(image, step, fill=False) for step in _AROUND])
    labels, fit = refine_pixels(cloud, labels, touching, config)
    distance = (fit.normal * fit.center).sum(dim=1)
    away = torch.stack([-fit.normal[:, 0], -fit.normal[:, 1], distance], dim=1)
    away = torch.where(fit.normal[:, 2:] < 0, -away, away)
    return PixelRegions(labels, -away / away.norm(dim=1, keepdim=True), fit.curved)


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
