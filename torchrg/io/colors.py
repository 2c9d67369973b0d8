"""Colors: the one place that decides their range, and their forms in 8 and 16 bits.

Colors are in 0..1, 0..255 or 0..65535, and few files say in which. The type decides where it can;
otherwise most of the values do, so that a rounding error or a few outliers change no other point.
"""

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError, TorchrgError
from torchrg.structures import Array

BYTE, WORD = 255, 65535
"""Values of a full channel in 8 and in 16 bits."""
WIDEN = WORD // BYTE
"""Factor from 8 bits to 16, and back without loss."""
_HALF_STEP = 0.5
"""Part of a step of integer colors up to which values beyond a range are rounded into it."""
_FEW = 0.01
"""Largest fraction of values that are taken for outliers of their range, and clipped."""
_FEW_OF_SMALL = 1 / 3
"""Largest fraction of values that a single one may be to be taken for an outlier."""


def find_white(color: Array) -> int:
    """Return the value of a full channel by type and values: 1, 255 or 65535.

    Convention:
        Floating-point numbers are in 0..1 if most of them are and some are fractions, or if all
        but a few are 0 or 1. Other numbers are in 0..255, or in 0..65535 if more than a few are
        beyond 255. Values that are black in every range do not count.

    Args:
        color: Real numbers of any type and shape, without NaN.

    Example:
        >>> find_white(np.array([0.2, 0.9, 1.3])), find_white(np.array([0.0, 1.0, 200.0]))
        (1, 255)
    """
    if color.dtype == np.uint8:
        return BYTE
    positive = _count(color > _HALF_STEP / BYTE)
    if color.dtype.kind == "f":
        above = _count(color > 1 + _HALF_STEP / BYTE)
        if _are_few(above, positive) or (2 * above < positive and not _is_whole(color)):
            return 1
    return BYTE if _are_few(_count(color > BYTE + _HALF_STEP), positive) else WORD


@np.errstate(over="ignore")
def read_colors(
    owner: object,
    color: Array,
    limits: NDArray[np.floating] | None = None,
    error: type[TorchrgError] = FormatError,
) -> tuple[Array, tuple[str, ...]]:
    """Return colors as uint8, or uint16 where 8 bits do not hold them, and notes for people.

    Args:
        owner: The file or the function that they are of, for messages.
        color: Integers or floating-point numbers, shape ``(*, 3)``. NaN is read as 0, and values
            beyond the range are clipped to it.
        limits: Smallest and largest value of each channel, shape ``(2, 3)``, where the file states
            them. Default: 0 and :func:`find_white`.
        error: What is raised where more than a few values fit no range.

    Example:
        >>> colors, notes = read_colors("a.ply", np.array([[0.5, 0.2, 1.0000001]]))
        >>> colors.tolist(), notes
        ([[128, 51, 255]], ())
        >>> read_colors("a.ply", np.array([[0.5, 0.2, 0.1], [0.5, 0.2, 1.3]]))[1]
        ('color values beyond 0..1 are clipped: 1 of 6',)
    """
    notes, dtype, white = list[str](), color.dtype, None
    if dtype.kind not in "fiu" or color.shape[-1:] != (3,):
        raise error(
            f"{owner}: expected color to be three real numbers a point, got shape {color.shape} of "
            f"{dtype}; convert it, or rename or remove that field."
        )
    if dtype.kind == "f":
        color = color.astype(np.float32) if dtype.itemsize < 4 else color
        if missing := _count(np.isnan(color)):
            color = np.where(np.isnan(color), 0, color)
            notes.append(f"color values that are NaN are read as 0: {missing:,}")
    if limits is not None:
        color, white, more = _within_limits(color, limits)
        notes += more
    elif dtype == np.int8:
        color = color.view(np.uint8)
        notes.append("its colors are signed bytes, and are read as unsigned")
    if color.dtype == np.uint8 or color.size == 0:
        return color.astype(np.uint8, copy=False), tuple(notes)
    if white is None:
        white = find_white(color)
        notes += _note_on_range(color, white)
    largest = max(white, BYTE)
    values = np.rint(color * (largest / white)) if color.dtype.kind == "f" else color
    below, above = _count(values < 0), _count(values > largest)
    if not _are_few(below, color.size) or (white == WORD and not _are_few(above, color.size)):
        raise error(
            f"{owner}: expected color in 0..255, got {color.min()} to {color.max()}; scale the "
            "colors, or rename or remove that field."
        )
    if below or above:
        values = np.clip(values, 0, largest)
        outside = f"{below + above:,} of {color.size:,}"
        notes.append(f"color values beyond 0..{white} are clipped: {outside}")
    if largest == BYTE:
        return values.astype(np.uint8), tuple(notes)
    values = values.astype(np.uint16)
    is_wide = bool((values % WIDEN).any())
    if limits is not None and find_white(values) == BYTE:
        # Limits are not written again, and such values would be read as 0..255 then.
        is_wide = False
        notes.append(f"its colors are at most {BYTE} of {WORD}, their limit, and almost black")
    return values if is_wide else narrow_colors(values), tuple(notes)


def _within_limits(
    color: Array, limits: NDArray[np.floating]
) -> tuple[Array, int | None, list[str]]:
    """Return colors and their white by limits that a file states, and what is to be said of it."""
    low, high = limits
    shown, near = f"{low.min():g}..{high.max():g}", (high - low) * _HALF_STEP / BYTE
    outside = _count((color < low - near) | (color > high + near))
    if not (low < high).all() or not _are_few(outside, color.size):
        return color, None, [f"the limits of its colors, {shown}, do not fit them and are not used"]
    for white in (1, BYTE, WORD):
        if (limits == [[0], [white]]).all():
            return color.astype(np.float64) if white == 1 else color, white, []
    scaled = (color - low) / (high - low)
    return scaled, 1, [f"its colors are scaled from {shown}, their limits, to 0..255"]


def _note_on_range(color: Array, white: int) -> list[str]:
    """Return a note where a range that the values tell is not the usual one of the type."""
    if white == 1:
        is_usual = not _is_whole(color)
    elif white == BYTE:
        is_usual = color.dtype != np.uint16 and bool((color > 1).any())
    else:
        is_usual = color.dtype == np.uint16
    if is_usual or not (color > 0).any():
        return []
    return [f"its colors are taken as 0..{white}, by their values"]


def narrow_colors(color: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return colors of 8 or 16 bits as uint8, rounded.

    Example:
        >>> narrow_colors(np.array([128, 129, 65535], np.uint16)).tolist()
        [0, 1, 255]
    """
    if color.dtype == np.uint8:
        return color.astype(np.uint8, copy=False)
    return np.rint(color.astype(np.float32) / WIDEN).astype(np.uint8)


def _are_few(count: int, total: int) -> bool:
    """Whether so many values of a total are few enough to be outliers, as one of three is."""
    return count <= max(_FEW * total, min(1, _FEW_OF_SMALL * total))


def _count(values: NDArray[np.bool_]) -> int:
    """Return how many of some values are true."""
    return int(np.count_nonzero(values))


def _is_whole(color: Array) -> bool:
    """Whether all values are integers, or infinite."""
    return bool((np.rint(color) == color).all())
