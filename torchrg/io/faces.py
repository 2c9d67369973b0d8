"""Faces of a mesh: which side of the surface is the front at each vertex.

A face is a list of three or more vertices, counter-clockwise as seen from its front. Nothing is
kept of it but what it adds to sums at its vertices.
"""

import sys
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

Fronts = tuple[NDArray[np.float32] | None, tuple[str, ...]]
"""Front of each point of a cloud, as :attr:`torchrg.Cloud.front`, and notes on it."""
_CORNERS_AT_ONCE = 1 << 18
"""Corners of faces that are added up together, which take some tens of megabytes."""
_FACES_AT_ONCE = 1 << 16
"""Faces with lists of different lengths that are in memory together."""
_LONGEST_LIST = 1 << 20
"""Bytes, or words of text, of the longest list; a longer one is taken for damage."""
_LEAST_AGREEMENT = 1e-3
"""Least length of a sum of normals as a share of the areas. A shorter one is rounding, as where
each face is there twice, once for each of its sides."""


class BrokenFacesError(Exception):
    """A list of faces is not what it should be; the text says what is wrong with it."""


def find_fronts(
    faces: Iterable[NDArray[np.int64]],
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
        BrokenFacesError: If a face has a vertex that there is not.

    Example:
        >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> find_fronts([np.array([[0, 2, 1]])], square, np.ones(4, bool)).tolist()
        [[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]
    """
    places, count = coordinates.astype(np.float64, copy=False), len(coordinates)
    sums, areas = np.zeros((3, count)), np.zeros(count)
    for part in faces:
        if part.size and not 0 <= part.min() <= part.max() < count:
            wrong = part.min() if part.min() < 0 else part.max()
            raise BrokenFacesError(f"vertex {wrong:,} of {count:,}")
        at_once = max(_CORNERS_AT_ONCE // max(part.shape[1], 1), 1)
        for start in range(0, len(part) if part.shape[1] > 2 else 0, at_once):
            some = part[start : start + at_once]
            some = some[finite[some].all(axis=1)]
            normals = _vector_areas(places, some)
            sizes = np.linalg.norm(normals, axis=1)
            for corner in some.T:
                np.add.at(areas, corner, sizes)
                for total, values in zip(sums, normals.T, strict=True):
                    np.add.at(total, corner, values)
    length = np.linalg.norm(sums, axis=0)
    is_clear = length > _LEAST_AGREEMENT * areas
    fronts = np.where(is_clear, sums / np.where(is_clear, length, 1.0), 0.0)
    return np.ascontiguousarray(fronts.T, dtype=np.float32)


def _vector_areas(places: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the normals of faces, twice as long as their areas, shape ``(n, 3)``."""
    first = places[faces[:, 0]]
    normals, last = np.zeros_like(first), places[faces[:, 1]] - first
    for number in range(2, faces.shape[1]):
        arm = places[faces[:, number]] - first
        normals += np.cross(last, arm)
        last = arm
    return normals


def stack_faces(faces: Iterable[Sequence[float]], count: int) -> Iterator[NDArray[np.int64]]:
    """Yield so many faces, those with equally many corners together, shape ``(n, corners)``.

    Raises:
        BrokenFacesError: If there are fewer faces.

    Example:
        >>> [part.shape for part in stack_faces([(0, 1, 2), (0, 1, 2, 3), (2, 1, 0)], 3)]
        [(2, 3), (1, 4)]
    """
    rest = islice(faces, min(count, sys.maxsize))
    while block := list(islice(rest, _FACES_AT_ONCE)):
        count -= len(block)
        for length in sorted({len(face) for face in block}):
            same = [face for face in block if len(face) == length]
            # Not a number becomes a vertex that there is not.
            yield np.array(same, np.float64).reshape(len(same), length).astype(np.int64)
    if count:
        raise BrokenFacesError(f"{count:,} are missing")


def check_list(length: float, num_bytes: int) -> int:
    """Return the length of a list of items of so many bytes, which is none that is damage."""
    if not 0 <= length * num_bytes <= _LONGEST_LIST:
        raise BrokenFacesError(f"a list of {length:,}")
    return int(length)
