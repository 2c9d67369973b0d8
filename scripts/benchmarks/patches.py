"""Planar patches inside the labeled parts of a scan.

The parts of a scan are objects, such as chairs, and few of them are planes. Up to three planes are
fitted to each part, largest first. A patch is a connected set of points within a tolerance of one
plane. A slice of a bent surface is no patch: as many points lie beyond its tolerance as within it.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

TOLERANCE = 0.015
"""Maximum distance of the points of a patch to its plane, in meters."""
MIN_PART, MIN_PATCH = 500, 200
"""Minimum number of points of a part and of a patch."""
MAX_PATCHES, MIN_INSIDE = 3, 0.8
"""Maximum number of patches of a part, and minimum fraction of the points within two tolerances of
the plane of a patch that are within one: half of a thick or bent part would be."""
GAP = 0.05
"""Maximum distance between connected points, in meters."""
NUM_HYPOTHESES = 1000
"""Planes through three random points of a part, of which the best is refitted."""
IGNORED = -2
"""Label of points without a patch."""

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def label_patches(
    points: Array, parts: NDArray[np.int64], tolerance: float = TOLERANCE
) -> NDArray[np.int64]:
    """Return the patch of each point ``(N,)``; ``parts`` are 0 or more, less for none.

    Points without a patch are ignored: parts may have planes there that are too small to count.
    """
    labels, count = np.full(len(points), IGNORED), 0
    for part in np.flatnonzero(np.bincount(parts[parts >= 0]) >= MIN_PART):
        rows = np.flatnonzero(parts == part)
        for patch in draw_patches(points[rows], tolerance, np.random.default_rng(part)):
            labels[rows[patch]] = count
            count += 1
    return labels


def draw_patches(points: Array, tolerance: float, rng: np.random.Generator) -> Iterator[Mask]:
    """Yield the patches ``(n,)`` of a part."""
    free = np.ones(len(points), dtype=bool)
    for _ in range(MAX_PATCHES):
        rows = np.flatnonzero(free)
        distance = distances_to_best_plane(points, rows, tolerance, rng)
        if (distance[rows] <= tolerance).sum() < MIN_PATCH:
            return
        near = largest_component(points, free & (distance <= 2 * tolerance))
        patch = near & (distance <= tolerance)
        if patch.sum() >= max(MIN_PATCH, MIN_INSIDE * near.sum()):
            yield patch
        free &= ~near


def distances_to_best_plane(
    points: Array, rows: NDArray[np.int64], tolerance: float, rng: np.random.Generator
) -> Array:
    """Return the distances of all points to the plane with most of ``rows`` within tolerance."""
    if not len(rows):
        return np.full(len(points), np.inf)
    corners = points[rng.choice(rows, (NUM_HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.full_like(normals, np.nan), where=lengths > 0)
    offsets = (normals * corners[:, 0]).sum(axis=1)
    some = points[rows[:: max(len(rows) // 2000, 1)]]
    best = (np.abs(some @ normals.T - offsets) <= tolerance).sum(axis=0).argmax()
    normal, offset = normals[best], offsets[best]
    for _ in range(5):
        inside = rows[np.abs(points[rows] @ normal - offset) <= tolerance]
        if not len(inside):  # All points are identical, or on a line.
            return np.full(len(points), np.inf)
        center = points[inside].mean(axis=0)
        normal = np.linalg.svd(points[inside] - center, full_matrices=False)[2][2]
        offset = normal @ center
    return np.abs(points @ normal - offset)


def largest_component(points: Array, mask: Mask) -> Mask:
    """Return the largest connected set of the masked points."""
    rows = np.flatnonzero(mask)
    pairs = cKDTree(points[rows]).query_pairs(GAP, output_type="ndarray")
    shape = (len(rows), len(rows))
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=shape)
    component = connected_components(graph, directed=False)[1]
    largest = np.zeros_like(mask)
    largest[rows[component == np.bincount(component).argmax()]] = True
    return largest
