"""PLY files: ASCII, little and big endian, any properties.

Other libraries lose data (measured with meshio 5.3.5 and trimesh 5.2.0): meshio reads ``uchar`` as
signed, lacks ``short``, ends the process at elements other than vertex and face, and allocates the
memory that a header announces; trimesh writes float32 and drops fields.
"""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg import scratch
from torchrg.errors import FormatError
from torchrg.io.columns import (
    FieldNames,
    check_exact,
    flatten_cloud,
    map_records,
    narrow_integers,
    write_records,
)
from torchrg.io.fields import MAX_EXACT_INTEGER, assemble_cloud
from torchrg.io.files import check_available, check_end, header_lines, open_lines, parse_count
from torchrg.io.mesh import Fronts, find_fronts
from torchrg.io.text import read_rows, skip_lines
from torchrg.structures import Cloud
from torchrg.structures.points import Array

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
"""NumPy type codes by PLY type name, as written."""
_NUMPY_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
_READ_TYPES = {
    **_TYPES,
    **{name: np.dtype(name).str[1:] for name in (*_NUMPY_NAMES, "float32", "float64")},
    "bool": "u1",
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_VERTEX_LISTS = ("vertex_indices", "vertex_index")
"""Names of the vertex list of a face."""
_BYTES_PER_READ = 1 << 19
"""Bytes of list records read together, more if one record is longer."""
_MARGIN = 9
"""Zero bytes appended to a block: an 8-byte number may begin one byte after its end."""
_MIN_EVEN_FRACTION = 0.25
"""Minimum fraction of leading records in a block with the length of the first one. Below it, a
search finds where the records start."""
_DOUBLINGS = 4
"""The search advances in steps of 2 ** _DOUBLINGS records, then halves the steps. Three to nine
doublings take about the same time."""


def read_ply(path: Path, size: int) -> Cloud:
    """Read every property of the element ``vertex``, and the fronts of points from the faces.

    Lists of equal length become multi-column fields. Other lists and elements are skipped.
    """
    with open_lines(path, b"end_header") as stream:
        header = _read_header(path, stream)
        vertex = header.vertex_index(path)
        columns, uneven = _read_vertices(path, stream, header, vertex, size)
        notes = header.check_end(path, stream, vertex)
    elements = list(enumerate(header.elements))
    face = next((i for i, element in elements if _is_mesh(element)), None)
    skipped = [
        f"{element.num_records:,} of {element.name}"
        for i, element in elements
        if i not in (vertex, face) and element.num_records
    ]
    if skipped:
        left = ", ".join(skipped)
        notes += (f"elements skipped (only vertices and faces are read): {left}",)
    if uneven:
        notes += (f"lists left out, as they are empty or differ in length: {', '.join(uneven)}",)
    cloud = assemble_cloud(path, columns, notes=notes)
    if face is None:
        return cloud
    del columns
    front, more = _vertex_fronts(path, header, face, size, cloud)
    return replace(cloud, front=front, notes=notes + more)


def count_ply(path: Path, size: int) -> int:
    """Return the number of vertices from the header."""
    with open_lines(path, b"end_header") as stream:
        header = _read_header(path, stream)
    return header.elements[header.vertex_index(path)].num_records


def _is_mesh(element: "_Element") -> bool:
    """Return whether an element contains faces."""
    lists = [prop for prop in element.properties if prop.name in _VERTEX_LISTS and prop.length_code]
    return element.name == "face" and element.num_records > 0 and len(lists) == 1


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write a little-endian file; identical clouds give byte-identical files.

    Coordinates keep their precision. 64-bit integers become 32-bit ones, or ``double`` if exact.
    """
    columns = flatten_cloud(path, cloud, FieldNames())
    check_exact(path, columns)
    narrow = {name: narrow_integers(column, ("i4", "u4")) for name, column in columns.items()}
    # Each type of eight bytes becomes double, the only one of PLY.
    columns = {n: c.astype("f8", copy=False) if c.itemsize == 8 else c for n, c in narrow.items()}
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


class _Property(NamedTuple):
    """Property of an element: one number, or a list preceded by its length.

    Codes are NumPy's, without byte order; ``length_code`` is None for a single number.
    """

    name: str
    code: str
    length_code: str | None = None


class _Element(NamedTuple):
    """Element: a number of records with the same properties."""

    name: str
    num_records: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        """Whether any property is a list."""
        return any(prop.length_code is not None for prop in self.properties)

    @property
    def min_bytes(self) -> int:
        """Minimum bytes of a binary record, with all lists empty."""
        return sum(np.dtype(prop.length_code or prop.code).itemsize for prop in self.properties)


class _Header(NamedTuple):
    """Parsed header and its size; the byte order is empty for ASCII."""

    byte_order: str
    elements: list[_Element]
    num_lines: int
    num_bytes: int

    def vertex_index(self, path: Path) -> int:
        """Return the index of the element that contains the points."""
        names = [element.name for element in self.elements]
        if "vertex" not in names:
            raise FormatError(
                f"{path}: expected an element vertex with properties, got elements "
                f"{', '.join(names) or 'none'}; write the points as vertices."
            )
        return names.index("vertex")

    def check_end(self, path: Path, stream: BinaryIO, index: int) -> tuple[str, ...]:
        """Check the end of the file after the last non-empty element."""
        if any(element.num_records for element in self.elements[index + 1 :]):
            return ()
        element = self.elements[index]
        is_binary = self.byte_order and element.num_records
        return check_end(path, stream, element.min_bytes if is_binary else 0)


def _read_header(path: Path, stream: BinaryIO) -> _Header:
    """Read the header and leave the stream at the first data byte."""
    formats = list[str]()
    elements: list[_Element] = []
    for number, words in header_lines(path, stream, "end_header"):
        shown = repr(" ".join(words)[:40])
        if number == 1 and words != ["ply"]:
            raise FormatError(f"{path}: line 1: expected 'ply', got {shown}.")
        match words:
            case [] | ["ply" | "comment" | "obj_info", *_]:
                continue
            case ["format", word, _] if word in _BYTE_ORDERS:
                formats.append(word)
                continue
            case ["end_header"] if formats:
                break
            case ["element", name, count] if parse_count(count) is not None:
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
                    f"{path}: line {number}: expected a PLY header, got {shown}; write it again."
                )
        if name in names:
            raise FormatError(f"{path}: line {number}: expected one {name!r}, got two; rename one.")
    elements = [element for element in elements if element.properties]
    return _Header(_BYTE_ORDERS[formats[-1]], elements, number, stream.tell())


def _read_vertices(
    path: Path, stream: BinaryIO, header: _Header, index: int, size: int
) -> tuple[dict[str, Array], list[str]]:
    """Return the vertex properties, and the names of lists that cannot be columns."""
    vertex, order = header.elements[index], header.byte_order
    line_number = _seek_element(path, stream, header, index, size)
    count = vertex.num_records
    if not vertex.has_lists:
        dtype = np.dtype([(prop.name, order + prop.code) for prop in vertex.properties])
        rows: Array
        if order:
            rows = map_records(stream, dtype, count)
        else:
            rows = read_rows(path, stream, dtype, count, "vertices", line_number=line_number)
        return {name: rows[name] for name in dtype.names or ()}, []
    parts: dict[str, list[Array]] = {prop.name: [] for prop in vertex.properties}
    for records in _read_records(path, stream, vertex, order, size, line_number):
        for prop in vertex.properties:
            if prop.name in parts:
                new = records.values(path, prop)
                parts[prop.name] += new
                shapes = {part.shape[1:] for part in (*parts[prop.name][:1], *new)}
                if len(shapes) > 1 or shapes == {(0,)}:
                    del parts[prop.name]
    uneven = [prop.name for prop in vertex.properties if prop.name not in parts]
    return {name: scratch.join(known or [np.empty(0)]) for name, known in parts.items()}, uneven


def _seek_element(path: Path, stream: BinaryIO, header: _Header, index: int, size: int) -> int:
    """Seek to the first record of an element, and return its line number in an ASCII file.

    For a binary element without lists, check that all records fit into the file.
    """
    *before, element = header.elements[: index + 1]
    stream.seek(header.num_bytes)
    if not header.byte_order:
        lines = skip_lines(stream, sum(other.num_records for other in before))
        return header.num_lines + 1 + lines
    for other in before:
        _check_available(path, stream, other, size)
        if other.has_lists:
            for _ in _read_binary(path, stream, other, header.byte_order, size):
                pass
        else:
            stream.seek(other.num_records * other.min_bytes, os.SEEK_CUR)
    _check_available(path, stream, element, size)
    return 0


def _check_available(path: Path, stream: BinaryIO, element: _Element, size: int) -> None:
    """Check that the records of a binary element fit into the remaining file."""
    start, needed = stream.tell(), element.num_records * element.min_bytes
    content, lists = f"{element.num_records:,} records of {element.name}", element.has_lists
    check_available(path, start, needed, content, available=size - start, at_least=lists)


class _Records(NamedTuple):
    """Consecutive records of an element that has lists.

    Attributes:
        content: Their bytes, and a margin. ASCII words are stored as float64.
        order: Byte order; empty for an ASCII file.
        starts: First byte of each record's values, by property name.
        lengths: Number of these values.
        ends: Byte after each record; one past the content for an incomplete record.
    """

    content: NDArray[np.uint8]
    order: str
    starts: dict[str, NDArray[np.int64]]
    lengths: dict[str, NDArray[np.int64]]
    ends: NDArray[np.int64]

    def values(self, path: Path, prop: _Property) -> list[Array]:
        """Return the values of a property, shape ``(n,)``.

        A list has shape ``(n, length)``, one array per length, ascending.
        """
        numbers = _numbers_at_bytes(self.content, self.order, prop.code)
        starts, lengths = self.starts[prop.name], self.lengths[prop.name]
        if prop.length_code is None:
            arrays = [numbers[starts]]
        elif (lengths == lengths[:1]).all():
            arrays = [_gather(numbers, starts, length) for length in lengths[:1]]
        else:
            distinct = np.unique(lengths)
            arrays = [_gather(numbers, starts[lengths == length], length) for length in distinct]
        return arrays if self.order else [_convert_words(path, prop, values) for values in arrays]


def _gather(numbers: Array, starts: NDArray[np.int64], length: int) -> Array:
    """Gather ``length`` numbers from each start, shape ``(n, length)``."""
    steps = np.diff(starts)
    if (steps == steps[:1]).all():
        step = int(steps[0]) if len(steps) else 0
        shape, strides = (len(starts), length), (step, numbers.itemsize)
        return np.lib.stride_tricks.as_strided(numbers[starts[0] :], shape, strides)
    gathered: Array = numbers[starts[:, None] + np.arange(length) * numbers.itemsize]
    return gathered


def _numbers_at_bytes(content: NDArray[np.uint8], order: str, code: str) -> Array:
    """Return a view with the number that begins at each byte."""
    dtype = np.dtype(order + code if order else np.float64)
    return np.ndarray(len(content) - dtype.itemsize + 1, dtype, content, strides=(1,))


def _convert_words(path: Path, prop: _Property, values: NDArray[np.float64]) -> Array:
    """Convert the words of an ASCII file to the type of their property."""
    converted: Array = values.astype(prop.code)
    if converted.dtype.kind != "f":
        wrong = values[(converted != values) | (np.abs(values) >= MAX_EXACT_INTEGER)]
        if wrong.size:
            word = next(word for word, code in _READ_TYPES.items() if code == prop.code)
            raise FormatError(
                f"{path}: expected {prop.name} to be numbers of type {word}, got {wrong[0]:.17g}; "
                "correct the number, or the type in the header."
            )
    return converted


def _find_records(
    content: NDArray[np.uint8], element: _Element, order: str, starts: NDArray[np.int64]
) -> _Records:
    """Parse the records that begin at the given bytes."""
    outside = len(content) - _MARGIN + 1
    at = np.minimum(starts, outside)
    value_starts, lengths = dict[str, NDArray[np.int64]](), dict[str, NDArray[np.int64]]()
    for prop in element.properties:
        length = np.ones_like(starts)
        if prop.length_code is not None:
            numbers = _numbers_at_bytes(content, order, prop.length_code)
            length = numbers[at].astype(np.int64)
            fits = (length == numbers[at]) & (length >= 0) & (length <= outside)
            length = np.where(fits, length, outside)
            at = at + numbers.itemsize
        value_starts[prop.name], lengths[prop.name] = at, length
        itemsize = np.dtype(prop.code if order else np.float64).itemsize
        at = np.minimum(at + length * itemsize, outside)
    return _Records(content, order, value_starts, lengths, at)


def _find_starts(content: NDArray[np.uint8], element: _Element, order: str) -> NDArray[np.int64]:
    """Return the starts of the complete, contiguous records in a block.

    Each record begins at the end of the previous one. The end of a record at any byte is known, so
    indexing the ends with themselves yields the end of the second, fourth, ... record.
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
    complete: NDArray[np.int64] = starts[ends[0][starts] <= size]
    return complete


def _read_records(
    path: Path, stream: BinaryIO, element: _Element, order: str, size: int, line_number: int
) -> Iterator[_Records]:
    """Yield chunks of records of a list element, starting at the stream position."""
    if order:
        return _read_binary(path, stream, element, order, size)
    return _read_lines(path, stream, element, size, line_number)


def _read_binary(
    path: Path, stream: BinaryIO, element: _Element, order: str, size: int
) -> Iterator[_Records]:
    """Yield chunks of records of a binary list element, and leave the stream at their end."""
    start, left, block_bytes = stream.tell(), element.num_records, _BYTES_PER_READ
    while left:
        stream.seek(start)
        content = np.fromfile(stream, np.uint8, min(block_bytes, size - start))
        num_bytes, content = len(content), np.append(content, np.zeros(_MARGIN, np.uint8))
        (first,) = _find_records(content, element, order, np.zeros(1, np.int64)).ends.tolist()
        if first > num_bytes:
            if num_bytes == size - start:
                raise FormatError(
                    f"{path}: byte {start}: expected {left:,} more records of {element.name}, got "
                    f"{num_bytes:,} bytes of an incomplete one; the file is truncated or corrupt, "
                    "write or copy it again."
                )
            block_bytes *= 2
            continue
        starts = np.arange(min(left, num_bytes // first)) * first
        records = _find_records(content, element, order, starts)
        differ = np.flatnonzero(records.ends != starts + first)
        count = int(differ[0]) if len(differ) else len(starts)
        if count < _MIN_EVEN_FRACTION * len(starts) and block_bytes == _BYTES_PER_READ:
            starts = _find_starts(content, element, order)[:left]
            count = len(starts)
        if len(differ):
            records = _find_records(content, element, order, starts[:count])
        yield records
        start += int(records.ends[-1])
        left, block_bytes = left - count, _BYTES_PER_READ
    stream.seek(start)


def _read_lines(
    path: Path, stream: BinaryIO, element: _Element, size: int, line_number: int
) -> Iterator[_Records]:
    """Yield the records of an ASCII list element, one per line.

    MeshLab appends the same number of surplus words to every line of faces.
    """
    start, left, surplus = stream.tell(), element.num_records, 0
    # A digit and a separator per number; the last separator may be missing.
    needed, what = 2 * left * len(element.properties) - 1, f"{left:,} records of {element.name}"
    check_available(path, start, needed, what, available=size - start, at_least=True)
    while left:
        block = stream.read(_BYTES_PER_READ) + stream.readline()
        if not block:
            raise FormatError(
                f"{path}: line {line_number}: expected {left:,} more records of {element.name}, "
                "got the end of the file; the file is truncated or its header is wrong, write or "
                "copy it again."
            )
        lines, counts = (column[:left] for column in _count_words(block))
        ends = np.cumsum(counts)
        words = list[float]()
        with suppress(ValueError):  # Up to the first word that is no number.
            words += map(float, block.split()[: counts.sum()])
        numbers = np.array(words)
        content = np.append(numbers.view(np.uint8), np.zeros(_MARGIN, np.uint8))
        records = _find_records(content, element, "", (ends - counts) * 8)
        if left == element.num_records and element.name != "vertex":
            surplus = max(int((ends * 8 - records.ends)[:1].sum()), 0)
        is_complete = records.ends <= len(numbers) * 8
        wrong = np.flatnonzero(~is_complete | (records.ends + surplus != ends * 8))
        if len(wrong):
            line = int(lines[wrong[0]])
            shown = repr(block.split(b"\n")[line][:40].decode("latin-1").strip())
            raise FormatError(
                f"{path}: line {line_number + line}: expected a record of {element.name}, got "
                f"{shown}; correct this line."
            )
        yield records
        line_number += block.count(b"\n")
        left -= len(lines)
        if not left:
            end = len(b"\n".join(block.split(b"\n")[: lines[-1] + 1]))
            stream.seek(end - len(block), os.SEEK_CUR)


def _count_words(block: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of the lines that contain words, and their word counts."""
    text = np.frombuffer(block, np.uint8)
    is_word = (text != ord(" ")) & ((text < ord("\t")) | (text > ord("\r")))
    begins = is_word & ~np.concatenate([[False], is_word[:-1]])
    lines, counts = np.unique(np.cumsum(text == ord("\n"))[begins], return_counts=True)
    return lines, counts


def _vertex_fronts(path: Path, header: _Header, index: int, size: int, cloud: Cloud) -> Fronts:
    """Return the front of each vertex from the faces, and notes on corrupt faces."""
    faces = header.elements[index]
    lists = next(prop for prop in faces.properties if prop.name in _VERTEX_LISTS)
    try:
        with open_lines(path, b"end_header") as stream:
            line_number = _seek_element(path, stream, header, index, size)
            blocks = _read_records(path, stream, faces, header.byte_order, size, line_number)
            arrays = (array for records in blocks for array in records.values(path, lists))
            front = find_fronts(arrays, cloud.coordinates, cloud.finite)
            return front, header.check_end(path, stream, index)
    except FormatError as error:
        return None, (f"faces skipped: {str(error).removeprefix(f'{path}: ').rstrip('.')}",)
