"""LAS and LAZ through laspy (extra ``las``): scale, offset, reference system and dimensions kept.

Normals, curvature and labels are extra dimensions named ``NormalX``, ``NormalY``, ``NormalZ``,
``Curvature`` and ``label``, the names PDAL knows where it has one. Extra dimensions that a file
came with keep their name, type, scale, offset, value for no data and description.
"""

import copy
import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.colors import WIDEN
from torchrg.io.columns import Spelling, flatten_cloud, slices
from torchrg.io.fields import Columns, Values, are_whole, assemble_cloud
from torchrg.io.files import (
    DAMAGES,
    asking_system,
    atomic_path,
    check_promise,
    first_line,
    refusing,
)
from torchrg.io.headers import LARGEST_INTEGER, check_grid, distance_outside
from torchrg.structures import Cloud, bounding_box

_SPELLING = Spelling(
    normals=("NormalX", "NormalY", "NormalZ"), curvature="Curvature", color_bits=16, blanks=True
)
_ASIDE = {
    **{name: f"normals_input_{i}" for i, name in enumerate(_SPELLING.normals)},
    _SPELLING.curvature: "curvature_input",
}
"""Names of columns that gave way to a result, where they do not end in ``_input`` alone."""
_POINTS_AT_ONCE = 1 << 20
"""Points that are read or written together. They take tens of megabytes."""
_WITH_COLOR = {0: 2, 1: 3, 4: 5, 6: 7, 9: 10}
"""By point format without colour, the one that adds it."""
_FIRST_LAYERED_FORMAT = 6
"""Point formats from here on are compressed field by field."""
_REPAIR = "convert it to .las with LASzip or PDAL, or copy it again"
"""Repair of a file that laspy does not read, which may be damaged or of a rare kind."""
_POINTWISE, _MAX_PACKING = 1, 3
"""LASzip's compressor without chunks, and the last version of its compression that lazrs reads."""
_CHUNK_SIZE_AT, _ITEMS_AT = 12, 32
"""Places in LASzip's record of the number of points of a chunk, and of the number of items, each of
which is a type, a size and a version."""
_PACKING = ("laszip encoded", "copc")
"""Owners of the records that say how the points lie in the file."""
_UNDESCRIBED = "Un-registered ExtraBytes"
"""Description that laspy gives to bytes that no record describes."""
_RANGE_BITS = 0b110
"""Bits of the options of an extra dimension that promise its least and its largest value."""
_UNFIT = "_value"
"""Ends the name of an extra dimension whose values the standard one of that name cannot hold."""
_UNFIT_DESCRIPTION = "more than the standard one holds"
"""Description of such a dimension, of at most 32 bytes. It tells ours from a dimension that another
program gave such a name."""
_VERSION_AT, _START_AT, _COUNT_AT, _EXTENDED_AT, _COUNT14_AT = 25, 96, 107, 235, 247
"""Places in the header: minor version, first byte of points and number of records, number of
points, extended records, and the number of points of 64 bits that version 1.4 has beside the old
one, which may be 0 there."""
_DATE_AT, _DATE_BYTES = 90, 4
"""Place in the header of the day and the year of creation, and how many bytes they are."""


def read_las(path: Path, size: int) -> Cloud:
    """Read a LAS, LAZ or COPC file.

    The cloud is float64, with every extra dimension and every standard one that is not zero
    everywhere; colours are uint8 where eight bits hold them, else uint16. The header is kept for
    writing.
    """
    laspy = _laspy("read")
    _check_header(path, size)
    with _reading(laspy, path) as reader:
        header = reader.header
        if header.point_count == 0:
            raise FormatError(
                f"{path}: expected at least one point, got none; check where it comes from."
            )
        check_grid(path, "x, y, z", header.scales, header.offsets)
        for dimension in header.point_format.extra_dimensions:
            if dimension.is_scaled:
                check_grid(path, dimension.name, dimension.scales, dimension.offsets)
        _check_points(path, header, size)
        # By parts, memory grows with the points that are there, whatever the header promises.
        parts = list(map(_columns, reader.chunk_iterator(_POINTS_AT_ONCE)))
    # How the points are packed is not about the points, and laspy cannot write an octree.
    for records in (header.vlrs, header.evlrs or []):
        records[:] = [r for r in records if r.user_id not in _PACKING]
    standard = set(header.point_format.standard_dimension_names)
    names = list(parts[0])
    unused = {n for n in names if n in standard and not any(chunk[n].any() for chunk in parts)}
    if not unused.issuperset(_SPELLING.color):
        unused.difference_update(_SPELLING.color)
    extra = header.point_format.extra_dimensions
    ours = {dim.name for dim in extra if dim.description == _UNFIT_DESCRIPTION}
    columns = {
        # Taken out of the parts, so that a column is not there twice for long.
        name.removesuffix(_UNFIT) if name in ours else name: np.concatenate(
            [chunk.pop(name) for chunk in parts]
        )
        for name in names
        if name not in unused
    }
    notes = _notes_on(header, columns, size)
    return assemble_cloud(path, columns, header={"las": header}, notes=notes)


