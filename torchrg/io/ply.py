"""PLY: ASCII, little and big endian, any properties.

An own codec, because the kept readers lose data (measured with meshio 5.3.5 and trimesh 5.2.0):
meshio reads ``uchar`` as signed, knows no ``short``, ends the process at elements other than vertex
and face, and takes the memory a header promises; trimesh writes float32 and drops fields.
"""

import io
import itertools
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import Spelling, assemble_cloud, flatten_cloud, narrow_integers
from torchrg.io.files import atomic_path, check_file, check_promise
from torchrg.io.text import read_table
from torchrg.structures import Cloud

TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
READ_TYPES = TYPES | {
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 1 << 20


class Property(NamedTuple):
    """A property of an element: one number, or a list with its length before it.

    Attributes:
        name: Its name.
        code: NumPy's code of its type, without byte order.
        length_code: The same of a list's length; None for a single number.
    """

    name: str
    code: str
    length_code: str | None = None


class Element(NamedTuple):
    """An element of a PLY file: so many records of some properties."""

    name: str
    num_records: int
    properties: list[Property]


class Header(NamedTuple):
    """What a PLY header says, and where the data begin.

    Attributes:
        byte_order: ``<`` or ``>``; empty for ASCII.
        elements: The elements in the order of their data.
        num_lines: Lines of the header.
        num_bytes: Bytes of the header.
    """

    byte_order: str
    elements: list[Element]
    num_lines: int
    num_bytes: int


def read_header(path: Path, stream: BinaryIO) -> Header:
    """Read the header and leave the stream at the first byte of data.

    Args:
        path: The file, for messages.
        stream: Its bytes, from the first.

    Returns:
        The header.

    Raises:
        FormatError: If a line makes no sense, or the end of the header is missing.
    """
    byte_order: str | None = None
    elements: list[Element] = []
    number = 0
    while True:
        number += 1
        raw = stream.readline(LONGEST_HEADER)
        words = raw.decode("latin-1").split()
        if number == 1 and words != ["ply"]:
            raise FormatError(f"{path}: line 1: expected 'ply', got {_shown(raw)}.")
        if not raw.endswith(b"\n") or stream.tell() > LONGEST_HEADER:
            raise FormatError(
                f"{path}: line {number}: expected the header to end with 'end_header'; "
                "the file is cut off, fetch it again."
            )
        match words:
            case [] | ["ply" | "comment" | "obj_info", *_]:
                pass
            case ["format", word, _] if word in BYTE_ORDERS:
                byte_order = BYTE_ORDERS[word]
            case ["element", name, count] if (
                count.isascii() and count.isdecimal() and len(count) < 19
            ):
                _check_new(path, number, name, [element.name for element in elements])
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, code, name] if (
                elements and code in READ_TYPES and READ_TYPES.get(length, "f")[0] != "f"
            ):
                _check_new(path, number, name, [prop.name for prop in elements[-1].properties])
                new = Property(name, READ_TYPES[code], READ_TYPES[length])
                elements[-1].properties.append(new)
            case ["property", code, name] if elements and code in READ_TYPES:
                _check_new(path, number, name, [prop.name for prop in elements[-1].properties])
                elements[-1].properties.append(Property(name, READ_TYPES[code]))
            case ["end_header"] if byte_order is not None:
                return Header(byte_order, elements, number, stream.tell())
            case _:
                raise FormatError(
                    f"{path}: line {number}: expected a line of a PLY header, got {_shown(raw)}; "
                    "write the file again."
                )


def _check_new(path: Path, number: int, name: str, known: list[str]) -> None:
    """Check that no two elements, or properties of one, have the same name."""
    if name in known:
        raise FormatError(
            f"{path}: line {number}: expected names that differ, got {name!r} twice; rename one."
        )


def _shown(raw: bytes) -> str:
    """Return the beginning of a line for a message."""
    return repr(raw[:40].decode("latin-1").strip())


LONGEST_LIST = 1 << 20
# Names in a PLY file have no spaces, so these cannot meet one.
LENGTH, LIST = " length", " list"


