"""NumPy files: single arrays (``.npy``) and archives (``.npz``), never pickles.

``.npz``: ``points`` (or ``coord``, or Open3D's ``positions``), shape (N, 3) or records, or ``x``,
``y`` and ``z``, and any arrays of N rows, which become fields. Arrays of other lengths and the
plane table of a result are skipped. See :func:`torchrg.io.write_cloud` for the names in a result.
``.npy``: an array (N, 3) or wider, with column names from the caller or by
:data:`torchrg.io.tables.COLUMNS_RULE`, or a structured array with named fields ``x``, ``y``, ``z``.
"""

import io
import json
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format

from torchrg import scratch
from torchrg.errors import FormatError
from torchrg.io.columns import FieldNames, flatten_cloud, to_records
from torchrg.io.fields import (
    FIELD_NAMES,
    assemble_cloud,
    assemble_table,
    backup_name,
    check_coordinates,
    check_names,
)
from torchrg.io.files import (
    ARCHIVE_ERRORS,
    BYTES_PER_READ,
    PARSE_ERRORS,
    atomic_path,
    check_available,
    check_file,
    wrap_errors,
)
from torchrg.io.plane_table import planes_to_arrays
from torchrg.io.tables import check_table
from torchrg.structures import Cloud, PlaneAdjacency, Planes, Segmentation, Superpoints
from torchrg.structures.points import Array

_Layout = tuple[tuple[int, ...], np.dtype[Any]]
"""Shape and type of an array."""
_COORDINATES = ("points", "coord", "positions")
POINT_RESULTS = ("labels", "normals", "curvature", "sharp", "valid")
"""Per-point arrays of a segmentation."""
DISPLAYED_FIELDS = ("color",)
"""Cloud fields stored with a result, for viewers and images."""
_NOT_PER_POINT = {
    *(f"plane_{name}" for name in (*(part.name for part in fields(Planes)), "of_superpoint")),
    *(f"adjacency_{name}" for name in PlaneAdjacency._fields),
    *(f"outline_{name}" for name in ("points", "ring_sizes", "ring_planes")),
    "provenance",
}
"""Arrays of a result that are not per point, whatever their number of rows."""
_MAX_RATIO = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 1032}
"""Maximum decompressed bytes per archive byte, by supported compression method."""
_MAX_ARRAYS = 10_000
"""Maximum number of arrays of an archive: to check an array takes a fifth of a millisecond."""
_REPAIR = "; copy or write it again"
_MAX_HEADER_BYTES = 1 << 16
"""Bytes read to parse an array header, of which NumPy accepts up to 10,000."""


def read_npy(path: Path, size: int, columns: Sequence[str] | None = None) -> Cloud:
    """Read a ``.npy`` file; ``columns`` names the columns of an unstructured array."""
    shape, dtype = _check_npy(path, size)
    if dtype.names is not None:
        if columns is not None:
            raise FormatError(
                f"{path}: column names apply to unstructured arrays only; this array has fields "
                f"{', '.join(dtype.names)}. Omit the names."
            )
        records = map_array(path).reshape(-1)
        return assemble_cloud(path, {name: records[name] for name in records.dtype.names or ()})
    if len(shape) != 2 or shape[1] < 3:
        raise FormatError(f"{path}: expected shape (N, 3) or wider, got {shape}; reshape it.")
    check_coordinates(path, (shape[0], 3), dtype)
    if columns is None and path.stem.lower() in FIELD_NAMES:
        raise FormatError(
            f"{path}: expected coordinates, got a file named as the field {path.stem}; pass the "
            "folder with coord.npy, or rename the file if it is a cloud."
        )
    if columns is not None:
        check_names(path, columns, shape[1])
    return assemble_table(path, map_array(path), columns)


def count_npy(path: Path, size: int) -> int:
    """Return the number of points: rows, or all records of a structured array."""
    shape, dtype = _check_npy(path, size)
    return math.prod(shape if dtype.names is not None else shape[:1])


def write_npy(path: Path, cloud: Cloud) -> None:
    """Write coordinates of shape (N, 3); with fields, write a structured array with PLY names."""
    columns = flatten_cloud(path, cloud, FieldNames())
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        _write_array(file, to_records(columns) if cloud.fields else cloud.coordinates)


def read_npz(path: Path, size: int) -> Cloud:
    """Read a ``.npz`` file."""
    with _open_archive(path) as archive:
        layouts = _check_members(path, archive, size)
        coordinates, num_points = _find_coordinates(path, layouts)
        per_point = [name for name in layouts if name not in _NOT_PER_POINT]
        mismatched = [name for name in per_point if layouts[name][0][:1] != (num_points,)]
        columns = {
            name: _read_member(path, archive, name) for name in per_point if name not in mismatched
        }
    notes: tuple[str, ...] = ()
    if mismatched:
        notes = (f"{', '.join(mismatched)} skipped: not {num_points:,} rows",)
    if coordinates is not None and coordinates not in _COORDINATES:
        check_coordinates(path, *layouts[coordinates])
        check_table(path, columns[coordinates])
        notes += (f"{coordinates} is read as the points, as no other array has 3 columns",)
    if coordinates is not None and (names := layouts[coordinates][1].names) is not None:
        # pyntcloud writes a structured array, whose fields become columns.
        records = columns.pop(coordinates)
        columns = {**{name: records[name] for name in names}, **columns}
        coordinates = None
    return assemble_cloud(path, columns, coordinates=coordinates, notes=notes)


