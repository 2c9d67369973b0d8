"""PCD 0.7: ascii, binary and binary_compressed.

An own reader and writer around the LZF codec that pypcd4 uses, because pypcd4 itself (1.5.1,
measured) takes the memory a header promises, misreads fields of COUNT > 1 in compressed files,
needs every header line in place, and writes ASCII with ten decimals.
"""

import math
import struct
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from torchrg.errors import FormatError
from torchrg.io.columns import Spelling, flatten_cloud, write_records
from torchrg.io.fields import Columns, Values, assemble_cloud
from torchrg.io.files import check_end, check_promise, words_of
from torchrg.io.text import read_rows
from torchrg.structures import FARTHEST, Cloud

_LONGEST_HEADER = 1 << 16
"""Bytes of the longest header; a longer one is taken for damage."""
_LARGEST_RECORD = 1 << 20
"""Bytes of the largest point; a larger one is taken for damage."""
_PADDING = "_"
_TYPES = ("F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8", "B1")
_ENCODINGS = ("ascii", "binary", "binary_compressed")
DEFAULT_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Position and quaternion w x y z of the sensor."""
_SPELLING = Spelling(normals=("normal_x", "normal_y", "normal_z"), vectors=True)
_PACKED_COLORS = ("rgb", "rgba")
_LARGEST_LZF_RATIO = 88
"""Most bytes that one byte of LZF becomes: three bytes refer to at most 264."""


def read_pcd(path: Path, size: int) -> Cloud:
    """Read a PCD file.

    Packed colours become ``color``, and the fourth channel of ``rgba`` becomes ``alpha``. An
    organised cloud has its ``grid_shape``, and the viewpoint is kept for writing.
    """
    with path.open("rb") as stream:
        header = _read_header(path, stream)
        read = {"ascii": _read_text, "binary": _read_binary}.get(header.encoding, _read_compressed)
        stored = read(path, stream, header, size)
        notes: tuple[str, ...] = ()
        if header.encoding != "binary_compressed" and header.num_points:
            is_binary = header.encoding == "binary"
            notes = check_end(path, stream, header.dtype.itemsize if is_binary else 0)
    columns: dict[str, Values] = {}
    for name in header.field_names:
        columns |= _unpacked(name, stored[name])
    grid_shape = (header.height, header.width) if header.height > 1 else None
    about = {"viewpoint": header.viewpoint or DEFAULT_VIEWPOINT}
    if not header.viewpoint:
        notes += ("its VIEWPOINT left out, as it is not a position and a rotation",)
    return assemble_cloud(path, columns, grid_shape=grid_shape, header=about, notes=notes)


def count_pcd(path: Path, size: int) -> int:
    """Return the number of points by the header."""
    with path.open("rb") as stream:
        return _read_header(path, stream).num_points


def write_pcd(path: Path, cloud: Cloud) -> None:
    """Write a binary file; equal clouds give equal bytes.

    Coordinates keep their precision, colours are packed as PCL does, an organised cloud keeps its
    width and height. (Open3D's older reader, and PCL's own point types, take float32 coordinates
    only; ``open3d.t.io`` takes both.)
    """
    height, width = cloud.grid_shape or (1, len(cloud))
    if height * width != len(cloud):
        raise FormatError(
            f"{path}: expected a grid of {len(cloud)} points, got {height} rows of {width}; "
            "set grid_shape to None."
        )
    viewpoint = cloud.header.get("viewpoint", DEFAULT_VIEWPOINT)
    columns = _packed(flatten_cloud(path, cloud, _SPELLING))
    values = columns.values()
    header = [
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
    write_records(path, header, columns)


class _Header(NamedTuple):
    """What a header says, and how many lines it has.

    A point has ``dtype``, whose padding fields are called ``_ 0``, ``_ 1`` and so on; a cloud
    without order is one row of ``width`` points. The viewpoint is empty where it is impossible.
    """

    dtype: np.dtype[np.void]
    width: int
    height: int
    viewpoint: tuple[float, ...]
    encoding: str
    num_lines: int

    @property
    def num_points(self) -> int:
        """Points that the header promises."""
        return self.width * self.height

    @property
    def field_names(self) -> list[str]:
        """Names of the fields that are no padding."""
        return [name for name in self.dtype.names or () if not _is_padding(name)]


def _is_padding(name: str) -> bool:
    """Whether a name in a header's type is that of padding; fields have no space in theirs."""
    return name.startswith(f"{_PADDING} ")


