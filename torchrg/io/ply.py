"""PLY: ASCII, little and big endian, any properties.

An own codec, because the kept readers lose data (measured with meshio 5.3.5 and trimesh 5.2.0):
meshio reads ``uchar`` as signed, knows no ``short``, ends the process at elements other than vertex
and face, and takes the memory a header promises; trimesh writes float32 and drops fields.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from torchrg.errors import FormatError
from torchrg.io.columns import (
    Spelling,
    check_exact,
    flatten_cloud,
    narrow_integers,
    slices,
    write_records,
)
from torchrg.io.faces import Fronts, find_fronts
from torchrg.io.fields import Values, assemble_cloud
from torchrg.io.files import check_promise
from torchrg.io.text import read_rows, skip_lines, words_of
from torchrg.structures import Cloud

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
_CORNERS = ("vertex_indices", "vertex_index")
"""Names of the list of a face's vertices."""
_BYTES_AT_ONCE = 1 << 22
"""Bytes of records with lists that are read together."""
_LENGTH, _LIST = " length", " list"
"""Ends of the names of a list and its length in records. Names in a PLY file have no spaces, so
that no property is called so."""


def read_ply(path: Path, size: int) -> Cloud:
    """Read a PLY file: every property of the element ``vertex``, and its front by the faces.

    Other elements are left out, and so are faces that come before the vertices, or that have
    different numbers of corners.
    """
    with path.open("rb") as stream:
        header = _read_header(path, stream)
        vertex = header.place_of_vertices(path)
        up_to_vertex = header._replace(elements=header.elements[: vertex + 1])
        read = _read_binary if header.byte_order else _read_text
        records = read(path, stream, up_to_vertex, size)
    names = [name for name in records.dtype.names or () if not name.endswith(_LENGTH)]
    columns = {name.removesuffix(_LIST): records[name] for name in names}
    places = range(vertex + 1, len(header.elements))
    face = next((i for i in places if _is_mesh(header.elements[i])), vertex)
    others = [
        f"{element.num_records:,} of {element.name}"
        for i, element in enumerate(header.elements)
        if i not in (vertex, face) and element.num_records
    ]
    notes: tuple[str, ...] = ()
    if others:
        left = ", ".join(others)
        notes = (f"elements left out, as only vertices and their faces are read: {left}",)
    cloud = assemble_cloud(path, columns, notes=notes)
    if face == vertex:
        return cloud
    del records, columns
    mesh = header._replace(elements=header.elements[: face + 1])
    front, more = _fronts(path, mesh, size, cloud)
    return replace(cloud, front=front, notes=notes + more)


def count_ply(path: Path, size: int) -> int:
    """Return the number of vertices by the header."""
    with path.open("rb") as stream:
        header = _read_header(path, stream)
    return header.elements[header.place_of_vertices(path)].num_records


