"""Color ranges and conversion to 8 or 16 bits.

Colors are in 0..1, 0..255 or 0..65535, and few files state the range. The type decides if it can.
Otherwise most of the values decide, so that rounding errors or a few outliers have no effect.
"""

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError, TorchrgError
from torchrg.structures.points import Array

BYTE, WORD = 255, 65535
"""Maximum of an 8-bit and of a 16-bit channel."""
WIDEN = WORD // BYTE
"""Factor from 8 to 16 bits; the way back is lossless."""
_HALF_STEP = 0.5
"""Fraction of an integer step by which values may exceed a range and still be rounded into it."""
_MAX_OUTLIER_FRACTION = 0.01
"""Maximum fraction of values that count as outliers of their range and are clipped."""
_MAX_SINGLE_FRACTION = 1 / 3
"""Maximum fraction that a single value may represent to count as an outlier."""


def find_white(color: Array) -> int:
    """Return the maximum channel value, 1, 255 or 65535, from type and values.

    Convention:
        Floating-point values are in 0..1 if most of them are and some are not integers, or if all
        but a few are 0 or 1. Other values are in 0..255, or in 0..65535 if more than a few exceed
        255. Values that are black in every range are ignored. Booleans are in 0..1. This function
        alone chooses the range, for reading and for writing.

    Args:
        color: Real numbers of any type and shape, without NaN.
    """
    if color.dtype.itemsize == 1 and color.dtype.kind in "ub":
        return BYTE if color.dtype.kind == "u" else 1
    positive = _count(color > _HALF_STEP / BYTE)
    if color.dtype.kind == "f":
        above = _count(color > 1 + _HALF_STEP / BYTE)
        if _are_outliers(above, positive) or (2 * above < positive and not _is_integral(color)):
            return 1
    wide = _count(color > BYTE + _HALF_STEP)
    if color.dtype == np.uint16:  # A type for wide values: a single one counts.
        return BYTE if wide <= _MAX_OUTLIER_FRACTION * positive else WORD
    return BYTE if _are_outliers(wide, positive) else WORD


@np.errstate(over="ignore")
def read_colors(
    owner: object,
    color: Array,
    limits: NDArray[np.floating] | None = None,
    error: type[TorchrgError] = FormatError,
) -> tuple[Array, tuple[str, ...]]:
    """Return colors as uint8, or uint16 if 8 bits are too few, and notes for the user.

    Args:
        owner: File or function that the colors belong to, for messages.
        color: Integers, booleans or floating-point numbers, shape ``(*, 3)``. NaN is read as 0;
            values outside the range are clipped.
        limits: Minimum and maximum of each channel, shape ``(2, 3)``, if the file states them.
            Default: 0 and :func:`find_white`.
        error: Exception class to raise if more than a few values fit no range.
    """
    notes, dtype, white = list[str](), color.dtype, None
    if dtype.kind not in "fiub" or color.shape[-1:] != (3,):
        raise error(
            f"{owner}: expected color of shape (N, 3), got shape {color.shape} of "
            f"{dtype}; convert it, or rename or remove that field."
        )
    if dtype.kind == "f":
        color = color.astype(np.float32) if dtype.itemsize < 4 else color
        if missing := _count(np.isnan(color)):
            color = np.where(np.isnan(color), 0, color)
            notes.append(f"NaN color values are read as 0: {missing:,}")
    if limits is not None:
        color, white, more = _scale_by_limits(color, limits)
        notes += more
    elif dtype == np.int8:
        color = color.view(np.uint8)
        notes.append("its colors are signed bytes, read as unsigned")
    if color.dtype in (np.uint8, np.bool_) or color.size == 0:
        return narrow_colors(color), tuple(notes)
    if white is None:
        white = find_white(color)
        notes += _range_notes(color, white)
    maximum = max(white, BYTE)
    values = np.rint(color * (maximum / white)) if color.dtype.kind == "f" else color
    below, above = _count(values < 0), _count(values > maximum)
    if not _are_outliers(below, color.size) or (
        white == WORD and not _are_outliers(above, color.size)
    ):
        raise error(
            f"{owner}: expected color in 0..255, got {color.min()} to {color.max()}; scale the "
            "colors, or rename or remove that field."
        )
    if below or above:
        values = np.clip(values, 0, maximum)
        outside = f"{below + above:,} of {color.size:,}"
        notes.append(f"color values beyond 0..{white} are clipped: {outside}")
    if maximum == BYTE:
        return values.astype(np.uint8), tuple(notes)
    values = values.astype(np.uint16)
    is_wide = bool((values % WIDEN).any())
    if limits is not None and find_white(values) == BYTE:
        # Limits are not written back, and such values would then be read as 0..255.
        is_wide = False
        notes.append(f"its colors are almost black: at most {BYTE} of their limit {WORD}")
    return values if is_wide else _scale_to_bytes(values, WORD), tuple(notes)


def _scale_by_limits(
    color: Array, limits: NDArray[np.floating]
) -> tuple[Array, int | None, list[str]]:
    """Return colors and their white value by the limits stated in a file, and notes."""
    low, high = limits
    shown, near = f"{low.min():g}..{high.max():g}", (high - low) * _HALF_STEP / BYTE
    outside = _count((color < low - near) | (color > high + near))
    if not (low < high).all() or not _are_outliers(outside, color.size):
        return color, None, [f"the color limits {shown} do not fit its colors and are ignored"]
    for white in (1, BYTE, WORD):
        if (limits == [[0], [white]]).all():
            return color.astype(np.float64) if white == 1 else color, white, []
    scaled = (color - low) / (high - low)
    return scaled, 1, [f"its colors are scaled from their limits {shown} to 0..255"]


def _range_notes(color: Array, white: int) -> list[str]:
    """Return a note if the detected range differs from the default range of the type."""
    if white == 1:
        is_default = not _is_integral(color)
    elif white == BYTE:
        is_default = color.dtype != np.uint16 and bool((color > 1).any())
    else:
        is_default = color.dtype == np.uint16
    if is_default or not (color > 0).any():
        return []
    return [f"colors are read as 0..{white}, judging by their values"]


def narrow_colors(color: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Round colors to uint8; :func:`find_white` chooses their range."""
    if color.dtype == np.uint8 or color.size == 0:
        return color.astype(np.uint8, copy=False)
    return _scale_to_bytes(color, find_white(color))


def _scale_to_bytes(color: NDArray[np.generic], white: int) -> NDArray[np.uint8]:
    """Scale colors in 0..white to uint8."""
    scaled: Array = np.rint(color.astype(np.float32) / np.float32(white / BYTE))
    return np.clip(scaled, 0, BYTE).astype(np.uint8)


def _are_outliers(count: int, total: int) -> bool:
    """Whether a count of values is small enough to be outliers; one of three is."""
    return count <= max(_MAX_OUTLIER_FRACTION * total, min(1, _MAX_SINGLE_FRACTION * total))


def _count(values: NDArray[np.bool_]) -> int:
    """Return the number of true values."""
    return int(np.count_nonzero(values))


def _is_integral(color: Array) -> bool:
    """Whether all values are integers or infinite."""
    return bool((np.rint(color) == color).all())