def _read_header(path: Path, stream: BinaryIO) -> _Header:
    """Read the header and leave the stream at the first byte of data.

    All lines but ``FIELDS``, ``DATA`` and one with the number of points may be absent, as in files
    before version 0.7. The lines may have any order as long as ``DATA`` is the last.
    """
    lines: dict[str, tuple[int, list[str]]] = {}
    number = 0
    while "DATA" not in lines:
        number += 1
        raw = stream.readline(_LONGEST_HEADER)
        if not raw.endswith(b"\n") or stream.tell() > _LONGEST_HEADER:
            raise FormatError(
                f"{path}: line {number}: expected the header to end with a line DATA; "
                "the file is cut off or no PCD file, write or copy it again."
            )
        words = words_of(raw)
        if words and not words[0].startswith("#"):
            lines["FIELDS" if words[0] == "COLUMNS" else words[0]] = (number, words[1:])
    entries = _Entries(path, lines)
    points = entries.integers("POINTS", 1) if "POINTS" in lines else None
    width = entries.integers("WIDTH", 1, None if "HEIGHT" in lines else points)[0]
    height = entries.integers("HEIGHT", 1, [1])[0]
    if points not in (None, [width * height]):
        raise entries.error("POINTS", f"WIDTH x HEIGHT = {width * height}")
    encoding = " ".join(entries.words("DATA"))
    if encoding not in _ENCODINGS:
        raise entries.error("DATA", f"one of {', '.join(_ENCODINGS)}")
    dtype, viewpoint = _record_type(entries), entries.viewpoint()
    return _Header(dtype, width, height, viewpoint, encoding, number)


class _Entries(NamedTuple):
    """The lines of a header by their first word: number and further words."""

    path: Path
    lines: dict[str, tuple[int, list[str]]]

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

    def viewpoint(self) -> tuple[float, ...]:
        """Return position and quaternion of the sensor, or nothing if they are impossible."""
        if "VIEWPOINT" not in self.lines:
            return DEFAULT_VIEWPOINT
        with suppress(ValueError):
            values = tuple(map(float, self.words("VIEWPOINT")))
            if len(values) == len(DEFAULT_VIEWPOINT):
                is_near = all(abs(value) <= FARTHEST for value in values[:3])
                return values if is_near and 0 < math.hypot(*values[3:]) < math.inf else ()
        raise self.error("VIEWPOINT", "7 numbers")


def _record_type(entries: _Entries) -> np.dtype[np.void]:
    """Return the type of a point from the lines FIELDS, SIZE, TYPE and COUNT.

    PCL writes fields of COUNT 0, and leaves them out when it reads.
    """
    names = entries.words("FIELDS")
    sizes = entries.integers("SIZE", len(names), [4] * len(names))
    kinds = entries.words("TYPE") if "TYPE" in entries.lines else ["F"] * len(names)
    counts = entries.integers("COUNT", len(names), [1] * len(names))
    if len(kinds) != len(names):
        raise entries.error("TYPE", f"{len(names)} letters")
    used = [name for name in names if name != _PADDING]
    if not used or len(set(used)) != len(used):
        raise entries.error("FIELDS", "names that differ")
    if sum(size * count for size, count in zip(sizes, counts, strict=True)) > _LARGEST_RECORD:
        raise entries.error("COUNT", f"sizes of at most {_LARGEST_RECORD} bytes")
    parts: list[tuple[str, str, tuple[int, ...]]] = []
    for i, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        shape = () if count == 1 else (count,)
        if count == 0:
            continue
        if name == _PADDING and size:
            parts.append((f"{_PADDING} {i}", f"V{size}", shape))
        elif f"{kind}{size}" in _TYPES:
            code = "u" if kind == "B" else kind.lower()
            parts.append((name, f"<{code}{size}", shape))
        else:
            raise entries.error("TYPE", f"F, I or U of a known SIZE for {name}")
    if not parts:
        raise entries.error("COUNT", "above 0 for a field")
    return np.dtype(parts)


