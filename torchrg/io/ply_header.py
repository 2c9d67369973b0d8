"""The header of a PLY file: which elements there are, and what a record of each holds."""

from pathlib import Path
from typing import BinaryIO, NamedTuple

from torchrg.errors import FormatError

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
