"""LAS and LAZ files, based on laspy (extra ``las``).

Scale, offset, reference system and dimensions are preserved. Normals, curvature and labels are
extra dimensions ``NormalX``, ``NormalY``, ``NormalZ``, ``Curvature`` (PDAL's names) and ``label``.
Extra dimensions of the input keep name, type, scale, offset, no-data value and description.
"""

import copy
import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from torchrg import scratch
from torchrg._optional import require
from torchrg._parallel import split_rows
from torchrg.errors import FormatError
from torchrg.io.columns import FieldNames, flatten_cloud
from torchrg.io.fields import NamedColumns, assemble_cloud, check_coordinates
from torchrg.io.files import (
    PARSE_ERRORS,
    atomic_path,
    check_available,
    first_line,
    raise_os_error,
    wrap_errors,
)
from torchrg.io.headers import MAX_INTEGER, check_grid, distance_outside
from torchrg.structures import Cloud
from torchrg.structures.colors import WIDEN
from torchrg.structures.points import Array, are_integers, bounding_box

_FIELD_NAMES = FieldNames(
    normals=("NormalX", "NormalY", "NormalZ"), curvature="Curvature", color_bits=16, blanks=True
)
_BACKUP_NAMES = {
    **{name: f"normals_input_{i}" for i, name in enumerate(_FIELD_NAMES.normals)},
    _FIELD_NAMES.curvature: "curvature_input",
}
"""Backup names of columns that a result replaces, if they are not the name plus ``_input``."""
_STEPS = "X"
"""Column of the coordinates in all three axes; no other dimension has this name."""
_POINTS_PER_CHUNK = 1 << 20
"""Points read or written together. They take tens of megabytes."""
_COLOR_FORMATS = {0: 2, 1: 3, 4: 5, 6: 7, 9: 10}
"""Point format that adds color, by point format without color."""
_FIRST_LAYERED_FORMAT = 6
"""First point format that is compressed field by field."""
_REPAIR = "convert it to .las with LASzip or PDAL, or copy it again"
"""Fix for a file that laspy cannot read, because it is corrupt or uses a rare feature."""
_POINTWISE, _MAX_LAZ_VERSION = 1, 3
"""LASzip's compressor without chunks, and the latest compression version that lazrs reads."""
_CHUNK_SIZE_AT, _ITEMS_AT = 12, 32
"""Offsets in LASzip's record of the chunk size, and of the number of items: type, size, version."""
_UNDOCUMENTED = "Un-registered ExtraBytes"
"""Description that laspy gives to undocumented extra bytes."""
_RANGE_BITS = 0b110
"""Option bits of an extra dimension that declare its minimum and maximum."""
_WIDE_SUFFIX = "_value"
"""Suffix of an extra dimension whose values do not fit the standard dimension of that name."""
_WIDE_DESCRIPTION = "more than the standard one holds"
"""Description of such a dimension, at most 32 bytes. It marks dimensions written by torchrg."""
_VERSION_AT, _START_AT, _COUNT_AT, _EXTENDED_AT, _COUNT14_AT = 25, 96, 107, 235, 247
"""Header offsets: minor version; start of points and number of records; number of points; extended
records; the 64-bit number of points of version 1.4, in which the old number may be 0."""
_DATE_AT, _DATE_BYTES = 90, 4
"""Header offset of the day and year of creation, and their size in bytes."""


