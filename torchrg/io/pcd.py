"""PCD 0.7 reader and writer: ascii, binary and binary_compressed.

It uses the LZF codec of pypcd4, but not pypcd4 itself (1.5.1, measured). That one allocates the
memory that a header announces, and misreads fields of COUNT > 1 in compressed files. It requires
every header line in order, and writes ASCII with ten decimals.
"""

import math
import struct
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from torchrg.errors import FormatError
from torchrg.io.columns import FieldNames, flatten_cloud, map_records, write_records
from torchrg.io.fields import NamedColumns, assemble_cloud
from torchrg.io.files import check_available, check_end, header_lines, open_lines, parse_count
from torchrg.io.text import read_rows
from torchrg.structures import FARTHEST, Cloud
from torchrg.structures.points import Array

_MAX_RECORD_BYTES = 1 << 20
"""Maximum bytes of a point; a larger one counts as corrupt."""
_PADDING = "_"
_TYPES = ("F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8", "B1")
_ENCODINGS = ("ascii", "binary", "binary_compressed")
DEFAULT_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Position and quaternion w x y z of the sensor."""
_FIELD_NAMES = FieldNames(normals=("normal_x", "normal_y", "normal_z"), vectors=True)
_MAX_LZF_RATIO = 88
"""Maximum bytes per byte of LZF data: three bytes refer to at most 264."""


def read_pcd(path: Path, size: int) -> Cloud:
    """Read a PCD file.

    Packed colors become ``color``; the fourth channel of ``rgba`` becomes ``alpha``. An organized
    cloud gets a ``grid_shape``. The viewpoint is kept for writing.
    """
    with open_lines(path, b"DATA") as stream:
        header = _read_header(path, stream)
        read = {"ascii": _read_text, "binary": _read_binary}.get(header.encoding, _read_compressed)
        stored = read(path, stream, header, size)
        notes: tuple[str, ...] = ()
        if header.encoding != "binary_compressed" and header.num_points:
            is_binary = header.encoding == "binary"
            notes = check_end(path, stream, header.dtype.itemsize if is_binary else 0)
    columns: dict[str, Array] = {}
    for name in header.field_names:
        columns |= _unpack_color(name, stored[name])
    grid_shape = (header.height, header.width) if header.height > 1 else None
    metadata = {"viewpoint": header.viewpoint or DEFAULT_VIEWPOINT}
    if not header.viewpoint:
        notes += ("its VIEWPOINT is ignored, because it is not a position and a rotation",)
    return assemble_cloud(path, columns, grid_shape=grid_shape, header=metadata, notes=notes)


def count_pcd(path: Path, size: int) -> int:
    """Return the number of points from the header."""
    with open_lines(path, b"DATA") as stream:
        return _read_header(path, stream).num_points


def write_pcd(path: Path, cloud: Cloud) -> None:
    """Write a binary file; identical clouds give byte-identical files.

    Coordinates keep their precision, colors are packed as in PCL, and an organized cloud keeps its
    width and height. (Open3D's legacy reader and PCL's point types accept float32 only.)
    """
    height, width = cloud.grid_shape or (1, len(cloud))
    if height * width != len(cloud):
        raise FormatError(
            f"{path}: expected a grid of {len(cloud)} points, got {height} rows of {width}; "
            "set grid_shape to None."
        )
    viewpoint = cloud.header.get("viewpoint", DEFAULT_VIEWPOINT)
    columns = _pack_columns(flatten_cloud(path, cloud, _FIELD_NAMES))
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
    """Parsed header and its number of lines.

    ``dtype`` is the type of a point, with padding fields named ``_ 0``, ``_ 1`` and so on. An
    unorganized cloud is one row of ``width`` points. The viewpoint is empty if it is invalid.
    """

    dtype: np.dtype[np.void]
    width: int
    height: int
    viewpoint: tuple[float, ...]
    encoding: str
    num_lines: int

    @property
    def num_points(self) -> int:
        """Number of points by the header."""
        return self.width * self.height

    @property
    def field_names(self) -> list[str]:
        """Names of the fields that are not padding."""
        return [name for name in self.dtype.names or () if self.dtype[name].base.kind != "V"]


def _read_header(path: Path, stream: BinaryIO) -> _Header:
    """Read the header and leave the stream at the first data byte.

    Only ``FIELDS``, ``DATA`` and a line with the number of points are required, as before version
    0.7. The lines may have any order, except that ``DATA`` is last.
    """
    lines: dict[str, tuple[int, list[str]]] = {}
    for number, words in header_lines(path, stream, "DATA"):
        if words and not words[0].startswith("#"):
            lines["FIELDS" if words[0] == "COLUMNS" else words[0]] = (number, words[1:])
    entries = _HeaderLines(path, lines)
    points = entries.integers("POINTS", 1) if "POINTS" in lines else None
    width = entries.integers("WIDTH", 1, None if "HEIGHT" in lines else points)[0]
    height = entries.integers("HEIGHT", 1, [1])[0]
    if points not in (None, [width * height]):
        raise entries.error("POINTS", f"WIDTH x HEIGHT = {width * height}")
    encoding = " ".join(entries.words("DATA"))
    if encoding not in _ENCODINGS:
        raise entries.error("DATA", f"one of {', '.join(_ENCODINGS)}")
    return _Header(_record_type(entries), width, height, entries.viewpoint(), encoding, number)


class _HeaderLines(NamedTuple):
    """Header lines by their first word: line number and remaining words."""

    path: Path
    lines: dict[str, tuple[int, list[str]]]

    def error(self, key: str, expected: str) -> FormatError:
        """Return the error for a wrong or missing line."""
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
        """Return the words after a required key."""
        if key not in self.lines:
            raise self.error(key, "")
        return self.lines[key][1]

    def integers(self, key: str, count: int, default: list[int] | None = None) -> list[int]:
        """Return the integers after a key."""
        if default is not None and key not in self.lines:
            return default
        words = self.words(key)
        numbers = [number for number in map(parse_count, words) if number is not None]
        if not len(words) == len(numbers) == count:
            raise self.error(key, f"{count} integer{'s' if count > 1 else ''} of up to 18 digits")
        return numbers

    def viewpoint(self) -> tuple[float, ...]:
        """Return position and quaternion of the sensor, or an empty tuple if they are invalid."""
        if "VIEWPOINT" not in self.lines:
            return DEFAULT_VIEWPOINT
        with suppress(ValueError):
            values = tuple(map(float, self.words("VIEWPOINT")))
            if len(values) == len(DEFAULT_VIEWPOINT):
                is_near = all(abs(value) <= FARTHEST for value in values[:3])
                return values if is_near and 0 < math.hypot(*values[3:]) < math.inf else ()
        raise self.error("VIEWPOINT", "7 numbers")


def _record_type(entries: _HeaderLines) -> np.dtype[np.void]:
    """Return the type of a point from the lines FIELDS, SIZE, TYPE and COUNT.

    Fields of COUNT 0, which PCL writes and ignores, are skipped.
    """
    names = entries.words("FIELDS")
    sizes = entries.integers("SIZE", len(names), [4] * len(names))
    kinds = entries.words("TYPE") if "TYPE" in entries.lines else ["F"] * len(names)
    counts = entries.integers("COUNT", len(names), [1] * len(names))
    if len(kinds) != len(names):
        raise entries.error("TYPE", f"{len(names)} letters")
    used = [name for name in names if name != _PADDING]
    if not used or len(set(used)) != len(used):
        raise entries.error("FIELDS", "distinct names")
    if sum(size * count for size, count in zip(sizes, counts, strict=True)) > _MAX_RECORD_BYTES:
        raise entries.error("COUNT", f"sizes of at most {_MAX_RECORD_BYTES} bytes")
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


def _read_text(path: Path, stream: BinaryIO, header: _Header, size: int) -> Array:
    """Read the points of an ASCII file."""
    # Padding has no type in ASCII: it is COUNT words to skip.
    fields = header.field_names
    parts = [
        (name, header.dtype[name].base if name in fields else "f8", header.dtype[name].shape)
        for name in header.dtype.names or ()
    ]
    dtype, number = np.dtype(parts), header.num_lines + 1
    return read_rows(path, stream, dtype, header.num_points, "points", line_number=number)


def _read_binary(path: Path, stream: BinaryIO, header: _Header, size: int) -> Array:
    """Read the points of a binary file."""
    num_bytes, content = header.num_points * header.dtype.itemsize, f"{header.num_points:,} points"
    start = stream.tell()
    check_available(path, start, num_bytes, content, available=size - start)
    return map_records(stream, header.dtype, header.num_points)


def _read_compressed(path: Path, stream: BinaryIO, header: _Header, size: int) -> dict[str, Array]:
    """Read a compressed file: one LZF block that stores one field after the other."""
    import lzf

    names = header.field_names
    # PCL omits padding from the block; writers that copy complete records do not.
    needed = header.num_points * sum(header.dtype[name].itemsize for name in names)
    padded = header.num_points * header.dtype.itemsize
    start = stream.tell()
    check_available(path, start, 8, "two block sizes", available=size - start)
    packed_size, full_size = struct.unpack("<II", stream.read(8))
    content = f"a block of {header.num_points:,} points"
    start += 8
    check_available(path, start, packed_size, content, available=size - start)
    if full_size not in (needed, padded) or full_size > packed_size * _MAX_LZF_RATIO:
        raise FormatError(
            f"{path}: byte {start - 4}: expected {needed:,} bytes for {header.num_points:,} points "
            f"from a block of {packed_size:,}, got {full_size:,}; the file is corrupt or its "
            "header is wrong, write or copy it again."
        )
    try:
        block = lzf.decompress(stream.read(packed_size), full_size)
    except ValueError:
        block = None
    if block is None or len(block) != full_size:
        raise FormatError(
            f"{path}: byte {start}: expected a block that decompresses to {full_size:,} bytes; "
            "the file is corrupt, write or copy it again."
        )
    fields, offset = {}, 0
    for name in names if full_size == needed else header.dtype.names or ():
        dtype = header.dtype[name]
        count = header.num_points * int(np.prod(dtype.shape))
        values = np.frombuffer(block, dtype.base, count, offset)
        fields[name] = values.reshape(header.num_points, *dtype.shape)
        offset += values.nbytes
    return fields


def _unpack_color(name: str, values: Array) -> dict[str, Array]:
    """Split a packed color into channels; return any other field unchanged."""
    if name.lower() not in ("rgb", "rgba") or values.ndim != 1 or values.dtype.itemsize != 4:
        return {name: values}
    channels = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    # Little-endian order: blue, green, red, alpha.
    quadruples = channels.view(np.uint8).reshape(-1, 4)
    unpacked = {"color": np.ascontiguousarray(quadruples[:, 2::-1])}
    return unpacked | ({"alpha": quadruples[:, 3].copy()} if name.lower() == "rgba" else {})


def _pack_columns(columns: NamedColumns) -> dict[str, Array]:
    """Pack color channels as in PCL, and convert normals to the type of the coordinates."""
    packed: dict[str, Array] = {}
    has_color = all(name in columns for name in _FIELD_NAMES.color)
    for name, column in columns.items():
        if has_color and name == _FIELD_NAMES.color[0]:
            quadruples = np.zeros((len(column), 4), np.uint8)
            for i, channel in enumerate(_FIELD_NAMES.color):
                quadruples[:, 2 - i] = columns[channel]
            packed["rgb"] = quadruples.view("<f4")[:, 0]
        elif name in _FIELD_NAMES.normals:
            # Open3D assumes that normals have the type of the coordinates.
            packed[name] = column.astype(np.result_type(column, columns["x"]))
        elif not (has_color and name in _FIELD_NAMES.color):
            packed[name] = column
    return packed
