"""Clouds in and out of files: :func:`read_cloud` and :func:`write_cloud` choose by the suffix."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_shapes
from torchrg.errors import FormatError
from torchrg.io.columns import check_length
from torchrg.io.e57 import count_e57, read_e57
from torchrg.io.fields import checked_coordinates, put_results
from torchrg.io.files import ARCHIVE_DAMAGES, atomic_path, check_file, check_place
from torchrg.io.las import check_las, count_las, read_las, write_las
from torchrg.io.npy import count_npy, count_npz, read_npy, read_npz, write_npy, write_npz
from torchrg.io.pcd import count_pcd, read_pcd, write_pcd
from torchrg.io.ply import count_ply, read_ply, write_ply
from torchrg.io.text import count_text, read_text, write_text
from torchrg.io.vg import write_vg
from torchrg.plane_table import planes_to_arrays
from torchrg.structures import Cloud, Segmentation, Superpoints

__all__ = [
    "FOLDER_SUFFIXES",
    "FORMATS",
    "RESULT_FIELDS",
    "atomic_path",
    "check_output",
    "estimate_points",
    "read_cloud",
    "takes_columns",
    "write_cloud",
]


class Format(NamedTuple):
    """How a kind of file is read and written; a new kind is a file, a row of FORMATS, and a test.

    Attributes:
        read: Reads a file of so many bytes, not 0; names of columns come third.
        count: Returns the number of points by the header of a file of so many bytes, or about their
            number by its size, in no time. May raise anything of a damaged file.
        write: Writes a cloud; None for a kind that is read only.
        check: Raises if a cloud, or any cloud for None, cannot be written; None if all can.
        takes_columns: Whether columns can be without names.
    """

    read: Callable[..., Cloud]
    count: Callable[[Path, int], int]  # type: ignore[assignment]
    write: Callable[[Path, Cloud], None] | None
    check: Callable[[Path, Cloud | None], None] | None = None
    takes_columns: bool = False


RESULT_FIELDS = ("labels", "normals", "curvature")
"""Fields that a segmentation adds to those of a cloud."""
FORMATS: dict[str, Format] = {
    ".npz": Format(read_npz, count_npz, write_npz),
    ".npy": Format(read_npy, count_npy, write_npy, takes_columns=True),
    ".ply": Format(read_ply, count_ply, write_ply),
    ".pcd": Format(read_pcd, count_pcd, write_pcd),
    ".las": Format(read_las, count_las, write_las, check_las),
    ".laz": Format(read_las, count_las, write_las, check_las),
    ".e57": Format(read_e57, count_e57, None),
    ".xyz": Format(read_text, count_text, write_text, takes_columns=True),
    ".txt": Format(read_text, count_text, write_text, takes_columns=True),
    ".asc": Format(read_text, count_text, write_text, takes_columns=True),
    ".pts": Format(read_text, count_text, None, takes_columns=True),
    ".csv": Format(read_text, count_text, None, takes_columns=True),
}
"""Formats that are read, by suffix. Those that are written hold any field."""
FOLDER_SUFFIXES = tuple(kind for kind in FORMATS if kind != ".csv")
"""Suffixes of what is taken for a cloud in folders, where ``.csv`` is mostly a table of others."""
_CONVERTERS = {
    ".obj": "a mesh; sample points on it with CloudCompare or pcl_mesh_sampling",
    ".glb": "a mesh; sample points on it with CloudCompare or Open3D",
    ".ptx": "a scan that CloudCompare opens; save it there as .e57",
}
"""Kinds of files that are not read, by suffix, and the programs that make clouds of them."""
_PLANES_SUFFIX = ".vg"
"""Suffix of vertex groups, which are written only, and hold coordinates, colours and planes."""


def read_cloud(path: str | os.PathLike[str], *, columns: Sequence[str] | None = None) -> Cloud:
    r"""Read a point cloud; the suffix says how.

    Convention:
        Coordinates and fields stay as they are in the file, points that are not finite included.
        Fields have one name whatever the format calls them, see :mod:`torchrg.io.fields`:
        ``labels`` int64, ``normals``, ``curvature``, ``intensity``, ``color`` uint8 or uint16, see
        :mod:`torchrg.io.colors`. What had to be taken for granted, as the names of columns without
        any, and what was left out, as pictures, is in :attr:`torchrg.Cloud.notes`. Of the faces of
        a mesh and the poses of scans it is kept from which side points were seen,
        :attr:`torchrg.Cloud.front`.

    Args:
        path: A file with a suffix of :data:`FORMATS`, in any case.
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
    size, form = check_file(source), _format_of(source)
    if columns is not None and not form.takes_columns:
        raise FormatError(
            f"{source}: expected text or .npy for names of columns, got a file that has its own; "
            "leave them out."
        )
    names = () if columns is None else (columns,)
    try:
        # Files may hold any bits as numbers: those that overflow or signal are kept, not reported.
        with np.errstate(over="ignore", invalid="ignore"):
            return form.read(source, size, *names)
    except OSError as error:
        raise FormatError(f"{source}: cannot be read: {error.strerror or error}.") from error
    except MemoryError as error:
        raise FormatError(
            f"{source}: its points do not fit into memory; use a machine with more, or cut the "
            "cloud into parts."
        ) from error


