"""NumPy's own files: ``.npy``, one array, and ``.npz``, several by name. No pickle is ever loaded.

``.npz``: ``points`` (or ``coord``), shape (N, 3), and any arrays of N rows, which become fields.
Arrays of another length are left out, and so is what a result says about its planes. See
:func:`torchrg.io.write_cloud` for all names of a result.
``.npy``: an array (N, 3) or wider, the columns of which are named when it is read or by
:data:`torchrg.io.fields.COLUMNS_RULE`, or a structured array with named fields ``x``, ``y``, ``z``.
"""

import io
import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import FormatError
from torchrg.io.columns import Spelling, flatten_cloud, to_records, wide_limits
from torchrg.io.fields import (
    FIRST_ROWS,
    Columns,
    check_coordinates,
    check_first_rows,
    check_names,
    name_aside,
    name_columns,
    rule_for,
)
from torchrg.io.files import DAMAGES, atomic_path, check_file, check_promise, refusing
from torchrg.io.stream import POINTS_A_CHUNK, CloudStream, Table, slices
from torchrg.plane_table import planes_to_arrays
from torchrg.structures import PlaneAdjacency, Planes, Segmentation, Superpoints

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
ARCHIVE_DAMAGES = (zipfile.BadZipFile, zlib.error, *DAMAGES)


def open_npy(path: Path, size: int, columns: Sequence[str] | None = None) -> Table:
    """Open a ``.npy`` file; ``columns`` are names for those of an array that has none."""
    with path.open("rb") as stream:
        layout = _read_header(path, stream, size, content="the array")
    fields = layout.dtype.names
    if fields is not None:
        return _open_records(path, layout, fields, columns)
    if len(layout.shape) != 2 or layout.shape[1] < 3:
        raise FormatError(
            f"{path}: expected an array of shape (N, 3) or wider, got {layout.shape}; reshape it."
        )
    num_rows, num_columns = layout.shape
    check_coordinates(path, (num_rows, 3), layout.dtype)

    def read(chunk_size: int) -> Iterator[Columns]:
        for rows in _read_rows(lambda: path.open("rb"), layout, chunk_size):
            yield name_columns(rows, columns)

    if columns is not None:
        check_names(path, columns, num_columns)
        return Table(read, num_rows)
    check_first_rows(path, next(_read_rows(lambda: path.open("rb"), layout, FIRST_ROWS)))
    naming, notes = rule_for(num_columns)
    return Table(read, num_rows, naming=naming, notes=notes)


def _open_records(
    path: Path, layout: "_Layout", fields: Sequence[str], columns: Sequence[str] | None
) -> Table:
    """Open an array of records."""
    if columns is not None:
        raise FormatError(
            f"{path}: expected no names for columns, as its fields have some: {', '.join(fields)}; "
            "leave them out."
        )
    if not layout.is_fortran:
        layout = layout._replace(shape=(math.prod(layout.shape),))

    def read(chunk_size: int) -> Iterator[Columns]:
        for rows in _read_rows(lambda: path.open("rb"), layout, chunk_size):
            flat = rows.reshape(-1)
            yield {name: flat[name] for name in fields}

    return Table(read, math.prod(layout.shape))


def write_npy(path: Path, stream: CloudStream) -> None:
    """Write coordinates of shape (N, 3), or with fields a structured array named as in PLY."""
    with atomic_path(path) as beside, beside.open("wb") as file:
        _write_array(file, stream.count, _bare_or_records(path, stream))


def _bare_or_records(path: Path, stream: CloudStream) -> Iterator[NDArray[Any]]:
    """Give the coordinates of each chunk, or its columns as records if it has fields."""
    spelling = Spelling()
    limits = wide_limits(path, stream, spelling)
    for chunk in stream:
        columns = flatten_cloud(path, chunk, spelling, limits)
        yield to_records(columns) if chunk.fields else chunk.coordinates


