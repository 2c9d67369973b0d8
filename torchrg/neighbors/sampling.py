"""How a cloud samples its surfaces: what tells a mesh from a scan, and noise from form."""

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrg.neighbors.knn import SomeNeighbors
from torchrg.structures import Neighbors, Sampling

Array = NDArray[np.float64]

_NUM_SAMPLES = 600
"""Points whose neighbourhoods are measured; medians of so many are within some hundredths."""
_NUM_FOR_HEIGHT = 20_000
"""Points that the height is measured on."""
_SMALL, _LARGE = 16, 100
"""Points of the two neighbourhoods whose deviations from a plane are compared."""
_NEAREST, _EXACT = 9, 1e-3
"""Points of the neighbourhood that is in a plane, and the deviation by its radius up to which."""
_LENDERS = 3
"""Every third neighbour of a point lends its neighbours to the larger neighbourhood."""
_OUTLIERS = 0.001
"""Share of the points that the height leaves out on either side."""
_DIGITS = 3
"""Digits of a measure: fewer than what another unit or origin rounds."""


def measure_sampling(points: Tensor, neighbors: Neighbors | SomeNeighbors) -> Sampling:
    """Measure how a cloud samples its surfaces, on 600 points evenly along their canonical order.

    The deviation ``s_k`` of the k nearest points from their own plane, of k - 3 degrees of freedom,
    is the same at every k where noise is independent from point to point, and grows with k where
    surfaces are bent, made of facets, or smoothed by a reconstruction. Whiteness is the ratio of
    the medians of ``s_16`` and ``s_100`` over the flatter half of the neighbourhoods: 0.05 to 0.35
    for points of S3DIS-like meshes and scans of real offices, 0.6 to 1 for laser scanners, depth
    cameras and the vertices of noisy meshes. It is 1 where both deviations are 0, and for clouds
    of so few points that there are no two neighbourhoods to compare.

    Args:
        points: Finite points in canonical order, shape ``(N, 3)``.
        neighbors: Neighbors of each, as :func:`torchrg.search_knn` finds them, or a function that
            returns those of given rows; see :func:`prepare_search`.

    Returns:
        The measures, in three digits. They do not depend on the order of the points, on threads,
        chunks or unit; on origin and rotation no more than rounding does.

    Example:
        >>> import torch
        >>> from torchrg.neighbors import canonical_order, search_knn
        >>> floor = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0))
        >>> floor = floor[canonical_order(floor)] * torch.tensor([1.0, 1.0, 0.002])
        >>> sampling = measure_sampling(floor, search_knn(floor, 50))
        >>> sampling.whiteness > 0.9, 3500 < sampling.density < 4500
        (True, True)
    """
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
    exact = _deviations(patches[:, :_NEAREST]) <= _EXACT * distances[:, _NEAREST - 1]
    flatness = _deviations(patches) / radius
    flat = flatness <= np.median(flatness)
    small = np.median(_deviations(patches[flat, :_SMALL]))
    rows = rows[flat]
    lent = lists_of(lists_of(rows)[:, ::_LENDERS].ravel()).reshape(len(rows), -1)
    large = np.median(_deviations(_nearest(points, rows, lent, _LARGE)[-1]))
    whiteness = min(float(small / large), 1.0) if large > 0 else 1.0
    measures = whiteness, variation, float(exact.mean()), density, _height(points)
    return Sampling(*(float(f"{measure:.{_DIGITS}g}") for measure in measures))


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return up to so many of the first numbers, evenly apart."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.int64))


def _nearest(
    points: Tensor, rows: NDArray[np.int64], lists: NDArray[np.integer], most: int
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the nearest of the different places in lists ``(n, L)``, from the point itself on.

    These are the rows that have as many places as half of them have, up to ``most``, the distances,
    which ascend, and the places relative to the point.
    """
    lists = np.sort(lists, axis=1)
    cpu = points.detach().cpu()
    centers = cpu[rows].double().numpy()
    places = cpu[lists.ravel()].double().numpy().reshape(*lists.shape, 3) - centers[:, None]
    distances = np.sqrt((places * places).sum(axis=2))
    is_double = (distances == 0) & (lists != rows[:, None])
    is_double[:, 1:] |= lists[:, 1:] == lists[:, :-1]
    distances[is_double] = np.inf
    counts = np.isfinite(distances).sum(axis=1)
    count = min(most, int(np.median(counts))) if len(rows) else 0
    order = distances.argsort(axis=1, kind="stable")[counts >= count, :count]
    chosen = rows[counts >= count]
    return (
        chosen,
        np.take_along_axis(distances[counts >= count], order, axis=1),
        np.take_along_axis(places[counts >= count], order[..., None], axis=1),
    )


def _deviations(patches: Array) -> Array:
    """Return how far points ``(n, k, 3)`` are from their plane, with k - 3 degrees of freedom."""
    centered = patches - patches.mean(axis=1, keepdims=True)
    moments = np.linalg.eigvalsh(centered.swapaxes(1, 2) @ centered)
    lowest: Array = np.sqrt(np.maximum(moments[:, 0], 0) / max(patches.shape[1] - 3, 1))
    return lowest


def _height(points: Tensor) -> float:
    """Return the least extent of a cloud along its principal axes, without outliers."""
    places = points.detach().cpu()[_evenly(len(points), _NUM_FOR_HEIGHT)].double().numpy()
    centered = places - places.mean(axis=0)
    along = centered @ np.linalg.eigh(centered.T @ centered)[1]
    low, high = np.quantile(along, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    return float((high - low).min())