def _is_mesh(element: "_Element") -> bool:
    """Return whether the records of an element are faces."""
    corners = [prop for prop in element.properties if prop.name in _CORNERS and prop.length_code]
    return element.name == "face" and element.num_records > 0 and len(corners) == 1


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write a little-endian file; coordinates keep their precision, equal clouds give equal bytes.

    64-bit integers become 32-bit ones, or ``double`` where that holds them.
    """
    columns = flatten_cloud(path, cloud, Spelling())
    check_exact(path, columns)
    columns = {name: _storable(column) for name, column in columns.items()}
    words = {code: word for word, code in _TYPES.items()}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by torchrg",
        f"element vertex {len(cloud)}",
        *(f"property {words[c.dtype.str[1:]]} {name}" for name, c in columns.items()),
        "end_header",
    ]
    write_records(path, header, columns)


def _storable(column: Values) -> Values:
    """Return a column in a type that PLY has and that holds its values."""
    column = narrow_integers(column, ("i4", "u4"))
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

    def place_of_vertices(self, path: Path) -> int:
        """Return which of the elements holds the points."""
        names = [element.name for element in self.elements]
        if "vertex" not in names:
            raise FormatError(
                f"{path}: expected an element vertex with properties, got elements "
                f"{', '.join(names) or 'none'}; write the points as vertices."
            )
        return names.index("vertex")


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
                elements = [element for element in elements if element.properties]
                return _Header(byte_order, elements, number, stream.tell())
            case ["element", name, count] if (
                count.isascii() and count.isdecimal() and len(count) < 19
            ):
                names = [element.name for element in elements]
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, code, name] if (
                elements and code in _READ_TYPES and _READ_TYPES.get(length, "f")[0] != "f"
            ):
                names = [prop.name for prop in elements[-1].properties]
                new = _Property(name, _READ_TYPES[code], _READ_TYPES[length])
                elements[-1].properties.append(new)
            case ["property", code, name] if elements and code in _READ_TYPES:
                names = [prop.name for prop in elements[-1].properties]
                elements[-1].properties.append(_Property(name, _READ_TYPES[code]))
            case _:
                raise FormatError(
                    f"{path}: line {number}: expected a line of a PLY header, got {_shown(raw)}; "
                    "write the file again."
                )
        if name in names:
            raise FormatError(
                f"{path}: line {number}: expected names that differ, got {name!r} twice; "
                "rename one."
            )


def _shown(raw: bytes) -> str:
    """Return the beginning of a line for a message."""
    return repr(raw[:40].decode("latin-1").strip())


def _read_binary(path: Path, stream: BinaryIO, header: _Header, size: int) -> Values:
    """Read the last of the elements of a binary file."""
    dtype = _go_to_last(path, stream, header, size)
    records = np.fromfile(stream, dtype, count=header.elements[-1].num_records)
    _check_lists(path, header.elements[-1], records)
    return records


def _go_to_last(path: Path, stream: BinaryIO, header: _Header, size: int) -> np.dtype[np.void]:
    """Go to the last of the elements of a binary file, and return the type of its records."""
    *before, last = header.elements
    start = header.num_bytes
    for element in before:
        dtype = _check_element(path, stream, element, header.byte_order, start, size)
        if any(prop.length_code for prop in element.properties):
            for _ in _blocks(path, stream, element, dtype):
                pass
        start += element.num_records * dtype.itemsize
    return _check_element(path, stream, last, header.byte_order, start, size)


def _blocks(
    path: Path, stream: BinaryIO, element: _Element, dtype: np.dtype[np.void]
) -> Iterator[Values]:
    """Yield the records of an element of a binary file, many at a time."""
    for rows in slices(element.num_records, max(_BYTES_AT_ONCE // dtype.itemsize, 1)):
        records = np.fromfile(stream, dtype, count=rows.stop - rows.start)
        _check_lists(path, element, records)
        yield records


def _check_element(
    path: Path, stream: BinaryIO, element: _Element, byte_order: str, start: int, size: int
) -> np.dtype[np.void]:
    """Return the type of the records of an element, all of which are there; go to the first.

    Lists have the length that the first record gives them.
    """
    parts: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for prop in element.properties:
        code = byte_order + prop.code
        if prop.length_code is None:
            parts.append((prop.name, code))
            continue
        parts.append((prop.name + _LENGTH, byte_order + prop.length_code))
        stream.seek(start + np.dtype(parts).itemsize - np.dtype(prop.length_code).itemsize)
        raw = np.fromfile(stream, byte_order + prop.length_code, min(element.num_records, 1))
        length = int(raw[0]) if len(raw) else 0
        if not 0 <= length * np.dtype(code).itemsize <= min(size, _LONGEST_LIST):
            raise FormatError(
                f"{path}: byte {stream.tell()}: expected a list that fits the file, got length "
                f"{length:,}; the file is damaged, fetch it again."
            )
        parts.append((prop.name + _LIST, code, (length,)))
    dtype = np.dtype(parts)
    promised = element.num_records * dtype.itemsize
    content = f"{element.num_records:,} records of {element.name}"
    check_promise(path, start, promised, content, available=size - start)
    stream.seek(start)
    return dtype


def _check_lists(path: Path, element: _Element, records: Values) -> None:
    """Check that the lists of an element all have one length, so that records have one size."""
    for name in (name for name in records.dtype.names or () if name.endswith(_LENGTH)):
        (length,) = records.dtype[name.removesuffix(_LENGTH) + _LIST].shape
        if (records[name] != length).any():
            raise _lists_differ(path, element)


def _lists_differ(path: Path, element: _Element) -> FormatError:
    """Return the error that the lists of an element have several lengths."""
    return FormatError(
        f"{path}: expected lists of one length in element {element.name}; write the vertices "
        "first and without lists, and only triangles as faces."
    )


def _read_text(path: Path, stream: BinaryIO, header: _Header, size: int) -> Values:
    """Read the last of the elements of an ASCII file, the vertices."""
    *before, vertex = header.elements
    if any(prop.length_code for prop in vertex.properties):
        raise FormatError(
            f"{path}: expected vertices without lists in an ASCII file; write it as binary."
        )
    dtype = np.dtype([(prop.name, prop.code) for prop in vertex.properties])
    number = header.num_lines + 1 + skip_lines(stream, _num_records(before))
    return read_rows(path, stream, dtype, vertex.num_records, "vertices", line_number=number)


def _num_records(elements: list[_Element]) -> int:
    """Return the number of records of several elements."""
    return sum(element.num_records for element in elements)


def _corners_of_text(path: Path, stream: BinaryIO, header: _Header) -> Values:
    """Read the vertices of the last of the elements of an ASCII file, the faces."""
    *before, faces = header.elements
    stream.seek(header.num_bytes)
    number = header.num_lines + 1 + skip_lines(stream, _num_records(before))
    start = stream.tell()
    num_words = len(next(filter(bytes.strip, stream), b"").split())
    stream.seek(start)
    dtype = np.dtype([("row", "f8", (num_words,))])
    read = read_rows(path, stream, dtype, faces.num_records, "faces", line_number=number)
    rows, place, corners = read["row"], 0, slice(0)
    for prop in faces.properties:
        length = 1
        if prop.length_code is not None:
            place += 1
            lengths = rows[:, place - 1 : place]
            fits = lengths.size > 0 and 0 <= lengths[0, 0] <= num_words - place
            if not fits or (lengths != lengths[0]).any():
                raise _lists_differ(path, faces)
            length = int(lengths[0, 0])
            if prop.name in _CORNERS:
                corners = slice(place, place + length)
        place += length
    if place != num_words:
        raise _lists_differ(path, faces)
    return rows[:, corners]


def _fronts(path: Path, header: _Header, size: int, cloud: Cloud) -> Fronts:
    """Return the front of each vertex by the last of the elements, and what is wrong with that."""
    faces = header.elements[-1]
    name = next(prop.name for prop in faces.properties if prop.name in _CORNERS) + _LIST
    try:
        with path.open("rb") as stream:
            if header.byte_order:
                dtype = _go_to_last(path, stream, header, size)
                blocks = _blocks(path, stream, faces, dtype)
                front = find_fronts((b[name] for b in blocks), cloud.coordinates, cloud.finite)
            else:
                corners = _corners_of_text(path, stream, header)
                front = find_fronts([corners], cloud.coordinates, cloud.finite)
        return front, ()
    except FormatError as error:
        return None, (f"its faces left out: {str(error).removeprefix(f'{path}: ').rstrip('.')}",)