def count_npz(path: Path, size: int) -> int:
    """Return the number of rows of the coordinates."""
    with _open_archive(path) as archive:
        return _find_coordinates(path, _check_members(path, archive, size))[1]


def _find_coordinates(path: Path, layouts: Mapping[str, _Layout]) -> tuple[str | None, int]:
    """Return the name of the coordinate array in an archive, and its number of rows.

    The name is None if each axis is an array of its own.
    """
    for name in _COORDINATES:
        if name in layouts:
            shape, dtype = layouts[name]
            if dtype.names is None or len(shape) != 1:
                check_coordinates(path, shape, dtype)
            return name, shape[0]
    if {"x", "y", "z"} <= layouts.keys() and layouts["x"][0]:
        return None, layouts["x"][0][0]
    others = {n: rows[0] for n, (rows, _) in layouts.items() if rows[1:] == (3,) and rows[0]}
    others = {name: others[name] for name in others.keys() - _NOT_PER_POINT - FIELD_NAMES.keys()}
    if len(others) == 1:
        return next(iter(others.items()))
    names = ", ".join(map(repr, layouts)) or "none"
    raise FormatError(f"{path}: expected an array points (or coord), got {names}; rename them.")


def read_result_arrays(path: Path) -> dict[str, Array]:
    """Read the arrays of a ``.npz`` file that are not per point: plane table, provenance."""
    size = check_file(path)
    with _open_archive(path) as archive:
        names = _check_members(path, archive, size).keys() & _NOT_PER_POINT
        return {name: _read_member(path, archive, name) for name in names}


def write_npz(
    path: Path,
    cloud: Cloud,
    segmentation: Segmentation | None = None,
    provenance: Mapping[str, Any] | None = None,
    superpoints: Superpoints | None = None,
) -> None:
    """Write ``points`` and all fields, or the arrays of a result, and provenance.

    Identical arrays give byte-identical files.
    """
    arrays: dict[str, Array] = {"points": cloud.coordinates}
    if segmentation is None:
        for name, values in cloud.fields.items():
            if name in _COORDINATES or name in _NOT_PER_POINT:
                raise FormatError(f"{path}: a field cannot be named {name!r}; rename it.")
            if values.dtype.hasobject:
                raise FormatError(f"{path}: field {name} contains Python objects; remove it.")
            arrays[name] = values
    else:
        arrays |= {name: cloud.fields[name] for name in DISPLAYED_FIELDS if name in cloud.fields}
        arrays |= {name: getattr(segmentation, name).numpy(force=True) for name in POINT_RESULTS}
        arrays |= planes_to_arrays(segmentation.planes, cloud.origin)
    if superpoints is not None:
        for name, level in superpoints.by_level().items():
            if name in arrays:
                arrays.setdefault(backup_name(name), arrays[name])
            arrays[name] = level
        arrays["plane_of_superpoint"] = superpoints.plane.numpy(force=True)
    if provenance is not None:
        arrays["provenance"] = np.array(json.dumps(provenance, sort_keys=True))
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", allowZip64=True) as archive,
    ):
        for name, values in arrays.items():
            # The default time of a member is constant: identical results are byte-identical.
            member = zipfile.ZipInfo(f"{name}.npy")
            with archive.open(member, "w", force_zip64=True) as file:
                _write_array(file, values)


def _write_array(file: IO[bytes], values: Array) -> None:
    """Write an array in NumPy's format, in C order."""
    npy_format.write_array(file, np.asarray(values, order="C"), allow_pickle=False)


def map_folder(folder: Path, names: Sequence[str]) -> dict[str, Array]:
    """Memory-map the arrays of a folder that exist; ``coord`` is required.

    Its shape is ``(N, 3)`` or that of an image; the others have one row per point.
    """
    paths = {name: folder / f"{name}.npy" for name in names}
    if not paths["coord"].is_file():
        raise FormatError(f"{folder}: expected coord.npy, got none; pass the folder of a scene.")
    arrays = {name: map_array(path) for name, path in paths.items() if path.is_file()}
    shape = arrays["coord"].shape
    if len(shape) not in (2, 3) or shape[-1] != 3:
        raise FormatError(f"{paths['coord']}: expected shape (N, 3), got {shape}; reshape it.")
    for name, values in arrays.items():
        check_rows(paths[name], values, shape[:-1])
    return arrays


def check_rows(path: Path, values: Array, shape: tuple[int, ...]) -> None:
    """Check that an array has one row per point, or per pixel of an image."""
    if values.shape[: len(shape)] != shape:
        rows = " x ".join(map(str, shape))
        raise FormatError(f"{path}: expected {rows} rows, got shape {values.shape}; correct it.")


def map_array(path: Path) -> Array:
    """Map a ``.npy`` file into memory, copy-on-write: changes never reach the file."""
    shape, _ = _check_npy(path, check_file(path))
    # Mapping an empty array fails.
    values = np.load(path, mmap_mode=None if 0 in shape else "c", allow_pickle=False)
    return np.asarray(values)


@contextmanager
def _open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive, and convert errors to errors that name it."""
    message = f"{path}: expected an archive of NumPy arrays, got: "
    with (
        wrap_errors(message, *ARCHIVE_ERRORS, repair=_REPAIR),
        zipfile.ZipFile(path) as archive,
    ):
        yield archive


def _check_members(path: Path, archive: zipfile.ZipFile, size: int) -> dict[str, _Layout]:
    """Check that all members fit into an archive, and return their shapes and types."""
    layouts, members = {}, archive.infolist()
    if len(members) > _MAX_ARRAYS:
        raise FormatError(
            f"{path}: expected at most {_MAX_ARRAYS:,} arrays, got {len(members):,}; remove some."
        )
    # Overlapping members of a small file could expand to any size.
    packed = sum(member.compress_size for member in members)
    check_available(path, 0, packed, f"{len(members):,} arrays", available=size)
    for member in members:
        if not member.filename.endswith(".npy"):
            continue
        if member.compress_type not in _MAX_RATIO:
            raise FormatError(
                f"{path}: expected {member.filename!r} stored or deflated, got compression "
                f"{member.compress_type}; write it with numpy.savez."
            )
        content = repr(member.filename)
        max_bytes = min(member.compress_size, size) * _MAX_RATIO[member.compress_type]
        check_available(path, member.header_offset, member.file_size, content, available=max_bytes)
        with (
            wrap_errors(f"{path}: {content}: ", *ARCHIVE_ERRORS, repair=_REPAIR),
            archive.open(member) as stream,
        ):
            name = member.filename.removesuffix(".npy")
            layouts[name] = _check_array(path, stream, member.file_size, content)
    return layouts


def _read_member(path: Path, archive: zipfile.ZipFile, name: str) -> Array:
    """Read an archive member to its end, which verifies its checksum."""
    member = f"{name}.npy"
    with (
        wrap_errors(f"{path}: {member!r}: ", *ARCHIVE_ERRORS, repair=_REPAIR),
        archive.open(member) as stream,
    ):
        shape, is_fortran, dtype = _read_header(stream)
        values = scratch.empty(shape[::-1] if is_fortran else shape, dtype)
        memory, filled = values.reshape(-1).view(np.uint8).data, 0
        while part := stream.read(BYTES_PER_READ):
            memory[filled : filled + len(part)] = part
            filled += len(part)
        if filled < len(memory):
            raise EOFError(f"{filled:,} of {len(memory):,} bytes")
        return values.T if is_fortran else values


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an array: shape, whether it is in Fortran order, and type."""
    is_old = npy_format.read_magic(stream) == (1, 0)
    read = npy_format.read_array_header_1_0 if is_old else npy_format.read_array_header_2_0
    return read(stream)


def _check_npy(path: Path, size: int) -> _Layout:
    """Check a complete ``.npy`` file, and return shape and type of its array."""
    with path.open("rb") as stream:
        return _check_array(path, stream, size, "the array")


def _check_array(path: Path, stream: IO[bytes], size: int, content: str) -> _Layout:
    """Check an array header against the available ``size``, and return shape and type."""
    message = f"{path}: byte 0: expected the header of a NumPy array in {content}, got: "
    repair = "; write it again with numpy.save or numpy.savez"
    with wrap_errors(message, *PARSE_ERRORS, repair=repair):
        head = io.BytesIO(stream.read(_MAX_HEADER_BYTES))
        shape, _, dtype = _read_header(head)
    if dtype.hasobject:
        raise FormatError(
            f"{path}: {content} contains pickled Python objects, which are not loaded for security "
            "reasons; convert them with numpy.asarray(..., dtype=float) and save again."
        )
    if min(shape, default=0) < 0 or dtype.itemsize == 0:
        raise FormatError(
            f"{path}: byte 0: wrong shape or type in {content}: {shape} of {dtype}; write it again."
        )
    num_bytes, start = math.prod(shape) * dtype.itemsize, head.tell()
    check_available(path, start, num_bytes, f"{content} of shape {shape}", available=size - start)
    if size - start > num_bytes:
        raise FormatError(
            f"{path}: byte {start}: expected {num_bytes:,} bytes for {content} of shape {shape}, "
            f"got {size - start:,}; correct the shape or the type, or write it again."
        )
    return shape, dtype