def _notes_on(header: Any, columns: Columns, size: int) -> tuple[str, ...]:  # noqa: ANN401
    """Return what in a header contradicts the points, a line each."""
    notes = list[str]()
    low, high = ([end(columns[axis]) for axis in "xyz"] for end in (np.min, np.max))
    far = distance_outside(low, high, [header.mins, header.maxs], header.scales)
    if far:
        notes.append(
            f"its points lie up to {far:.3g} outside of the box in its header; check its scales, "
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
                f"{end - start:,} bytes after its last point left out, as its header counts no more"
            )
    for dimension in header.point_format.extra_dimensions:
        if dimension.description == _UNDESCRIBED:
            notes.append(
                f"bytes that its header does not describe are kept as {dimension.name}: "
                f"{dimension.num_bytes} of each point"
            )
    return tuple(notes)


@contextmanager
def _reading(laspy: ModuleType, path: Path) -> Iterator[Any]:
    """Open a reader; what is wrong with the file is an error that names it."""
    message = f"{path}: expected a LAS or LAZ file, got: "
    damages = (laspy.errors.LaspyException, *DAMAGES)
    try:
        # The parallel backend takes what memory a damaged table of chunks asks for.
        with (
            refusing(message, *damages, repair=f"; {_REPAIR}"),
            laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader,
        ):
            yield reader
    except BaseException as error:
        # A panic of lazrs, which is written in Rust, is no Exception and has no importable name.
        if type(error).__name__ != "PanicException":
            raise
        raise FormatError(
            f"{path}: expected whole compressed points, got: {first_line(error)}; {_REPAIR}."
        ) from error


def check_las(path: Path, cloud: Cloud | None) -> None:
    """Check that laspy is installed, and that all points of a cloud that is known are finite."""
    _laspy("write")
    lost = np.flatnonzero([] if cloud is None else ~cloud.finite)
    if len(lost):
        raise FormatError(
            f"{path}: expected finite coordinates, as LAS has no others, got {len(lost)} points "
            f"that are not (first: {lost[0]}); write .npz, .ply or .pcd."
        )


def write_las(path: Path, cloud: Cloud) -> None:
    """Write a LAS file, or a LAZ file if the suffix says so.

    If the cloud came from a LAS file, scale, offset, reference system and point format are kept;
    otherwise the scale is the smallest power of ten that the grid of 32 bits allows.
    """
    laspy = _laspy("write")
    columns = flatten_cloud(path, cloud, _SPELLING)
    has_date = "las" in cloud.header and cloud.header["las"].creation_date is not None
    header = _header(laspy, cloud, colored=all(name in columns for name in _SPELLING.color))
    columns = _add_dimensions(path, laspy, header, cloud, columns)
    errors = (laspy.errors.LaspyException, ValueError, ArithmeticError, RuntimeError)
    with (
        refusing(f"{path}: cannot be written: ", *errors),
        atomic_path(path) as beside,
        asking_system(beside, *errors),
    ):
        packed = path.suffix.lower() == ".laz"
        # laspy leaves a file open that it cannot end.
        with (
            beside.open("wb+") as file,
            laspy.open(file, mode="w", header=header, do_compress=packed, closefd=False) as writer,
        ):
            for rows in slices(len(cloud), _POINTS_AT_ONCE):
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
            _erase_date(beside)


