"""PLY: ASCII, little and big endian, any properties.

An own codec, because the kept readers lose data (measured with meshio 5.3.5 and trimesh 5.2.0):
meshio reads ``uchar`` as signed, knows no ``short``, ends the process at elements other than vertex
and face, and takes the memory a header promises; trimesh writes float32 and drops fields.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.columns import (
    Limits,
    Spelling,
    exact_limits,
    flatten_cloud,
    narrow_integers,
    write_records,
)
from torchrg.io.fields import Columns
from torchrg.io.files import check_promise
from torchrg.io.stream import CloudStream, Table, slices
from torchrg.io.text import LINES_AT_ONCE, read_ascii, words_of

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
"""NumPy's codes by the words that are written."""
_NUMPY_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
_READ_TYPES = _TYPES | {
    name: np.dtype(name).str[1:] for name in (*_NUMPY_NAMES, "float32", "float64")
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20
"""Bytes of the longest header; a longer one is taken for damage."""
_LONGEST_LIST = 1 << 20
"""Bytes of the longest list; a longer one is taken for damage."""
_LENGTH, _LIST = " length", " list"
"""Ends of the names of a list and its length in records. Names in a PLY file have no spaces, so
that no property is called so."""


def open_ply(path: Path, size: int) -> Table:
    """Open a PLY file: every property of the element ``vertex``; other elements are left out."""
    with path.open("rb") as stream:
        header = _read_header(path, stream)
    elements = [element for element in header.elements if element.properties]
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise FormatError(
            f"{path}: expected an element vertex with properties, got elements "
            f"{', '.join(names) or 'none'}; write the points as vertices."
        )
    others = [
        f"{element.num_records:,} of {element.name}"
        for element in elements
        if element.name != "vertex" and element.num_records
    ]
    notes = (f"elements left out, as only vertices are read: {', '.join(others)}",)
    header = header._replace(elements=elements[: names.index("vertex") + 1])
    read_records = _read_binary if header.byte_order else _read_text

    def read(chunk_size: int) -> Iterator[Columns]:
        with path.open("rb") as stream:
            for records in read_records(path, stream, header, size, chunk_size):
                names = [name for name in records.dtype.names or () if not name.endswith(_LENGTH)]
                yield {name.removesuffix(_LIST): records[name] for name in names}

    at_once = None if header.byte_order else LINES_AT_ONCE
    num_points = header.elements[-1].num_records
    return Table(read, num_points, at_once, notes=notes if others else ())


def write_ply(path: Path, stream: CloudStream) -> None:
    """Write a little-endian file; coordinates keep their precision, equal clouds give equal bytes.

    64-bit integers become 32-bit ones, or ``double`` where that holds them.
    """
    spelling = Spelling()
    limits = exact_limits(path, stream, spelling)
    words = {code: word for word, code in _TYPES.items()}

    def header(columns: Columns) -> list[str]:
        return [
            "ply",
            "format binary_little_endian 1.0",
            "comment written by torchrg",
            f"element vertex {stream.count}",
            *(f"property {words[c.dtype.str[1:]]} {name}" for name, c in columns.items()),
            "end_header",
        ]

    chunks = (flatten_cloud(path, chunk, spelling, limits) for chunk in stream)
    write_records(
        path,
        header,
        (
            {name: _storable(c, limits.get(name)) for name, c in columns.items()}
            for columns in chunks
        ),
    )


def _storable(column: NDArray[Any], limits: Limits | None) -> NDArray[Any]:
    """Return a column in a type that PLY has and that holds its limits."""
    column = narrow_integers(column, ("i4", "u4"), limits)
    is_wide = column.dtype.kind in "iu" and column.dtype.itemsize == 8
    return column.astype(np.float64) if is_wide else column


class _Property(NamedTuple):
    """A property of an element: one number, or a list with its length before it.

    Codes are NumPy's, without byte order; that of the length is None for a single number.
    """

    name: str
    code: str
    length_code: str | None = None


class _Element(NamedTuple):
    """An element: so many records of some properties."""

    name: str
    num_records: int
    properties: list[_Property]


class _Header(NamedTuple):
    """What a header says, and how long it is; the byte order is empty for ASCII."""

    byte_order: str
    elements: list[_Element]
    num_lines: int
    num_bytes: int


def _read_header(path: Path, stream: BinaryIO) -> _Header:
    """Read the header and leave the stream at the first byte of data."""
    byte_order: str | None = None
    elements: list[_Element] = []
    number = 0
    while True:
        number += 1
        raw = stream.readline(_LONGEST_HEADER)
        words = words_of(raw)
        if number == 1 and words != ["ply"]:
            raise FormatError(f"{path}: line 1: expected 'ply', got {_shown(raw)}.")
        if not raw.endswith(b"\n") or stream.tell() > _LONGEST_HEADER:
            raise FormatError(
                f"{path}: line {number}: expected the header to end with 'end_header'; "
                "the file is cut off, fetch it again."
            )
        match words:
            case [] | ["ply" | "comment" | "obj_info", *_]:
                continue
            case ["format", word, _] if word in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[word]
                continue
            case ["end_header"] if byte_order is not None:
                return _Header(byte_order, elements, number, stream.tell())
            case ["element", name, count] if (
                count.isascii() and count.isdecimal() and len(count) < 19
            ):
                known = [element.name for element in elements]
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, code, name] if (
                elements and code in _READ_TYPES and _READ_TYPES.get(length, "f")[0] != "f"
            ):
                known = [prop.name for prop in elements[-1].properties]
                new = _Property(name, _READ_TYPES[code], _READ_TYPES[length])
                elements[-1].properties.append(new)
            case ["property", code, name] if elements and code in _READ_TYPES:
                known = [prop.name for prop in elements[-1].properties]
                elements[-1].properties.append(_Property(name, _READ_TYPES[code]))
            case _:
                raise FormatError(
                    f"{path}: line {number}: expected a line of a PLY header, got {_shown(raw)}; "
                    "write the file again."
                )
        if name in known:
            raise FormatError(
                f"{path}: line {number}: expected names that differ, got {name!r} twice; "
                "rename one."
            )


