"""PLY: ASCII, little and big endian, any properties.

An own codec, because the kept readers lose data (measured with meshio 5.3.5 and trimesh 5.2.0):
meshio reads ``uchar`` as signed, knows no ``short``, ends the process at elements other than vertex
and face, and takes the memory a header promises; trimesh writes float32 and drops fields.
"""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
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
    write_records,
)
from torchrg.io.fields import LARGEST_WHOLE, Values, assemble_cloud
from torchrg.io.files import check_end, check_promise, words_of
from torchrg.io.text import read_rows, skip_lines
from torchrg.mesh import Fronts, find_fronts
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
_READ_TYPES = {
    **_TYPES,
    **{name: np.dtype(name).str[1:] for name in (*_NUMPY_NAMES, "float32", "float64")},
    "bool": "u1",
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20
"""Bytes of the longest header; a longer one is taken for damage."""
_CORNERS = ("vertex_indices", "vertex_index")
"""Names of the list of a face's vertices."""
_BYTES_AT_ONCE = 1 << 19
"""Bytes of records with lists that are read together, more where one record is longer."""
_MARGIN = 9
"""Zero bytes after such records: a number of 8 bytes can begin one byte after their end."""
_MIN_EVEN_FRACTION = 0.25
"""Fraction of the records of a block that must have the length of the first one, up to the first
that differs, to be read without a search for their starts."""
_DOUBLINGS = 4
"""The search goes through a block in steps of 2 ** _DOUBLINGS records, and then halves the steps.
Three to nine doublings take about the same time."""


def read_ply(path: Path, size: int) -> Cloud:
    """Read a PLY file: every property of the element ``vertex``, and its front by the faces.

    Lists of one length become fields of as many columns. Other lists and elements are left out.
    """
    with path.open("rb") as stream:
        header = _read_header(path, stream)
        vertex = header.place_of_vertices(path)
        columns, uneven = _read_vertices(path, stream, header, vertex, size)
        notes = header.check_end(path, stream, vertex)
    elements = list(enumerate(header.elements))
    face = next((i for i, element in elements if _is_mesh(element)), None)
    others = [
        f"{element.num_records:,} of {element.name}"
        for i, element in elements
        if i not in (vertex, face) and element.num_records
    ]
    if others:
        left = ", ".join(others)
        notes += (f"elements left out, as only vertices and their faces are read: {left}",)
    if uneven:
        notes += (f"lists left out, as they are empty or differ in length: {', '.join(uneven)}",)
    cloud = assemble_cloud(path, columns, notes=notes)
    if face is None:
        return cloud
    del columns
    front, more = _fronts(path, header, face, size, cloud)
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

    @property
    def has_lists(self) -> bool:
        """Whether any property is a list."""
        return any(prop.length_code is not None for prop in self.properties)

    @property
    def min_bytes(self) -> int:
        """Bytes of a record in a binary file, where all lists are empty."""
        return sum(np.dtype(prop.length_code or prop.code).itemsize for prop in self.properties)


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

    def check_end(self, path: Path, stream: BinaryIO, place: int) -> tuple[str, ...]:
        """Check what follows an element that has been read, if the header has no further one."""
        if any(element.num_records for element in self.elements[place + 1 :]):
            return ()
        element = self.elements[place]
        is_binary = self.byte_order and element.num_records
        return check_end(path, stream, element.min_bytes if is_binary else 0)


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
                "the file is cut off or no PLY file, write or copy it again."
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


def _read_vertices(
    path: Path, stream: BinaryIO, header: _Header, place: int, size: int
) -> tuple[dict[str, Values], list[str]]:
    """Return the properties of the vertices, and the names of lists that cannot be columns."""
    vertex, order = header.elements[place], header.byte_order
    line_number = _go_to(path, stream, header, place, size)
    count = vertex.num_records
    if not vertex.has_lists:
        dtype = np.dtype([(prop.name, order + prop.code) for prop in vertex.properties])
        rows: Values
        if order:
            rows = np.fromfile(stream, dtype, count)
        else:
            rows = read_rows(path, stream, dtype, count, "vertices", line_number=line_number)
        return {name: rows[name] for name in dtype.names or ()}, []
    parts: dict[str, list[Values]] = {prop.name: [] for prop in vertex.properties}
    for records in _read_records(path, stream, vertex, order, size, line_number):
        for prop in vertex.properties:
            if prop.name in parts:
                new = records.values(path, prop)
                parts[prop.name] += new
                shapes = {part.shape[1:] for part in (*parts[prop.name][:1], *new)}
                if len(shapes) > 1 or shapes == {(0,)}:
                    del parts[prop.name]
    uneven = [prop.name for prop in vertex.properties if prop.name not in parts]
    return {name: np.concatenate(known or [np.empty(0)]) for name, known in parts.items()}, uneven


def _go_to(path: Path, stream: BinaryIO, header: _Header, place: int, size: int) -> int:
    """Go to the first record of an element, and return the number of its line in an ASCII file.

    The records of a binary file are all there if they have no lists.
    """
    *before, element = header.elements[: place + 1]
    stream.seek(header.num_bytes)
    if not header.byte_order:
        lines = skip_lines(stream, sum(other.num_records for other in before))
        return header.num_lines + 1 + lines
    for other in before:
        _check_promise(path, stream, other, size)
        if other.has_lists:
            for _ in _read_binary(path, stream, other, header.byte_order, size):
                pass
        else:
            stream.seek(other.num_records * other.min_bytes, os.SEEK_CUR)
    _check_promise(path, stream, element, size)
    return 0


def _check_promise(path: Path, stream: BinaryIO, element: _Element, size: int) -> None:
    """Check that the records of a binary element fit into what the file has left."""
    start, promised = stream.tell(), element.num_records * element.min_bytes
    content, lists = f"{element.num_records:,} records of {element.name}", element.has_lists
    check_promise(path, start, promised, content, available=size - start, at_least=lists)


class _Records(NamedTuple):
    """Consecutive records of an element, some of whose properties are lists.

    Attributes:
        content: Their bytes, and a margin. Each word of an ASCII file is a float64.
        order: Byte order; empty for an ASCII file.
        starts: First byte of each record's values of a property, by its name.
        lengths: Numbers of these values.
        ends: Byte after each record; one after the content where it is not whole.
    """

    content: NDArray[np.uint8]
    order: str
    starts: dict[str, NDArray[np.int64]]
    lengths: dict[str, NDArray[np.int64]]
    ends: NDArray[np.int64]

    def values(self, path: Path, prop: _Property) -> list[Values]:
        """Return the values of a property, shape ``(n,)``.

        Those of lists have shape ``(n, length)``, one array for each length, ascending.
        """
        numbers = _numbers_at_bytes(self.content, self.order, prop.code)
        starts, lengths = self.starts[prop.name], self.lengths[prop.name]
        if prop.length_code is None:
            arrays = [numbers[starts]]
        elif (lengths == lengths[:1]).all():
            arrays = [_take(numbers, starts, length) for length in lengths[:1]]
        else:
            each = np.unique(lengths)
            arrays = [_take(numbers, starts[lengths == length], length) for length in each]
        return arrays if self.order else [_cast(path, prop, values) for values in arrays]


def _take(numbers: Values, starts: NDArray[np.int64], length: int) -> Values:
    """Return so many numbers from each start on, shape ``(n, length)``."""
    steps = np.diff(starts)
    if (steps == steps[:1]).all():
        step = int(steps[0]) if len(steps) else 0
        shape, strides = (len(starts), length), (step, numbers.itemsize)
        return np.lib.stride_tricks.as_strided(numbers[starts[0] :], shape, strides)
    taken: Values = numbers[starts[:, None] + np.arange(length) * numbers.itemsize]
    return taken


def _numbers_at_bytes(content: NDArray[np.uint8], order: str, code: str) -> Values:
    """Return the number that begins at each byte of some content."""
    dtype = np.dtype(order + code if order else np.float64)
    return np.ndarray(len(content) - dtype.itemsize + 1, dtype, content, strides=(1,))


def _cast(path: Path, prop: _Property, values: NDArray[np.float64]) -> Values:
    """Return the words of an ASCII file as numbers of the type of their property."""
    cast: Values = values.astype(prop.code)
    if cast.dtype.kind != "f":
        wrong = values[(cast != values) | (np.abs(values) >= LARGEST_WHOLE)]
        if wrong.size:
            word = next(word for word, code in _READ_TYPES.items() if code == prop.code)
            raise FormatError(
                f"{path}: expected {prop.name} to be numbers of type {word}, got {wrong[0]:.17g}; "
                "correct the number, or the type in the header."
            )
    return cast


def _find_records(
    content: NDArray[np.uint8], element: _Element, order: str, starts: NDArray[np.int64]
) -> _Records:
    """Return the records that begin at some bytes."""
    outside = len(content) - _MARGIN + 1
    at = np.minimum(starts, outside)
    places, lengths = dict[str, NDArray[np.int64]](), dict[str, NDArray[np.int64]]()
    for prop in element.properties:
        length = np.ones_like(starts)
        if prop.length_code is not None:
            numbers = _numbers_at_bytes(content, order, prop.length_code)
            length = numbers[at].astype(np.int64)
            fits = (length == numbers[at]) & (length >= 0) & (length <= outside)
            length = np.where(fits, length, outside)
            at = at + numbers.itemsize
        places[prop.name], lengths[prop.name] = at, length
        itemsize = np.dtype(prop.code if order else np.float64).itemsize
        at = np.minimum(at + length * itemsize, outside)
    return _Records(content, order, places, lengths, at)


def _find_starts(content: NDArray[np.uint8], element: _Element, order: str) -> NDArray[np.int64]:
    """Return where the records begin that fill some content, as far as they are whole.

    Each begins where the one before ends. That is known for a record at any byte, so the end of the
    second, fourth, ... record after any byte comes from looking up ends of ends.
    """
    size = len(content) - _MARGIN
    ends = [_find_records(content, element, order, np.arange(size + 2)).ends]
    for _ in range(_DOUBLINGS):
        ends.append(ends[-1].take(ends[-1]))
    far, at = ends.pop(), 0
    found = []
    while at <= size:
        found.append(at)
        at = int(far[at])
    starts = np.array(found, np.int64)
    for end in reversed(ends):
        starts = np.stack([starts, end[starts]], axis=1).reshape(-1)
    whole: NDArray[np.int64] = starts[ends[0][starts] <= size]
    return whole


def _read_records(
    path: Path, stream: BinaryIO, element: _Element, order: str, size: int, line_number: int
) -> Iterator[_Records]:
    """Yield the records of an element with lists, many at a time, from where a stream is."""
    if order:
        return _read_binary(path, stream, element, order, size)
    return _read_lines(path, stream, element, size, line_number)


def _read_binary(
    path: Path, stream: BinaryIO, element: _Element, order: str, size: int
) -> Iterator[_Records]:
    """Yield the records of a binary element with lists, and leave the stream at their end."""
    start, left, at_once = stream.tell(), element.num_records, _BYTES_AT_ONCE
    while left:
        stream.seek(start)
        content = np.fromfile(stream, np.uint8, min(at_once, size - start))
        whole, content = len(content), np.append(content, np.zeros(_MARGIN, np.uint8))
        (first,) = _find_records(content, element, order, np.zeros(1, np.int64)).ends.tolist()
        if first > whole:
            if whole == size - start:
                raise FormatError(
                    f"{path}: byte {start}: expected {left:,} more records of {element.name}, got "
                    f"{whole:,} bytes without a whole one; the file is cut off or damaged, write "
                    "or copy it again."
                )
            at_once *= 2
            continue
        starts = np.arange(min(left, whole // first)) * first
        records = _find_records(content, element, order, starts)
        differ = np.flatnonzero(records.ends != starts + first)
        count = int(differ[0]) if len(differ) else len(starts)
        if count < _MIN_EVEN_FRACTION * len(starts) and at_once == _BYTES_AT_ONCE:
            starts = _find_starts(content, element, order)[:left]
            count = len(starts)
        if len(differ):
            records = _find_records(content, element, order, starts[:count])
        yield records
        start += int(records.ends[-1])
        left, at_once = left - count, _BYTES_AT_ONCE
    stream.seek(start)


def _read_lines(
    path: Path, stream: BinaryIO, element: _Element, size: int, line_number: int
) -> Iterator[_Records]:
    """Yield the records of an ASCII element with lists, each of which is a line.

    MeshLab ends all lines of faces with as many numbers more than its header names.
    """
    start, left, surplus = stream.tell(), element.num_records, 0
    # A digit and what separates it from the next; the last may end with the file.
    least, what = 2 * left * len(element.properties) - 1, f"{left:,} records of {element.name}"
    check_promise(path, start, least, what, available=size - start, at_least=True)
    while left:
        block = stream.read(_BYTES_AT_ONCE) + stream.readline()
        if not block:
            raise FormatError(
                f"{path}: line {line_number}: expected {left:,} more records of {element.name}, "
                "got the end of the file; the file is cut off or its header is wrong, write or "
                "copy it again."
            )
        lines, counts = (column[:left] for column in _count_words(block))
        ends = np.cumsum(counts)
        numbers = _parse_words(block.split()[: counts.sum()])
        content = np.append(numbers.view(np.uint8), np.zeros(_MARGIN, np.uint8))
        records = _find_records(content, element, "", (ends - counts) * 8)
        if left == element.num_records and element.name != "vertex":
            surplus = max(int((ends * 8 - records.ends)[:1].sum()), 0)
        is_whole = records.ends <= len(numbers) * 8
        wrong = np.flatnonzero(~is_whole | (records.ends + surplus != ends * 8))
        if len(wrong):
            line = int(lines[wrong[0]])
            shown = _shown(block.split(b"\n")[line])
            raise FormatError(
                f"{path}: line {line_number + line}: expected a record of {element.name}, got "
                f"{shown}; repair this line."
            )
        yield records
        line_number += block.count(b"\n")
        left -= len(lines)
        if not left:
            end = len(b"\n".join(block.split(b"\n")[: lines[-1] + 1]))
            stream.seek(end - len(block), os.SEEK_CUR)


def _parse_words(words: list[bytes]) -> NDArray[np.float64]:
    """Return the numbers that words are, up to the first that is none."""
    with suppress(ValueError):
        return np.fromiter(map(float, words), np.float64, len(words))
    numbers = list[float]()
    with suppress(ValueError):
        numbers += map(float, words)
    return np.array(numbers)


def _count_words(block: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which lines of a text hold words, ascending from 0, and how many each."""
    text = np.frombuffer(block, np.uint8)
    is_word = (text != ord(" ")) & ((text < ord("\t")) | (text > ord("\r")))
    begins = is_word & ~np.concatenate([[False], is_word[:-1]])
    lines, counts = np.unique(np.cumsum(text == ord("\n"))[begins], return_counts=True)
    return lines, counts


def _fronts(path: Path, header: _Header, place: int, size: int, cloud: Cloud) -> Fronts:
    """Return the front of each vertex by the faces, and what is wrong with these."""
    faces = header.elements[place]
    corners = next(prop for prop in faces.properties if prop.name in _CORNERS)
    try:
        with path.open("rb") as stream:
            line_number = _go_to(path, stream, header, place, size)
            blocks = _read_records(path, stream, faces, header.byte_order, size, line_number)
            arrays = (array for records in blocks for array in records.values(path, corners))
            front = find_fronts(arrays, cloud.coordinates, cloud.finite)
            return front, header.check_end(path, stream, place)
    except FormatError as error:
        return None, (f"its faces left out: {str(error).removeprefix(f'{path}: ').rstrip('.')}",)
