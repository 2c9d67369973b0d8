"""LAS and LAZ through laspy (extra ``las``): scale, offset, reference system and dimensions kept.

Normals, curvature and labels are extra dimensions named ``NormalX``, ``NormalY``, ``NormalZ``,
``Curvature`` and ``label``, the names PDAL knows where it has one. Extra dimensions that a file
came with keep their name, type, scale, offset, value for no data and description.
"""

import copy
import math
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.columns import Limits, Spelling, flatten_cloud, merge_limits, spell
from torchrg.io.fields import WIDEN, Columns, Naming, are_whole, name_aside, sources_of
from torchrg.io.files import (
    DAMAGES,
    asking_system,
    atomic_path,
    check_promise,
    first_line,
    refusing,
)
from torchrg.io.stream import POINTS_A_CHUNK, CloudStream, Table
from torchrg.structures import Cloud

_SPELLING = Spelling(
    normals=("NormalX", "NormalY", "NormalZ"), curvature="Curvature", color_bits=16, blanks=True
)
_WITH_COLOR = {0: 2, 1: 3, 4: 5, 6: 7, 9: 10}
"""By point format without colour, the one that adds it."""
_FIRST_LAYERED_FORMAT = 6
"""Point formats from here on are compressed field by field."""
_PACKING = ("laszip encoded", "copc")
"""Owners of the records that say how the points lie in the file."""
_RANGE_BITS = 0b110
"""Bits of the options of an extra dimension that promise its least and its largest value."""
_UNFIT = "_value"
"""Ends the name of an extra dimension whose values the standard one of that name cannot hold."""
_UNFIT_DESCRIPTION = "more than the standard one holds"
"""Description of such a dimension, of at most 32 bytes. It tells ours from a dimension that another
program gave such a name."""
LARGEST_INTEGER = 2**31 - 1
"""Largest coordinate of a LAS file, in steps of its scale from its offset."""
_VERSION_AT, _RECORDS_AT, _COUNT_AT, _EXTENDED_AT, _COUNT14_AT = 25, 100, 107, 235, 247
"""Places in the header: minor version, number of records, of points, extended records, and the
number of points of 64 bits that version 1.4 has beside the old one, which may be 0 there."""
_DATE_AT, _DATE_BYTES = 90, 4
"""Place in the header of the day and the year of creation, and how many bytes they are."""


def open_las(path: Path, size: int) -> Table:
    """Open a LAS, LAZ or COPC file.

    The cloud is float64, with every extra dimension and every standard one that is not zero
    everywhere; colours are uint8 where eight bits hold them, else uint16. The header is kept for
    writing.
    """
    laspy = _laspy("read")
    _check_header(path, size)
    with _reading(laspy, path) as reader:
        header = reader.header
        _check_points(path, header, size)
    if header.point_count == 0:
        raise FormatError(f"{path}: expected at least one point, got none; fetch the file again.")
    # How the points are packed is not about the points, and laspy cannot write an octree.
    for records in (header.vlrs, header.evlrs or []):
        records[:] = [r for r in records if r.user_id not in _PACKING]

    def read(chunk_size: int) -> Iterator[Columns]:
        with _reading(laspy, path) as reader:
            yield from map(_columns, reader.chunk_iterator(chunk_size))

    standard = set(header.point_format.standard_dimension_names)
    extra = header.point_format.extra_dimensions
    ours = {dim.name for dim in extra if dim.description == _UNFIT_DESCRIPTION}

    def facts(columns: Columns) -> set[str]:
        return {name for name in standard if name in columns and columns[name].any()}

    def names(columns: Collection[str], used: Collection[str]) -> dict[str, str]:
        unused = _unused(columns, standard, used)
        return {
            name.removesuffix(_UNFIT) if name in ours else name: name
            for name in columns
            if name not in unused
        }

    naming = Naming(facts, names)
    # By chunks, memory grows with the points that are there, whatever the header promises.
    return Table(read, header.point_count, POINTS_A_CHUNK, naming, header={"las": header})


@contextmanager
def _reading(laspy: Any, path: Path) -> Iterator[Any]:  # noqa: ANN401
    """Open a reader; what is wrong with the file is an error that names it."""
    message = f"{path}: expected a LAS or LAZ file, got: "
    damages = (laspy.errors.LaspyException, *DAMAGES)
    try:
        # The parallel backend takes what memory a damaged table of chunks asks for.
        with (
            refusing(message, *damages, repair="; fetch it again"),
            laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader,
        ):
            yield reader
    except BaseException as error:
        # A panic of lazrs, which is written in Rust, is no Exception and has no importable name.
        if type(error).__name__ != "PanicException":
            raise
        raise FormatError(
            f"{path}: expected whole compressed points, got: {first_line(error)}; fetch it again."
        ) from error


