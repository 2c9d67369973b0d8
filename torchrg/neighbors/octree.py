"""Boxes about runs of points in canonical order, to tell which rows can lie near a block."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg._parallel import chunks_of
from torchrg.neighbors.order import MORTON_BITS, morton_codes

POINTS_PER_BOX = 256
"""Points. A box of surface is then as wide as two neighbourhoods of 50: few rows are read in vain,
and the boxes take a hundredth of the memory of the points."""

_ROUNDING = 1 + 1e-9
"""Factor by which distances are taken larger, so that rounding leaves no point out."""

_BOXES_AT_ONCE = 64
"""Boxes, near to one another as they follow one another: the box about them all leaves few others
to compare with each."""


class Boxes(NamedTuple):
    """The cells of an octree that hold few points each; in canonical order each is one run of rows.

    Attributes:
        starts: First row of each, and the number of points, shape ``(B + 1,)``.
        low: Lower corner of the points, shape ``(B, 3)``, float64.
        high: Upper corner, shape ``(B, 3)``, float64.
    """

    starts: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def find_boxes(points: NDArray[np.floating], most: int = POINTS_PER_BOX) -> Boxes:
    """Return the boxes of at most so many points ``(N, 3)`` in canonical order.

    Only a cell of the finest level may hold more: nearly equal points.

    Example:
        >>> find_boxes(np.array([[0.0, 0, 0], [0.1, 0, 0], [1, 1, 1]]), 2).starts.tolist()
        [0, 2, 3]
    """
    codes = morton_codes(points)
    is_start = np.zeros(len(points) + 1, dtype=bool)
    is_start[[0, -1]] = True
    for level in range(MORTON_BITS - 1, -1, -1):
        starts = np.flatnonzero(is_start)
        counts = np.diff(starts)
        full = counts > most
        if not full.any():
            break
        changes = codes >> (3 * level)
        is_start[1:-1] |= (changes[1:] != changes[:-1]) & np.repeat(full, counts)[1:]
    starts = np.flatnonzero(is_start)
    low, high = (how.reduceat(points, starts[:-1], axis=0) for how in (np.minimum, np.maximum))
    return Boxes(starts, low.astype(np.float64), high.astype(np.float64))


def near_boxes(
    boxes: Boxes, chosen: NDArray[np.int64], reach: NDArray[np.float64]
) -> Iterator[tuple[slice, NDArray[np.int64], NDArray[np.bool_]]]:
    """Yield which boxes are within the reach ``(n,)`` of the chosen ones ``(n,)``.

    For some of the chosen ones at a time: which these are, the numbers of boxes near them, and who
    is near whom, shape ``(chosen, near)``.
    """
    about = _about(boxes.low, boxes.high, boxes.low[chosen], boxes.high[chosen], reach)
    all_low, all_high = boxes.low[about], boxes.high[about]
    for some in chunks_of(len(chosen), _BOXES_AT_ONCE):
        low, high = boxes.low[chosen[some]], boxes.high[chosen[some]]
        near = _about(all_low, all_high, low, high, reach[some])
        gap = _gaps(all_low[near], all_high[near], low, high)
        yield some, about[near], gap <= reach[some, None] * _ROUNDING


def _about(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    own_low: NDArray[np.float64],
    own_high: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Return which boxes are within the largest reach of the box about some."""
    far = reach.max() * _ROUNDING
    inside = (low <= own_high.max(axis=0) + far) & (high >= own_low.min(axis=0) - far)
    return np.flatnonzero(inside.all(axis=1))


def farthest_neighbor(boxes: Boxes, box: int, k: int) -> float:
    """Return a distance within which each point of a box has k points, itself included."""
    low, high = boxes.low[box], boxes.high[box]
    far = np.maximum(high - boxes.low, boxes.high - low)
    distances = np.sqrt((far * far).sum(axis=1))
    order = np.argsort(distances)
    enough = np.searchsorted(np.cumsum(np.diff(boxes.starts)[order]), k)
    return float(distances[order[enough]])


def _gaps(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    own_low: NDArray[np.float64],
    own_high: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the distances between some boxes and others, shape ``(own, others)``."""
    gap = np.maximum(low - own_high[:, None], own_low[:, None] - high).clip(min=0)
    distance: NDArray[np.float64] = np.sqrt((gap * gap).sum(axis=2))
    return distance