def _read_text(path: Path, stream: BinaryIO, header: _Header, size: int) -> Values:
    """Read the points of an ASCII file."""
    # Padding has no type of its own; in ASCII it is COUNT words to skip.
    parts = [
        (name, "f8" if _is_padding(name) else header.dtype[name].base, header.dtype[name].shape)
        for name in header.dtype.names or ()
    ]
    line_number = header.num_lines + 1
    return read_rows(
        path, stream, np.dtype(parts), header.num_points, "points", line_number=line_number
    )


def _read_binary(path: Path, stream: BinaryIO, header: _Header, size: int) -> Values:
    """Read the points of a binary file."""
    promised, content = header.num_points * header.dtype.itemsize, f"{header.num_points:,} points"
    start = stream.tell()
    check_promise(path, start, promised, content, available=size - start)
    return np.fromfile(stream, header.dtype, count=header.num_points)


def _read_compressed(path: Path, stream: BinaryIO, header: _Header, size: int) -> dict[str, Values]:
    """Read the fields of a compressed file: one field after the other, in one block of LZF."""
    import lzf

    names = header.field_names
    # PCL leaves padding out of the block; writers that copy whole records do not.
    needed = header.num_points * sum(header.dtype[name].itemsize for name in names)
    padded = header.num_points * header.dtype.itemsize
    start = stream.tell()
    check_promise(path, start, 8, "two block sizes", available=size - start)
    packed_size, full_size = struct.unpack("<II", stream.read(8))
    content = f"a block of {header.num_points:,} points"
    start += 8
    check_promise(path, start, packed_size, content, available=size - start)
    if full_size not in (needed, padded) or full_size > packed_size * _LARGEST_LZF_RATIO:
        raise FormatError(
            f"{path}: byte {start - 4}: expected {needed:,} bytes for {header.num_points:,} points "
            f"from a block of {packed_size:,}, got {full_size:,}; the file is damaged or its "
            "header is wrong, write or copy it again."
        )
    try:
        block = lzf.decompress(stream.read(packed_size), full_size)
    except ValueError:
        block = None
    if block is None or len(block) != full_size:
        raise FormatError(
            f"{path}: byte {start}: expected a block that unpacks to {full_size:,} bytes; "
            "the file is damaged, write or copy it again."
        )
    fields, offset = {}, 0
    for name in names if full_size == needed else header.dtype.names or ():
        dtype = header.dtype[name]
        count = header.num_points * int(np.prod(dtype.shape))
        values = np.frombuffer(block, dtype.base, count, offset)
        fields[name] = values.reshape(header.num_points, *dtype.shape)
        offset += values.nbytes
    return fields


def _unpacked(name: str, values: Values) -> dict[str, Values]:
    """Cut a packed colour into channels; give back any other field as it is."""
    if name.lower() not in _PACKED_COLORS or values.ndim != 1 or values.dtype.itemsize != 4:
        return {name: values}
    channels = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    # Least significant byte first: blue, green, red, alpha.
    quadruples = channels.view(np.uint8).reshape(-1, 4)
    unpacked = {"color": np.ascontiguousarray(quadruples[:, 2::-1])}
    return unpacked | ({"alpha": quadruples[:, 3].copy()} if name.lower() == "rgba" else {})


def _packed(columns: Columns) -> dict[str, Values]:
    """Pack the channels of a colour as PCL does, and give normals the type of the coordinates."""
    packed: dict[str, Values] = {}
    has_color = all(name in columns for name in _SPELLING.color)
    for name, column in columns.items():
        if has_color and name == _SPELLING.color[0]:
            quadruples = np.zeros((len(column), 4), np.uint8)
            for i, channel in enumerate(_SPELLING.color):
                quadruples[:, 2 - i] = columns[channel]
            packed["rgb"] = quadruples.view("<f4")[:, 0]
        elif name in _SPELLING.normals:
            # Open3D reads normals as if they had the type of the coordinates.
            packed[name] = column.astype(np.result_type(column, columns["x"]))
        elif not (has_color and name in _SPELLING.color):
            packed[name] = column
    return packed
