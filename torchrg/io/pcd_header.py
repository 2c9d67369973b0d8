"""The header of a PCD file: eleven lines of text before the points."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError

LONGEST_HEADER = 1 << 16
LARGEST_RECORD = 1 << 20
PADDING = "_"
TYPES = ("F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8")
ENCODINGS = ("ascii", "binary", "binary_compressed")
DEFAULT_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class Header(NamedTuple):
    """What a PCD header says, and where the data begin.

    Attributes:
        dtype: A point; padding fields are called ``_ 0``, ``_ 1`` and so on.
        width: Points in a row.
        height: Rows; 1 for a cloud without order.
        viewpoint: Position and quaternion (w x y z) of the sensor.
        encoding: One of ``ascii``, ``binary``, ``binary_compressed``.
        num_lines: Lines of the header.
        num_bytes: Bytes of the header.
    """

    dtype: np.dtype[np.void]
    width: int
    height: int
    viewpoint: tuple[float, ...]
    encoding: str
    num_lines: int
    num_bytes: int

    @property
    def num_points(self) -> int:
        """Points that the header promises."""
        return self.width * self.height


def read_header(path: Path, stream: BinaryIO) -> Header:
    """Read the header of a PCD file and leave the stream at the first byte of data.

    ``VERSION``, ``COUNT``, ``HEIGHT``, ``VIEWPOINT`` and ``POINTS`` may be absent; the lines may
    have any order as long as ``DATA`` is the last.

    Args:
        path: The file, for messages.
        stream: Its bytes, from the first.

    Returns:
        The header.

    Raises:
        FormatError: If a line is missing or makes no sense.
    """
    lines: dict[str, tuple[int, list[str]]] = {}
    number = 0
    while "DATA" not in lines:
        number += 1
        raw = stream.readline(LONGEST_HEADER)
        if not raw.endswith(b"\n") or stream.tell() > LONGEST_HEADER:
            raise FormatError(
                f"{path}: line {number}: expected the header to end with a line DATA; "
                "the file is cut off or no PCD file, fetch it again."
            )
        words = raw.decode("latin-1").split()
        if words and not words[0].startswith("#"):
            lines["FIELDS" if words[0] == "COLUMNS" else words[0]] = (number, words[1:])
    entries = _Entries(path, lines)
    width, height = entries.integers("WIDTH", 1)[0], entries.integers("HEIGHT", 1, [1])[0]
    points = entries.integers("POINTS", 1, [width * height])[0]
    if points != width * height:
        raise entries.error("POINTS", f"WIDTH x HEIGHT = {width * height}")
    encoding = " ".join(entries.words("DATA"))
    if encoding not in ENCODINGS:
        raise entries.error("DATA", f"one of {', '.join(ENCODINGS)}")
    viewpoint = entries.numbers("VIEWPOINT", 7, DEFAULT_VIEWPOINT)
    dtype = _record_type(entries)
    return Header(dtype, width, height, viewpoint, encoding, number, stream.tell())


class _Entries:
    """The lines of a header by their first word."""

    def __init__(self, path: Path, lines: Mapping[str, tuple[int, list[str]]]) -> None:
        self.path = path
        self.lines = lines

    def error(self, key: str, expected: str) -> FormatError:
        """Return the error that a line is wrong or missing."""
        if key not in self.lines:
            return FormatError(f"{self.path}: expected a header line {key}; write the file again.")
        number, words = self.lines[key]
        text = " ".join(words)
        shown = text if len(text) <= 40 else f"{text[:37]}..."
        return FormatError(
            f"{self.path}: line {number}: expected {key} to be {expected}, got {shown!r}; "
            "write the file again."
        )

    def words(self, key: str) -> list[str]:
        """Return the words after a key that must be there."""
        if key not in self.lines:
            raise self.error(key, "")
        return self.lines[key][1]

    def integers(self, key: str, count: int, default: list[int] | None = None) -> list[int]:
        """Return whole numbers after a key."""
        if default is not None and key not in self.lines:
            return default
        words = self.words(key)
        if len(words) != count or not all(w.isascii() and w.isdecimal() for w in words):
            raise self.error(key, f"{count} whole number{'s' if count > 1 else ''}")
        if any(len(word) > 18 for word in words):
            raise self.error(key, "a size that fits a file")
        return [int(word) for word in words]

    def numbers(self, key: str, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return numbers after a key."""
        if key not in self.lines:
            return default
        words = self.words(key)
        try:
            values = tuple(float(word) for word in words)
        except ValueError:
            values = ()
        if len(values) != count:
            raise self.error(key, f"{count} numbers")
        return values


def _record_type(entries: _Entries) -> np.dtype[np.void]:
    """Return the type of a point from the lines FIELDS, SIZE, TYPE and COUNT."""
    names = entries.words("FIELDS")
    sizes = entries.integers("SIZE", len(names))
    kinds = entries.words("TYPE")
    counts = entries.integers("COUNT", len(names), [1] * len(names))
    if len(kinds) != len(names):
        raise entries.error("TYPE", f"{len(names)} letters")
    used = [name for name in names if name != PADDING]
    if not used or len(set(used)) != len(used):
        raise entries.error("FIELDS", "names that differ")
    num_bytes = [size * count for size, count in zip(sizes, counts, strict=True)]
    if 0 in num_bytes or sum(num_bytes) > LARGEST_RECORD:
        raise entries.error("COUNT", f"sizes of 1 to {LARGEST_RECORD} bytes")
    parts: list[tuple[Any, ...]] = []
    for i, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        shape = () if count == 1 else (count,)
        if name == PADDING:
            parts.append((f"{PADDING} {i}", f"V{size}", shape))
        elif f"{kind}{size}" in TYPES:
            parts.append((name, f"<{kind.lower()}{size}", shape))
        else:
            raise entries.error("TYPE", f"F, I or U of a known SIZE for {name}")
    return np.dtype(parts)


def format_header(
    columns: Mapping[str, NDArray[Any]],
    *,
    width: int,
    height: int,
    viewpoint: tuple[float, ...] = DEFAULT_VIEWPOINT,
) -> str:
    """Return the header of a binary file.

    Args:
        columns: What a point holds by name, each of shape ``(N,)`` or ``(N, COUNT)``.
        width: Points in a row.
        height: Rows.
        viewpoint: Position and quaternion (w x y z) of the sensor.

    Returns:
        The lines, each with its newline.
    """
    values = list(columns.values())
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(column.dtype.itemsize) for column in values)}",
        f"TYPE {' '.join(column.dtype.kind.upper() for column in values)}",
        f"COUNT {' '.join(str(int(np.prod(column.shape[1:]))) for column in values)}",
        f"WIDTH {width}",
        f"HEIGHT {height}",
        f"VIEWPOINT {' '.join(f'{value:.17g}' for value in viewpoint)}",
        f"POINTS {width * height}",
        "DATA binary",
    ]
    return "".join(f"{line}\n" for line in lines)
