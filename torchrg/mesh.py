"""Faces of a mesh: which side of the surface is the front at each vertex.

A face is a list of three or more vertices, counter-clockwise as seen from its front. Nothing is
kept of it but what it adds to sums at its vertices.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError

Fronts = tuple[NDArray[np.float32] | None, tuple[str, ...]]
"""Front of each point of a cloud, as :attr:`torchrg.Cloud.front`, and notes on it."""
_CORNERS_AT_ONCE = 1 << 18
"""Corners of faces that are added up together, which take some tens of megabytes."""
_MAX_CORNERS = 2
"""Corners of a face by the vertices of its mesh. A face with holes has the vertices of the edges
that lead to them twice; a larger one is damage, for which no memory is taken."""
_MIN_AGREEMENT = 1e-3
"""Least length of a sum of normals as a share of the areas. A shorter one is rounding, as where
each face is there twice, once for each of its sides."""


def find_fronts(
    faces: Iterable[NDArray[np.number]],
    coordinates: NDArray[np.floating],
    finite: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return the direction in which the front of the surface lies at each vertex.

    It is that of the sum of the normals of the faces at the vertex, weighted by area.

    Args:
        faces: Vertices of faces with equally many corners, each of shape ``(n, corners)``.
        coordinates: Those of the vertices, shape ``(N, 3)``.
        finite: Which vertices have a place, shape ``(N,)``; faces with others do not count.

    Returns:
        Unit vectors, shape ``(N, 3)``; zero where no face has the vertex, or its faces cancel.

    Raises:
        FormatError: If a face has a vertex that there is not.

    Example:
        >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> find_fronts([np.array([[0, 2, 1]])], square, np.ones(4, bool)).tolist()
        [[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]
    """
    places, count = coordinates.astype(np.float64, copy=False), len(coordinates)
    sums, areas = np.zeros((3, count)), np.zeros(count)
    for block in faces:
        if block.shape[1] > _MAX_CORNERS * count:
            raise FormatError(
                f"expected faces of {count:,} vertices, got one of {block.shape[1]:,} corners"
            )
        corners = block.astype(np.int64)
        if corners.size and not 0 <= corners.min() <= corners.max() < count:
            wrong = corners.min() if corners.min() < 0 else corners.max()
            raise FormatError(f"expected faces of {count:,} vertices, got vertex {wrong:,}")
        at_once = max(_CORNERS_AT_ONCE // max(corners.shape[1], 1), 1)
        for start in range(0, len(corners) if corners.shape[1] > 2 else 0, at_once):
            part = corners[start : start + at_once]
            part = part[finite[part].all(axis=1)]
            normals = _vector_areas(places, part)
            sizes = np.linalg.norm(normals, axis=1)
            for total, values in zip((areas, *sums), (sizes, *normals.T), strict=True):
                np.add.at(total, part.reshape(-1), np.repeat(values, part.shape[1]))
    length = np.linalg.norm(sums, axis=0)
    is_clear = length > _MIN_AGREEMENT * areas
    fronts = np.where(is_clear, sums / np.where(is_clear, length, 1.0), 0.0)
    return np.ascontiguousarray(fronts.T, dtype=np.float32)


def _vector_areas(places: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the normals of faces, twice as long as their areas, shape ``(n, 3)``."""
    arms = places[faces[:, 1:]] - places[faces[:, :1]]
    areas: NDArray[np.float64] = np.cross(arms[:, :-1], arms[:, 1:]).sum(axis=1)
    return areas