def read_las(path: Path, size: int) -> Cloud:
    """Read a LAS, LAZ or COPC file.

    The cloud is float64, with every extra dimension and every standard dimension that is not all
    zero; colors are uint8 if 8 bits are enough, else uint16. The header is kept for writing.
    """
    laspy = require("laspy", extra="las", purpose="read LAS and LAZ files")
    _check_header(path, size)
    with _open_reader(laspy, path) as reader:
        header = reader.header
        check_coordinates(path, (header.point_count, 3), np.dtype(np.float64))
        check_grid(path, "x, y, z", header.scales, header.offsets)
        for dimension in header.point_format.extra_dimensions:
            if dimension.is_scaled:
                check_grid(path, dimension.name, dimension.scales, dimension.offsets)
        start, is_laz = header.offset_to_point_data, header.are_points_compressed
        min_bytes = 0 if is_laz else header.point_count * header.point_format.size
        content = f"{header.point_count:,} points"
        check_available(path, start, min_bytes, content, available=size - start)
        if is_laz:
            _check_chunks(path, header, size)
        # Reading in chunks bounds the memory by the stored points, whatever the header claims.
        parts = list(map(_chunk_columns, reader.chunk_iterator(_POINTS_PER_CHUNK)))
    # Compression does not matter for the cloud, and laspy cannot write an octree.
    for records in (header.vlrs, header.evlrs or []):
        records[:] = [r for r in records if r.user_id not in ("laszip encoded", "copc")]
    standard = set(header.point_format.standard_dimension_names)
    coordinates = _join_coordinates([chunk.pop(_STEPS) for chunk in parts], header)
    names = list(parts[0])
    unused = {n for n in names if n in standard and not any(chunk[n].any() for chunk in parts)}
    if not unused.issuperset(_FIELD_NAMES.color):
        unused.difference_update(_FIELD_NAMES.color)
    extra = header.point_format.extra_dimensions
    wide = {dim.name for dim in extra if dim.description == _WIDE_DESCRIPTION}
    columns = {
        # Popped from the parts, so that a column is not stored twice for long.
        name.removesuffix(_WIDE_SUFFIX) if name in wide else name: scratch.join(
            [chunk.pop(name) for chunk in parts]
        )
        for name in names
        if name not in unused
    }
    notes = _header_notes(header, coordinates, size)
    columns[_STEPS] = coordinates
    return assemble_cloud(path, columns, coordinates=_STEPS, header={"las": header}, notes=notes)


def _join_coordinates(parts: Sequence[NDArray[np.int32]], header: Any) -> NDArray[np.float64]:  # noqa: ANN401
    """Return the coordinates ``(N, 3)`` of chunks of integer steps ``(n, 3)``."""
    coordinates, start = scratch.empty((sum(map(len, parts)), 3), np.float64), 0
    for steps in parts:
        rows = coordinates[start : start + len(steps)]
        np.multiply(steps, header.scales, out=rows)
        rows += header.offsets
        start += len(steps)
    return coordinates


def _header_notes(header: Any, coordinates: Array, size: int) -> tuple[str, ...]:  # noqa: ANN401
    """Return notes on contradictions between a header and its points."""
    notes, box = list[str](), [header.mins, header.maxs]
    distance = distance_outside(*bounding_box(coordinates), box, header.scales)
    if distance:
        notes.append(
            f"its points lie up to {distance:.3g} outside the box in its header; check its scales, "
            "offsets and number of points"
        )
    count, returns = header.point_count, int(header.number_of_points_by_return.sum())
    if returns not in (0, count):
        notes.append(f"its header counts {count:,} points, but {returns:,} returns")
    if not header.are_points_compressed:
        start = header.offset_to_point_data + count * header.point_format.size
        evlrs = header.start_of_first_evlr if header.number_of_evlrs else size
        end = min(evlrs, header.start_of_waveform_data_packet_record or size)
        if end - start >= header.point_format.size:
            notes.append(
                f"{end - start:,} bytes after its last point are ignored, beyond its header's count"
            )
    for dimension in header.point_format.extra_dimensions:
        if dimension.description == _UNDOCUMENTED:
            notes.append(
                f"bytes that its header does not describe are read as {dimension.name}: "
                f"{dimension.num_bytes} of each point"
            )
    return tuple(notes)


@contextmanager
def _open_reader(laspy: ModuleType, path: Path) -> Iterator[Any]:
    """Open a reader, and convert its errors to errors that name the file."""
    message = f"{path}: expected a LAS or LAZ file, got: "
    errors = (laspy.errors.LaspyException, *PARSE_ERRORS)
    try:
        # The parallel backend allocates any amount of memory that a corrupt chunk table requests.
        with (
            wrap_errors(message, *errors, repair=f"; {_REPAIR}"),
            laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader,
        ):
            yield reader
    except BaseException as error:
        # A panic of lazrs (written in Rust) is not an Exception and cannot be imported.
        if type(error).__name__ != "PanicException":
            raise
        raise FormatError(f"{path}: cannot decompress: {first_line(error)}; {_REPAIR}.") from error


def check_las(path: Path, cloud: Cloud | None) -> None:
    """Check that laspy is installed, and that the points of a known cloud are finite."""
    require("laspy", extra="las", purpose="write LAS and LAZ files")
    non_finite = np.flatnonzero([] if cloud is None else ~cloud.finite)
    if len(non_finite):
        raise FormatError(
            f"{path}: expected finite coordinates for LAS, got {len(non_finite)} non-finite "
            f"points (first: {non_finite[0]}); write .npz, .ply or .pcd."
        )


