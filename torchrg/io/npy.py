"""NumPy's own files: ``.npy``, one array, and ``.npz``, several by name. No pickle is ever loaded.

``.npz``: ``points`` (or ``coord``), shape (N, 3), and any arrays of N rows, which become fields.
Arrays of another length are left out, and so is what a result says about its planes, under names
that begin with ``plane_``. See :func:`torchrg.io.write_cloud` for all names of a result.
``.npy``: an array (N, 3) or wider, see :func:`torchrg.io.fields.name_columns` for its columns, or
a structured array with named fields ``x``, ``y``, ``z``.
"""

import json
import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
import torch
from numpy.lib import format as npy_format
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import FormatError
from torchrg.io.fields import (
    Spelling,
    assemble_cloud,
    check_length,
    cloud_of,
    flatten_cloud,
    name_columns,
    to_records,
)
from torchrg.io.files import DAMAGES, atomic_path, check_file, check_promise, refusing
from torchrg.structures import PLANE_KINDS, Cloud, Segmentation, Superpoints

_COORDINATES = ("points", "coord")
_NOT_PER_POINT = "plane_"
_LARGEST_RATIO = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 1032}
"""Most bytes that one byte of an archive becomes, by the methods of compression that are read."""
_EARLIEST_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
ARCHIVE_DAMAGES = (zipfile.BadZipFile, zlib.error, *DAMAGES)


def read_npy(path: Path, size: int) -> Cloud:
    """Read a ``.npy`` file."""
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
    """Write coordinates of shape (N, 3), or with fields a structured array named as in PLY."""
    values: NDArray[Any] = cloud.coordinates
    if cloud.fields:
        values = to_records(flatten_cloud(path, cloud, Spelling()))
    with atomic_path(path) as beside, beside.open("wb") as stream:
        npy_format.write_array(stream, values, allow_pickle=False)


def count_npy(path: Path, stream: IO[bytes], size: int) -> int:
    """Return the number of rows of an array."""
    shape, _ = _read_shape(stream)
    return shape[0] if shape else 0


def read_npz(path: Path, size: int) -> Cloud:
    """Read a ``.npz`` file."""
    message = f"{path}: expected an archive of NumPy arrays, got: "
    with (
        refusing(message, *ARCHIVE_DAMAGES, repair="; fetch or write it again"),
        zipfile.ZipFile(path) as archive,
    ):
        arrays = {
            member.filename.removesuffix(".npy"): _read_member(path, archive, member, size)
            for member in archive.infolist()
            if member.filename.endswith(".npy")
        }
    name = next((name for name in _COORDINATES if name in arrays), None)
    if name is None:
        found = ", ".join(map(repr, arrays)) or "none"
        raise FormatError(
            f"{path}: expected an array points (or coord), got {found}; rename the coordinates."
        )
    coordinates = arrays.pop(name)
    fields = {
        name: values
        for name, values in arrays.items()
        if values.shape[:1] == coordinates.shape[:1] and not name.startswith(_NOT_PER_POINT)
    }
    return cloud_of(path, coordinates, fields)


def write_npz(
    path: Path,
    cloud: Cloud,
    segmentation: Segmentation | None = None,
    provenance: Mapping[str, Any] | None = None,
    superpoints: Superpoints | None = None,
) -> None:
    """Write ``points`` and every field under its name, or the arrays of a result, and provenance.

    Equal arrays give equal bytes, whenever and wherever.
    """
    if segmentation is None:
        for name, values in cloud.fields.items():
            check_length(path, name, values, len(cloud))
            if name in _COORDINATES:
                raise FormatError(
                    f"{path}: expected fields beside points, got {name!r}; rename it."
                )
        arrays = {"points": cloud.coordinates, **cloud.fields}
    else:
        arrays = _result(cloud, segmentation)
    if superpoints is not None:
        arrays |= superpoints.by_level()
        arrays["plane_of_superpoint"] = superpoints.plane.numpy(force=True)
    if provenance is not None:
        arrays["provenance"] = np.array(json.dumps(provenance, sort_keys=True))
    for name, values in arrays.items():
        if values.dtype.hasobject:
            raise FormatError(
                f"{path}: expected numbers or text in {name}, got Python objects; leave it out."
            )
    with atomic_path(path) as beside, zipfile.ZipFile(beside, "w", allowZip64=True) as archive:
        for name, values in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", _EARLIEST_ZIP_TIME)
            with archive.open(member, "w", force_zip64=True) as stream:
                npy_format.write_array(stream, np.asarray(values, order="C"), allow_pickle=False)


