"""Number of sites, one point per voxel, before a cloud is segmented."""

import math

import torch
from torch import Tensor

_MAX_CELLS = 2**21
"""Number of cells along an axis after which their numbers repeat: three of them fit into int64."""
_HALF = 1.594
"""Mean number of points per voxel at which half of them are left."""
_POINTS_AT_ONCE = 2**20
"""Number of points whose voxels are found at a time."""


def count_sites(points: Tensor, size: float) -> int:
    """Return the number of voxels with width ``size`` that contain finite points ``(N, 3)``.

    Example:
        >>> count_sites(torch.tensor([[0.0, 0, 0], [0.04, 0, 0], [0.11, 0, 0]]), 0.1)
        2
    """
    low, parts = torch.where(points.isfinite(), points, torch.inf).amin(dim=0), []
    for part in torch.split(points, _POINTS_AT_ONCE):
        cells = (part[part.isfinite().all(dim=1)].double() - low).div(size).floor().long()
        x, y, z = cells.remainder(_MAX_CELLS).unbind(dim=1)
        parts.append(torch.unique((x * _MAX_CELLS + y) * _MAX_CELLS + z))
    return len(torch.unique(torch.cat(parts)))


def propose_voxel(points: Tensor) -> float:
    """Return a voxel size that leaves about half of the points ``(N, 3)``, to two digits.

    Points of one density have a Poisson distribution over the voxels of a surface: with a mean of m
    points, the fraction ``(1 - exp(-m)) / m`` is left.
    """
    finite = points[points.isfinite().all(dim=1)]
    extent = float((finite.amax(dim=0) - finite.amin(dim=0)).max())
    size = 2 * extent / math.sqrt(len(finite))
    fraction, mean = count_sites(finite, size or 1.0) / len(finite), 1.0
    for _ in range(50):
        mean = max((1 - math.exp(-mean)) / fraction, 1e-6)
    return float(f"{size * math.sqrt(_HALF / mean):.2g}")