def _header(laspy: ModuleType, cloud: Cloud, *, colored: bool) -> Any:  # noqa: ANN401
    """Return the header that the cloud came with, or a new one, without extra dimensions."""
    stored = cloud.header.get("las")
    if stored is None:
        header = laspy.LasHeader(version="1.4", point_format=7 if colored else 6)
        low, high = bounding_box(cloud.coordinates)
        middle = np.rint((low + high) / 2)
        step = max(float(np.spacing(np.abs(middle)).max()), 1e-30)
        reach = max(float(np.abs([low - middle, high - middle]).max()), step)
        header.offsets = middle
        header.scales = np.full(3, 10.0 ** math.ceil(math.log10(reach / LARGEST_INTEGER)))
        return header
    number = stored.point_format.id
    number = _WITH_COLOR.get(number, number) if colored else number
    least = laspy.LasHeader(point_format=number).version
    header = copy.deepcopy(stored)
    header.set_version_and_point_format(max(stored.version, least), laspy.PointFormat(number))
    return header


def _add_dimensions(
    path: Path,
    laspy: ModuleType,
    header: Any,  # noqa: ANN401
    cloud: Cloud,
    columns: Columns,
) -> dict[str, Values]:
    """Add to a header the extra dimensions that columns need, and return all dimensions by name.

    Those that the cloud came with keep type, scale and description as long as these hold its
    values exactly. A column that the standard dimension of its name cannot hold gets one more.
    """
    dimensions, params = dict[str, Values](), list[Any]()
    for extra in _own_dimensions(cloud.header.get("las"), columns):
        if extra.holds(columns):
            dimension = extra.dimension
            more = (dimension.description, dimension.offsets, dimension.scales, dimension.no_data)
            params.append(laspy.ExtraBytesParams(dimension.name, dimension.dtype, *more))
            dimensions[dimension.name] = extra.join(columns)
            columns = {name: c for name, c in columns.items() if name not in extra.columns}
    standard = set(header.point_format.dimension_names)
    for name, column in columns.items():
        if name in ("x", "y", "z"):
            continue
        if name in _SPELLING.color and column.dtype == np.uint8:
            column = column.astype(np.uint16) * WIDEN
        is_unfit = name in standard and not _holds(
            header.point_format.dimension_by_name(name), column
        )
        name = f"{name}{_UNFIT}" if is_unfit else name
        if name in ("X", "Y", "Z") or len(name.encode()) > 32:
            raise FormatError(
                f"{path}: expected names of at most 32 bytes other than X, Y, Z, got {name!r}; "
                "rename the field."
            )
        if name not in standard:
            description = _UNFIT_DESCRIPTION if is_unfit else ""
            params.append(laspy.ExtraBytesParams(name, column.dtype.str[1:], description))
        dimensions[name] = column
    header.add_extra_dims(params)
    _claim_no_ranges(header)
    return dimensions


class _Own(NamedTuple):
    """An extra dimension that the cloud came with.

    Attributes:
        dimension: What laspy says about it, under the name it is written by.
        columns: The columns of the cloud that are its elements.
    """

    dimension: Any
    columns: tuple[str, ...]

    def holds(self, columns: Columns) -> bool:
        """Whether the dimension, in its own type and scale, holds its columns exactly."""
        values, dimension = self.join(columns), self.dimension
        dtype = dimension.dtype.base
        if dimension.is_scaled:
            steps = np.rint((values - dimension.offsets) / dimension.scales)
            if not np.isfinite(steps).all():
                return False
            back = steps * dimension.scales + dimension.offsets
            return _fits(steps, dtype) and bool((back == values).all())
        return _fits(values, dtype)

    def join(self, columns: Columns) -> Values:
        """Return the values of the dimension, shape ``(N,)`` or ``(N, K)``."""
        parts = [columns[name] for name in self.columns]
        return parts[0] if len(parts) == 1 else np.stack(parts, axis=1)