def open_npz(path: Path, size: int) -> Table:
    """Open a ``.npz`` file."""
    with _open_archive(path) as archive:
        layouts = {
            member.filename.removesuffix(".npy"): _check_member(path, archive, member, size)
            for member in archive.infolist()
            if member.filename.endswith(".npy")
        }
    coordinates = next((name for name in _COORDINATES if name in layouts), None)
    if coordinates is None:
        found = ", ".join(map(repr, layouts)) or "none"
        raise FormatError(
            f"{path}: expected an array points (or coord), got {found}; rename the coordinates."
        )
    shape = layouts[coordinates].shape
    check_coordinates(path, shape, layouts[coordinates].dtype)
    kept = [
        name
        for name, layout in layouts.items()
        if layout.shape[:1] == shape[:1] and name not in _NOT_PER_POINT
    ]
    others = [name for name in layouts if name not in kept and name not in _NOT_PER_POINT]
    notes = (f"{', '.join(others)} left out: not of {shape[0]:,} rows",) if others else ()

    def read(chunk_size: int) -> Iterator[Columns]:
        with _open_archive(path) as archive:
            for name, layout in layouts.items():
                # What is left out is read, too, so that damage in it is found; and so is what will
                # be read from several places, as a checksum needs all bytes in their order.
                if name not in kept or layout.is_cut_across(chunk_size):
                    _check_bytes(path, archive, name)
            arrays = [_read_member(path, archive, name, layouts[name], chunk_size) for name in kept]
            for rows in zip(*arrays, strict=True):
                yield dict(zip(kept, rows, strict=True))

    return Table(read, shape[0], coordinates=coordinates, notes=notes)


def read_beside(path: Path) -> dict[str, NDArray[Any]]:
    """Return what a ``.npz`` file says beside its points: table of planes, provenance."""
    found, size = {}, check_file(path)
    with _open_archive(path) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name in _NOT_PER_POINT and name != member.filename:
                layout = _check_member(path, archive, member, size)
                rows = max(layout.num_rows, 1)
                found[name] = next(_read_member(path, archive, name, layout, rows))
    return found


def write_npz(
    path: Path,
    stream: CloudStream,
    segmentation: Segmentation | None = None,
    provenance: Mapping[str, Any] | None = None,
    superpoints: Superpoints | None = None,
) -> None:
    """Write ``points`` and every field under its name, or the arrays of a result, and provenance.

    Equal arrays give equal bytes, whenever and wherever. As one array comes after the other, the
    chunks are gone through once for each field.
    """
    arrays: dict[str, NDArray[Any] | Callable[[], Iterator[NDArray[Any]]]] = {
        "points": lambda: (chunk.coordinates for chunk in stream)
    }
    if segmentation is None:
        for name, values in next(iter(stream)).fields.items():
            if name in _COORDINATES or name in _NOT_PER_POINT:
                raise FormatError(
                    f"{path}: expected fields beside points, got {name!r}; rename it."
                )
            if values.dtype.hasobject:
                raise FormatError(
                    f"{path}: expected numbers or text in {name}, got Python objects; leave it out."
                )
            arrays[name] = partial(_field, stream, name)
    else:
        for name in _RESULTS:
            arrays[name] = partial(_cut, getattr(segmentation, name))
        arrays |= planes_to_arrays(segmentation.planes, stream.origin)
    if superpoints is not None:
        for name in superpoints.rows(slice(0)).by_level():
            if name in arrays:
                arrays.setdefault(name_aside(name), arrays[name])
            arrays[name] = partial(_level, superpoints, name)
        arrays["plane_of_superpoint"] = superpoints.plane.numpy(force=True)
    if provenance is not None:
        arrays["provenance"] = np.array(json.dumps(provenance, sort_keys=True))
    with atomic_path(path) as beside, zipfile.ZipFile(beside, "w", allowZip64=True) as archive:
        for name, content in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", _EARLIEST_ZIP_TIME)
            with archive.open(member, "w", force_zip64=True) as file:
                if callable(content):
                    _write_array(file, stream.count, content())
                else:
                    npy_format.write_array(file, np.asarray(content, order="C"), allow_pickle=False)


def _field(stream: CloudStream, name: str) -> Iterator[NDArray[Any]]:
    """Give a field of each chunk."""
    return (chunk.fields[name] for chunk in stream)


def _cut(values: Tensor) -> Iterator[NDArray[Any]]:
    """Give the rows of a tensor in chunks."""
    return (values[rows].numpy(force=True) for rows in slices(len(values), POINTS_A_CHUNK))