def read_ply(path: Path) -> Cloud:
    """Read the vertices of a PLY file.

    Args:
        path: The file.

    Returns:
        The cloud, with every property of the element ``vertex``; other elements are left out.

    Raises:
        FormatError: If the file is damaged or has no vertices with x, y and z.
    """
    size = check_file(path)
    with path.open("rb") as stream:
        header = read_header(path, stream)
        names = [element.name for element in header.elements if element.properties]
        if "vertex" not in names:
            raise FormatError(
                f"{path}: expected an element vertex with properties, got elements "
                f"{', '.join(names) or 'none'}; write the points as vertices."
            )
        needed = [element for element in header.elements if element.properties]
        needed = needed[: names.index("vertex") + 1]
        read = _read_binary if header.byte_order else _read_text
        records = read(path, stream, header._replace(elements=needed), size)
    names = [name for name in records.dtype.names or () if not name.endswith(LENGTH)]
    return assemble_cloud(path, {name.removesuffix(LIST): records[name] for name in names})


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write a cloud as a little-endian PLY file; equal clouds give equal bytes.

    Args:
        path: The file.
        cloud: The cloud; coordinates keep their precision. 64-bit integers become 32-bit ones, or
            ``double`` where that holds them.

    Raises:
        FormatError: If a field has no place in a PLY file, or the file cannot be written.
    """
    columns = {
        name: _storable(path, name, column)
        for name, column in flatten_cloud(path, cloud, Spelling()).items()
    }
    records = np.empty(len(cloud), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        records[name] = column
    words = {code: word for word, code in TYPES.items()}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by torchrg",
        f"element vertex {len(cloud)}",
        *(f"property {words[c.dtype.str[1:]]} {name}" for name, c in columns.items()),
        "end_header",
    ]
    with atomic_path(path) as beside, beside.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in lines).encode())
        records.tofile(stream)


def _storable(path: Path, name: str, column: NDArray[Any]) -> NDArray[Any]:
    """Return a column in a little-endian type that PLY has."""
    column = narrow_integers(column, ("i4", "u4"))
    if column.dtype.kind in "iu" and column.dtype.itemsize == 8:
        exact = column.astype(np.float64)
        if max(abs(int(column.min())), abs(int(column.max()))) > 2**53:
            raise FormatError(
                f"{path}: expected field {name} within 2^53, got 64-bit integers beyond; "
                "leave it out or write .npz."
            )
        column = exact
    return column.astype(column.dtype.newbyteorder("<"), copy=False)


def _read_binary(path: Path, stream: BinaryIO, header: Header, size: int) -> NDArray[np.void]:
    """Read the last of the elements of a binary file."""
    start = header.num_bytes
    vertex = header.elements[-1]
    for element in header.elements:
        stream.seek(start)
        dtype = _record_type(path, stream, element, header.byte_order, size)
        promised = element.num_records * dtype.itemsize
        check_promise(
            path,
            byte=start,
            promised=promised,
            available=size - start,
            content=f"{element.num_records:,} records of {element.name}",
        )
        if element is vertex or any(prop.length_code for prop in element.properties):
            stream.seek(start)
            records = np.fromfile(stream, dtype, count=element.num_records)
            _check_lists(path, element, records)
        start += promised
    return records


def _record_type(
    path: Path, stream: BinaryIO, element: Element, byte_order: str, size: int
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
        if not 0 <= num_bytes <= min(size, LONGEST_LIST):
            raise FormatError(
                f"{path}: byte {stream.tell()}: expected a list that fits the file, got length "
                f"{length:,}; the file is damaged, fetch it again."
            )
        stream.seek(num_bytes, io.SEEK_CUR)
        parts.append((prop.name + LENGTH, length_type))
        parts.append((prop.name + LIST, byte_order + prop.code, (length,)))
    return np.dtype(parts)


def _check_lists(path: Path, element: Element, records: NDArray[np.void]) -> None:
    """Check that the lists of an element all have one length, so that records have one size."""
    for name in records.dtype.names or ():
        if not name.endswith(LENGTH) or len(records) == 0:
            continue
        if (records[name] != records[name][0]).any():
            raise FormatError(
                f"{path}: expected lists of one length in element {element.name}, which comes "
                "with or before the vertices; write the vertices first and without lists."
            )


def _read_text(path: Path, stream: BinaryIO, header: Header, size: int) -> NDArray[np.void]:
    """Read the last of the elements of an ASCII file."""
    *before, vertex = header.elements
    if any(prop.length_code for prop in vertex.properties):
        raise FormatError(
            f"{path}: expected vertices without lists in an ASCII file; write it as binary."
        )
    check_promise(
        path,
        byte=header.num_bytes,
        # A digit and what separates it from the next; the last may end with the file.
        promised=vertex.num_records * 2 * len(vertex.properties) - 1,
        available=size - header.num_bytes,
        content=f"{vertex.num_records:,} vertices",
        at_least=True,
    )
    lines = (raw.decode("latin-1") for raw in stream)
    skipped = sum(1 for element in before for _ in itertools.islice(lines, element.num_records))
    return read_table(
        path,
        lines,
        [(prop.name, prop.code) for prop in vertex.properties],
        first_line=header.num_lines + 1 + skipped,
        num_rows=vertex.num_records,
    )
