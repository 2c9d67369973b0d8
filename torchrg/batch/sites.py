"""Number of sites, one point per voxel, before a cloud is segmented."""

import math

import torch
from torch import Tensor

from torchrg.neighbors.voxels import cell_keys, split_voxels

_HALF = 1.594
"""Mean number of points per voxel at which half of them are left."""


def count_sites(points: Tensor, size: float) -> int:
    """Return the number of voxels with width ``size`` that contain finite points ``(N, 3)``.

    Example:
        >>> count_sites(torch.tensor([[0.0, 0, 0], [0.04, 0, 0], [0.11, 0, 0]]), 0.1)
        2
    """
    parts = split_voxels(points, size)
    return sum(len(torch.unique(cell_keys(cells))) for _, cells, _ in parts)


def propose_voxel(points: Tensor) -> float:
    """Return a voxel size that leaves about half of the points ``(N, 3)``, to two digits.

    Points of one density have a Poisson distribution over the voxels of a surface: with a mean of m
    points, the fraction ``(1 - exp(-m)) / m`` is left.
    """
    is_finite = points.isfinite().all(dim=1)
    finite = points if bool(is_finite.all()) else points[is_finite]
    extent = float((finite.amax(dim=0) - finite.amin(dim=0)).max())
    size = 2 * extent / math.sqrt(len(finite))
    fraction, mean = count_sites(finite, size or 1.0) / len(finite), 1.0
    for _ in range(50):
        mean = max((1 - math.exp(-mean)) / fraction, 1e-6)
    return float(f"{size * math.sqrt(_HALF / mean):.2g}")