def _own_dimensions(header: Any, columns: Columns) -> list[_Own]:  # noqa: ANN401
    """Return the extra dimensions of the file that a cloud came from, as far as it still has them.

    A field that was put aside for a result takes its dimension along, under its new name.
    """
    extras = list[_Own]()
    dimensions = [] if header is None else [*header.point_format.extra_dimensions]
    names = {dimension.name for dimension in dimensions}
    for dimension in dimensions:
        parts = list[str]()
        for column in _parts_of(dimension):
            aside = _ASIDE.get(column, f"{column}_input")
            parts.append(aside if aside in columns and aside not in names else column)
        if all(column in columns for column in parts):
            name = parts[0] if len(parts) == 1 else dimension.name
            extras.append(_Own(dimension._replace(name=name), tuple(parts)))
    return extras


def _parts_of(dimension: Any) -> list[str]:  # noqa: ANN401
    """Return the names of the columns that a dimension is read as."""
    name, count = dimension.name, dimension.num_elements
    return [name] if count == 1 else [f"{name}_{i}" for i in range(count)]


def _claim_no_ranges(header: Any) -> None:  # noqa: ANN401
    """Say nothing of the range of extra dimensions, for which laspy 2.7.0 takes a first value."""
    for record in header.vlrs.get("ExtraBytesVlr"):
        for described in record.extra_bytes_structs:
            # Without a type the same byte is the number of bytes.
            if described.data_type != 0:
                described.options &= ~_RANGE_BITS


def count_las(path: Path, size: int) -> int:
    """Return the number of points by the header, for which laspy need not be installed."""
    with path.open("rb") as stream:
        head = stream.read(_COUNT14_AT + 8)
    (count,) = struct.unpack_from("<I", head, _COUNT_AT)
    if head[_VERSION_AT] >= 4:
        (count,) = struct.unpack_from("<Q", head, _COUNT14_AT)
    return int(count)


def _laspy(verb: str) -> ModuleType:
    """Return the module."""
    return require("laspy", extra="las", purpose=f"{verb} LAS and LAZ files")


def _check_header(path: Path, size: int) -> None:
    """Check the numbers of records that laspy would otherwise loop over."""
    with path.open("rb") as stream:
        head = stream.read(255)
        if head[:4] != b"LASF" or len(head) < 227:
            raise FormatError(f"{path}: byte 0: expected the header of a LAS file; {_REPAIR}.")
        start, num_records = struct.unpack_from("<II", head, _START_AT)
        check_promise(path, _START_AT, start, "what comes before points", available=size)
        check_promise(path, _START_AT + 4, 54 * num_records, "header records", available=size)
        if head[_VERSION_AT] < 4 or len(head) < 247:
            return
        start, num_extended = struct.unpack_from("<QI", head, _EXTENDED_AT)
        content = f"{num_extended:,} extended header records"
        for _ in range(num_extended):
            check_promise(path, start, 60, content, available=size - start)
            stream.seek(start)
            (length,) = struct.unpack_from("<Q", stream.read(60), 20)
            start += 60
            check_promise(path, start, length, content, available=size - start)
            start += length


def _check_points(path: Path, header: Any, size: int) -> None:  # noqa: ANN401
    """Check the number of points."""
    start, content = header.offset_to_point_data, f"{header.point_count:,} points"
    least = 0 if header.are_points_compressed else header.point_count * header.point_format.size
    check_promise(path, start, least, content, available=size - start)
    if header.are_points_compressed:
        _check_chunks(path, header, size)