def check_las(path: Path, cloud: Cloud | CloudStream | None) -> None:
    """Check that laspy is installed, and that all points of a cloud that is known are finite."""
    _laspy("write")
    num_before, num_lost, first = 0, 0, 0
    for chunk in [cloud] if isinstance(cloud, Cloud) else cloud or ():
        lost = np.flatnonzero(~chunk.finite)
        if len(lost) and not num_lost:
            first = num_before + int(lost[0])
        num_lost += len(lost)
        num_before += len(chunk)
    if num_lost:
        raise FormatError(
            f"{path}: expected finite coordinates, as LAS has no others, got {num_lost} points "
            f"that are not (first: {first}); write .npz, .ply or .pcd."
        )


def write_las(path: Path, stream: CloudStream) -> None:
    """Write a LAS file, or a LAZ file if the suffix says so.

    If the cloud came from a LAS file, scale, offset, reference system and point format are kept;
    otherwise the scale is the smallest power of ten that the grid of 32 bits allows.
    """
    laspy = _laspy("write")
    plan = _plan(path, laspy, stream)
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
            laspy.open(
                file, mode="w", header=plan.header, do_compress=packed, closefd=False
            ) as writer,
        ):
            for chunk in stream:
                record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=plan.header)
                data = laspy.LasData(plan.header, record)
                data.x, data.y, data.z = chunk.coordinates.T.astype(np.float64)
                for name, column in plan.columns(path, chunk).items():
                    data[name] = column
                writer.write_points(data.points)
            if plan.header.version.minor >= 4 and plan.header.evlrs is not None:
                writer.write_evlrs(plan.header.evlrs)
        if not plan.has_date:
            _erase_date(beside)


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

    def join(self, columns: Columns) -> NDArray[Any]:
        """Return the values of the dimension, shape ``(N,)`` or ``(N, K)``."""
        parts = [columns[name] for name in self.columns]
        return parts[0] if len(parts) == 1 else np.stack(parts, axis=1)


class _Plan(NamedTuple):
    """What has to be known of all points before the first is written.

    The header holds the extra dimensions, of which ``own`` are those that the cloud came with;
    ``unfit`` are the columns that the standard dimension of their name cannot hold; without a date,
    that of the day is erased.
    """

    header: Any
    has_date: bool
    unfit: set[str]
    limits: dict[str, Limits]
    own: list[_Own]

    def columns(self, path: Path, chunk: Cloud) -> dict[str, NDArray[Any]]:
        """Return the dimensions of a chunk but for its coordinates."""
        columns = flatten_cloud(path, chunk, _SPELLING, self.limits)
        joined = {own.dimension.name: own.join(columns) for own in self.own}
        taken = {name for own in self.own for name in own.columns}
        others = {name: column for name, column in columns.items() if name not in taken}
        return joined | _fitted(path, others, self.unfit)


