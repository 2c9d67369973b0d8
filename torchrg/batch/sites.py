"""Voxel size for a cloud before it is segmented."""

import math

from torch import Tensor

from torchrg.neighbors import sample_voxels

_HALF = 1.594
"""Mean number of points per voxel at which half of them are left."""


def propose_voxel(points: Tensor) -> float:
    """Return a voxel size that leaves about half of the points ``(N, 3)``, to two digits.

    Points of one density have a Poisson distribution over the voxels of a surface: with a mean of m
    points, the fraction ``(1 - exp(-m)) / m`` is left.
    """
    is_finite = points.isfinite().all(dim=1)
    finite = points if bool(is_finite.all()) else points[is_finite]
    extent = float((finite.amax(dim=0) - finite.amin(dim=0)).max())
    size = 2 * extent / math.sqrt(len(finite))
    fraction, mean = len(sample_voxels(finite, size or 1.0).rows) / len(finite), 1.0
    for _ in range(50):
        mean = max((1 - math.exp(-mean)) / fraction, 1e-6)
    return float(f"{size * math.sqrt(_HALF / mean):.2g}")
