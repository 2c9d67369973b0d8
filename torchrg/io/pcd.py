"""PCD 0.7: ascii, binary and binary_compressed.

An own reader and writer around the LZF codec that pypcd4 uses, because pypcd4 itself (1.5.1,
measured) takes the memory a header promises, misreads fields of COUNT > 1 in compressed files,
needs every header line in place, and writes ASCII with ten decimals.
"""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import Spelling, assemble_cloud, flatten_cloud
from torchrg.io.files import atomic_path, check_file, check_promise
from torchrg.io.text import read_table
from torchrg.structures import Cloud

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


SPELLING = Spelling(normals=("normal_x", "normal_y", "normal_z"), vectors=True)
PACKED_COLORS = ("rgb", "rgba")
# A reference of three bytes in LZF stands for at most 264 bytes.
LARGEST_LZF_RATIO = 88


def read_pcd(path: Path) -> Cloud:
    """Read a PCD file.

    Args:
        path: The file.

    Returns:
        The cloud with its fields; packed colours become ``color``, and the fourth channel of
        ``rgba`` becomes ``alpha``. An organised cloud has its ``grid_shape``, and the viewpoint is
        kept for writing.

    Raises:
        FormatError: If the file is damaged or has no fields x, y and z.
    """
    size = check_file(path)
    with path.open("rb") as stream:
        header = read_header(path, stream)
        read = {"ascii": _read_text, "binary": _read_binary}.get(header.encoding, _read_compressed)
        stored = read(path, stream, header, size)
    columns: dict[str, NDArray[Any]] = {}
    for name, values in stored.items():
        columns |= _unpacked(name, values)
    return assemble_cloud(
        path,
        columns,
        grid_shape=(header.height, header.width) if header.height > 1 else None,
        header={"viewpoint": header.viewpoint},
    )


def write_pcd(path: Path, cloud: Cloud) -> None:
    """Write a cloud as a binary PCD file; equal clouds give equal bytes.

    Args:
        path: The file.
        cloud: The cloud; coordinates keep their precision, colours are packed as PCL does, an
            organised cloud keeps its width and height. (Open3D's older reader, and PCL's own point
            types, take float32 coordinates only; ``open3d.t.io`` takes both.)

    Raises:
        FormatError: If a field has no place in a PCD file, or the file cannot be written.
    """
    height, width = cloud.grid_shape or (1, len(cloud))
    if height * width != len(cloud):
        raise FormatError(
            f"{path}: expected a grid of {len(cloud)} points, got {height} rows of {width}; "
            "set grid_shape to None."
        )
    columns = _packed(flatten_cloud(path, cloud, SPELLING))
    records = np.empty(
        len(cloud),
        [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in columns.items()],
    )
    for name, column in columns.items():
        records[name] = column
    header = format_header(
        columns,
        width=width,
        height=height,
        viewpoint=cloud.header.get("viewpoint", DEFAULT_VIEWPOINT),
    )
    with atomic_path(path) as beside, beside.open("wb") as stream:
        stream.write(header.encode())
        records.tofile(stream)


def _read_text(path: Path, stream: BinaryIO, header: Header, size: int) -> dict[str, NDArray[Any]]:
    """Read the fields of an ASCII file."""
    # Padding has no type of its own; in ASCII it is COUNT words to skip.
    parts = [
        (
            name,
            "f8" if name.startswith(f"{PADDING} ") else header.dtype[name].base,
            header.dtype[name].shape,
        )
        for name in header.dtype.names or ()
    ]
    dtype = np.dtype(parts)
    columns = sum(int(np.prod(shape)) for _, _, shape in parts)
    check_promise(
        path,
        byte=header.num_bytes,
        # A digit and what separates it from the next; the last may end with the file.
        promised=header.num_points * columns * 2 - 1,
        available=size - header.num_bytes,
        content=f"{header.num_points:,} points",
        at_least=True,
    )
    lines = (raw.decode("latin-1") for raw in stream)
    first = header.num_lines + 1
    return _fields(read_table(path, lines, dtype, first_line=first, num_rows=header.num_points))


