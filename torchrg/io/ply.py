"""PLY: ASCII, little and big endian, any properties.

An own codec, because the kept readers lose data (measured with meshio 5.3.5 and trimesh 5.2.0):
meshio reads ``uchar`` as signed, knows no ``short``, ends the process at elements other than vertex
and face, and takes the memory a header promises; trimesh writes float32 and drops fields.
"""

import struct
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.columns import (
    Spelling,
    check_exact,
    flatten_cloud,
    narrow_integers,
    slices,
    write_records,
)
from torchrg.io.faces import BrokenFacesError, Fronts, check_list, find_fronts, stack_faces
from torchrg.io.fields import Values, assemble_cloud
from torchrg.io.files import check_promise
from torchrg.io.text import read_rows, words_of
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
_LETTERS = {code: np.dtype(code).char for code in _TYPES.values()} | {"i8": "q", "u8": "Q"}
"""Letters of the module struct by NumPy's codes."""
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20
"""Bytes of the longest header; a longer one is taken for damage."""
_LONGEST_LIST = 1 << 20
"""Bytes of the longest list; a longer one is taken for damage."""
_CORNERS = ("vertex_indices", "vertex_index")
"""Names of the list of a face's vertices."""
_BYTES_AT_ONCE = 1 << 22
"""Bytes of faces that are read together."""
_SHOWN = 60
"""Characters of what is wrong in a text that are told."""
_LENGTH, _LIST = " length", " list"
"""Ends of the names of a list and its length in records. Names in a PLY file have no spaces, so
that no property is called so."""