def write_las(path: Path, cloud: Cloud) -> None:
    """Write a LAS file, or a LAZ file if the suffix is ``.laz``.

    Scale, offset, reference system and point format of a LAS input are kept. Otherwise the scale is
    the smallest power of ten for which the coordinates fit 32 bits.
    """
    laspy = require("laspy", extra="las", purpose="write LAS and LAZ files")
    columns = flatten_cloud(path, cloud, _FIELD_NAMES)
    has_date = "las" in cloud.header and cloud.header["las"].creation_date is not None
    header = _header(laspy, cloud, colored=all(name in columns for name in _FIELD_NAMES.color))
    columns = _add_dimensions(path, laspy, header, cloud, columns)
    errors = (laspy.errors.LaspyException, ValueError, ArithmeticError, RuntimeError)
    with (
        wrap_errors(f"{path}: cannot be written: ", *errors),
        atomic_path(path) as temporary,
        raise_os_error(temporary, *errors),
    ):
        is_laz = path.suffix.lower() == ".laz"
        # laspy does not close a file that it fails to complete.
        with (
            temporary.open("wb+") as file,
            laspy.open(file, mode="w", header=header, do_compress=is_laz, closefd=False) as writer,
        ):
            for rows in split_rows(len(cloud), _POINTS_PER_CHUNK):
                points = cloud.coordinates[rows].astype(np.float64, copy=False)
                record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
                data = laspy.LasData(header, record)
                data.x, data.y, data.z = points.T
                for name, column in columns.items():
                    data[name] = column[rows]
                writer.write_points(data.points)
            if header.version.minor >= 4 and header.evlrs is not None:
                writer.write_evlrs(header.evlrs)
        if not has_date:
            # Identical runs produce byte-identical files.
            with temporary.open("rb+") as stream:
                stream.seek(_DATE_AT)
                stream.write(bytes(_DATE_BYTES))


def _header(laspy: ModuleType, cloud: Cloud, *, colored: bool) -> Any:  # noqa: ANN401
    """Return the input's header or a new one, without extra dimensions."""
    stored = cloud.header.get("las")
    if stored is None:
        header = laspy.LasHeader(version="1.4", point_format=7 if colored else 6)
        low, high = bounding_box(cloud.coordinates)
        center = np.rint((low + high) / 2)
        step = max(float(np.spacing(np.abs(center)).max()), 1e-30)
        reach = max(float(np.abs([low - center, high - center]).max()), step)
        header.offsets = center
        header.scales = np.full(3, 10.0 ** math.ceil(math.log10(reach / MAX_INTEGER)))
        return header
    number = stored.point_format.id
    number = _COLOR_FORMATS.get(number, number) if colored else number
    min_version = laspy.LasHeader(point_format=number).version
    header = copy.deepcopy(stored)
    header.set_version_and_point_format(max(stored.version, min_version), laspy.PointFormat(number))
    return header


def _add_dimensions(
    path: Path,
    laspy: ModuleType,
    header: Any,  # noqa: ANN401
    cloud: Cloud,
    columns: NamedColumns,
) -> dict[str, Array]:
    """Add the extra dimensions that the columns need to a header, and return dimensions by name.

    Input dimensions keep type, scale and description if these represent the values exactly. A
    column that does not fit the standard dimension of its name becomes an extra dimension.
    """
    dimensions, params = dict[str, Array](), list[Any]()
    stored = cloud.header.get("las")
    extras = [] if stored is None else [*stored.point_format.extra_dimensions]
    free = columns.keys() - {d.name for d in extras}
    for d in extras:
        # A renamed field that a result replaces keeps its dimension, under the new name.
        backups = {name: _BACKUP_NAMES.get(name, f"{name}_input") for name in _column_names(d)}
        names = [backup if backup in free else name for name, backup in backups.items()]
        if not columns.keys() >= {*names}:
            continue
        parts, is_single = [columns[name] for name in names], len(names) == 1
        values = parts[0] if is_single else np.stack(parts, axis=1)
        name = names[0] if is_single else d.name
        if _extra_holds(d, values):
            parameters = (name, d.dtype, d.description, d.offsets, d.scales, d.no_data)
            params.append(laspy.ExtraBytesParams(*parameters))
            dimensions[name] = values
            columns = {name: c for name, c in columns.items() if name not in names}
    standard = set(header.point_format.dimension_names)
    for name, column in columns.items():
        if name in ("x", "y", "z"):
            continue
        if name in _FIELD_NAMES.color and column.dtype == np.uint8:
            column = column.astype(np.uint16) * WIDEN
        is_wide = name in standard and not _dimension_holds(
            header.point_format.dimension_by_name(name), column
        )
        name = f"{name}{_WIDE_SUFFIX}" if is_wide else name
        if name in ("X", "Y", "Z") or len(name.encode()) > 32:
            raise FormatError(
                f"{path}: expected names of at most 32 bytes, not X, Y, Z, got {name!r}; rename it."
            )
        if name not in standard:
            description = _WIDE_DESCRIPTION if is_wide else ""
            params.append(laspy.ExtraBytesParams(name, column.dtype.str[1:], description))
        dimensions[name] = column
    header.add_extra_dims(params)
    # laspy 2.7.0 sets ranges from the first value; the options of undocumented bytes are a number.
    for record in header.vlrs.get("ExtraBytesVlr"):
        for structure in record.extra_bytes_structs:
            if structure.data_type != 0:
                structure.options &= ~_RANGE_BITS
    return dimensions


