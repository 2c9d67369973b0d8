"""Checks of the numbers in a header that place the points of a file."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from torchrg.errors import FormatError
from torchrg.structures import FARTHEST

LARGEST_INTEGER = 2**31 - 1
"""Largest integer that stands for a coordinate, in steps of a scale from an offset."""
_MIN_REACH = 2.0**-126
"""Least extent of all integers, the smallest normal number of float32, in which points are kept."""
_MAX_OUTSIDE = 0.01
"""Largest distance of points from the box in a header, as a fraction of their extent, without a
note. Programs round the box."""


def check_grid(path: Path, what: str, scales: ArrayLike, offsets: ArrayLike) -> None:
    """Check that integers become numbers that differ, and none too far away.

    Example:
        >>> check_grid(Path("a.las"), "x, y, z", [0.1, 0.1, 0], [7, 7, 7])  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        torchrg.errors.FormatError: a.las: expected a scale and offset of x, y, z that ...
    """
    scale, offset = np.abs(np.array([scales, offsets], np.float64))
    min_reach = np.maximum(np.spacing(offset), _MIN_REACH)
    is_grid = (scale * LARGEST_INTEGER >= min_reach) & (scale <= FARTHEST) & (offset <= FARTHEST)
    if not is_grid.all():
        shown = ", ".join(map(str, np.ravel(scales))), ", ".join(map(str, np.ravel(offsets)))
        raise FormatError(
            f"{path}: expected a scale and offset of {what} that keep values apart and within "
            f"{FARTHEST:g}, got {' and '.join(shown)}; correct them or write the file again."
        )


def distance_outside(
    low: ArrayLike, high: ArrayLike, box: ArrayLike, step: ArrayLike = 0.0
) -> float:
    """Return how far points from ``low`` to ``high`` reach out of the box that a header names.

    It is 0 within rounding, of which ``step`` is a part, and where the header knows no box.

    Args:
        low: Least coordinates, shape ``(3,)``.
        high: Largest coordinates, shape ``(3,)``.
        box: Least and largest coordinates by the header, shape ``(2, 3)``.
        step: Step of the coordinates.

    Example:
        >>> distance_outside([0, 0, 0], [1, 1, 1], [[0, 0, 0], [1, 1, 0.5]])
        0.5
    """
    # Programs that know no box leave zeros.
    if not np.isfinite(box).all() or not np.any(box):
        return 0.0
    (least, most), extent = np.array(box, np.float64), np.subtract(high, low)
    outside = np.maximum(least - low, high - most)
    allowed = np.maximum(2 * np.abs(step), _MAX_OUTSIDE * extent)
    return float(outside.max()) if (outside > allowed).any() else 0.0