def takes_columns(path: str | os.PathLike[str]) -> bool:
    """Whether names can be given for the columns of a file, which its format does not ask for.

    Example:
        >>> takes_columns("scan.txt"), takes_columns("scan.ply")
        (True, False)
    """
    form = FORMATS.get(Path(path).suffix.lower())
    return form is not None and form.takes_columns


def write_cloud(
    path: str | os.PathLike[str],
    cloud: Cloud | Tensor | NDArray[np.floating],
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
        ``.npz`` holds ``points``, ``color`` of the cloud, ``labels``, ``normals``, ``curvature``,
        ``sharp``, ``valid``, the table of planes as
        :func:`torchrg.plane_table.planes_to_arrays` gives it in the input's coordinates, and
        ``provenance``. Equal input gives equal bytes. Superpoints are
        ``superpoint``, and ``superpoint_1`` and so on for the coarser levels; in ``.npz`` also
        ``plane_of_superpoint``. ``.vg`` holds coordinates, colours, normals and the planes as
        vertex groups, see :mod:`torchrg.io.vg`; it is not read.

    Args:
        path: The file; an older one is replaced. Its suffix is ``.vg`` or one of :data:`FORMATS`
            but ``.e57``, ``.pts`` and ``.csv``.
        cloud: The cloud, or its points, shape ``(N, 3)``.
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
    if not isinstance(cloud, Cloud):
        points = as_tensor("write_cloud", "cloud", cloud)
        check_shapes("write_cloud", cloud=(points, "N 3"))
        cloud = Cloud(points.numpy(force=True))
    check_output(target, cloud)
    for name, values in cloud.fields.items():
        check_length(target, name, values, len(cloud))
    cloud = replace(cloud, coordinates=checked_coordinates(target, cloud.coordinates))
    for what, result in (("a segmentation", segmentation), ("superpoints", superpoints)):
        if result is not None and len(result.labels) != len(cloud):
            raise FormatError(
                f"{target}: expected {what} of {len(cloud)} points, got {len(result.labels)}; "
                "pass the cloud that was segmented."
            )
    suffix = target.suffix.lower()
    if suffix == ".npz":
        write_npz(target, cloud, segmentation, provenance, superpoints)
        return
    fields = cloud.fields
    if superpoints is not None:
        fields = put_results(fields, superpoints.by_level())
    if segmentation is not None:
        results = {name: getattr(segmentation, name).numpy(force=True) for name in RESULT_FIELDS}
        fields = put_results(fields, results)
    labelled = replace(cloud, fields=fields)
    if suffix == _PLANES_SUFFIX and segmentation is not None:
        table = planes_to_arrays(segmentation.planes, cloud.origin)
        equations = np.column_stack([table["plane_normal"], -table["plane_offset"]])
        write_vg(target, labelled, equations)
        return
    _writer_of(target)(target, labelled)


def check_output(path: str | os.PathLike[str], cloud: Cloud | None = None) -> None:
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
    target = Path(path)
    _writer_of(target)
    check_place(path)
    form = FORMATS.get(target.suffix.lower())
    if form is not None and form.check is not None:
        form.check(target, cloud)


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
        return _format_of(path).count(path, path.stat().st_size)
    except (OSError, FormatError, *ARCHIVE_DAMAGES):
        return 0


def _format_of(path: Path, *, is_written: bool = False) -> Format:
    """Return how a file is read, or written, by its suffix."""
    suffix = path.suffix.lower()
    if suffix in _CONVERTERS and not is_written:
        raise FormatError(f"{path}: expected points, got {_CONVERTERS[suffix]}.")
    if suffix not in FORMATS:
        suffixes = [kind for kind, format_ in FORMATS.items() if format_.write or not is_written]
        raise FormatError(
            f"{path}: expected a file that ends in one of {' '.join(suffixes)}, got "
            f"{path.suffix!r}."
        )
    return FORMATS[suffix]


def _writer_of(path: Path) -> Callable[[Path, Cloud], None]:
    """Return the function that writes a file, by its suffix."""
    if path.suffix.lower() == _PLANES_SUFFIX:
        return write_vg
    write = _format_of(path, is_written=True).write
    if write is None:
        raise FormatError(
            f"{path}: expected a format that is written, got {path.suffix}, which is only read; "
            "write .laz or .ply."
        )
    return write
