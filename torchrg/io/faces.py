"""Faces of a mesh: which side of the surface is the front at each vertex.

A face is a list of three or more vertices, counter-clockwise as seen from its front. Nothing is
kept of it but what it adds to sums at its vertices.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Fronts = tuple[NDArray[np.float32] | None, tuple[str, ...]]
"""Front of each point of a cloud, as :attr:`torchrg.Cloud.front`, and notes on it."""
_CORNERS_AT_ONCE = 1 << 18
"""Corners of faces that are added up together, which take some tens of megabytes."""
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


class ListOf(NamedTuple):
    """A list in the records of faces: what comes between the one before and it, and its parts.

    Attributes:
        skipped: Bytes, or words, before its length.
        length_of: Returns the length from the data and its place in them.
        length_size: Bytes, or words, of the length.
        item_size: Bytes, or words, of each item.
        is_corners: Whether the items are the vertices of a face.
    """

    skipped: int
    length_of: Callable[[Any, int], int]
    length_size: int
    item_size: int
    is_corners: bool


def split_lists(
    blocks: Iterable[Any],
    lists: Sequence[ListOf],
    tail: int,
    count: int,
    as_corners: Callable[[Any, NDArray[np.int64], int], NDArray[np.int64]],
) -> Iterator[NDArray[np.int64]]:
    """Take apart records whose lists differ in length, and yield those of equal length together.

    Args:
        blocks: The data one after the other, bytes or lists of words.
        lists: The lists of a record.
        tail: Bytes, or words, behind the last of them.
        count: Number of records.
        as_corners: Returns the items of lists of one length, from the data, where they begin, and
            the length.

    Raises:
        BrokenFacesError: If there are fewer records, or a list is longer than any.
    """
    rest: Any = None
    for block in blocks:
        data = block if rest is None else rest + block
        starts, lengths, end = _walk(data, lists, tail, count)
        for length in np.unique(lengths).tolist():
            own = starts[lengths == length]
            at_once = max(_CORNERS_AT_ONCE // max(length, 1), 1)
            for start in range(0, len(own), at_once):
                yield as_corners(data, own[start : start + at_once], length)
        count, rest = count - len(starts), data[end:]
        if not count:
            return
    if count:
        raise BrokenFacesError(f"{count:,} are missing")


def _walk(
    data: Any,  # noqa: ANN401
    lists: Sequence[ListOf],
    tail: int,
    count: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Return where the corners of each record begin, how many they are, and the end of the last.

    Records are those that are whole, at most so many.
    """
    starts, lengths, end = list[int](), list[int](), 0
    while len(starts) < count:
        place, start, corners = end, 0, 0
        for skipped, length_of, length_size, item_size, is_corners in lists:
            place += skipped + length_size
            if place > len(data):
                break
            length = length_of(data, place - length_size)
            if not 0 <= length * item_size <= _LONGEST_LIST:
                raise BrokenFacesError(f"a list of {length:,}")
            if is_corners:
                start, corners = place, length
            place += length * item_size
        place += tail
        if place > len(data):
            break
        starts.append(start)
        lengths.append(corners)
        end = place
    return np.array(starts, np.int64), np.array(lengths, np.int64), end
