"""PCD 0.7: ascii, binary and binary_compressed.

An own reader and writer around the LZF codec that pypcd4 uses, because pypcd4 itself (1.5.1,
measured) takes the memory a header promises, misreads fields of COUNT > 1 in compressed files,
needs every header line in place, and writes ASCII with ten decimals.
"""

import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.atomic import atomic_path
from torchrg.io.columns import Spelling, flatten_cloud
from torchrg.io.fields import assemble_cloud
from torchrg.io.files import check_file, check_promise
from torchrg.io.pcd_header import DEFAULT_VIEWPOINT, PADDING, Header, format_header, read_header
from torchrg.io.tables import read_table
from torchrg.structures import Cloud

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
