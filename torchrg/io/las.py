"""LAS and LAZ through laspy (extra ``las``): scale, offset, reference system and dimensions kept.

Normals, curvature and labels are extra dimensions named ``NormalX``, ``NormalY``, ``NormalZ``,
``Curvature`` and ``label``, the names PDAL knows where it has one.
"""

import copy
import math
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.fields import Spelling, assemble_cloud, flatten_cloud
from torchrg.io.files import DAMAGES, atomic_path, check_file, check_promise, first_line
from torchrg.structures import Cloud

FIRST_LAYERED_FORMAT = 6


def check_header(path: Path, size: int) -> None:
    """Check the numbers of records that laspy would otherwise loop over."""
    with path.open("rb") as stream:
        head = stream.read(255)
        if head[:4] != b"LASF" or len(head) < 227:
            raise FormatError(f"{path}: byte 0: expected the header of a LAS file; fetch it again.")
        (num_records,) = struct.unpack_from("<I", head, 100)
        check_promise(
            path, byte=100, promised=54 * num_records, available=size, content="header records"
        )
        if head[25] < 4 or len(head) < 247:
            return
        start, num_extended = struct.unpack_from("<QI", head, 235)
        for _ in range(num_extended):
            content = f"{num_extended:,} extended header records"
            check_promise(path, byte=start, promised=60, available=size - start, content=content)
            stream.seek(start)
            (length,) = struct.unpack_from("<Q", stream.read(60), 20)
            start += 60
            check_promise(
                path, byte=start, promised=length, available=size - start, content=content
            )
            start += length


def check_chunks(path: Path, header: Any, size: int) -> None:  # noqa: ANN401
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
        check_promise(path, byte=offset, promised=8, available=size - offset, content=content)
        stream.seek(offset)
        _, num_chunks = struct.unpack("<II", stream.read(8))
        # The first point of a chunk is stored as it is.
        check_promise(
            path,
            byte=offset + 4,
            promised=num_chunks * header.point_format.size,
            available=size,
            content=f"{num_chunks:,} chunks",
            at_least=True,
        )
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
        if header.point_format.id >= FIRST_LAYERED_FORMAT:
            _check_layers(path, stream, header, [num_bytes for _, num_bytes in table])


def _check_layers(path: Path, stream: BinaryIO, header: Any, chunks: list[int]) -> None:  # noqa: ANN401
    """Check the sizes of the layers of each chunk, each of which lazrs takes memory for."""
    point_format = header.point_format
    # Nine for the fields all points have, one for colour, one for near infrared, one for waves.
    num_layers = 9 + {6: 0, 7: 1, 8: 2, 9: 1, 10: 3}[point_format.id]
    num_layers += point_format.num_extra_bytes
    start = header.offset_to_point_data + 8
    for num_bytes in chunks:
        # A whole point and the number of points come first.
        place = start + point_format.size + 4
        stream.seek(place)
        sizes = np.frombuffer(stream.read(4 * num_layers), "<u4")
        check_promise(
            path,
            byte=place,
            promised=int(sizes.sum(dtype=np.uint64)),
            available=num_bytes,
            content="the layers of a chunk",
        )
        start += num_bytes


POINTS_AT_ONCE = 1 << 20
SPELLING = Spelling(normals=("NormalX", "NormalY", "NormalZ"), curvature="Curvature", color_bits=16)
COLOR = ("red", "green", "blue")
WITH_COLOR = {0: 2, 1: 3, 4: 5, 6: 7, 9: 10}
"""By point format without colour, the one that adds it."""
UNFIT = "_value"
"""Ends the name of an extra dimension whose values the standard one of that name cannot hold."""
LARGEST_INTEGER = 2**31 - 1
DATE_BYTES = (90, 4)


def read_las(path: Path) -> Cloud:
    """Read a LAS or LAZ file.

    Args:
        path: The file.

    Returns:
        The cloud in float64, with every extra dimension and every standard one that is not zero
        everywhere; colours as uint8 where eight bits hold them, else uint16. The header is kept for
        writing.

    Raises:
        FormatError: If the file is damaged.
        MissingDependencyError: If laspy is not installed.
    """
    laspy = require("laspy", extra="las", purpose="read LAS and LAZ files")
    size = check_file(path)
    check_header(path, size)
    try:
        # The parallel backend takes what memory a damaged table of chunks asks for.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            header = reader.header
            start = header.offset_to_point_data
            least = 0 if header.are_points_compressed else header.point_format.size
            check_promise(
                path,
                byte=start,
                promised=header.point_count * least,
                available=size - start,
                content=f"{header.point_count:,} points",
            )
            if header.are_points_compressed:
                check_chunks(path, header, size)
            # By blocks, so that memory grows with the points that are really there.
            blocks = [_columns(block) for block in reader.chunk_iterator(POINTS_AT_ONCE)]
    except FormatError:
        raise
    except (laspy.errors.LaspyException, *DAMAGES) as error:
        raise FormatError(
            f"{path}: expected a LAS or LAZ file, got: {first_line(error)}; fetch it again."
        ) from error
    except BaseException as error:
        # A panic of lazrs, which is written in Rust, is no Exception and has no importable name.
        if type(error).__name__ != "PanicException":
            raise
        raise FormatError(
            f"{path}: expected whole compressed points, got: {first_line(error)}; fetch it again."
        ) from error
    if not blocks:
        raise FormatError(f"{path}: expected at least one point, got none; fetch the file again.")
    columns = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    unused = _unused(header.point_format, columns)
    named = {
        name.removesuffix(UNFIT) if name.removesuffix(UNFIT) in unused else name: column
        for name, column in columns.items()
        if name not in unused
    }
    return assemble_cloud(path, named, header={"las": header})


