"""Mesh faces: front direction of the surface at each vertex.

A face is a list of at least three vertices, counter-clockwise seen from its front. Faces are not
kept, only their contribution to the sums of their vertices.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError

Fronts = tuple[NDArray[np.float32] | None, tuple[str, ...]]
"""Front directions of a cloud, as in :attr:`torchrg.Cloud.front`, and notes about them."""
_CORNERS_AT_ONCE = 1 << 18
"""Number of face corners added at a time; they take some tens of megabytes."""
_MAX_CORNERS = 2
"""Maximum number of corners of a face, as a multiple of the number of vertices. A face with holes
visits some vertices twice; a larger face means a corrupt file."""
_MIN_AGREEMENT = 1e-3
"""Minimum length of a sum of normals, as a fraction of the sum of areas. Shorter sums are rounding
noise, as for meshes with every face in both orientations."""


def find_fronts(
    faces: Iterable[NDArray[np.number]],
    coordinates: NDArray[np.floating],
    finite: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return the front direction of the surface at each vertex.

    The direction is the area-weighted sum of the normals of the adjacent faces.

    Args:
        faces: Blocks of vertex indices of faces of equal size, shape ``(n, corners)``.
        coordinates: Vertex coordinates, shape ``(N, 3)``.
        finite: Mask of vertices with finite coordinates, shape ``(N,)``; other faces are ignored.

    Returns:
        Unit vectors, shape ``(N, 3)``; zero for vertices without faces, or whose faces cancel.

    Raises:
        FormatError: If a vertex index is out of range.
    """
    positions, count = coordinates.astype(np.float64, copy=False), len(coordinates)
    sums, areas = np.zeros((3, count)), np.zeros(count)
    for block in faces:
        if block.shape[1] > _MAX_CORNERS * count:
            raise FormatError(
                f"expected at most {_MAX_CORNERS * count:,} corners a face, got {block.shape[1]:,}"
            )
        corners = block.astype(np.int64)
        if corners.size and not 0 <= corners.min() <= corners.max() < count:
            wrong = corners.min() if corners.min() < 0 else corners.max()
            raise FormatError(f"expected vertex indices in [0, {count:,}), got {wrong:,}")
        at_once = max(_CORNERS_AT_ONCE // max(corners.shape[1], 1), 1)
        for start in range(0, len(corners) if corners.shape[1] > 2 else 0, at_once):
            part = corners[start : start + at_once]
            part = part[finite[part].all(axis=1)]
            edges = positions[part[:, 1:]] - positions[part[:, :1]]
            normals = np.cross(edges[:, :-1], edges[:, 1:]).sum(axis=1)
            sizes = np.linalg.norm(normals, axis=1)
            for total, values in zip((areas, *sums), (sizes, *normals.T), strict=True):
                np.add.at(total, part.reshape(-1), np.repeat(values, part.shape[1]))
    length = np.linalg.norm(sums, axis=0)
    is_clear = length > _MIN_AGREEMENT * areas
    fronts = np.where(is_clear, sums / np.where(is_clear, length, 1.0), 0.0)
    return np.ascontiguousarray(fronts.T, dtype=np.float32)