def _check_chunks(path: Path, header: Any, size: int) -> None:  # noqa: ANN401
    """Check how points are compressed, and the number of chunks.

    lazrs ends the process if memory for them fails.
    """
    start = header.offset_to_point_data
    lazrs = require("lazrs", extra="las", purpose="read LAZ files")
    (record,) = header.vlrs.get("LasZipVlr")
    (compressor,) = struct.unpack_from("<H", record.record_data)
    (num_items,) = struct.unpack_from("<H", record.record_data, _ITEMS_AT)
    items = np.frombuffer(record.record_data, "<u2", 3 * num_items, _ITEMS_AT + 2).reshape(-1, 3)
    version = int(items[:, 2].max(initial=0))
    if version > _MAX_PACKING:
        raise FormatError(
            f"{path}: expected LAZ of compression version {_MAX_PACKING} or below, got {version}; "
            "convert it to .las with LASzip or PDAL."
        )
    if items[:, 1].sum() != header.point_format.size:
        raise FormatError(
            f"{path}: expected compressed fields of {header.point_format.size} bytes a point, got "
            f"{items[:, 1].sum()}; {_REPAIR}."
        )
    if compressor == _POINTWISE:
        # LASzip does not look at the size of chunks then; lazrs takes some values for a table.
        data = bytearray(record.record_data)
        struct.pack_into("<I", data, _CHUNK_SIZE_AT, LARGEST_INTEGER)
        record.record_data = bytes(data)
        return
    with path.open("rb") as stream:
        stream.seek(start)
        offset = int.from_bytes(stream.read(8), "little", signed=True)
        if offset == -1:
            # The writer could not go back to the beginning, so the offset is at the end.
            stream.seek(size - 8)
            offset = int.from_bytes(stream.read(8), "little", signed=True)
        content = "the table of chunks"
        if offset < 0:
            raise FormatError(f"{path}: byte {start}: expected the place of {content}; {_REPAIR}.")
        check_promise(path, offset, 8, content, available=size - offset)
        stream.seek(offset)
        _, num_chunks = struct.unpack("<II", stream.read(8))
        # The first point of a chunk is stored as it is.
        least, content = num_chunks * header.point_format.size, f"{num_chunks:,} chunks"
        check_promise(path, offset + 4, least, content, available=size, at_least=True)
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
    """Check the sizes of the layers of each chunk, each of which lazrs takes memory for.

    Check the sum of the numbers of points that the chunks say they hold, too.
    """
    point_format, num_points = header.point_format, 0
    # Nine for the fields all points have, one for colour, one for near infrared, one for waves.
    num_layers = 9 + {6: 0, 7: 1, 8: 2, 9: 1, 10: 3}[point_format.id]
    num_layers += point_format.num_extra_bytes
    start = header.offset_to_point_data + 8
    # Writers that end a chunk themselves leave an empty one behind the last.
    for num_bytes in filter(None, chunks):
        # A whole point and the number of points come first.
        place = start + point_format.size + 4
        stream.seek(place - 4)
        num_points += int.from_bytes(stream.read(4), "little")
        sizes = np.frombuffer(stream.read(4 * num_layers), "<u4")
        total = int(sizes.sum(dtype=np.uint64))
        # lazrs goes on where the layers end, wherever the table says that the next chunk begins.
        used = place + sizes.nbytes - start
        check_promise(path, place, total, "the layers of a chunk", available=num_bytes - used)
        start += used + total
    if num_points != header.point_count:
        raise FormatError(
            f"{path}: expected {header.point_count:,} points, as its header says, got "
            f"{num_points:,} in its chunks; {_REPAIR}."
        )


def _columns(block: Any) -> dict[str, Values]:  # noqa: ANN401
    """Return the dimensions of a block of points."""
    columns = {axis: np.asarray(block[axis]) for axis in "xyz"}
    for dimension in block.point_format.dimensions:
        values = np.asarray(block[dimension.name])
        if dimension.name in ("X", "Y", "Z"):
            continue
        parts = [values] if values.ndim == 1 else values.T
        columns |= dict(zip(_parts_of(dimension), parts, strict=True))
    return columns


def _holds(dimension: Any, column: Values) -> bool:  # noqa: ANN401
    """Whether a standard dimension holds all values of a column exactly."""
    if dimension.dtype is not None:
        return _fits(column, dimension.dtype)
    return _fits(column, np.dtype(np.uint8)) and bool(column.max() <= dimension.max)


def _fits(values: Values, dtype: np.dtype[Any]) -> bool:
    """Whether a type holds all values exactly."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return np.array_equal(values.astype(dtype), values, equal_nan=values.dtype.kind == "f")
    held = np.iinfo(dtype)
    return are_whole(values) and bool(values.min() >= held.min and values.max() <= held.max)


def _erase_date(path: Path) -> None:
    """Set the date of creation to none; laspy writes the day, so that equal runs would differ."""
    with path.open("rb+") as stream:
        stream.seek(_DATE_AT)
        stream.write(bytes(_DATE_BYTES))
