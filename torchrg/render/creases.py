"""Creases: where the surface of a plane ends at an adjacent plane."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.config import load_config
from torchrg.metrics.contingency import number_labels
from torchrg.pipeline import segment_planes
from torchrg.regions.table import summarize_planes
from torchrg.render.surface import VisibleSurface

_ANGLE_DEG = 4.0
"""Maximum angle for region growing on voxels, in degrees. With more, ceilings grow into walls."""
_NUM_FILLS = 2
"""Number of times that planes of voxels extend to unlabeled voxels at their edges."""
_MAX_COSINE = 0.9
"""Maximum cosine between the normals of two planes that meet in a crease."""
_MAX_RMS = 0.25
"""Maximum RMS distance of a plane to its voxels, in voxel edges; others are curved."""
_NUM_PLANES = 3
"""Number of planes that meet in a corner."""


class Creases(NamedTuple):
    """The nearest planes around each of V voxels, up to three of different directions.

    Attributes:
        normals: Unit normals, shape ``(V, 3, 3)``; zero for fewer planes.
        offsets: Offsets along the normals, shape ``(V, 3)``.
        sides: Mean height of each plane's neighboring voxels above each plane, ``(V, 3, 3)``.
    """

    normals: Tensor
    offsets: Tensor
    sides: Tensor

    def normals_at(self, points: Tensor, voxels: Tensor) -> Tensor:
        """Return the normal of the nearest plane of each point, ``(n, 3)``; zero if unknown."""
        planes = self.normals[voxels]
        heights = ((planes * points[:, None]).sum(dim=2) - self.offsets[voxels]).abs()
        nearest = heights.masked_fill_((planes == 0).all(dim=2), torch.inf).argmin(dim=1)
        return planes[torch.arange(len(planes), device=planes.device), nearest]

    def bounds_of(self, points: Tensor, normals: Tensor, voxels: Tensor) -> Tensor:
        """Return the planes at which the surface of each point ends, shape ``(n, 2, 4)``.

        The surface is the plane most parallel to the normal of the point, and ends at the others,
        whose normals point to the surface. The last column is the height of the point above.
        """
        planes = self.normals[voxels]
        heights = (planes * points[:, None]).sum(dim=2) - self.offsets[voxels]
        column = (planes * normals[:, None]).sum(dim=2).abs().argmax(dim=1, keepdim=True)
        others = (column + torch.arange(1, _NUM_PLANES, device=column.device)) % _NUM_PLANES
        rows = torch.arange(len(column), device=column.device)[:, None]
        height = heights[rows, others]
        side = torch.where(height + self.sides[voxels][rows, column, others] < 0, -1.0, 1.0)
        bounds = torch.cat([planes[rows, others], height[:, :, None]], dim=2)
        return bounds * side[:, :, None]


def segment_surface(surface: VisibleSurface) -> Tensor:
    """Return the plane of the voxel of each of the n points, or -1."""
    config = load_config("classic").with_angle(_ANGLE_DEG)
    # Otherwise a few voxels at a corner join two walls to a region that is no wall.
    config = replace(config, growing=replace(config.growing, cut_bridges=True))
    labels = segment_planes(surface.centers, config).labels
    normals, offsets = _planes_of(surface, labels)
    for _ in range(_NUM_FILLS):
        around = labels[surface.near]
        lowest, column = _distances(surface, normals, offsets, around).min(dim=1, keepdim=True)
        is_free = (labels < 0) & (lowest[:, 0] <= surface.size / 2)
        labels = torch.where(is_free, around.gather(1, column)[:, 0], labels)
    return labels[surface.voxel_of]


def _planes_of(surface: VisibleSurface, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return normals and offsets by label; the last row is zero, as for curved surfaces."""
    planes = summarize_planes(surface.centers, surface.normals, labels)
    is_flat = planes.rms <= _MAX_RMS * surface.size
    nothing = surface.centers.new_zeros(1, 3)
    normals = torch.cat([planes.normal * is_flat[:, None], nothing])
    return normals, torch.cat([planes.offset * is_flat, nothing[:, 0]])


def _distances(surface: VisibleSurface, normals: Tensor, offsets: Tensor, around: Tensor) -> Tensor:
    """Return the distance of each voxel to the planes of its neighbors; infinite without one."""
    heights = (normals[around] * surface.centers[:, None]).sum(dim=2) - offsets[around]
    return heights.abs().masked_fill_((normals[around] == 0).all(dim=2), torch.inf)


def find_creases(surface: VisibleSurface, labels: Tensor) -> Creases:
    """Find the planes that meet around each voxel.

    Args:
        surface: Surface of at least one finite point.
        labels: Plane of each of its n points, shape ``(n,)``, or negative.
    """
    centers, near = surface.centers, surface.near
    numbers = number_labels(labels[surface.first])[1]
    normals, offsets = _planes_of(surface, numbers)
    around = numbers[near]
    heights = _distances(surface, normals, offsets, around)
    chosen, means = [], []
    for _ in range(_NUM_PLANES):
        lowest, column = heights.min(dim=1, keepdim=True)
        plane = torch.where(lowest < torch.inf, around.gather(1, column), -1)
        cosines = (normals[around] * normals[plane]).sum(dim=2).abs()
        heights.masked_fill_(cosines >= _MAX_COSINE, torch.inf)
        same = (around == plane).to(centers.dtype)
        total = (centers[near] * same[:, :, None]).sum(dim=1)
        means.append(total / same.sum(dim=1, keepdim=True).clamp(min=1))
        chosen.append(plane)
    rows = torch.cat(chosen, dim=1)
    sides = torch.stack(means, dim=1) @ normals[rows].mT - offsets[rows][:, None]
    return Creases(normals[rows], offsets[rows], sides)
