"""NumPy's own files: ``.npy``, one array, and ``.npz``, several by name. No pickle is ever loaded.

``.npz``: ``points`` (or ``coord``), shape (N, 3), and any arrays of N rows, which become fields.
Arrays of another length are left out, and so is what a result file says about its planes, under
names that begin with ``plane_``.
``.npy``: an array (N, 3) or wider, see :func:`torchrg.io.fields.name_columns` for its columns, or
a structured array with named fields ``x``, ``y``, ``z``.
"""

import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import (
    Spelling,
    assemble_cloud,
    check_length,
    cloud_of,
    flatten_cloud,
    name_columns,
)
from torchrg.io.files import DAMAGES, atomic_path, check_file, check_promise, first_line
from torchrg.structures import Cloud

COORDINATES = ("points", "coord")
NOT_PER_POINT = "plane_"
# Deflate packs at most 1032 bytes into one.
LARGEST_DEFLATE_RATIO = 1032
EARLIEST_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


def read_npy(path: Path) -> Cloud:
    """Read a ``.npy`` file.

    Args:
        path: The file.

    Returns:
        The cloud.

    Raises:
        FormatError: If the file is damaged, holds Python objects, or is no table of points.
    """
    size = check_file(path)
    with path.open("rb") as stream:
        values = _read_array(path, stream, size, content="the array")
    if values.dtype.names is not None:
        flat = values.reshape(-1)
        return assemble_cloud(path, {name: flat[name] for name in values.dtype.names})
    if values.ndim != 2 or values.shape[1] < 3:
        raise FormatError(
            f"{path}: expected an array of shape (N, 3) or wider, got {values.shape}; reshape it."
        )
    return assemble_cloud(path, name_columns(values))


def write_npy(path: Path, cloud: Cloud) -> None:
    """Write a cloud as a ``.npy`` file.

    Args:
        path: The file.
        cloud: The cloud. Without fields an array of shape (N, 3) is written, with fields a
            structured array whose names are those of a PLY file.

    Raises:
        FormatError: If a field cannot be a column, or the file cannot be written.
    """
    values: NDArray[Any] = cloud.coordinates
    if cloud.fields:
        columns = flatten_cloud(path, cloud, Spelling())
        values = np.empty(len(cloud), [(name, c.dtype) for name, c in columns.items()])
        for name, column in columns.items():
            values[name] = column
    with atomic_path(path) as beside, beside.open("wb") as stream:
        npy_format.write_array(stream, values, allow_pickle=False)


def read_npz(path: Path) -> Cloud:
    """Read a ``.npz`` file.

    Args:
        path: The file.

    Returns:
        The cloud.

    Raises:
        FormatError: If the file is damaged, holds Python objects, or has no points.
    """
    size = check_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = {
                member.filename.removesuffix(".npy"): _read_member(path, archive, member, size)
                for member in archive.infolist()
                if member.filename.endswith(".npy")
            }
    except FormatError:
        raise
    except (zipfile.BadZipFile, zlib.error, *DAMAGES) as error:
        raise FormatError(
            f"{path}: expected an archive of NumPy arrays, got: {first_line(error)}; "
            "fetch or write it again."
        ) from error
    name = next((name for name in COORDINATES if name in arrays), None)
    if name is None:
        found = ", ".join(map(repr, arrays)) or "none"
        raise FormatError(
            f"{path}: expected an array points (or coord), got {found}; rename the coordinates."
        )
    coordinates = arrays.pop(name)
    fields = {
        name: values
        for name, values in arrays.items()
        if values.shape[:1] == coordinates.shape[:1] and not name.startswith(NOT_PER_POINT)
    }
    return cloud_of(path, coordinates, fields)


def write_npz(path: Path, cloud: Cloud) -> None:
    """Write a cloud as a ``.npz`` file: ``points`` and every field under its name.

    Args:
        path: The file.
        cloud: The cloud.

    Raises:
        FormatError: If a field holds Python objects or has another length than the cloud, or the
            file cannot be written.
    """
    write_arrays(path, cloud_arrays(path, cloud))