def count_npz(path: Path, stream: BinaryIO, size: int) -> int:
    """Return the number of rows of the coordinates."""
    with zipfile.ZipFile(stream) as archive:
        known = [f"{name}.npy" for name in _COORDINATES if f"{name}.npy" in archive.namelist()]
        with archive.open(known[0]) as member:
            return count_npy(path, member, size)


def _result(cloud: Cloud, segmentation: Segmentation) -> dict[str, NDArray[Any]]:
    """Return the arrays of a result, planes in the coordinates of the cloud itself.

    What the table of planes does not have is left out.
    """

    def moved(places: Tensor) -> NDArray[np.float64]:
        return places.numpy(force=True).astype(np.float64) + cloud.origin

    per_point = segmentation._asdict()
    planes, _ = per_point.pop("planes"), per_point.pop("points")
    table = planes._asdict()
    kind, outline, adjacency = (table.pop(name) for name in ("kind", "outline", "adjacency"))
    arrays = {"points": cloud.coordinates}
    arrays |= {name: values.numpy(force=True) for name, values in per_point.items()}
    arrays |= {f"plane_{name}": values.numpy(force=True) for name, values in table.items()}
    arrays["plane_offset"] = (
        arrays["plane_offset"].astype(np.float64) + arrays["plane_normal"] @ cloud.origin
    )
    arrays |= {f"plane_{name}": moved(table[name]) for name in ("centroid", "center")}
    if kind is not None:
        arrays["plane_kind"] = np.array(PLANE_KINDS)[kind.numpy(force=True)]
    if adjacency is not None:
        for name, values in adjacency._asdict().items():
            arrays[f"adjacency_{name}"] = values.numpy(force=True)
    if outline is not None:
        rings = [(plane, ring) for plane, own in enumerate(outline) for ring in own]
        arrays["outline_points"] = moved(torch.cat([planes.center[:0], *(r for _, r in rings)]))
        arrays["outline_ring_sizes"] = np.array([len(ring) for _, ring in rings], dtype=np.int64)
        arrays["outline_ring_planes"] = np.array([plane for plane, _ in rings], dtype=np.int64)
    return arrays


def map_array(path: Path) -> NDArray[Any]:
    """Map the array of a ``.npy`` file into memory, copy-on-write: no change reaches the file."""
    size = check_file(path)
    with path.open("rb") as stream:
        shape = _read_header(path, stream, size, content="the array")
    # There is nothing to map in an empty array, and trying fails.
    values = np.load(path, mmap_mode=None if 0 in shape else "c", allow_pickle=False)
    return np.asarray(values)


def _read_member(
    path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo, size: int
) -> NDArray[Any]:
    """Read one array of an archive."""
    if member.compress_type not in _LARGEST_RATIO:
        raise FormatError(
            f"{path}: expected {member.filename!r} stored or deflated, got compression "
            f"{member.compress_type}; write it with numpy.savez."
        )
    content = repr(member.filename)
    most = min(member.compress_size, size) * _LARGEST_RATIO[member.compress_type]
    check_promise(path, member.header_offset, member.file_size, content, available=most)
    with (
        refusing(f"{path}: {content}: ", *ARCHIVE_DAMAGES, repair="; fetch the file again"),
        archive.open(member) as stream,
    ):
        return _read_array(path, stream, member.file_size, content=content)


def _read_array(path: Path, stream: IO[bytes], size: int, *, content: str) -> NDArray[Any]:
    """Read an array of NumPy's format of which ``size`` bytes are there."""
    _read_header(path, stream, size, content=content)
    stream.seek(0)
    values: NDArray[Any] = npy_format.read_array(stream, allow_pickle=False)
    return values


def _read_header(path: Path, stream: IO[bytes], size: int, *, content: str) -> tuple[int, ...]:
    """Read the header of an array, check it against the file, and return the shape."""
    message = f"{path}: byte 0: expected the header of a NumPy array in {content}, got: "
    repair = "; write it again with numpy.save or numpy.savez"
    with refusing(message, *DAMAGES, SyntaxError, tokenize.TokenError, repair=repair):
        shape, dtype = _read_shape(stream)
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
    start, promised = stream.tell(), math.prod(shape) * dtype.itemsize
    check_promise(path, start, promised, f"{content} of shape {shape}", available=size - start)
    return shape


def _read_shape(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read shape and type of an array, and leave the stream at the first value."""
    version = npy_format.read_magic(stream)
    # Versions 2 and 3 differ in the encoding of field names only, which sizes do not need.
    read = npy_format.read_array_header_1_0
    if version != (1, 0):
        read = npy_format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return tuple(shape), dtype