def _plan(path: Path, laspy: Any, stream: CloudStream) -> _Plan:  # noqa: ANN401
    """Look at all points for what the header has to say of them."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    unfit, limits = set[str](), dict[str, Limits]()
    for number, chunk in enumerate(stream):
        columns = flatten_cloud(path, chunk, _SPELLING)
        if number == 0:
            colored = all(name in columns for name in _SPELLING.color)
            header, has_date = _header(laspy, stream, colored=colored)
            own = _own_dimensions(stream.header.get("las"), chunk)
        merge_limits(limits, columns)
        own = [dimension for dimension in own if dimension.holds(columns)]
        fitted = _fitted(path, columns, set())
        unfit |= {
            name
            for name in fitted.keys() & set(header.point_format.dimension_names)
            if not _holds(header.point_format.dimension_by_name(name), fitted[name])
        }
        low = np.minimum(low, chunk.coordinates.min(axis=0))
        high = np.maximum(high, chunk.coordinates.max(axis=0))
    if "las" not in stream.header:
        middle = np.rint((low + high) / 2)
        reach = max(float(np.abs([low - middle, high - middle]).max()), 1e-30)
        header.offsets = middle
        header.scales = np.full(3, 10.0 ** math.ceil(math.log10(reach / LARGEST_INTEGER)))
    plan = _Plan(header, has_date, unfit, limits, own)
    described = {known.dimension.name: known.dimension for known in own}
    standard = set(header.point_format.dimension_names)
    params = []
    for name, column in plan.columns(path, chunk).items():
        known = described.get(name)
        if known is not None:
            more = (known.description, known.offsets, known.scales, known.no_data)
            params.append(laspy.ExtraBytesParams(name, known.dtype, *more))
        elif name not in standard:
            ours = _UNFIT_DESCRIPTION if name.removesuffix(_UNFIT) in unfit else ""
            params.append(laspy.ExtraBytesParams(name, column.dtype.str[1:], ours))
    header.add_extra_dims(params)
    _claim_no_ranges(header)
    return plan


def _own_dimensions(header: Any, cloud: Cloud) -> list[_Own]:  # noqa: ANN401
    """Return the extra dimensions of the file that a cloud came from, as far as it still has them.

    A field that was put aside for a result takes its dimension along, under its new name.
    """
    if header is None:
        return []
    dimensions = {name: dim for dim in header.point_format.dimensions for name in _parts_of(dim)}
    fields = sources_of({name: np.empty(0, _type_of(dim)) for name, dim in dimensions.items()})
    found = dict[str, tuple[str, str]]()
    for field, parts in fields.items():
        aside = name_aside(field)
        is_aside = aside in cloud.fields and aside not in fields
        name = aside if is_aside else field
        if name not in cloud.fields:
            continue
        spelled = spell(name, cloud.fields[name].shape[1:], _SPELLING)
        if len(spelled) != len(parts):
            continue
        for part, column in zip(parts, spelled, strict=True):
            new = column if dimensions[part].num_elements == 1 else name
            found[part] = (column, new if is_aside else dimensions[part].name)
    own = []
    for dim in header.point_format.extra_dimensions:
        elements = [found[part] for part in _parts_of(dim) if part in found]
        if len(elements) == dim.num_elements:
            columns, names = zip(*elements, strict=True)
            own.append(_Own(dim._replace(name=names[0]), columns))
    return own


def _parts_of(dimension: Any) -> list[str]:  # noqa: ANN401
    """Return the names of the columns that a dimension is read as."""
    name, count = dimension.name, dimension.num_elements
    return [name] if count == 1 else [f"{name}_{i}" for i in range(count)]


def _type_of(dimension: Any) -> np.dtype[Any]:  # noqa: ANN401
    """Return the type of the columns that a dimension is read as."""
    if dimension.is_scaled:
        return np.dtype(np.float64)
    return np.dtype(np.uint8) if dimension.dtype is None else dimension.dtype.base


def _claim_no_ranges(header: Any) -> None:  # noqa: ANN401
    """Say nothing of the range of extra dimensions, for which laspy 2.7.0 takes a first value."""
    for record in header.vlrs.get("ExtraBytesVlr"):
        for described in record.extra_bytes_structs:
            # Without a type the same byte is the number of bytes.
            if described.data_type != 0:
                described.options &= ~_RANGE_BITS


def count_las(stream: BinaryIO, size: int) -> int:
    """Return the number of points by the header, for which laspy need not be installed."""
    head = stream.read(_COUNT14_AT + 8)
    (count,) = struct.unpack_from("<I", head, _COUNT_AT)
    if head[_VERSION_AT] >= 4:
        (count,) = struct.unpack_from("<Q", head, _COUNT14_AT)
    return int(count)


def _laspy(verb: str) -> Any:  # noqa: ANN401
    """Return the module."""
    return require("laspy", extra="las", purpose=f"{verb} LAS and LAZ files")


def _check_header(path: Path, size: int) -> None:
    """Check the numbers of records that laspy would otherwise loop over."""
    with path.open("rb") as stream:
        head = stream.read(255)
        if head[:4] != b"LASF" or len(head) < 227:
            raise FormatError(f"{path}: byte 0: expected the header of a LAS file; fetch it again.")
        (num_records,) = struct.unpack_from("<I", head, _RECORDS_AT)
        check_promise(path, _RECORDS_AT, 54 * num_records, "header records", available=size)
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
    """Check the number of compressed chunks; lazrs ends the process if memory for it fails."""
    start = header.offset_to_point_data
    with path.open("rb") as stream:
        stream.seek(start)
        offset = int.from_bytes(stream.read(8), "little", signed=True)
        if offset == -1:
            # The writer could not go back to the beginning, so the offset is at the end.
            stream.seek(size - 8)
            offset = int.from_bytes(stream.read(8), "little", signed=True)
        content = "the table of chunks"
        if offset < 0:
            raise FormatError(
                f"{path}: byte {start}: expected the place of {content}; fetch it again."
            )
        check_promise(path, offset, 8, content, available=size - offset)
        stream.seek(offset)
        _, num_chunks = struct.unpack("<II", stream.read(8))
        # The first point of a chunk is stored as it is.
        least, content = num_chunks * header.point_format.size, f"{num_chunks:,} chunks"
        check_promise(path, offset + 4, least, content, available=size, at_least=True)
        lazrs = require("lazrs", extra="las", purpose="read LAZ files")
        (record,) = header.vlrs.get("LasZipVlr")
        layout = lazrs.LazVlr(record.record_data)
        if layout.chunk_size() * num_chunks < header.point_count:
            raise FormatError(
                f"{path}: byte {offset}: expected chunks for {header.point_count:,} points, got "
                f"{num_chunks:,} of {layout.chunk_size():,}; the file is damaged, fetch it again."
            )
        stream.seek(start)
        table = lazrs.read_chunk_table(stream, layout)
        if header.point_format.id >= _FIRST_LAYERED_FORMAT:
            _check_layers(path, stream, header, [num_bytes for _, num_bytes in table])


def _check_layers(path: Path, stream: BinaryIO, header: Any, chunks: list[int]) -> None:  # noqa: ANN401
    """Check the sizes of the layers of each chunk, each of which lazrs takes memory for."""
    point_format = header.point_format
    # Nine for the fields all points have, one for colour, one for near infrared, one for waves.
    num_layers = 9 + {6: 0, 7: 1, 8: 2, 9: 1, 10: 3}[point_format.id]
    num_layers += point_format.num_extra_bytes
    start = header.offset_to_point_data + 8
    # Writers that end a chunk themselves leave an empty one behind the last.
    for num_bytes in filter(None, chunks):
        # A whole point and the number of points come first.
        place = start + point_format.size + 4
        stream.seek(place)
        sizes = np.frombuffer(stream.read(4 * num_layers), "<u4")
        total = int(sizes.sum(dtype=np.uint64))
        check_promise(path, place, total, "the layers of a chunk", available=num_bytes)
        start += num_bytes


def _columns(block: Any) -> dict[str, NDArray[Any]]:  # noqa: ANN401
    """Return the dimensions of a block of points."""
    columns: dict[str, NDArray[Any]] = {axis: np.asarray(block[axis]) for axis in "xyz"}
    for dimension in block.point_format.dimensions:
        values = np.asarray(block[dimension.name])
        if dimension.name in ("X", "Y", "Z"):
            continue
        parts = [values] if values.ndim == 1 else values.T
        columns |= dict(zip(_parts_of(dimension), parts, strict=True))
    return columns


def _unused(columns: Collection[str], standard: set[str], used: Collection[str]) -> set[str]:
    """Return the standard dimensions that are zero everywhere; the channels of a colour as one."""
    kept = {name for name in columns if name not in standard or name in used}
    if not kept.isdisjoint(_SPELLING.color):
        kept.update(_SPELLING.color)
    return set(columns) - kept


def _header(laspy: Any, stream: CloudStream, *, colored: bool) -> tuple[Any, bool]:  # noqa: ANN401
    """Return the header the cloud came with, or a new one, and whether it has a date."""
    stored = stream.header.get("las")
    if stored is None:
        return laspy.LasHeader(version="1.4", point_format=7 if colored else 6), False
    number = stored.point_format.id
    number = _WITH_COLOR.get(number, number) if colored else number
    least = laspy.LasHeader(point_format=number).version
    header = copy.deepcopy(stored)
    header.set_version_and_point_format(max(stored.version, least), laspy.PointFormat(number))
    return header, stored.creation_date is not None


def _fitted(path: Path, columns: Columns, unfit: Collection[str]) -> dict[str, NDArray[Any]]:
    """Return all columns but x, y, z; those that a standard dimension cannot hold renamed."""
    fitted = {}
    for name, column in columns.items():
        if name in ("x", "y", "z"):
            continue
        if name in _SPELLING.color and column.dtype == np.uint8:
            column = column.astype(np.uint16) * WIDEN
        if name in unfit:
            name = f"{name}{_UNFIT}"
        if name in ("X", "Y", "Z") or len(name.encode()) > 32:
            raise FormatError(
                f"{path}: expected names of at most 32 bytes other than X, Y, Z, got {name!r}; "
                "rename the field."
            )
        fitted[name] = column
    return fitted


def _holds(dimension: Any, column: NDArray[Any]) -> bool:  # noqa: ANN401
    """Whether a standard dimension holds all values of a column exactly."""
    if dimension.dtype is not None:
        return _fits(column, dimension.dtype)
    return _fits(column, np.dtype(np.uint8)) and bool(column.max() <= dimension.max)


def _fits(values: NDArray[Any], dtype: np.dtype[Any]) -> bool:
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
