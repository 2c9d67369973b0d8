"""Point cloud files; the file suffix selects the format."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchrg._checks import check_kinds, to_cloud
from torchrg.errors import FormatError
from torchrg.io.columns import check_field
from torchrg.io.e57 import count_e57, read_e57
from torchrg.io.fields import add_result_fields, convert_coordinates
from torchrg.io.files import ARCHIVE_ERRORS, check_file, check_writable, local_path
from torchrg.io.las import check_las, count_las, read_las, write_las
from torchrg.io.npy import count_npy, count_npz, read_npy, read_npz, write_npy, write_npz
from torchrg.io.pcd import count_pcd, read_pcd, write_pcd
from torchrg.io.ply import count_ply, read_ply, write_ply
from torchrg.io.text import count_text, read_text, write_text
from torchrg.io.vg import write_vg
from torchrg.structures import AnyCloud, Cloud, Segmentation, Superpoints
from torchrg.structures.points import FilePath

__all__ = ["FOLDER_SUFFIXES", "FORMATS", "RESULT_FIELDS", "read_cloud", "write_cloud"]
__dir__ = __all__.copy


class Format(NamedTuple):
    """Functions of a file format. A new format needs a module, a row of FORMATS, and a test.

    Attributes:
        read: Reads a non-empty file of the given size; the third argument holds column names.
        count: Returns the number of points from the header, or an estimate from the file size,
            without reading points. May raise any error on a corrupt file.
        write: Writes a cloud; None for read-only formats.
        check: Raises if a cloud (None: any cloud) cannot be written; None if every cloud can.
    """

    read: Callable[..., Cloud]
    count: Callable[[Path, int], int]  # type: ignore[assignment]
    write: Callable[[Path, Cloud], None] | None
    check: Callable[[Path, Cloud | None], None] | None = None


RESULT_FIELDS = ("labels", "normals", "curvature")
"""Fields that a segmentation adds to a cloud."""
FORMATS: dict[str, Format] = {
    ".npz": Format(read_npz, count_npz, write_npz),
    ".npy": Format(read_npy, count_npy, write_npy),
    ".ply": Format(read_ply, count_ply, write_ply),
    ".pcd": Format(read_pcd, count_pcd, write_pcd),
    ".las": Format(read_las, count_las, write_las, check_las),
    ".laz": Format(read_las, count_las, write_las, check_las),
    ".e57": Format(read_e57, count_e57, None),
    ".xyz": Format(read_text, count_text, write_text),
    ".txt": Format(read_text, count_text, write_text),
    ".asc": Format(read_text, count_text, write_text),
    ".pts": Format(read_text, count_text, None),
    ".csv": Format(read_text, count_text, None),
}
"""Readable formats, by suffix. Writable formats store any field."""
FOLDER_SUFFIXES = tuple(kind for kind in FORMATS if kind != ".csv")
"""Suffixes read as clouds in folders. A ``.csv`` file is usually another table."""
_CONVERTERS = {
    "a mesh; sample points on it with CloudCompare or pcl_mesh_sampling": (
        ".obj .glb .gltf .stl .off .fbx .dae .3ds .x3d .wrl .usdz"
    ),
    "a scan of another program; save it there or in CloudCompare as .e57, .laz or .ply": (
        ".ptx .fls .lsproj .zfs .rcp .rcs .rdb .rxp .bin .pcap .bag .mcap .db3 .pod .potree"
    ),
    "an image; pass images of depth to torchrg depth": (
        ".png .pgm .ppm .exr .tif .tiff .jpg .jpeg .pfm .bmp .webp"
    ),
    "an archive; unpack it, or save its points with numpy.save": (
        ".zip .gz .7z .tar .h5 .hdf5 .mat .pkl .pt .pth .parquet .feather"
    ),
}
"""Contents of files that are not read and the way to read them, with their suffixes."""
_SIGNATURES = {
    b"PK\x03\x04": ".npz or .zip",
    b"\x93NUMPY": ".npy",
    b"LASF": ".las or .laz",
    b"ASTM-E57": ".e57",
    b"ply": ".ply",
    b"# .PCD": ".pcd",
}
"""Suffixes of files by their first bytes."""
TEXT_SUFFIXES = tuple(kind for kind, form in FORMATS.items() if form.read is read_text)
"""Suffixes of text files."""
_MAX_POINTS_PER_BYTE = dict.fromkeys((".npz", ".laz", ".pcd", ".e57"), 1032)
"""Maximum number of points per byte of a file that may be compressed, by deflate; others have 1."""
_PLANES_SUFFIX = ".vg"
"""Suffix of vertex groups, which are write-only and store coordinates, colors and planes."""


def read_cloud(path: FilePath, *, columns: Sequence[str] | None = None) -> Cloud:
    r"""Read a point cloud; the file suffix selects the format.

    Convention:
        Coordinates and fields are returned unchanged, including non-finite points. Field names do
        not depend on the format (see :mod:`torchrg.io.fields`): ``labels`` int64, ``normals``,
        ``curvature``, ``intensity``, ``color`` uint8 or uint16 (:mod:`torchrg.structures.colors`).
        :attr:`torchrg.Cloud.notes` lists assumptions, such as guessed column names, and skipped
        data, such as images. Mesh faces and scan poses give the side from which each point was
        seen, :attr:`torchrg.Cloud.front`.

    Args:
        path: A file with a suffix of :data:`FORMATS`, in any case.
        columns: Column names of a text file or a plain ``.npy`` array, in order: ``x``, ``y``,
            ``z`` and any others, ``_`` to skip a column. Default: the names in the file, else
            :data:`torchrg.io.tables.COLUMNS_RULE`.

    Returns:
        The cloud, with at least one point.

    Raises:
        FormatError: If the file is missing, corrupt, or of an unknown format, or if ``columns`` do
            not fit it. The message begins with the path and names the position and the fix.
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
    source = local_path(path)
    size, fmt = check_file(source), _get_format(source)
    if columns is not None and not takes_columns(source):
        raise FormatError(f"{source}: column names apply to text and .npy files only; omit them.")
    names = () if columns is None else (columns,)
    try:
        # Arbitrary bit patterns may overflow or signal; keep them without a warning.
        with np.errstate(over="ignore", invalid="ignore"):
            _check_signature(source)
            return fmt.read(source, size, *names)
    except OSError as error:
        raise FormatError(f"{source}: cannot be read: {error.strerror or error}.") from error
    except MemoryError as error:
        raise FormatError(
            f"{source}: not enough memory for its points; use a larger machine, or split the cloud."
        ) from error