def read_ply(path: Path, size: int) -> Cloud:
    """Read a PLY file: every property of the element ``vertex``, and its front by the faces.

    Other elements are left out, and so are faces that come before the vertices.
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
    front, more = _fronts(path, mesh, vertex, size, cloud)
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


def _read_binary(path: Path, stream: BinaryIO, header: _Header, size: int) -> Values:
    """Read the last of the elements of a binary file."""
    *before, vertex = header.elements
    start = _pass_elements(path, stream, header, before, size)
    dtype = _check_element(path, stream, vertex, header.byte_order, start, size)
    records = np.fromfile(stream, dtype, count=vertex.num_records)
    _check_lists(path, vertex, records)
    return records


def _pass_elements(
    path: Path, stream: BinaryIO, header: _Header, elements: list[_Element], size: int
) -> int:
    """Return the byte behind the first elements of a binary file, whose records have one size."""
    start = header.num_bytes
    for element in elements:
        dtype = _check_element(path, stream, element, header.byte_order, start, size)
        if any(prop.length_code for prop in element.properties):
            at_once = max(_BYTES_AT_ONCE // dtype.itemsize, 1)
            for rows in slices(element.num_records, at_once):
                records = np.fromfile(stream, dtype, count=rows.stop - rows.start)
                _check_lists(path, element, records)
        start += element.num_records * dtype.itemsize
    return start


def _check_element(
    path: Path, stream: BinaryIO, element: _Element, byte_order: str, start: int, size: int
) -> np.dtype[np.void]:
    """Return the type of the records of an element, all of which are there; go to the first."""
    dtype = _record_type(path, stream, element, byte_order, start, size)
    promised = element.num_records * dtype.itemsize
    content = f"{element.num_records:,} records of {element.name}"
    check_promise(path, start, promised, content, available=size - start)
    stream.seek(start)
    return dtype


def _record_type(
    path: Path, stream: BinaryIO, element: _Element, byte_order: str, start: int, size: int
) -> np.dtype[np.void]:
    """Return the type of a record; lists have the length that the first record gives them."""
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
    return np.dtype(parts)


def _check_lists(path: Path, element: _Element, records: Values) -> None:
    """Check that the lists of an element all have one length, so that records have one size."""
    if not _have_one_length(records):
        raise FormatError(
            f"{path}: expected lists of one length in element {element.name}, which comes "
            "with or before the vertices; write the vertices first and without lists."
        )


def _have_one_length(records: Values) -> bool:
    """Return whether each list has in all records the length that its type says."""
    names = [name for name in records.dtype.names or () if name.endswith(_LENGTH)]
    lengths = [records.dtype[name.removesuffix(_LENGTH) + _LIST].shape[0] for name in names]
    return all((records[n] == k).all() for n, k in zip(names, lengths, strict=True))


def _read_text(path: Path, stream: BinaryIO, header: _Header, size: int) -> Values:
    """Read the last of the elements of an ASCII file."""
    *before, vertex = header.elements
    if any(prop.length_code for prop in vertex.properties):
        raise FormatError(
            f"{path}: expected vertices without lists in an ASCII file; write it as binary."
        )
    return read_rows(
        path,
        stream,
        np.dtype([(prop.name, prop.code) for prop in vertex.properties]),
        vertex.num_records,
        "vertices",
        line_number=header.num_lines + 1,
        skipped=sum(element.num_records for element in before),
    )


def _fronts(path: Path, header: _Header, vertex: int, size: int, cloud: Cloud) -> Fronts:
    """Return the front of each vertex by the last of the elements, and what is wrong with that."""
    try:
        with path.open("rb") as stream:
            if header.byte_order:
                faces = _corners_of_binary(path, stream, header, size)
            else:
                faces = _corners_of_text(stream, header, vertex)
            return find_fronts(faces, cloud.coordinates, cloud.finite), ()
    except BrokenFacesError as error:
        return None, (f"its faces left out, as they are damaged: {error}",)
    except FormatError as error:
        return None, (f"its faces left out: {str(error).removeprefix(f'{path}: ').rstrip('.')}",)


def _corners_of_binary(
    path: Path, stream: BinaryIO, header: _Header, size: int
) -> Iterator[NDArray[np.int64]]:
    """Yield the vertices of faces, of many at a time as long as all lists have one length."""
    *before, faces = header.elements
    start = _pass_elements(path, stream, header, before, size)
    dtype = _record_type(path, stream, faces, header.byte_order, start, size)
    name = next(prop.name for prop in faces.properties if prop.name in _CORNERS)
    done, at_once = 0, max(_BYTES_AT_ONCE // dtype.itemsize, 1)
    while done < faces.num_records:
        stream.seek(start + done * dtype.itemsize)
        wanted = min(at_once, faces.num_records - done)
        records = np.fromfile(stream, dtype, count=wanted)
        if len(records) < wanted or not _have_one_length(records):
            break
        yield records[name + _LIST].astype(np.int64)
        done += wanted
    stream.seek(start + done * dtype.itemsize)
    yield from stack_faces(
        _faces_of_bytes(stream, faces, header.byte_order), faces.num_records - done
    )


def _faces_of_bytes(
    stream: BinaryIO, element: _Element, byte_order: str
) -> Iterator[tuple[float, ...]]:
    """Yield the vertices of the faces from here to the end of a binary file."""

    def take(letter: str, count: int) -> tuple[float, ...]:
        form = f"{byte_order}{count}{letter}"
        return struct.unpack(form, stream.read(struct.calcsize(form)))

    lists = [
        (
            None if prop.length_code is None else _LETTERS[prop.length_code],
            _LETTERS[prop.code],
            np.dtype(prop.code).itemsize,
            prop.name in _CORNERS,
        )
        for prop in element.properties
    ]
    corners: tuple[float, ...] = ()
    with suppress(struct.error):  # Raised at the end of the file.
        while True:
            for length_letter, letter, size, is_corners in lists:
                if length_letter is None:
                    take(letter, 1)
                    continue
                values = take(letter, check_list(take(length_letter, 1)[0], size))
                corners = values if is_corners else corners
            yield corners


def _corners_of_text(stream: BinaryIO, header: _Header, vertex: int) -> Iterator[NDArray[np.int64]]:
    """Yield the vertices of the faces of an ASCII file, a face a line."""
    stream.seek(header.num_bytes)
    *before, faces = header.elements
    counts = [element.num_records for element in before]
    lines = islice(stream, min(sum(counts[:vertex]), sys.maxsize), None)
    between = min(sum(counts[vertex:]), sys.maxsize)
    lines = islice((line for line in lines if line.strip()), between, None)
    return stack_faces((_face_of_line(line, faces) for line in lines), faces.num_records)


def _face_of_line(line: bytes, element: _Element) -> list[float]:
    """Return the vertices of the face of a line."""
    try:
        words = [float(word) for word in line.split()]
    except ValueError as error:
        raise BrokenFacesError(str(error)[:_SHOWN]) from None
    place, corners = 0, list[float]()
    for prop in element.properties:
        length = 1
        if prop.length_code is not None:
            length = check_list(words[place] if place < len(words) else -1, 1)
            place += 1
        if prop.name in _CORNERS and prop.length_code is not None:
            corners = words[place : place + length]
        place += length
    if place > len(words):
        raise BrokenFacesError("a line of too few numbers")
    return corners
