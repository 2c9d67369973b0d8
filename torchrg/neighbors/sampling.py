"""Surface sampling statistics that distinguish meshes from scans."""

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.neighbors.knn import SomeNeighbors
from torchrg.structures import AnyCloud, Neighbors, Sampling

FloatArray = NDArray[np.float64]

_NUM_SAMPLES = 600
"""Number of measured neighborhoods; their medians are accurate to a few hundredths."""
_NUM_FOR_HEIGHT = 20_000
"""Number of points used to measure the height."""
_SMALL, _LARGE = 16, 100
"""Sizes of the two neighborhoods whose deviations from a plane are compared."""
_NEAREST, _EXACT = 9, 1e-3
"""Size of the neighborhood tested for planarity, and its maximum ratio of deviation to radius."""
_STRIDE = 3
"""Every third neighbor of a point contributes its neighbors to the larger neighborhood."""
_OUTLIER_FRACTION = 0.001
"""Fraction of the points excluded from the height on either side."""
_DIGITS = 3
"""Significant digits of a measure; another unit or origin changes only further digits."""


def measure_sampling(points: AnyCloud, neighbors: Neighbors | SomeNeighbors) -> Sampling:
    """Measure the surface sampling of a cloud at 600 points along the canonical order.

    Let ``s_k`` be the deviation of the k nearest points from their plane, with k - 3 degrees of
    freedom. It is the same for every k if noise is independent per point. It grows with k if
    surfaces are curved, faceted, or smoothed by a reconstruction. Whiteness is the ratio of the
    medians of ``s_16`` and ``s_100`` over the flatter half of the neighborhoods. It is 0.05 to 0.35
    for points of S3DIS-like meshes and scans of real offices. It is 0.6 to 1 for laser scanners,
    depth cameras and the vertices of noisy meshes. It is 1 if both deviations are 0, and for clouds
    with too few points for two neighborhood sizes.

    Args:
        points: Finite points in canonical order, shape ``(N, 3)``.
        neighbors: Neighbors of each point from :func:`torchrg.search_knn`, or a function that
            returns the neighbors of rows, such as the result of :func:`prepare_search`.

    Returns:
        The measures, to three digits. They do not depend on the point order, threads, chunks or
        unit, and on origin and rotation only through rounding.

    Example:
        >>> import torch
        >>> from torchrg.neighbors import canonical_order, search_knn
        >>> floor = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0))
        >>> floor = floor[canonical_order(floor)] * torch.tensor([1.0, 1.0, 0.002])
        >>> sampling = measure_sampling(floor, search_knn(floor, 50))
        >>> sampling.whiteness > 0.9, 3500 < sampling.density < 4500
        (True, True)
    """
    points = as_tensor("measure_sampling", "points", points)
    rows = _evenly(len(points), _NUM_SAMPLES)
    lists_of = neighbors if callable(neighbors) else neighbors.indices.cpu().numpy().__getitem__
    lists = lists_of(rows)
    rows, distances, patches = _nearest(points, rows, lists, lists.shape[1])
    k = distances.shape[1]
    if k <= _SMALL:
        return Sampling()
    radius, first = distances[:, -1], distances[:, 1]
    density = k / (math.pi * float(np.median(radius)) ** 2)
    variation = float(first.std() / first.mean())
    exact = _deviations(patches[..., :_NEAREST]) <= _EXACT * distances[:, _NEAREST - 1]
    flatness = _deviations(patches) / radius
    flat = flatness <= np.median(flatness)
    small = np.median(_deviations(patches[flat, :, :_SMALL]))
    rows = rows[flat]
    # The list of a point may already contain its nearest hundred.
    extended = lists_of(rows)
    if k < _LARGE:
        extended = lists_of(extended[:, ::_STRIDE].ravel()).reshape(len(rows), -1)
    large = np.median(_deviations(_nearest(points, rows, extended, _LARGE)[-1]))
    whiteness = min(float(small / large), 1.0) if large > 0 else 1.0
    exactness, height = float(exact.mean()), _height(points)
    measures = whiteness, variation, exactness, density, height, float(large)
    return Sampling(*(float(f"{measure:.{_DIGITS}g}") for measure in measures))


def _evenly(count: int, max_count: int) -> NDArray[np.int64]:
    """Return up to ``max_count`` evenly spaced integers below ``count``."""
    return np.unique(np.linspace(0, count - 1, min(max_count, count)).astype(np.int64))


def _nearest(
    points: Tensor, rows: NDArray[np.int64], lists: NDArray[np.integer], max_count: int
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Return the nearest distinct positions in lists ``(n, L)``, starting with the point itself.

    Returns the rows with at least the median number of positions, up to ``max_count``, the
    ascending distances, and the positions relative to the point, ``(n, 3, count)``.
    """
    lists = np.sort(lists, axis=1)
    is_first = np.diff(lists, axis=1, prepend=-1) > 0
    # Lists of neighbors of neighbors repeat most points: keep one of each, at the beginning.
    sizes = is_first.sum(axis=1)
    is_filled = np.arange(sizes.max(initial=0)) < sizes[:, None]
    distinct = np.zeros(is_filled.shape, dtype=lists.dtype)
    distinct[is_filled] = lists[is_first]
    x, y, z = positions = [
        column[distinct].astype(np.float64) - column[rows].astype(np.float64)[:, None]
        for column in points.numpy(force=True).T
    ]
    distances = np.sqrt(x * x + y * y + z * z)
    distances[~is_filled | ((distances == 0) & (distinct != rows[:, None]))] = np.inf
    counts = np.isfinite(distances).sum(axis=1)
    count = min(max_count, int(np.median(counts))) if len(rows) else 0
    is_chosen = counts >= count
    order = distances[is_chosen].argsort(axis=1, kind="stable")[:, :count]
    near = [np.take_along_axis(v[is_chosen], order, axis=1) for v in (distances, *positions)]
    return rows[is_chosen], near[0], np.stack(near[1:], axis=1)


def _deviations(patches: FloatArray) -> FloatArray:
    """Return RMS distances of points ``(n, 3, k)`` to their plane, k - 3 degrees of freedom."""
    centered = patches - patches.mean(axis=2, keepdims=True)
    moments = np.linalg.eigvalsh(centered @ centered.swapaxes(1, 2))
    deviation: FloatArray = np.sqrt(np.maximum(moments[:, 0], 0) / max(patches.shape[2] - 3, 1))
    return deviation


def _height(points: Tensor) -> float:
    """Return the minimum extent of a cloud along its principal axes, without outliers."""
    positions = points.detach().cpu()[_evenly(len(points), _NUM_FOR_HEIGHT)].double().numpy()
    centered = positions - positions.mean(axis=0)
    along = centered @ np.linalg.eigh(centered.T @ centered)[1]
    low, high = np.quantile(along, [_OUTLIER_FRACTION, 1 - _OUTLIER_FRACTION], axis=0)
    return float((high - low).min())
