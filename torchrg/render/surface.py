"""Density and normals of a cloud, from voxels with a few points each."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import covariance, eigh3
from torchrg.neighbors import search_knn
from torchrg.neighbors.knn import gather_patches
from torchrg.neighbors.order import spread_bits

_BITS = 20
"""The longest side of a cloud has ``2**_BITS`` steps; points of one step are duplicates."""
_MAX_VOXELS = 60_000
"""Maximum number of voxels of a cloud: every 5 cm in a room of 6 m."""
_MAX_SINGLE_VOXELS = 1000
"""Number of points up to which each point has its own voxel."""
_NEIGHBORS = 16
"""Number of neighboring voxels for density and normals."""
_FLAT = 0.15
"""Maximum ratio of the two smallest eigenvalues of coplanar voxels."""


class VisibleSurface(NamedTuple):
    """The n finite points of a cloud along a Morton curve, in V voxels.

    Attributes:
        rows: Row of each point in the cloud, shape ``(n,)``, int64.
        points: Coordinates relative to ``origin``, shape ``(n, 3)``, float32.
        origin: Lower corner of the bounding box, shape ``(3,)``, float64.
        spacing: Distance of points to their neighbors on the surface, ``(n,)``; 0 if all coincide.
        voxel_of: Voxel of each point, shape ``(n,)``.
        first: First point of each voxel, shape ``(V,)``.
        centers: Means of the points, shape ``(V, 3)``, float32, relative to ``origin``.
        normals: Unit normals of arbitrary sign, shape ``(V, 3)``; zero without a plane.
        near: Nearest voxels, including itself first, shape ``(V, K)``.
        size: Edge of a voxel, or the median spacing if larger.
    """

    rows: Tensor
    points: Tensor
    origin: Tensor
    spacing: Tensor
    voxel_of: Tensor
    first: Tensor
    centers: Tensor
    normals: Tensor
    near: Tensor
    size: float

    def normals_at(self, rows: Tensor) -> Tensor:
        """Return unit normals of the selected points, ``(*, 3)``; zero without a plane.

        In a voxel at an edge, a point gets the normal of the nearest plane of a neighboring voxel.
        """
        voxel = self.voxel_of[rows]
        normals = self.normals[voxel]
        at_edge = (normals == 0).all(dim=1).nonzero().squeeze(1)
        near = self.near[voxel[at_edge]]
        around = self.normals[near]
        away = self.points[rows[at_edge], None] - self.centers[near]
        heights = (away * around).sum(dim=2).abs()
        heights.masked_fill_((around == 0).all(dim=2), torch.inf)
        best = heights.argmin(dim=1)
        return normals.index_copy(0, at_edge, around[torch.arange(len(best)), best])

    def disc_spacing(self, cap: float, labels: Tensor | None = None) -> Tensor:
        """Return the spacing that the disc of each of the n points must cover, shape ``(n,)``.

        It is at most ``cap`` times the median for points in a plane, and at most the median
        for other points, so that outliers stay small.

        Args:
            cap: Maximum ratio to the median spacing.
            labels: Plane of each of the n points, shape ``(n,)``, or negative. Default: points of
                planar voxels are in a plane.
        """
        in_plane = (self.normals != 0).any(dim=1)[self.voxel_of]
        if labels is not None:
            in_plane = in_plane & (labels >= 0)
        return torch.minimum(self.spacing, self.spacing.median() * torch.where(in_plane, cap, 1.0))


def sample_surface(points: Tensor) -> VisibleSurface:
    """Sort the finite points of a cloud into voxels, and measure density and normals.

    The result does not depend on the order of the points: sums of integers are exact.
    """
    rows = points.isfinite().all(dim=-1).nonzero().squeeze(-1)
    finite = points[rows].detach()
    low = finite.amin(dim=0) if len(rows) else finite.new_zeros(3)
    local = (finite - low).float()
    step = float(local.amax()) / 2**_BITS if len(rows) else 0.0
    steps = torch.zeros_like(local, dtype=torch.int64)
    if step > 0:
        steps = (local / step).int().clamp_(max=2**_BITS - 1).long()
    codes = sum((spread_bits(steps[:, axis]) << axis for axis in range(3)), torch.zeros_like(rows))
    codes, order = codes.sort(stable=True)
    distinct = torch.unique_consecutive(codes)
    level = _level_of_voxels(distinct)
    counts = torch.unique_consecutive(distinct >> 3 * level, return_counts=True)[1]
    _, voxel_of, held = torch.unique_consecutive(
        codes >> 3 * level, return_inverse=True, return_counts=True
    )
    sums = steps.new_zeros(len(held), 3).index_add_(0, voxel_of, steps[order])
    centers = ((sums / held.double()[:, None] + 0.5) * step).float()
    spacing, normals, near = _measure(centers, counts)
    return VisibleSurface(
        rows[order],
        local[order],
        low.double(),
        spacing[voxel_of],
        voxel_of,
        held.cumsum(0) - held,
        centers,
        normals,
        near,
        max(step * 2**level, float(spacing.median()) if len(spacing) else 0.0),
    )


def _level_of_voxels(codes: Tensor) -> int:
    """Return how often steps are doubled until voxels have two points on average, within limits."""
    cap = min(_MAX_VOXELS, max(_MAX_SINGLE_VOXELS, len(codes) // 2))
    level = 0
    while int((codes >> 3 * level).diff().count_nonzero()) >= cap:
        level += 1
    return level


def _measure(centers: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the spacing of points ``(V,)``, the normals and the nearest voxels.

    Voxels with covariance eigenvalues ``a <= b <= c`` cover about ``12 sqrt(b c)`` of a plane,
    ``sqrt(12 c)`` of a line.
    """
    if len(centers) < 2:
        nothing = torch.zeros_like(centers)
        return nothing[:, 0], nothing, nothing[:, :1].long()
    near = search_knn(centers, min(_NEIGHBORS, len(centers))).indices.long()
    values, vectors = eigh3(covariance(gather_patches(centers, near))[1])
    num_points = counts[near].sum(dim=1)
    smallest, middle, largest = values.clamp(min=0).unbind(dim=1)
    area, length = 12 * (middle * largest).sqrt(), (12 * largest).sqrt()
    flat = (smallest < _FLAT * middle)[:, None]
    spacing = torch.maximum((area / num_points).sqrt(), length / num_points)
    return spacing, torch.where(flat, vectors[..., 0], 0.0), near