def _shown(raw: bytes) -> str:
    """Return the beginning of a line for a message."""
    return repr(raw[:40].decode("latin-1").strip())


def _read_binary(
    path: Path, stream: BinaryIO, header: _Header, size: int, chunk_size: int
) -> Iterator[NDArray[np.void]]:
    """Read the last of the elements of a binary file."""
    start = header.num_bytes
    *before, vertex = header.elements
    for element in before:
        dtype = _check_element(path, stream, element, header.byte_order, start, size)
        if any(prop.length_code for prop in element.properties):
            for rows in slices(element.num_records, chunk_size):
                _check_lists(path, element, _read_records(stream, dtype, rows))
        start += element.num_records * dtype.itemsize
    dtype = _check_element(path, stream, vertex, header.byte_order, start, size)
    for rows in slices(vertex.num_records, chunk_size):
        records = _read_records(stream, dtype, rows)
        _check_lists(path, vertex, records)
        yield records


def _check_element(
    path: Path, stream: BinaryIO, element: _Element, byte_order: str, start: int, size: int
) -> np.dtype[np.void]:
    """Return the type of the records of an element, all of which are there; go to the first."""
    stream.seek(start)
    dtype = _record_type(path, stream, element, byte_order, size)
    promised = element.num_records * dtype.itemsize
    content = f"{element.num_records:,} records of {element.name}"
    check_promise(path, start, promised, content, available=size - start)
    stream.seek(start)
    return dtype


def _read_records(stream: BinaryIO, dtype: np.dtype[np.void], rows: slice) -> NDArray[np.void]:
    """Read the next records, as many as there are rows."""
    return np.fromfile(stream, dtype, count=rows.stop - rows.start)


def _record_type(
    path: Path, stream: BinaryIO, element: _Element, byte_order: str, size: int
) -> np.dtype[np.void]:
    """Return the type of a record; lists have the length that the first record gives them."""
    parts: list[tuple[Any, ...]] = []
    for prop in element.properties:
        if prop.length_code is None:
            parts.append((prop.name, byte_order + prop.code))
            stream.seek(np.dtype(prop.code).itemsize, io.SEEK_CUR)
            continue
        length_type = np.dtype(byte_order + prop.length_code)
        raw = stream.read(length_type.itemsize) if element.num_records else b""
        length = int(np.frombuffer(raw, length_type)[0]) if len(raw) == length_type.itemsize else 0
        num_bytes = length * np.dtype(prop.code).itemsize
        if not 0 <= num_bytes <= min(size, _LONGEST_LIST):
            raise FormatError(
                f"{path}: byte {stream.tell()}: expected a list that fits the file, got length "
                f"{length:,}; the file is damaged, fetch it again."
            )
        stream.seek(num_bytes, io.SEEK_CUR)
        parts.append((prop.name + _LENGTH, length_type))
        parts.append((prop.name + _LIST, byte_order + prop.code, (length,)))
    return np.dtype(parts)


def _check_lists(path: Path, element: _Element, records: NDArray[np.void]) -> None:
    """Check that the lists of an element all have one length, so that records have one size."""
    for name in records.dtype.names or ():
        if not name.endswith(_LENGTH):
            continue
        (length,) = records.dtype[name.removesuffix(_LENGTH) + _LIST].shape
        if (records[name] != length).any():
            raise FormatError(
                f"{path}: expected lists of one length in element {element.name}, which comes "
                "with or before the vertices; write the vertices first and without lists."
            )


def _read_text(
    path: Path, stream: BinaryIO, header: _Header, size: int, chunk_size: int
) -> Iterator[NDArray[np.void]]:
    """Read the last of the elements of an ASCII file."""
    *before, vertex = header.elements
    if any(prop.length_code for prop in vertex.properties):
        raise FormatError(
            f"{path}: expected vertices without lists in an ASCII file; write it as binary."
        )
    return read_ascii(
        path,
        stream,
        np.dtype([(prop.name, prop.code) for prop in vertex.properties]),
        chunk_size,
        num_rows=vertex.num_records,
        size=size,
        num_lines=header.num_lines,
        start=header.num_bytes,
        skipped=sum(element.num_records for element in before),
        content="vertices",
    )
