"""E57 reader based on pye57 (extra ``e57``).

All scans of a file form one cloud. Points are read through pye57's ``libe57``, because
``pye57.E57`` (0.4.19) reads only color, intensity, row and column. Normals are the ``nor``
extension of the standard; fields of other extensions lose their prefix. Names and poses of scans
and the coordinate system are read too.
"""

import contextlib
import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from torchrg import scratch
from torchrg._optional import require
from torchrg._parallel import ROWS_AT_ONCE, split_rows
from torchrg.errors import FormatError
from torchrg.io.fields import assemble_cloud, stack_columns
from torchrg.io.files import PARSE_ERRORS, check_available, wrap_errors
from torchrg.io.headers import check_grid, distance_outside
from torchrg.io.mesh import Fronts
from torchrg.structures import FARTHEST, Cloud
from torchrg.structures.colors import WIDEN, read_colors
from torchrg.structures.points import Array, bounding_box

_AXES = ("cartesianX", "cartesianY", "cartesianZ")
_COORDINATES = "cartesianX"
"""Column of the coordinates in all three axes; no field of a scan keeps this name."""
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_STATES = ("cartesianInvalidState", "sphericalInvalidState")
_CHANNELS = {"colorRed": "red", "colorGreen": "green", "colorBlue": "blue"}
_LIMITS = "colorLimits"
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_SYSTEM_NODE, SYSTEM = "coordinateMetadata", "coordinate_metadata"
"""Key of the coordinate reference system in a file, and in the header of a cloud."""
_BOUNDS = tuple(f"{axis}{end}" for end in ("Minimum", "Maximum") for axis in "xyz")
_MAX_DEVIATION, _MAX_ROTATION = 0.01, 2.0
"""Maximum deviation of a quaternion's norm from 1 without a note, and maximum factor from 1 without
an error. Programs round quaternions."""
_PAGE_BYTES, _CONTENT_BYTES = 1024, 1020
"""Page size of the standard, with and without the CRC-32C of the page in its last four bytes."""
_XML_ENTRY = struct.Struct("<24xQQ")
"""File offset (counting checksums) and length of the XML, in the file header."""
_MAX_DEPTH, _MAX_CHILDREN = 100, 1_000
"""Maximum XML depth and children per structure: libe57's time grows with their squares."""
_MAX_RATIO = 1_000
"""Maximum bytes of memory per byte of a file. Constant values take no bits in the file."""
_VALUE_BYTES = 8
"""Maximum bytes of a value in memory."""
_Block = dict[str, Array]
"""Columns of a scan, by name."""


