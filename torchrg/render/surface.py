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
MAX_SPACING_RATIO = 4.0
"""Maximum ratio of the spacing of points in a plane to the median."""
MAX_DISCS = 2**19
"""Maximum number of points that an image shows; more would not be visible in two million pixels."""
_CHUNK_POINTS = 2**17
"""Number of points sampled at a time."""
_PRIMES = (73_856_093, 19_349_663, 83_492_791)
"""Factors of a spatial hash."""


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

    def disc_spacing(self, labels: Tensor) -> Tensor:
        """Return the spacing that the disc of each of the n points must cover, shape ``(n,)``.

        ``labels`` ``(n,)`` are their planes, or negative. The spacing is at most the median for
        points in no plane or in no planar voxel, so that outliers stay small.
        """
        in_plane = (self.normals != 0).any(dim=1)[self.voxel_of] & (labels >= 0)
        cap = torch.where(in_plane, MAX_SPACING_RATIO, 1.0)
        return torch.minimum(self.spacing, self.spacing.median() * cap)


def sample_rows(points: Tensor) -> Tensor:
    """Return the rows of at most :data:`MAX_DISCS` finite points, evenly spread over surfaces.

    Voxels are hashed to slots, and each slot keeps one point. The memory does not grow with
    the cloud, and the order of the points matters only for duplicates.
    """
    if len(points) <= MAX_DISCS:
        return points.isfinite().all(dim=-1).nonzero().squeeze(-1)
    parts = torch.split(points.detach(), _CHUNK_POINTS)
    low, high = (
        torch.stack([end(part.nan_to_num(*[missing] * 3), dim=0) for part in parts]).double()
        for end, missing in ((torch.amin, torch.inf), (torch.amax, -torch.inf))
    )
    low, size = low.amin(dim=0), float((high.amax(dim=0) - low.amin(dim=0)).amax()) / 2**8
    unset = torch.iinfo(torch.int64).max
    slots = torch.full((MAX_DISCS,), unset, device=points.device)
    primes = torch.tensor(_PRIMES, device=points.device)
    for _ in range(_BITS):
        size /= 2
        slots.fill_(unset)
        for number, part in enumerate(parts):
            rows = part.isfinite().all(dim=1).nonzero().squeeze(1)
            chosen = part[rows]
            cells = ((chosen - low) / size).clamp(max=2.0**40).long() * primes
            bits = chosen.float().view(torch.int32).long() * primes
            slot, draw = (_mixed(values) for values in (cells, bits))
            rows += number * _CHUNK_POINTS
            slots.scatter_reduce_(0, slot % MAX_DISCS, draw % 2**31 << 32 | rows, "amin")
        # Outliers would make voxels too large.
        if int(torch.count_nonzero(slots != unset)) > MAX_DISCS // 2:
            break
    return (slots[slots != unset] % 2**32).sort().values


def _mixed(values: Tensor) -> Tensor:
    """Return a hash of the rows of ``(n, 3)`` int64 values."""
    hashed = values[:, 0] ^ values[:, 1] ^ values[:, 2]
    hashed = (hashed ^ hashed >> 31) * 0x7FB5D329728EA185
    return (hashed ^ hashed >> 27) * -0x7E25210B43D22BB3


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