def check_las(path: Path, cloud: Cloud | None) -> None:
    """Check that a cloud can be written as LAS: laspy is installed, and all points are finite.

    Args:
        path: The file to write.
        cloud: The cloud; None if it is not known yet.

    Raises:
        FormatError: If a point is not finite.
        MissingDependencyError: If laspy is not installed.
    """
    require("laspy", extra="las", purpose="write LAS and LAZ files")
    if cloud is not None and not cloud.finite.all():
        raise FormatError(
            f"{path}: expected finite coordinates, as LAS has no others, got "
            f"{int((~cloud.finite).sum())} points that are not (first: "
            f"{int(np.argmin(cloud.finite))}); write .npz, .ply or .pcd."
        )


def write_las(path: Path, cloud: Cloud) -> None:
    """Write a cloud as a LAS file, or a LAZ file if its suffix says so.

    Args:
        path: The file.
        cloud: The cloud, all of it finite. If it came from a LAS file, scale, offset, reference
            system and point format are kept; otherwise the scale is the smallest power of ten that
            the grid of 32 bits allows.

    Raises:
        FormatError: If a point is off the grid, a field has no place in a LAS file, or the file
            cannot be written.
        MissingDependencyError: If laspy is not installed.
    """
    laspy = require("laspy", extra="las", purpose="write LAS and LAZ files")
    columns = flatten_cloud(path, cloud, SPELLING)
    header, has_date = _header(laspy, cloud, colored=all(name in columns for name in COLOR))
    named = _fitted(path, header.point_format, columns)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name, column.dtype.str[1:])
            for name, column in named.items()
            if name not in header.point_format.dimension_names
        ]
    )
    try:
        data = laspy.LasData(header)
        data.x, data.y, data.z = cloud.coordinates.T.astype(np.float64)
        for name, column in named.items():
            data[name] = column
        with atomic_path(path) as beside:
            data.write(beside)
            if not has_date:
                _erase_date(beside)
    except (laspy.errors.LaspyException, ValueError, ArithmeticError, RuntimeError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{path}: cannot be written: {first_line(error)}.") from error


def _columns(block: Any) -> dict[str, NDArray[Any]]:  # noqa: ANN401
    """Return the dimensions of a block of points."""
    columns: dict[str, NDArray[Any]] = {axis: np.asarray(block[axis]) for axis in "xyz"}
    for dimension in block.point_format.dimensions:
        values = np.asarray(block[dimension.name])
        if dimension.name in ("X", "Y", "Z"):
            continue
        if values.ndim == 1:
            columns[dimension.name] = values
        else:
            columns |= {f"{dimension.name}_{i}": part for i, part in enumerate(values.T)}
    return columns


def _unused(point_format: Any, columns: dict[str, NDArray[Any]]) -> set[str]:  # noqa: ANN401
    """Return the standard dimensions that are zero everywhere; the channels of a colour as one."""
    standard = set(point_format.standard_dimension_names)
    used = {name for name, column in columns.items() if name not in standard or column.any()}
    if not used.isdisjoint(COLOR):
        used.update(COLOR)
    return columns.keys() - used


def _header(laspy: Any, cloud: Cloud, *, colored: bool) -> tuple[Any, bool]:  # noqa: ANN401
    """Return the header the cloud came with, or a new one, and whether it has a date."""
    stored = cloud.header.get("las")
    if stored is None:
        header = laspy.LasHeader(version="1.4", point_format=7 if colored else 6)
        low, high = cloud.coordinates.min(axis=0), cloud.coordinates.max(axis=0)
        middle = np.rint((low.astype(np.float64) + high) / 2)
        reach = max(float(np.abs([low - middle, high - middle]).max()), 1e-30)
        header.offsets = middle
        header.scales = np.full(3, 10.0 ** math.ceil(math.log10(reach / LARGEST_INTEGER)))
        return header, False
    number = stored.point_format.id
    number = WITH_COLOR.get(number, number) if colored else number
    least = laspy.LasHeader(point_format=number).version
    header = copy.deepcopy(stored)
    header.set_version_and_point_format(max(stored.version, least), laspy.PointFormat(number))
    return header, stored.creation_date is not None


def _fitted(
    path: Path,
    point_format: Any,  # noqa: ANN401
    columns: dict[str, NDArray[Any]],
) -> dict[str, NDArray[Any]]:
    """Return all columns but x, y, z; those that a standard dimension cannot hold renamed."""
    fitted = {}
    for name, column in columns.items():
        if name in ("x", "y", "z"):
            continue
        if name in COLOR and column.dtype == np.uint8:
            column = column.astype(np.uint16) * 257
        known = name in point_format.dimension_names
        if known and not _holds(point_format.dimension_by_name(name), column):
            name = f"{name}{UNFIT}"
        if name in ("X", "Y", "Z") or len(name.encode()) > 32:
            raise FormatError(
                f"{path}: expected names of at most 32 bytes other than X, Y, Z, got {name!r}; "
                "rename the field."
            )
        fitted[name] = column
    return fitted


def _holds(dimension: Any, column: NDArray[Any]) -> bool:  # noqa: ANN401
    """Whether a standard dimension holds all values of a column exactly."""
    if dimension.dtype is not None and dimension.dtype.kind == "f":
        return bool((column.astype(dimension.dtype) == column).all())
    whole = np.isfinite(column).all() and (column == np.floor(column)).all()
    return bool(whole and column.min() >= dimension.min and column.max() <= dimension.max)


def _erase_date(path: Path) -> None:
    """Set the date of creation to none; laspy writes the day, so that equal runs would differ."""
    start, length = DATE_BYTES
    with path.open("rb+") as stream:
        stream.seek(start)
        stream.write(bytes(length))
