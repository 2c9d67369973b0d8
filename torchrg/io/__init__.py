"""Clouds in and out of files: :func:`read_cloud` and :func:`write_cloud` choose by the suffix."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from torchrg.errors import ConfigError, FormatError
from torchrg.io.columns import check_length
from torchrg.io.e57 import check_e57, count_e57, open_e57, write_e57
from torchrg.io.fields import checked_coordinates
from torchrg.io.files import atomic_path, check_file, check_place
from torchrg.io.las import check_las, count_las, open_las, write_las
from torchrg.io.merge import merge_streams
from torchrg.io.npy import (
    ARCHIVE_DAMAGES,
    open_npy,
    open_npz,
    write_npy,
    write_npz,
)
from torchrg.io.pcd import open_pcd, write_pcd
from torchrg.io.ply import open_ply, write_ply
from torchrg.io.stream import (
    POINTS_A_CHUNK,
    SILENT,
    CloudStream,
    Table,
    read_table,
    reporting_unreadable,
    stream_table,
)
from torchrg.io.text import count_text, open_text, write_text
from torchrg.io.vg import open_bvg, open_vg, write_bvg, write_vg
from torchrg.plane_table import planes_to_arrays
from torchrg.structures import Cloud, Segmentation, Superpoints

__all__ = [
    "FORMATS",
    "RESULT_FIELDS",
    "CloudStream",
    "atomic_path",
    "check_output",
    "estimate_points",
    "merge_streams",
    "read_cloud",
    "stream_cloud",
    "takes_columns",
    "write_cloud",
]


class Format(NamedTuple):
    """How a kind of file is read and written; a new kind is a codec, a row of FORMATS, and a test.

    Attributes:
        open: Reads the header of a file of so many bytes, not 0, and gives a table of its points,
            in chunks. Opening it, or reading the damaged chunk, raises FormatError if the file is
            damaged. Where columns can be without names, these come third.
        write: Writes a cloud, going through its chunks once or several times. Raises FormatError if
            the format cannot hold it.
        count: Number of points, from the open file and its size, of a format whose table cannot
            say it at once. May raise anything of a damaged file. None where the table can.
        check: Raises if a cloud, or any cloud for None, cannot be written; None if all can.
        takes_columns: Whether columns can be without names.
    """

    open: Callable[..., Table]
    write: Callable[[Path, CloudStream], None]
    count: Callable[[BinaryIO, int], int] | None = None  # type: ignore[assignment]
    check: Callable[[Path, Cloud | CloudStream | None], None] | None = None
    takes_columns: bool = False


RESULT_FIELDS = ("labels", "normals", "curvature")
"""What a segmentation writes of each point beside the fields of the cloud."""
FORMATS: dict[str, Format] = {
    ".npz": Format(open_npz, write_npz),
    ".npy": Format(open_npy, write_npy, takes_columns=True),
    ".ply": Format(open_ply, write_ply),
    ".pcd": Format(open_pcd, write_pcd),
    ".las": Format(open_las, write_las, count_las, check_las),
    ".laz": Format(open_las, write_las, count_las, check_las),
    ".e57": Format(open_e57, write_e57, count_e57, check_e57),
    ".xyz": Format(open_text, write_text, count_text, takes_columns=True),
    ".txt": Format(open_text, write_text, count_text, takes_columns=True),
}
"""What is known of each format that holds any field, by suffix."""
GROUP_FORMATS: dict[str, Format] = {
    ".vg": Format(open_vg, write_vg),
    ".bvg": Format(open_bvg, write_bvg),
}
"""Formats of planes, which hold coordinates, normals and labels, and ``.vg`` also colours."""


def read_cloud(path: str | os.PathLike[str], *, columns: Sequence[str] | None = None) -> Cloud:
    r"""Read a point cloud; the suffix says how.

    Convention:
        Coordinates and fields stay as they are in the file, points that are not finite included.
        Fields have one name whatever the format calls them, see :mod:`torchrg.io.fields`:
        ``labels`` int64, ``normals``, ``curvature``, ``intensity``, ``color`` uint8. What had to be
        taken for granted, as the names of columns without any, and what was left out, as pictures,
        is in :attr:`torchrg.Cloud.notes`. Of the faces of a mesh and the poses of scans it is kept
        from which side points were seen, :attr:`torchrg.Cloud.front`.

    Args:
        path: A file with a suffix of :data:`FORMATS` or :data:`GROUP_FORMATS`, in any case.
        columns: Names of the columns of text and of a bare ``.npy`` array, in their order: ``x``,
            ``y``, ``z`` and any others, ``_`` for one to leave out. Default: those that the file
            says, else those of :data:`torchrg.io.fields.COLUMNS_RULE`.

    Returns:
        The cloud, with at least one point.

    Raises:
        FormatError: If the file is missing, damaged, or not of a known format, or if ``columns``
            are not its. The message begins with the path and names the place and the repair.
        MissingDependencyError: If the format needs an optional package.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "corner.xyz"
        ...     _ = path.write_text("0 0 0 255 0 0\n0.5 0 0 0 255 0\n")
        ...     cloud = read_cloud(path)
        >>> cloud.coordinates.shape, cloud.fields["color"].tolist()
        ((2, 3), [[255, 0, 0], [0, 255, 0]])
    """
    source = Path(path)
    with reporting_unreadable(source):
        return read_table(source, _open(source, columns))


def stream_cloud(
    path: str | os.PathLike[str],
    *,
    columns: Sequence[str] | None = None,
    chunk_size: int = POINTS_A_CHUNK,
) -> CloudStream:
    r"""Read a point cloud in chunks, for clouds larger than memory; the suffix says how.

    Convention:
        The chunks put one after the other are what :func:`read_cloud` gives, bit for bit. What
        depends on all points (the range of floating-point or 16-bit colours, which dimensions of a
        LAS file are empty, the names of six or seven columns without names) is found in a pass over
        the file before the first chunk. Memory is that of a few chunks, but for
        ``binary_compressed`` PCD files, which hold all points in one lump and are unpacked whole.

    Args:
        path: A file with a suffix of :data:`FORMATS`, in any case.
        columns: As of :func:`read_cloud`.
        chunk_size: Most points of a chunk, at least 1. Chunks may be smaller.

    Returns:
        The chunks, read anew each time they are iterated.

    Raises:
        FormatError: As :func:`read_cloud`, with the same message; damaged points are reported at
            the latest when they are reached.
        ConfigError: If ``chunk_size`` is less than 1.
        MissingDependencyError: If the format needs an optional package.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "corner.xyz"
        ...     _ = path.write_text("0 0 0\n1 0 0\n0 1 0\n")
        ...     [chunk.coordinates.tolist() for chunk in stream_cloud(path, chunk_size=2)]
        [[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]]
    """
    if chunk_size < 1:
        raise ConfigError(f"stream_cloud: expected chunk_size of at least 1, got {chunk_size}.")
    source = Path(path)
    with reporting_unreadable(source):
        return stream_table(source, _open(source, columns), chunk_size)


def takes_columns(path: str | os.PathLike[str]) -> bool:
    """Whether names can be given for the columns of a file, which its format does not ask for.

    Example:
        >>> takes_columns("scan.txt"), takes_columns("scan.ply")
        (True, False)
    """
    found = FORMATS.get(Path(path).suffix.lower())
    return found is not None and found.takes_columns


def _open(path: Path, columns: Sequence[str] | None) -> Table:
    """Open a file by its suffix."""
    size, found = check_file(path), _format_of(path)
    if columns is not None and not found.takes_columns:
        raise FormatError(
            f"{path}: expected text or .npy for names of columns, got a file that has its own; "
            "leave them out."
        )
    with np.errstate(**SILENT):
        return found.open(path, size) if columns is None else found.open(path, size, columns)


def write_cloud(
    path: str | os.PathLike[str],
    cloud: Cloud | CloudStream,
    segmentation: Segmentation | None = None,
    *,
    superpoints: Superpoints | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a point cloud, or the result of segmenting it; the suffix says how.

    The file appears whole or not at all. What is written reads back with :func:`read_cloud`, in the
    same order and, but for the grid of ``.las``, to the last bit of the coordinates.

    Convention:
        A segmentation is written as ``label``, normals and ``curvature`` of each point, beside the
        cloud's own fields, under the names that Open3D, CloudCompare, PCL and PDAL know. A field of
        the cloud whose name a result takes is kept under another: ``label_input``,
        ``normals_input`` and so on; where there is such a field already, it is that which stays.
        ``.npz``
        holds ``points``, ``labels``, ``normals``, ``curvature``, ``sharp``, ``valid``, the table of
        planes as :func:`torchrg.plane_table.planes_to_arrays` gives it in the input's coordinates,
        and ``provenance``. Equal input gives equal bytes (``.e57`` excepted: its files carry random
        identifiers). Superpoints are ``superpoints``, and ``superpoints_1`` and so on for the
        coarser levels; in ``.npz`` also ``plane_of_superpoint``. ``.vg`` and ``.bvg`` hold
        coordinates, normals and the planes as vertex groups, numbered from zero, and ``.vg`` holds
        colours; see :mod:`torchrg.io.vg`.

    Args:
        path: The file; an older one is replaced. Its suffix is one of :data:`FORMATS`
            or :data:`GROUP_FORMATS`.
        cloud: The cloud; one larger than memory as :func:`stream_cloud` gives it, which leaves the
            same bytes. Its chunks are gone through up to four times, for ``.npz`` without a
            segmentation once for each field. Tensors of the results are taken chunk by chunk, too,
            so they may be mapped from files.
        segmentation: What :func:`torchrg.segment_planes` said about ``cloud.points``.
        superpoints: What :func:`torchrg.make_superpoints` said about them.
        provenance: How the result was made, anything that JSON can hold; kept by ``.npz`` only.

    Raises:
        FormatError: If the format cannot hold the values, or the file cannot be written.
        MissingDependencyError: If the format needs an optional package.

    Example:
        >>> import tempfile
        >>> cloud = Cloud(np.eye(3), {"labels": np.array([0, 0, -1])})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_cloud(Path(folder) / "corner.ply", cloud)
        ...     read_cloud(Path(folder) / "corner.ply").fields["labels"].tolist()
        [0, 0, -1]
    """
    target = Path(path)
    found = _format_of(target)
    if not isinstance(cloud, Cloud | CloudStream):
        raise FormatError(
            f"{target}: expected a Cloud, or a stream of one, got {type(cloud).__name__}; "
            "Cloud(coordinates) makes one of a NumPy array."
        )
    check_output(target, cloud)
    if isinstance(cloud, Cloud):
        for name, values in cloud.fields.items():
            check_length(target, name, values, len(cloud))
        points = checked_coordinates(target, cloud.coordinates)
        stream = CloudStream.of(replace(cloud, coordinates=points), chunk_size=POINTS_A_CHUNK)
    else:
        stream = cloud
    for what, result in (("a segmentation", segmentation), ("superpoints", superpoints)):
        if result is not None and len(result.labels) != stream.count:
            raise FormatError(
                f"{target}: expected {what} of {stream.count} points, got {len(result.labels)}; "
                "pass the cloud that was segmented."
            )
    if found.write is write_npz:
        own = segmentation is None
        write_npz(target, _checked(target, stream, own), segmentation, provenance, superpoints)
        return
    if superpoints is not None:
        stream = stream.with_results(lambda rows: superpoints.rows(rows).by_level())
    if segmentation is not None:
        results = {name: getattr(segmentation, name) for name in RESULT_FIELDS}
        stream = stream.with_results(
            lambda rows: {name: values[rows].numpy(force=True) for name, values in results.items()}
        )
    if found in GROUP_FORMATS.values() and segmentation is not None:
        table = planes_to_arrays(segmentation.planes, stream.origin)
        equations = np.column_stack([table["plane_normal"], -table["plane_offset"]])
        found.write(target, _checked(target, stream), equations)  # type: ignore[call-arg]
        return
    found.write(target, _checked(target, stream))


