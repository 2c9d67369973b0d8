"""Checks of scales, offsets and bounds in file headers."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from torchrg.errors import FormatError
from torchrg.structures import FARTHEST

MAX_INTEGER = 2**31 - 1
"""Largest stored integer coordinate, in steps of a scale from an offset."""
_MIN_EXTENT = 2.0**-126
"""Minimum extent of all integers: the smallest normal float32, the type of points."""
_MAX_OUTSIDE = 0.01
"""Maximum distance of points from the box in a header, which is rounded, as a fraction of it."""


def check_grid(path: Path, what: str, scales: ArrayLike, offsets: ArrayLike) -> None:
    """Check that a scale and offset keep integers distinct and within range."""
    scale, offset = np.abs(np.array([scales, offsets], np.float64))
    min_extent = np.maximum(np.spacing(offset), _MIN_EXTENT)
    is_grid = (scale * MAX_INTEGER >= min_extent) & (scale <= FARTHEST) & (offset <= FARTHEST)
    if not is_grid.all():
        shown = ", ".join(map(str, np.ravel(scales))), ", ".join(map(str, np.ravel(offsets)))
        raise FormatError(
            f"{path}: expected a scale and offset of {what} that keep values distinct and within "
            f"{FARTHEST:g}, got {' and '.join(shown)}; correct them or write the file again."
        )


def distance_outside(
    low: ArrayLike, high: ArrayLike, box: ArrayLike, step: ArrayLike = 0.0
) -> float:
    """Return how far the box from ``low`` to ``high`` extends beyond the box in a header.

    It is 0 within rounding (which includes ``step``) and if the header contains no box.

    Args:
        low: Minimum coordinates, shape ``(3,)``.
        high: Maximum coordinates, shape ``(3,)``.
        box: Minimum and maximum coordinates by the header, shape ``(2, 3)``.
        step: Step of the coordinates.
    """
    # Programs that compute no box write zeros.
    if not np.isfinite(box).all() or not np.any(box):
        return 0.0
    (box_low, box_high), extent = np.array(box, np.float64), np.subtract(high, low)
    outside = np.maximum(box_low - low, high - box_high)
    tolerance = np.maximum(2 * np.abs(step), _MAX_OUTSIDE * extent)
    return float(outside.max()) if (outside > tolerance).any() else 0.0