def _level(superpoints: Superpoints, name: str) -> Iterator[NDArray[Any]]:
    """Give a level of superpoints in chunks."""
    for rows in slices(len(superpoints.labels), POINTS_A_CHUNK):
        yield superpoints.rows(rows).by_level()[name]


def _write_array(file: IO[bytes], num_rows: int, chunks: Iterator[NDArray[Any]]) -> None:
    """Write an array of so many rows in NumPy's format, a few of them at a time."""
    for number, values in enumerate(chunks):
        if number == 0:
            file.write(_header_of(values[:0], num_rows))
        file.write(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)


def _header_of(empty: NDArray[Any], num_rows: int) -> bytes:
    """Return the header of an array of so many rows from an array of none.

    NumPy keeps room in it for the number to grow, so the length is the same for both.
    """
    with io.BytesIO() as memory:
        npy_format.write_array(memory, empty, allow_pickle=False)
        before, mark, after = memory.getvalue().rpartition(b"'shape': (0,")
    digits = str(num_rows).encode()
    room = b" " * (len(digits) - 1)
    return before + mark[:-2] + digits + b"," + after.removesuffix(room + b"\n") + b"\n"


def map_folder(folder: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
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


def check_rows(path: Path, values: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Check that an array has a row for each point, or for each pixel of an image."""
    if values.shape[: len(shape)] != shape:
        rows = " x ".join(map(str, shape))
        raise FormatError(f"{path}: expected {rows} rows, got shape {values.shape}.")


def map_array(path: Path) -> NDArray[Any]:
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

    @property
    def row_shape(self) -> tuple[int, ...]:
        """Shape of a row."""
        return self.shape[1:]

    def is_cut_across(self, chunk_size: int) -> bool:
        """Whether chunks of so many rows are not whole in the file."""
        return self.is_fortran and len(self.shape) > 1 and chunk_size < self.num_rows


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
        while stream.read(_BYTES_AT_ONCE):
            pass


def _read_member(
    path: Path, archive: zipfile.ZipFile, name: str, layout: _Layout, chunk_size: int
) -> Iterator[NDArray[Any]]:
    """Read one array of an archive, so many rows at a time."""
    with _refusing_member(path, name):
        yield from _read_rows(partial(archive.open, f"{name}.npy"), layout, chunk_size)


def _read_rows(
    open_stream: Callable[[], IO[bytes]], layout: _Layout, chunk_size: int
) -> Iterator[NDArray[Any]]:
    """Read an array so many rows at a time; what does not lie in rows, from several places."""
    width = max(math.prod(layout.row_shape), 1) if layout.is_cut_across(chunk_size) else 1
    column_bytes = layout.num_rows * layout.dtype.itemsize
    with ExitStack() as stack:
        streams = [stack.enter_context(open_stream()) for _ in range(width)]
        for i, stream in enumerate(streams):
            _skip(stream, layout.start + i * column_bytes)
        for rows in slices(layout.num_rows, chunk_size):
            shape = (rows.stop - rows.start, *layout.row_shape) if layout.shape else ()
            values = np.empty(shape, layout.dtype, "F" if layout.is_fortran else "C")
            memory = values.reshape(-1, order="A").view(np.uint8).reshape(width, -1)
            for stream, part in zip(streams, memory, strict=True):
                _fill(stream, part.data)
            yield values


def _skip(stream: IO[bytes], num_bytes: int) -> None:
    """Go from the beginning of an array to a byte.

    In an archive by reading what comes before: a checksum is one of all bytes, and ``seek`` of
    Python 3.13.0 loses count of what is left.
    """
    if not isinstance(stream, zipfile.ZipExtFile):
        stream.seek(num_bytes)
        return
    while num_bytes > 0 and (skipped := len(stream.read(min(num_bytes, _BYTES_AT_ONCE)))):
        num_bytes -= skipped


def _fill(stream: IO[bytes], memory: memoryview) -> None:
    """Read as many bytes as a piece of memory has."""
    done = 0
    while done < len(memory):
        got = stream.readinto(memory[done : done + _BYTES_AT_ONCE])  # type: ignore[attr-defined]
        if not got:
            raise EOFError(f"EOF: reading array data, expected {len(memory)} bytes got {done}")
        done += got


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