def _checked(path: Path, stream: CloudStream, has_fields: bool = True) -> CloudStream:
    """Check the chunks while they are written, as far as formats do not differ.

    Without ``has_fields`` they are left out.
    """

    def chunks() -> Iterator[Cloud]:
        count = 0
        for chunk in stream:
            fields = chunk.fields if has_fields else {}
            for name, values in fields.items():
                check_length(path, name, values, len(chunk))
            count += len(chunk)
            points = checked_coordinates(path, chunk.coordinates)
            yield replace(chunk, coordinates=points, fields=fields)
        if count != stream.count:
            raise FormatError(f"{path}: expected {stream.count} points in chunks, got {count}.")

    return replace(stream, chunks=chunks, measure=lambda: stream.extent)


def check_output(path: str | os.PathLike[str], cloud: Cloud | CloudStream | None = None) -> None:
    """Check before long work that its result has a place: known suffix, folder there.

    ``cloud`` is the one that shall be written, if it is known yet: LAS holds no points that are not
    finite.

    Raises:
        FormatError: If :func:`write_cloud` would refuse the path, or the cloud.
        MissingDependencyError: If the format needs an optional package.

    Example:
        >>> check_output("planes.stl")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        torchrg.errors.FormatError: planes.stl: expected a file that ends in one of .npz ...'.stl'.
    """
    found = _format_of(Path(path))
    check_place(path)
    if found.check is not None:
        found.check(Path(path), cloud)


def estimate_points(path: Path) -> int:
    r"""Return the number of points that a file says it holds, without reading them.

    For text, which has no header, and for E57 it is an estimate from the size; 0 for a file that is
    damaged or of no known format, which reading will tell.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "corner.xyz"
        ...     _ = path.write_text("0 0 0\n1 0 0\n0 1 0\n")
        ...     estimate_points(path)
        3
    """
    try:
        size, found = path.stat().st_size, _format_of(path)
        if found.count is None:
            return found.open(path, size).num_points or 0
        with path.open("rb") as stream:
            return found.count(stream, size)
    except (OSError, FormatError, *ARCHIVE_DAMAGES):
        return 0


def _format_of(path: Path) -> Format:
    """Return the format of a path."""
    suffix = path.suffix.lower()
    found = FORMATS.get(suffix) or GROUP_FORMATS.get(suffix)
    if found is None:
        known = " ".join(FORMATS)
        raise FormatError(
            f"{path}: expected a file that ends in one of {known}, got {path.suffix!r}."
        )
    return found