def takes_columns(path: FilePath) -> bool:
    """Whether the format of a file allows column names to be passed."""
    return Path(path).suffix.lower() in (*TEXT_SUFFIXES, ".npy")


def write_cloud(
    path: FilePath,
    cloud: AnyCloud,
    segmentation: Segmentation | None = None,
    *,
    superpoints: Superpoints | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a point cloud or a segmentation result; the file suffix selects the format.

    The file is written atomically. :func:`read_cloud` returns the points in the same order with
    bit-identical coordinates, except for the ``.las`` grid.

    Convention:
        A segmentation is written as ``label``, normals and ``curvature`` of each point, next to the
        cloud's fields. The names match Open3D, CloudCompare, PCL and PDAL. A cloud field
        with the name of a result is renamed to ``label_input``, ``normals_input`` and so on; if
        the cloud already has such a field, that field is kept instead.
        ``.npz`` contains ``points``, the cloud's ``color``, ``labels``, ``normals``, ``curvature``,
        ``sharp``, ``valid``, the plane table in input coordinates (see
        :func:`torchrg.io.plane_table.planes_to_arrays`), and ``provenance``. Identical input gives
        byte-identical files. Superpoints are ``superpoint``, and ``superpoint_1`` and so on for
        the coarser levels; ``.npz`` also contains ``plane_of_superpoint``. ``.vg`` contains
        coordinates, colors, normals and the planes as vertex groups (see :mod:`torchrg.io.vg`); it
        cannot be read back.

    Args:
        path: The file; an existing one is replaced. Its suffix is ``.vg`` or one of :data:`FORMATS`
            except ``.e57``, ``.pts`` and ``.csv``.
        cloud: The cloud, its points, shape ``(N, 3)``, or the path of another file.
        segmentation: Result of :func:`torchrg.segment_planes` for ``cloud.points``.
        superpoints: Result of :func:`torchrg.make_superpoints` for ``cloud.points``.
        provenance: How the result was made; any JSON-serializable mapping. Stored in ``.npz`` only.

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
    repair, paths = "pass path, cloud, then a result", (str, os.PathLike)
    check_kinds(
        "write_cloud", repair, path=(path, paths), segmentation=(segmentation, Segmentation)
    )
    check_kinds("write_cloud", repair, superpoints=(superpoints, Superpoints))
    target = Path(path)
    cloud = to_cloud("write_cloud", cloud)
    check_output(target, cloud)
    for name, values in cloud.fields.items():
        check_field(target, name, values, len(cloud))
    cloud = replace(cloud, coordinates=convert_coordinates(target, cloud.coordinates))
    for what, result in (("a segmentation", segmentation), ("superpoints", superpoints)):
        if result is not None and len(result.labels) != len(cloud):
            raise FormatError(
                f"{target}: expected {what} of {len(cloud)} points, got {len(result.labels)}; "
                "pass the cloud that was segmented."
            )
    if target.suffix.lower() == ".npz":
        write_npz(target, cloud, segmentation, provenance, superpoints)
        return
    fields = cloud.fields
    if superpoints is not None:
        fields = add_result_fields(fields, superpoints.by_level())
    if segmentation is not None:
        results = {name: getattr(segmentation, name).numpy(force=True) for name in RESULT_FIELDS}
        fields = add_result_fields(fields, results)
    _get_writer(target)(target, replace(cloud, fields=fields))


def check_output(path: FilePath, cloud: Cloud | None = None, *, other: str = "") -> None:
    """Check an output path before long work: known suffix, existing writable folder.

    ``cloud`` is the cloud to write, if already known: LAS cannot store non-finite points. ``other``
    is a suffix that the caller itself writes, such as ``.png``.

    Raises:
        FormatError: If :func:`write_cloud` would reject the path or the cloud.
        MissingDependencyError: If the format needs an optional package.
    """
    target = Path(path)
    if target.suffix.lower() != other:
        _get_writer(target, other)
    check_writable(path)
    fmt = FORMATS.get(target.suffix.lower())
    if fmt is not None and fmt.check is not None:
        fmt.check(target, cloud)


def estimate_points(path: Path) -> int:
    r"""Return the number of points of a file from its header, without reading the points.

    Text files have no header; for them and for E57 the number is estimated from the file size.
    Returns 0 for an unknown format or a corrupt file, such as one that is too small for its number
    of points; reading reports them.
    """
    limit = _MAX_POINTS_PER_BYTE.get(path.suffix.lower(), 1)
    try:
        size = check_file(path)
        count = _get_format(path).count(path, size)
        return count if count <= limit * size else 0
    except (OSError, FormatError, *ARCHIVE_ERRORS):
        return 0


def _get_format(path: Path, other: str = "", *, for_writing: bool = False) -> Format:
    """Return the format of a file to read or write, by its suffix; see :func:`check_output`."""
    suffix = path.suffix.lower()
    content = next((what for what, kinds in _CONVERTERS.items() if suffix in kinds.split()), "")
    if content and not for_writing:
        raise FormatError(f"{path}: expected points, got {content}.")
    if suffix not in FORMATS:
        suffixes = [kind for kind, format_ in FORMATS.items() if format_.write or not for_writing]
        endings = " ".join(dict.fromkeys([*filter(None, [other]), *suffixes]))
        raise FormatError(
            f"{path}: expected a file ending in one of {endings}, got {path.suffix!r}."
        )
    return FORMATS[suffix]


def _check_signature(path: Path) -> None:
    """Raise FormatError if a file begins as another format does."""
    with path.open("rb") as stream:
        start = stream.read(max(map(len, _SIGNATURES)))
    kinds = next((kinds for first, kinds in _SIGNATURES.items() if start.startswith(first)), "")
    if kinds and path.suffix.lower() not in kinds.split(" or "):
        raise FormatError(
            f"{path}: byte 0: expected a {path.suffix} file, got a {kinds} file; rename it."
        )


def _get_writer(path: Path, other: str = "") -> Callable[[Path, Cloud], None]:
    """Return the writer of a file, by its suffix."""
    if path.suffix.lower() == _PLANES_SUFFIX:
        return write_vg
    write = _get_format(path, other, for_writing=True).write
    if write is None:
        raise FormatError(f"{path}: {path.suffix} can be read but not written. Use .laz or .ply.")
    return write