def _extra_holds(dimension: Any, values: Array) -> bool:  # noqa: ANN401
    """Whether the type and scale of an extra dimension represent all values exactly."""
    dtype = dimension.dtype.base
    if not dimension.is_scaled:
        return _fits(values, dtype)
    steps = np.rint((values - dimension.offsets) / dimension.scales)
    if not np.isfinite(steps).all():
        return False
    back = steps * dimension.scales + dimension.offsets
    return _fits(steps, dtype) and bool((back == values).all())


def _column_names(dimension: Any) -> list[str]:  # noqa: ANN401
    """Return the column names of a dimension."""
    name, count = dimension.name, dimension.num_elements
    return [name] if count == 1 else [f"{name}_{i}" for i in range(count)]


def count_las(path: Path, size: int) -> int:
    """Return the number of points from the header; laspy is not needed."""
    _check_header(path, size)
    with path.open("rb") as stream:
        head = stream.read(_COUNT14_AT + 8)
    (count,) = struct.unpack_from("<I", head, _COUNT_AT)
    if head[_VERSION_AT] >= 4:
        (count,) = struct.unpack_from("<Q", head, _COUNT14_AT)
    return int(count)


def _check_header(path: Path, size: int) -> None:
    """Check the record counts of the header, over which laspy would loop."""
    with path.open("rb") as stream:
        head = stream.read(255)
        if head[:4] != b"LASF" or len(head) < 227:
            raise FormatError(f"{path}: byte 0: expected the header of a LAS file; {_REPAIR}.")
        start, num_records = struct.unpack_from("<II", head, _START_AT)
        check_available(path, _START_AT, start, "the data before its points", available=size)
        check_available(path, _START_AT + 4, 54 * num_records, "header records", available=size)
        if head[_VERSION_AT] < 4 or len(head) < 247:
            return
        start, num_extended = struct.unpack_from("<QI", head, _EXTENDED_AT)
        content = f"{num_extended:,} extended header records"
        for _ in range(num_extended):
            check_available(path, start, 60, content, available=size - start)
            stream.seek(start)
            (length,) = struct.unpack_from("<Q", stream.read(60), 20)
            start += 60
            check_available(path, start, length, content, available=size - start)
            start += length