class ScanPose(NamedTuple):
    """Name and pose of a scan in an E57 file.

    The rotation is a quaternion w x y z of any norm (zero: identity), applied first.
    """

    name: str = ""
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def is_moved(self) -> bool:
        """Whether the pose is not the identity; if it is, points are bit-identical."""
        return (self.rotation, self.translation) != (ScanPose().rotation, ScanPose().translation)

    def turn(self, vectors: NDArray[np.floating]) -> NDArray[np.float64]:
        """Rotate vectors from scan to world axes, shape ``(N, 3)``.

        Unlike a BLAS product, the result of a row does not depend on the number of rows.
        """
        from scipy.spatial.transform import Rotation

        w, x, y, z = self.rotation if any(self.rotation) else ScanPose().rotation
        turned, (i, j, k) = scratch.empty(vectors.shape, np.float64), vectors.T
        for axis, (a, b, c) in enumerate(Rotation.from_quat([x, y, z, w]).as_matrix()):
            turned[:, axis] = i * a + j * b + k * c
        return turned

    def to_world(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Transform points from the scan to the world, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        moved = self.turn(points)
        moved += np.array(self.translation)
        return moved


def read_e57(path: Path, size: int) -> Cloud:
    """Read all scans of an E57 file.

    Each scan's pose is applied to its points and normals. Invalid points become NaN. If there are
    several scans, the field ``scan`` is the scan index of each point, and a field missing in a scan
    is zero there. The front of a point is the direction to its scanner, if the pose has one.
    """
    pye57 = require("pye57", extra="e57", purpose="read E57 files")
    _check_pages(path, size)
    _check_tree(path, size)
    message = f"{path}: expected an E57 file, got: "
    errors = (pye57.libe57.E57Exception, *PARSE_ERRORS)
    with (
        wrap_errors(message, *errors, repair="; the file may be corrupt, copy or write it again"),
        pye57.E57(str(path)) as file,
    ):
        headers = [file.get_header(i) for i in range(file.scan_count)]
        if not headers:
            raise FormatError(f"{path}: expected at least one scan, got none; check its source.")
        counts = [header.point_count for header in headers]
        content = f"{sum(counts):,} points"
        num_values = sum(header.point_count * len(header.point_fields) for header in headers)
        # Coordinates take at least one bit, unless they are all equal.
        min_bytes = max(sum(counts) // 8, _VALUE_BYTES * num_values // _MAX_RATIO)
        check_available(path, 0, min_bytes, content, available=size, at_least=True)
        scans = tuple(_read_pose(path, header) for header in headers)
        blocks, num_outside = list[_Block](), 0
        for header, scan in zip(headers, scans, strict=True):
            points, fields = _read_points(path, pye57, file, header)
            # pye57 transforms the bounds of a scan that has a pose, contrary to the standard.
            bounds = () if scan.is_moved else _read_numbers(header.node, "cartesianBounds", _BOUNDS)
            if bounds and len(finite := points[np.isfinite(points).all(axis=1)]):
                box = np.reshape(bounds, (2, 3))
                num_outside += distance_outside(*bounding_box(finite), box) > 0
            blocks.append(_to_world(points, fields, scan))
        notes = _unify_colors(path, blocks, [_color_limits(pye57, header) for header in headers])
        root = file.root
        system = root[_SYSTEM_NODE].value() if root.isDefined(_SYSTEM_NODE) else ""
        num_images = len(root["images2D"]) if root.isDefined("images2D") else 0
    names = dict.fromkeys(name for block in blocks for name in block)
    absent = [names.keys() - block.keys() for block in blocks]
    num_rotated = sum(abs(math.hypot(*scan.rotation) - 1) > _MAX_DEVIATION for scan in scans)
    if num_rotated:
        notes += (
            f"the rotations of {num_rotated} of {len(scans)} scans are not unit quaternions and "
            "are normalized; zero means no rotation",
        )
    if num_outside:
        notes += (
            f"the points of {num_outside} of {len(scans)} scans lie outside the bounds in the "
            "header; check the scales",
        )
    if any(absent):
        missing = ", ".join(name for name in names if any(name in each for each in absent))
        notes += (f"{sum(map(bool, absent))} of {len(scans)} scans lack {missing}, zero there",)
    if num_images:
        notes += (f"images left out: {num_images}",)
    columns = {
        name: scratch.join(
            [block.pop(name, np.zeros(n, "u1")) for block, n in zip(blocks, counts, strict=True)]
        )
        for name in names
    }
    if len(scans) > 1:
        columns["scan"] = np.repeat(np.arange(len(scans), dtype=np.int32), counts)
    header = {"scans": scans} | ({SYSTEM: system} if system else {})
    cloud = assemble_cloud(path, columns, coordinates=_COORDINATES, header=header, notes=notes)
    front, more = _scanner_directions(scans, counts, cloud)
    return replace(cloud, front=front, notes=notes + more)


def count_e57(path: Path, size: int) -> int:
    """Return the number of points of all scans from the XML, without checking all pages."""
    counts: list[int] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        if name == "points":
            counts.append(int(attributes.get("recordCount", 0)))

    _parse_tree(path, size, begin)
    return min(sum(counts), 8 * size)  # A point takes at least a bit.


def _color_limits(pye57: ModuleType, header: Any) -> NDArray[np.float64] | None:  # noqa: ANN401
    """Return the color limits of a scan, shape ``(2, 3)``; None if any is missing."""
    if _LIMITS not in header.scan_fields:
        return None
    names = [f"{channel}{end}" for end in ("Minimum", "Maximum") for channel in _CHANNELS]
    if not all(map(header[_LIMITS].isDefined, names)):
        return None
    nodes = [header[_LIMITS][name] for name in names]
    is_scaled = [isinstance(node, pye57.libe57.ScaledIntegerNode) for node in nodes]
    values = [n.scaledValue() if s else n.value() for n, s in zip(nodes, is_scaled, strict=True)]
    return np.array(values, np.float64).reshape(2, len(_CHANNELS))


def _unify_colors(
    path: Path, blocks: Sequence[_Block], limits: Sequence[NDArray[np.float64] | None]
) -> tuple[str, ...]:
    """Scale the colors of all scans to one range if any scan states limits; return notes."""
    if all(each is None for each in limits):
        return ()
    channels, notes = [*_CHANNELS.values()], dict[str, None]()
    colors = dict[int, Array]()
    for i, (block, stated) in enumerate(zip(blocks, limits, strict=True)):
        if all(channel in block for channel in channels):
            color = stack_columns(path, [block[channel] for channel in channels])
            colors[i], more = read_colors(path, color, stated)
            notes |= dict.fromkeys(more)
    is_wide = any(color.dtype == np.uint16 for color in colors.values())
    for i, color in colors.items():
        factor = WIDEN if is_wide and color.dtype == np.uint8 else 1
        columns = (color.astype(np.uint16) * factor if is_wide else color).T
        blocks[i].update(zip(channels, columns, strict=True))
    return tuple(notes)


def _scanner_directions(scans: Sequence[ScanPose], counts: Sequence[int], cloud: Cloud) -> Fronts:
    """Return the direction from each point to its scanner, and notes on implausible positions.

    Programs without poses write the identity for all scans. Others use the pose to keep coordinates
    small, with a position outside the points.
    """
    if not any(scan.is_moved for scan in scans) or not cloud.finite.any():
        return None, ()
    positions = np.array([scan.translation for scan in scans])
    is_whole = bool(cloud.finite.all())
    low, high = bounding_box(cloud.coordinates if is_whole else cloud.coordinates[cloud.finite])
    inside = np.all([low <= positions, positions <= high], axis=(0, 2))
    notes: tuple[str, ...] = ()
    if not inside.all():
        notes = (
            f"the poses of {int((~inside).sum())} of {len(scans)} scans lie outside the points and "
            "are not used as scanner positions",
        )
    if not inside.any():
        return None, notes
    front = scratch.empty((len(cloud), 3), np.float32)
    front[:] = 0
    parts = (np.split(values, np.cumsum(counts)[:-1]) for values in (front, cloud.coordinates))
    for position, is_inside, part, points in zip(positions, inside, *parts, strict=True):
        if is_inside:
            np.subtract(position, points, out=part, casting="same_kind")
    front[~cloud.finite] = 0
    return front, notes


def _check_pages(path: Path, size: int) -> None:
    """Check the checksum of each page before libe57 does.

    A libe57 reader that meets a corrupt page during construction leaks its two megabytes. libe57
    itself reports an incomplete last page.
    """
    crc32c = require("google_crc32c", extra="e57", purpose="read E57 files")
    with path.open("rb") as stream:
        for start in range(0, size if size % _PAGE_BYTES == 0 else 0, _PAGE_BYTES):
            page = stream.read(_PAGE_BYTES)
            content, checksum = page[:_CONTENT_BYTES], page[_CONTENT_BYTES:]
            if crc32c.value(content) != int.from_bytes(checksum, "big"):
                raise FormatError(
                    f"{path}: byte {start}: the checksum of a page does not match; copy it again."
                )


def _check_tree(path: Path, size: int) -> None:
    """Check that libe57 parses the XML in time; libe57 reports any other errors in it."""
    open_nodes: list[tuple[str | None, int]] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        kind, count = open_nodes.pop() if open_nodes else (None, 0)
        open_nodes.extend([(kind, count + 1), (attributes.get("type"), 0)])
        if len(open_nodes) > _MAX_DEPTH or (kind != "Vector" and count >= _MAX_CHILDREN):
            raise FormatError(
                f"{path}: expected XML of at most {_MAX_DEPTH} levels and {_MAX_CHILDREN:,} fields "
                f"per structure, got more at {name}; write the file again."
            )

    _parse_tree(path, size, begin, lambda name: open_nodes.pop())


def _parse_tree(
    path: Path,
    size: int,
    begin: Callable[[str, dict[str, str]], object],
    end: Callable[[str], object] | None = None,
) -> None:
    """Pass the name and attributes of each XML element to functions; ignore an incomplete XML."""
    with path.open("rb") as stream:
        head = stream.read(_XML_ENTRY.size)
        if len(head) < _XML_ENTRY.size or not max(_XML_ENTRY.unpack(head)) <= size:
            return
        start, length = _XML_ENTRY.unpack(head)
        stream.seek(start - start % _PAGE_BYTES)
        num_pages = -(-(start % _PAGE_BYTES + length) // _CONTENT_BYTES)
        pages = [stream.read(_PAGE_BYTES)[:_CONTENT_BYTES] for _ in range(num_pages)]
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    with contextlib.suppress(expat.ExpatError):
        parser.Parse(b"".join(pages)[start % _PAGE_BYTES :][:length], True)


def _read_pose(path: Path, header: Any) -> ScanPose:  # noqa: ANN401
    """Return the name and the pose of a scan."""
    name = header["name"].value() if "name" in header.scan_fields else ""
    rotation = _read_numbers(header.node, "pose/rotation", "wxyz") or ScanPose().rotation
    translation = _read_numbers(header.node, "pose/translation", "xyz") or ScanPose().translation
    length = math.hypot(*rotation)
    if length and not 1 / _MAX_ROTATION <= length <= _MAX_ROTATION:
        raise FormatError(
            f"{path}: expected a unit quaternion in {name!r}, got norm {length:.3g}; correct it."
        )
    if not all(abs(value) <= FARTHEST for value in translation):
        raise FormatError(
            f"{path}: expected a translation of scan {name!r} within {FARTHEST:g}, got "
            f"{max(translation, key=abs):.3g}; correct the pose or write the file again."
        )
    return ScanPose(name, rotation, translation)


def _read_numbers(node: Any, prefix: str, names: Iterable[str]) -> tuple[float, ...]:  # noqa: ANN401
    """Return the numbers of a structure in the order of ``names``; empty if any is missing."""
    paths = [f"{prefix}/{name}" for name in names]
    if not all(map(node.isDefined, paths)):
        return ()
    return tuple(float(node[each].value()) for each in paths)


def _read_points(path: Path, pye57: ModuleType, file: Any, header: Any) -> tuple[Array, _Block]:  # noqa: ANN401
    """Read the coordinates of a scan, shape ``(n, 3)``, and its fields by the standard's names.

    Text fields are skipped.
    """
    libe57, count = pye57.libe57, header.point_count
    prototype = libe57.StructureNode(header.points.prototype())
    nodes = {name: pye57.utils.get_node(prototype, name) for name in header.point_fields}
    block = _Block()
    for name, node in nodes.items():
        if name in (*_AXES, *_SPHERICAL) and isinstance(node, libe57.ScaledIntegerNode):
            check_grid(path, name, [node.scale()], [node.offset()])
        if not isinstance(node, libe57.StringNode):
            is_single = isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE
            # libe57 has a single code for 64-bit integers.
            code = "q" if isinstance(node, libe57.IntegerNode) else "f" if is_single else "d"
            block[name] = scratch.empty((count,), np.dtype(code))
    if count:
        buffers = libe57.VectorSourceDestBuffer()
        for name, column in block.items():
            buffer = libe57.SourceDestBuffer(file.image_file, name, column, count, True, True)
            buffers.append(buffer)
        reader = header.points.reader(buffers)
        num_read = reader.read()
        if num_read < count:
            raise EOFError(f"{num_read:,} of {count:,} points")
        reader.close()
    if all(axis in block for axis in _AXES):
        points = stack_columns(path, [block.pop(axis) for axis in _AXES])
    elif all(axis in block for axis in _SPHERICAL):
        spherical = stack_columns(path, [block.pop(axis) for axis in _SPHERICAL])
        points = scratch.empty(spherical.shape, np.float64)
        for rows in split_rows(count, ROWS_AT_ONCE):
            points[rows] = to_cartesian(spherical[rows].astype(np.float64))
    else:
        raise FormatError(f"{path}: expected {', '.join(_AXES)}, got {', '.join(block) or 'none'}.")
    for name in _STATES:
        if name in block:
            points[block.pop(name) != 0] = np.nan
    return points, block


def _to_world(points: Array, block: _Block, scan: ScanPose) -> _Block:
    """Apply the pose to points and normals of a scan, and rename its fields to column names.

    The points are one column, ``_COORDINATES``.
    """
    if scan.is_moved and all(name in block for name in _NORMALS):
        normals = np.stack([block[name] for name in _NORMALS], axis=1)
        block.update(zip(_NORMALS, scan.turn(normals).astype(normals.dtype).T, strict=True))
        # The extension prefix is dropped from a field name, unless two fields would collide.
    short = {name: _CHANNELS.get(name, name.rpartition(":")[2]) for name in block}
    counts = Counter(short.values())
    named = {short[name] if counts[short[name]] == 1 else name: c for name, c in block.items()}
    return {**named, _COORDINATES: scan.to_world(points)}


def to_cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert range, azimuth and elevation (radians) to Cartesian coordinates, shape ``(N, 3)``."""
    distance, azimuth, elevation = spherical.T
    flat = distance * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )
