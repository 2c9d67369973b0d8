"""NumPy's own files: ``.npy``, one array, and ``.npz``, several by name. No pickle is ever loaded.

``.npz``: ``points`` (or ``coord``), shape (N, 3), and any arrays of N rows, which become fields.
Arrays of another length are left out, and so is what a result says about its planes. See
:func:`torchrg.io.write_cloud` for all names of a result.
``.npy``: an array (N, 3) or wider, the columns of which are named when it is read or by
:data:`torchrg.io.fields.COLUMNS_RULE`, or a structured array with named fields ``x``, ``y``, ``z``.
"""

import json
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy_format

from torchrg.errors import FormatError
from torchrg.io.columns import Spelling, flatten_cloud, to_records
from torchrg.io.fields import (
    Values,
    assemble_cloud,
    assemble_table,
    check_coordinates,
    check_names,
    name_aside,
)
from torchrg.io.files import (
    ARCHIVE_DAMAGES,
    DAMAGES,
    atomic_path,
    check_file,
    check_promise,
    refusing,
)
from torchrg.structures import Cloud, PlaneAdjacency, Planes, Segmentation, Superpoints

_COORDINATES = ("points", "coord")
_RESULTS = ("labels", "normals", "curvature", "sharp", "valid")
_NOT_PER_POINT = {
    *(f"plane_{name}" for name in (*Planes._fields, "of_superpoint")),
    *(f"adjacency_{name}" for name in PlaneAdjacency._fields),
    *(f"outline_{name}" for name in ("points", "ring_sizes", "ring_planes")),
    "provenance",
}
"""What a result says beside its points, of however many rows."""
_LARGEST_RATIO = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 1032}
"""Most bytes that one byte of an archive becomes, by the methods of compression that are read."""
_BYTES_AT_ONCE = 1 << 20
"""Bytes that are unpacked together, which bounds the memory."""
_EARLIEST_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of every array in an archive, the earliest that there is, so that equal results give equal
bytes."""


def read_npy(path: Path, size: int, columns: Sequence[str] | None = None) -> Cloud:
    """Read a ``.npy`` file; ``columns`` are names for those of an array that has none."""
    with path.open("rb") as stream:
        layout = _read_header(path, stream, size, content="the array")
        shape, names = layout.shape, layout.dtype.names
        if names is None and (len(shape) != 2 or shape[1] < 3):
            raise FormatError(
                f"{path}: expected an array of shape (N, 3) or wider, got {shape}; reshape it."
            )
        if names is None:
            check_coordinates(path, (shape[0], 3), layout.dtype)
            if columns is not None:
                check_names(path, columns, shape[1])
        elif columns is not None:
            raise FormatError(
                f"{path}: expected no names for columns, as its fields have some: "
                f"{', '.join(names)}; leave them out."
            )
        values = _read_values(stream, layout)
    if names is None:
        return assemble_table(path, values, columns)
    flat = values.reshape(-1)
    return assemble_cloud(path, {name: flat[name] for name in names})


def count_npy(path: Path, size: int) -> int:
    """Return the number of points: of rows, or of all records."""
    with path.open("rb") as stream:
        layout = _read_header(path, stream, size, content="the array")
    return layout.num_rows if layout.dtype.names is None else math.prod(layout.shape)


def write_npy(path: Path, cloud: Cloud) -> None:
    """Write coordinates of shape (N, 3), or with fields a structured array named as in PLY."""
    columns = flatten_cloud(path, cloud, Spelling())
    with atomic_path(path) as beside, beside.open("wb") as file:
        _write_array(file, to_records(columns) if cloud.fields else cloud.coordinates)


def read_npz(path: Path, size: int) -> Cloud:
    """Read a ``.npz`` file."""
    with _open_archive(path) as archive:
        layouts = _layouts(path, archive, size)
        coordinates = _name_of_coordinates(path, layouts)
        shape = layouts[coordinates].shape
        check_coordinates(path, shape, layouts[coordinates].dtype)
        columns, others = dict[str, Values](), list[str]()
        for name, layout in layouts.items():
            if layout.shape[:1] == shape[:1] and name not in _NOT_PER_POINT:
                columns[name] = _read_member(path, archive, name, layout)
                continue
            # What is left out is read, too, so that damage in it is told.
            _check_bytes(path, archive, name)
            if name not in _NOT_PER_POINT:
                others.append(name)
    notes = (f"{', '.join(others)} left out: not of {shape[0]:,} rows",) if others else ()
    return assemble_cloud(path, columns, coordinates=coordinates, notes=notes)


def count_npz(path: Path, size: int) -> int:
    """Return the number of rows of the coordinates."""
    with _open_archive(path) as archive:
        layouts = _layouts(path, archive, size)
    return layouts[_name_of_coordinates(path, layouts)].num_rows


def _layouts(path: Path, archive: zipfile.ZipFile, size: int) -> dict[str, "_Layout"]:
    """Return the layouts of the arrays of an archive by their names."""
    return {
        member.filename.removesuffix(".npy"): _check_member(path, archive, member, size)
        for member in archive.infolist()
        if member.filename.endswith(".npy")
    }


def _name_of_coordinates(path: Path, layouts: Mapping[str, "_Layout"]) -> str:
    """Return the name of the array of an archive that holds coordinates."""
    for name in _COORDINATES:
        if name in layouts:
            return name
    names = ", ".join(map(repr, layouts)) or "none"
    raise FormatError(
        f"{path}: expected an array points (or coord), got {names}; rename the coordinates."
    )


def read_beside(path: Path) -> dict[str, Values]:
    """Return what a ``.npz`` file says beside its points: table of planes, provenance."""
    size = check_file(path)
    with _open_archive(path) as archive:
        return {
            name: _read_member(path, archive, name, layout)
            for name, layout in _layouts(path, archive, size).items()
            if name in _NOT_PER_POINT
        }


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
    arrays: dict[str, Values] = {"points": cloud.coordinates}
    if segmentation is None:
        for name, values in cloud.fields.items():
            if name in _COORDINATES or name in _NOT_PER_POINT:
                raise FormatError(
                    f"{path}: expected fields beside points, got {name!r}; rename it."
                )
            if values.dtype.hasobject:
                raise FormatError(
                    f"{path}: expected numbers or text in {name}, got Python objects; leave it out."
                )
            arrays[name] = values
    else:
        arrays |= {name: getattr(segmentation, name).numpy(force=True) for name in _RESULTS}
        arrays |= segmentation.planes.to_arrays(cloud.origin)
    if superpoints is not None:
        for name, level in superpoints.by_level().items():
            if name in arrays:
                arrays.setdefault(name_aside(name), arrays[name])
            arrays[name] = level
        arrays["plane_of_superpoint"] = superpoints.plane.numpy(force=True)
    if provenance is not None:
        arrays["provenance"] = np.array(json.dumps(provenance, sort_keys=True))
    with atomic_path(path) as beside, zipfile.ZipFile(beside, "w", allowZip64=True) as archive:
        for name, values in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", _EARLIEST_ZIP_TIME)
            with archive.open(member, "w", force_zip64=True) as file:
                _write_array(file, values)


def _write_array(file: IO[bytes], values: Values) -> None:
    """Write an array in NumPy's format, its rows one after the other."""
    npy_format.write_array(file, np.asarray(values, order="C"), allow_pickle=False)


def map_folder(folder: Path, names: Sequence[str]) -> dict[str, Values]:
    """Map those arrays of a folder that are there, one of which, ``coord``, has to be.

    It has shape ``(N, 3)``, or that of an image; the others have a row for each of its points.
    """
    paths = {name: folder / f"{name}.npy" for name in names}
    if not paths["coord"].is_file():
        raise FormatError(f"{folder}: expected coord.npy in this folder, got none.")
    arrays = {name: map_array(path) for name, path in paths.items() if path.is_file()}
    shape = arrays["coord"].shape
    if len(shape) not in (2, 3) or shape[-1] != 3:
        raise FormatError(f"{paths['coord']}: expected shape (N, 3), got {shape}.")
    for name, values in arrays.items():
        check_rows(paths[name], values, shape[:-1])
    return arrays


def check_rows(path: Path, values: Values, shape: tuple[int, ...]) -> None:
    """Check that an array has a row for each point, or for each pixel of an image."""
    if values.shape[: len(shape)] != shape:
        rows = " x ".join(map(str, shape))
        raise FormatError(f"{path}: expected {rows} rows, got shape {values.shape}.")


def map_array(path: Path) -> Values:
    """Map the array of a ``.npy`` file into memory, copy-on-write: no change reaches the file."""
    size = check_file(path)
    with path.open("rb") as stream:
        shape = _read_header(path, stream, size, content="the array").shape
    # There is nothing to map in an empty array, and trying fails.
    values = np.load(path, mmap_mode=None if 0 in shape else "c", allow_pickle=False)
    return np.asarray(values)


class _Layout(NamedTuple):
    """What the header of an array says, and at which byte its values begin.

    In Fortran's order the first index runs fastest, so that columns are whole and not rows.
    """

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype[Any]
    start: int

    @property
    def num_rows(self) -> int:
        """Length of the array; one of a bare number."""
        return self.shape[0] if self.shape else 1


@contextmanager
def _open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; errors name it."""
    message = f"{path}: expected an archive of NumPy arrays, got: "
    with (
        refusing(message, *ARCHIVE_DAMAGES, repair="; fetch or write it again"),
        zipfile.ZipFile(path) as archive,
    ):
        yield archive


def _refusing_member(path: Path, name: str) -> AbstractContextManager[None]:
    """Raise what reading a member raises as an error that names it."""
    message = f"{path}: {f'{name}.npy'!r}: "
    return refusing(message, *ARCHIVE_DAMAGES, repair="; fetch the file again")


def _check_member(
    path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo, size: int
) -> _Layout:
    """Return the layout of an array of an archive, of which there are as many bytes as needed."""
    if member.compress_type not in _LARGEST_RATIO:
        raise FormatError(
            f"{path}: expected {member.filename!r} stored or deflated, got compression "
            f"{member.compress_type}; write it with numpy.savez."
        )
    content = repr(member.filename)
    most = min(member.compress_size, size) * _LARGEST_RATIO[member.compress_type]
    check_promise(path, member.header_offset, member.file_size, content, available=most)
    name = member.filename.removesuffix(".npy")
    with _refusing_member(path, name), archive.open(member) as stream:
        return _read_header(path, stream, member.file_size, content=content)


def _check_bytes(path: Path, archive: zipfile.ZipFile, name: str) -> None:
    """Read a member to its end, where its checksum is compared."""
    with _refusing_member(path, name), archive.open(f"{name}.npy") as stream:
        _read_to_end(stream)


def _read_member(path: Path, archive: zipfile.ZipFile, name: str, layout: _Layout) -> Values:
    """Read one array of an archive, and its checksum."""
    with _refusing_member(path, name), archive.open(f"{name}.npy") as stream:
        stream.read(layout.start)
        values = _read_values(stream, layout)
        _read_to_end(stream)
        return values


def _read_to_end(stream: IO[bytes]) -> None:
    """Read on to the end of a member, where its checksum is compared."""
    while stream.read(_BYTES_AT_ONCE):
        pass


def _read_values(stream: IO[bytes], layout: _Layout) -> Values:
    """Read the values of an array, at which the stream is."""
    values = np.empty(layout.shape, layout.dtype, "F" if layout.is_fortran else "C")
    memory = values.reshape(-1, order="A").view(np.uint8).data
    done = 0
    while done < len(memory):
        got = stream.readinto(memory[done : done + _BYTES_AT_ONCE])  # type: ignore[attr-defined]
        if not got:
            raise EOFError(f"EOF: reading array data, expected {len(memory)} bytes got {done}")
        done += got
    return values


def _read_header(path: Path, stream: IO[bytes], size: int, *, content: str) -> _Layout:
    """Read the header of an array and check it against the ``size`` bytes that are there."""
    message = f"{path}: byte 0: expected the header of a NumPy array in {content}, got: "
    repair = "; write it again with numpy.save or numpy.savez"
    with refusing(message, *DAMAGES, repair=repair):
        layout = _read_layout(stream)
    shape, _, dtype, start = layout
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
    promised = math.prod(shape) * dtype.itemsize
    check_promise(path, start, promised, f"{content} of shape {shape}", available=size - start)
    return layout


def _read_layout(stream: IO[bytes]) -> _Layout:
    """Read what the header of an array says."""
    version = npy_format.read_magic(stream)
    read = npy_format.read_array_header_1_0
    if version != (1, 0):
        read = npy_format.read_array_header_2_0
    shape, is_fortran, dtype = read(stream)
    if version == (3, 0) and dtype.names is not None:
        # Version 3 is version 2 with another encoding of field names.
        dtype.names = tuple(name.encode("latin-1").decode("utf-8") for name in dtype.names)
    return _Layout(tuple(shape), is_fortran, dtype, stream.tell())