def _check_chunks(path: Path, header: Any, size: int) -> None:  # noqa: ANN401
    """Check the compression and the number of chunks.

    lazrs aborts the process if it cannot allocate the chunks.
    """
    start = header.offset_to_point_data
    lazrs = require("lazrs", extra="las", purpose="read LAZ files")
    (record,) = header.vlrs.get("LasZipVlr")
    (compressor,) = struct.unpack_from("<H", record.record_data)
    (num_items,) = struct.unpack_from("<H", record.record_data, _ITEMS_AT)
    items = np.frombuffer(record.record_data, "<u2", 3 * num_items, _ITEMS_AT + 2).reshape(-1, 3)
    version = int(items[:, 2].max(initial=0))
    if version > _MAX_LAZ_VERSION:
        raise FormatError(
            f"{path}: expected LAZ compression version {_MAX_LAZ_VERSION} or below, got {version}; "
            "convert it to .las with LASzip or PDAL."
        )
    if items[:, 1].sum() != header.point_format.size:
        raise FormatError(
            f"{path}: expected compressed points of {header.point_format.size} bytes, got "
            f"{items[:, 1].sum()}; {_REPAIR}."
        )
    if compressor == _POINTWISE:
        # LASzip ignores the chunk size then; lazrs interprets some values as variable chunks.
        data = bytearray(record.record_data)
        struct.pack_into("<I", data, _CHUNK_SIZE_AT, MAX_INTEGER)
        record.record_data = bytes(data)
        return
    with path.open("rb") as stream:
        stream.seek(start)
        offset = int.from_bytes(stream.read(8), "little", signed=True)
        if offset == -1:
            # A writer that could not seek back stores the offset at the end of the file.
            stream.seek(size - 8)
            offset = int.from_bytes(stream.read(8), "little", signed=True)
        content = "the table of chunks"
        if offset < 0:
            raise FormatError(f"{path}: byte {start}: expected the offset of {content}; {_REPAIR}.")
        check_available(path, offset, 8, content, available=size - offset)
        stream.seek(offset)
        _, num_chunks = struct.unpack("<II", stream.read(8))
        # The first point of a chunk is uncompressed.
        min_bytes, content = num_chunks * header.point_format.size, f"{num_chunks:,} chunks"
        check_available(path, offset + 4, min_bytes, content, available=size, at_least=True)
        layout = lazrs.LazVlr(record.record_data)
        if layout.chunk_size() * num_chunks < header.point_count:
            raise FormatError(
                f"{path}: byte {offset}: expected chunks for {header.point_count:,} points, got "
                f"{num_chunks:,} of {layout.chunk_size():,}; {_REPAIR}."
            )
        stream.seek(start)
        table = lazrs.read_chunk_table(stream, layout)
        if header.point_format.id >= _FIRST_LAYERED_FORMAT:
            _check_layers(path, stream, header, [num_bytes for _, num_bytes in table])


def _check_layers(path: Path, stream: BinaryIO, header: Any, chunks: list[int]) -> None:  # noqa: ANN401
    """Check the layer sizes of each chunk, which lazrs allocates.

    Also check the total number of points in the chunks.
    """
    point_format, num_points = header.point_format, 0
    # Nine layers of common fields, one each for color, near infrared and waveforms.
    num_layers = 9 + {6: 0, 7: 1, 8: 2, 9: 1, 10: 3}[point_format.id]
    num_layers += point_format.num_extra_bytes
    start = header.offset_to_point_data + 8
    # Writers that finish chunks themselves leave an empty last chunk.
    for num_bytes in filter(None, chunks):
        # A chunk starts with an uncompressed point and the number of points.
        offset = start + point_format.size + 4
        stream.seek(offset - 4)
        num_points += int.from_bytes(stream.read(4), "little")
        sizes = np.frombuffer(stream.read(4 * num_layers), "<u4")
        total = int(sizes.sum(dtype=np.uint64))
        # lazrs continues where the layers end, regardless of the offsets in the chunk table.
        used = offset + sizes.nbytes - start
        check_available(path, offset, total, "the layers of a chunk", available=num_bytes - used)
        start += used + total
    if num_points != header.point_count:
        raise FormatError(
            f"{path}: expected {header.point_count:,} points by its header, got "
            f"{num_points:,} in its chunks; {_REPAIR}."
        )


def _chunk_columns(block: Any) -> dict[str, Array]:  # noqa: ANN401
    """Return the columns of a chunk of points, and its coordinates in steps of the scale."""
    steps = np.stack([block[axis] for axis in "XYZ"], axis=1)
    columns: dict[str, Array] = {_STEPS: scratch.store(steps)}
    for dimension in block.point_format.dimensions:
        if dimension.name.upper() in ("X", "Y", "Z"):
            continue
        values = np.asarray(block[dimension.name])
        parts = [values] if values.ndim == 1 else values.T
        columns |= dict(zip(_column_names(dimension), map(_compact, parts), strict=True))
    return columns


def _compact(values: Array) -> Array:
    """Return a copy that does not keep the packed points, and takes no memory if all are zero."""
    zeros = np.broadcast_to(values.dtype.type(0), values.shape)
    return scratch.join([values]) if values.any() else zeros


def _dimension_holds(dimension: Any, column: Array) -> bool:  # noqa: ANN401
    """Whether a standard dimension represents all values of a column exactly."""
    if dimension.dtype is not None:
        return _fits(column, dimension.dtype)
    return _fits(column, np.dtype(np.uint8)) and bool(column.max() <= dimension.max)


def _fits(values: Array, dtype: np.dtype[Any]) -> bool:
    """Whether a type represents all values exactly."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return np.array_equal(values.astype(dtype), values, equal_nan=values.dtype.kind == "f")
    limits = np.iinfo(dtype)
    return are_integers(values) and bool(values.min() >= limits.min and values.max() <= limits.max)