def _read_binary(
    path: Path, stream: BinaryIO, header: Header, size: int
) -> dict[str, NDArray[Any]]:
    """Read the fields of a binary file."""
    check_promise(
        path,
        byte=header.num_bytes,
        promised=header.num_points * header.dtype.itemsize,
        available=size - header.num_bytes,
        content=f"{header.num_points:,} points",
    )
    return _fields(np.fromfile(stream, header.dtype, count=header.num_points))


def _fields(records: NDArray[np.void]) -> dict[str, NDArray[Any]]:
    """Return the fields of records without the padding."""
    names = records.dtype.names or ()
    return {name: records[name] for name in names if not name.startswith(f"{PADDING} ")}


def _read_compressed(
    path: Path, stream: BinaryIO, header: Header, size: int
) -> dict[str, NDArray[Any]]:
    """Read the fields of a compressed file: one field after the other, in one block of LZF."""
    import lzf

    names = [n for n in header.dtype.names or () if not n.startswith(f"{PADDING} ")]
    # PCL leaves padding out of the block; writers that copy whole records do not.
    needed = header.num_points * sum(header.dtype[name].itemsize for name in names)
    padded = header.num_points * header.dtype.itemsize
    start = header.num_bytes
    check_promise(path, byte=start, promised=8, available=size - start, content="two block sizes")
    packed_size, full_size = struct.unpack("<II", stream.read(8))
    content = f"a block of {header.num_points:,} points"
    start += 8
    check_promise(path, byte=start, promised=packed_size, available=size - start, content=content)
    if full_size not in (needed, padded) or full_size > packed_size * LARGEST_LZF_RATIO:
        raise FormatError(
            f"{path}: byte {start - 4}: expected {needed:,} bytes for {header.num_points:,} points "
            f"from a block of {packed_size:,}, got {full_size:,}; fetch the file again."
        )
    try:
        block = lzf.decompress(stream.read(packed_size), full_size)
    except ValueError:
        block = None
    if block is None or len(block) != full_size:
        raise FormatError(
            f"{path}: byte {start}: expected a block that unpacks to {full_size:,} bytes; "
            "the file is damaged, fetch it again."
        )
    fields, offset = {}, 0
    for name in names if full_size == needed else header.dtype.names or ():
        dtype = header.dtype[name]
        values = np.frombuffer(
            block, dtype.base, header.num_points * int(np.prod(dtype.shape)), offset
        )
        fields[name] = values.reshape(header.num_points, *dtype.shape)
        offset += values.nbytes
    return {name: fields[name] for name in names}


def _unpacked(name: str, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Cut a packed colour into channels; give back any other field as it is."""
    if name.lower() not in PACKED_COLORS or values.ndim != 1 or values.dtype.itemsize != 4:
        return {name: values}
    channels = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    # Least significant byte first: blue, green, red, alpha.
    quadruples = channels.view(np.uint8).reshape(-1, 4)
    unpacked = {"color": np.ascontiguousarray(quadruples[:, 2::-1])}
    return unpacked | ({"alpha": quadruples[:, 3].copy()} if name.lower() == "rgba" else {})


def _packed(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Pack the channels of a colour as PCL does, and give normals the type of the coordinates."""
    packed: dict[str, NDArray[Any]] = {}
    has_color = all(name in columns for name in SPELLING.color)
    for name, column in columns.items():
        if has_color and name == SPELLING.color[0]:
            quadruples = np.zeros((len(column), 4), np.uint8)
            for i, channel in enumerate(SPELLING.color):
                quadruples[:, 2 - i] = columns[channel]
            packed["rgb"] = quadruples.view("<f4")[:, 0]
        elif name in SPELLING.normals:
            # Open3D reads normals as if they had the type of the coordinates.
            packed[name] = column.astype(np.result_type(column, columns["x"]))
        elif not (has_color and name in SPELLING.color):
            packed[name] = column
    return packed
