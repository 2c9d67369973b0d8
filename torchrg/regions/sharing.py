"""How many neighbours two points have in common, counted exactly."""

import numpy as np
from numpy.typing import NDArray

_BLOCK_SIZE = 256


def shares_at_least(
    indices: NDArray[np.int32],
    rows: slice,
    asked: NDArray[np.bool_],
    min_shared: int,
    *,
    counted: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """Tell for edges of the neighbour graph whether their ends share enough neighbours, eq. (10).

    The lists of a block of points are held as bit sets over the points that occur in them, so that
    an edge costs a few AND and popcount instructions; lists of points outside the block lose only
    members that no list of the block has. Points should be in canonical order: then a block is a
    patch of surface and its dictionary is small.

    Args:
        indices: Neighbours of all points, shape ``(N, K)``, the point itself included.
        rows: The points whose edges are asked for.
        asked: Which of their edges to test, shape ``(n, K)``.
        min_shared: Least number of common neighbours.
        counted: Which entries of ``indices`` are neighbours, shape ``(N, K)``. Default: all.

    Returns:
        Shape ``(n, K)``; False where not asked.

    Example:
        >>> indices = np.array([[0, 1, 2], [1, 0, 2], [2, 1, 3], [3, 2, 1]], dtype=np.int32)
        >>> asked = np.ones((1, 3), dtype=bool)
        >>> shares_at_least(indices, slice(0, 1), asked, 3)
        array([[ True,  True, False]])
    """
    result = np.zeros(asked.shape, dtype=bool)
    if min_shared <= 0:
        return asked.copy()
    slots = np.full(len(indices) + 1, -1, dtype=np.int32)
    for start in range(rows.start, rows.stop, _BLOCK_SIZE):
        block = slice(start, min(start + _BLOCK_SIZE, rows.stop))
        within = slice(block.start - rows.start, block.stop - rows.start)
        result[within] = _test_block(indices, block, asked[within], min_shared, counted, slots)
    return result


def _test_block(
    indices: NDArray[np.int32],
    block: slice,
    asked: NDArray[np.bool_],
    min_shared: int,
    counted: NDArray[np.bool_] | None,
    slots: NDArray[np.int32],
) -> NDArray[np.bool_]:
    """Test the edges of one block; ``slots`` is scratch, -1 everywhere before and after."""
    lists = indices[block]
    members = lists.ravel() if counted is None else lists[counted[block]]
    slots[members] = np.arange(len(members), dtype=np.int32)
    members = members[slots[members] == np.arange(len(members))]
    slots[members] = np.arange(len(members), dtype=np.int32)
    words = _bit_sets(indices, members, counted, slots)
    source, column = np.nonzero(asked)
    own = slots[np.arange(block.start, block.stop)][source]
    other = slots[lists[source, column]]
    slots[members] = -1
    shared = np.zeros(len(source), dtype=np.uint16)
    for word in words:
        shared += np.bitwise_count(word[own] & word[other])
    result = np.zeros(asked.shape, dtype=bool)
    result[source, column] = shared >= min_shared
    return result


def _bit_sets(
    indices: NDArray[np.int32],
    members: NDArray[np.int32],
    counted: NDArray[np.bool_] | None,
    slots: NDArray[np.int32],
) -> NDArray[np.uint64]:
    """Return neighbour lists of ``members`` as bit sets over them, shape ``(words, members)``."""
    size = len(members)
    width = -(-size // 64) * 64
    # The slot of a point outside the dictionary is -1: the last column, which is cut off.
    bits = np.zeros((size, width + 1), dtype=bool)
    columns = slots[indices[members]]
    if counted is not None:
        columns[~counted[members]] = -1
    bits[np.arange(size)[:, None], columns] = True
    packed = np.packbits(bits[:, :width], axis=1).view(np.uint64)
    return np.ascontiguousarray(packed.T)