def cloud_arrays(path: Path, cloud: Cloud) -> dict[str, NDArray[Any]]:
    """Return ``points`` and the fields of a cloud, checked to have one row a point.

    Args:
        path: The file to write, for messages.
        cloud: The cloud.

    Returns:
        The arrays by name.

    Raises:
        FormatError: If a field has another length than the cloud, or the name of the coordinates.
    """
    for name, values in cloud.fields.items():
        check_length(path, name, values, len(cloud))
        if name in COORDINATES:
            raise FormatError(f"{path}: expected fields beside points, got {name!r}; rename it.")
    return {"points": cloud.coordinates, **cloud.fields}


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as a ``.npz`` file; equal arrays give equal bytes, whenever and wherever.

    Args:
        path: The file.
        arrays: The arrays by name.

    Raises:
        FormatError: If one holds Python objects, or the file cannot be written.
    """
    for name, values in arrays.items():
        if values.dtype.hasobject:
            raise FormatError(
                f"{path}: expected numbers or text in {name}, got Python objects; leave it out."
            )
    with atomic_path(path) as beside, zipfile.ZipFile(beside, "w", allowZip64=True) as archive:
        for name, values in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", EARLIEST_ZIP_TIME)
            with archive.open(member, "w", force_zip64=True) as stream:
                npy_format.write_array(stream, np.asarray(values, order="C"), allow_pickle=False)


def _read_member(
    path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo, size: int
) -> NDArray[Any]:
    """Read one array of an archive."""
    ratio = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: LARGEST_DEFLATE_RATIO}
    if member.compress_type not in ratio:
        raise FormatError(
            f"{path}: expected {member.filename!r} stored or deflated, got compression "
            f"{member.compress_type}; write it with numpy.savez."
        )
    check_promise(
        path,
        byte=member.header_offset,
        promised=member.file_size,
        available=min(member.compress_size, size) * ratio[member.compress_type],
        content=repr(member.filename),
    )
    try:
        with archive.open(member) as stream:
            return _read_array(path, stream, member.file_size, content=repr(member.filename))
    except FormatError:
        raise
    except (zipfile.BadZipFile, zlib.error, *DAMAGES) as error:
        raise FormatError(
            f"{path}: {member.filename!r}: {first_line(error)}; fetch the file again."
        ) from error


def map_array(path: Path) -> NDArray[Any]:
    """Map the array of a ``.npy`` file into memory, copy-on-write: no change reaches the file.

    Args:
        path: The file.

    Returns:
        The array; its values are read from the disk when they are used.

    Raises:
        FormatError: If the file is missing, damaged, or holds Python objects.
    """
    size = check_file(path)
    with path.open("rb") as stream:
        shape = _read_header(path, stream, size, content="the array")
    if 0 in shape:
        return np.asarray(np.load(path, allow_pickle=False))
    return np.asarray(np.load(path, mmap_mode="c", allow_pickle=False))


def _read_array(path: Path, stream: IO[bytes], size: int, *, content: str) -> NDArray[Any]:
    """Read an array of NumPy's format of which ``size`` bytes are there."""
    _read_header(path, stream, size, content=content)
    stream.seek(0)
    values: NDArray[Any] = npy_format.read_array(stream, allow_pickle=False)
    return values


def _read_header(path: Path, stream: IO[bytes], size: int, *, content: str) -> tuple[int, ...]:
    """Read the header of an array, check it against the file, and return the shape."""
    try:
        version = npy_format.read_magic(stream)
        # Versions 2 and 3 differ in the encoding of field names only, which sizes do not need.
        read = npy_format.read_array_header_1_0
        if version != (1, 0):
            read = npy_format.read_array_header_2_0
        shape, _, dtype = read(stream)
    except (*DAMAGES, SyntaxError, tokenize.TokenError) as error:
        raise FormatError(
            f"{path}: byte 0: expected the header of a NumPy array in {content}, got: "
            f"{first_line(error)}; write it again with numpy.save or numpy.savez."
        ) from error
    if dtype.hasobject:
        raise FormatError(
            f"{path}: expected numbers or text in {content}, got pickled Python objects, which are "
            "never loaded; convert them with numpy.asarray(..., dtype=float) and save again."
        )
    if min(shape, default=0) < 0 or dtype.itemsize == 0:
        raise FormatError(
            f"{path}: byte 0: expected a shape and a type in {content}, got {shape} of {dtype}; "
            "write it again."
        )
    start = stream.tell()
    check_promise(
        path,
        byte=start,
        promised=math.prod(shape) * dtype.itemsize,
        available=size - start,
        content=f"{content} of shape {shape}",
    )
    return tuple(shape)
