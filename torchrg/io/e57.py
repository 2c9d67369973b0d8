"""E57 through pye57 (extra ``e57``): all scans of a file as one cloud. It is read only.

Points go through pye57's ``libe57``, because ``pye57.E57`` itself (0.4.19) knows no field beyond
colour, intensity, row and column. Normals are the standard's extension ``nor``; fields of other
extensions lose their prefix. Of what a file holds beside points, names and poses of scans and the
coordinate system are read.
"""

import contextlib
import math
import struct
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.colors import WIDEN, read_colors
from torchrg.io.fields import Values, assemble_cloud
from torchrg.io.files import DAMAGES, check_promise, refusing
from torchrg.io.headers import check_grid, distance_outside
from torchrg.mesh import Fronts
from torchrg.structures import FARTHEST, Cloud, bounding_box

_AXES = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_STATES = ("cartesianInvalidState", "sphericalInvalidState")
_CHANNELS = {"colorRed": "red", "colorGreen": "green", "colorBlue": "blue"}
_LIMITS = "colorLimits"
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_SYSTEM_NODE, SYSTEM = "coordinateMetadata", "coordinate_metadata"
"""Where the coordinate reference system is in a file, and in the header of a cloud."""
_BOUNDS = tuple(f"{axis}{end}" for end in ("Minimum", "Maximum") for axis in "xyz")
_MAX_DEVIATION, _MAX_ROTATION = 0.01, 2.0
"""Largest deviation of a quaternion's length from 1 without a note, and largest factor between them
that is not an error. Programs round quaternions."""
_PAGE_BYTES = 1024
"""The standard's page, the last four bytes of which are the CRC-32C of the others."""
_CONTENT_BYTES = 1020
"""Bytes of a page before its checksum."""
_XML_ENTRY = struct.Struct("<24xQQ")
"""Place, counted with checksums, and length of the XML, in the header of a file."""
_MAX_DEPTH, _MAX_CHILDREN = 100, 1_000
"""Most levels of the XML and children of a structure: libe57's time grows with their squares."""
_MAX_RATIO = 1_000
"""Most bytes of memory for a byte of a file. Values that are all equal take no bits of it."""
_VALUE_BYTES = 8
"""Bytes of a value in memory, at most."""
_BYTES_PER_POINT = 12
"""Bytes of a point to guess their number by the size of a file: three coordinates of 32 bits."""
_Block = dict[str, Values]
"""Columns of a scan by name."""


class ScanPose(NamedTuple):
    """A scan of an E57 file: its name, and how its points were moved to where they are.

    The rotation is a quaternion w x y z of any length, where zero turns nothing; the translation is
    added after it.
    """

    name: str = ""
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def is_moved(self) -> bool:
        """Whether the pose changes anything; if not, points keep their bits."""
        return (self.rotation, self.translation) != (ScanPose().rotation, ScanPose().translation)

    def turn(self, vectors: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return vectors of the scan as they are in the world, shape ``(N, 3)``.

        The bits of each do not depend on how many there are, as those of a product by BLAS would.
        """
        from scipy.spatial.transform import Rotation

        w, x, y, z = self.rotation if any(self.rotation) else ScanPose().rotation
        turned, (i, j, k) = np.empty(vectors.shape), vectors.T
        for axis, (a, b, c) in enumerate(Rotation.from_quat([x, y, z, w]).as_matrix()):
            turned[:, axis] = i * a + j * b + k * c
        return turned

    def to_world(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Move points of the scan to the world, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        moved = self.turn(points)
        moved += np.array(self.translation)
        return moved


def read_e57(path: Path, size: int) -> Cloud:
    """Read an E57 file, all scans of it.

    Every scan is moved by its pose, and its normals with it. Points marked as invalid are kept as
    not-a-number. Of several scans, ``scan`` is the number of each point's; a field that some scans
    lack is zero there. The front of a point is where its scanner stood, as far as poses say so.
    """
    pye57 = require("pye57", extra="e57", purpose="read E57 files")
    _check_pages(path)
    _check_tree(path, size)
    message = f"{path}: expected an E57 file, got: "
    errors = (pye57.libe57.E57Exception, *DAMAGES)
    with (
        refusing(message, *errors, repair="; copy or write it again"),
        pye57.E57(str(path)) as file,
    ):
        headers = [file.get_header(i) for i in range(file.scan_count)]
        if not headers:
            raise FormatError(
                f"{path}: expected at least one scan, got none; check where it comes from."
            )
        counts = [header.point_count for header in headers]
        content = f"{sum(counts):,} points"
        num_values = sum(header.point_count * len(header.point_fields) for header in headers)
        # Coordinates that differ at all take a bit.
        least = max(sum(counts) // 8, _VALUE_BYTES * num_values // _MAX_RATIO)
        check_promise(path, 0, least, content, available=size, at_least=True)
        scans = tuple(_scan_of(path, header) for header in headers)
        blocks, num_outside = list[_Block](), 0
        for header, scan in zip(headers, scans, strict=True):
            points, fields = _read_points(path, pye57, file, header)
            # pye57 moves the bounds of a scan that has a pose, which is not the standard.
            bounds = () if scan.is_moved else _numbers(header.node, "cartesianBounds", _BOUNDS)
            if bounds and len(finite := points[np.isfinite(points).all(axis=1)]):
                box = np.reshape(bounds, (2, 3))
                num_outside += distance_outside(*bounding_box(finite), box) > 0
            blocks.append(_to_world(points, fields, scan))
        notes = _unify_colors(path, blocks, [_limits_of(pye57, header) for header in headers])
        root = file.root
        system = root[_SYSTEM_NODE].value() if root.isDefined(_SYSTEM_NODE) else ""
        num_pictures = len(root["images2D"]) if root.isDefined("images2D") else 0
    names = dict.fromkeys(name for block in blocks for name in block)
    lacks = [names.keys() - block.keys() for block in blocks]
    num_turned = sum(abs(math.hypot(*scan.rotation) - 1) > _MAX_DEVIATION for scan in scans)
    if num_turned:
        notes += (
            f"the rotations of {num_turned} of {len(scans)} scans have another length than 1, and "
            "are scaled to it; those of length 0 turn nothing",
        )
    if num_outside:
        notes += (
            f"the points of {num_outside} of {len(scans)} scans lie outside of the bounds in its "
            "header; check the scales",
        )
    if any(lacks):
        missing = ", ".join(name for name in names if any(name in each for each in lacks))
        notes += (f"{sum(map(bool, lacks))} of {len(scans)} scans lack {missing}, zero there",)
    if num_pictures:
        notes += (f"pictures left out: {num_pictures}",)
    columns = {name: _joined(blocks, name, counts) for name in names}
    if len(scans) > 1:
        columns["scan"] = np.repeat(np.arange(len(scans), dtype=np.int32), counts)
    header = {"scans": scans} | ({SYSTEM: system} if system else {})
    cloud = assemble_cloud(path, columns, header=header, notes=notes)
    front, more = _fronts(scans, counts, cloud)
    return replace(cloud, front=front, notes=notes + more)


def count_e57(path: Path, size: int) -> int:
    """Return about the number of points by the size: opening a file checks all of its pages."""
    return size // _BYTES_PER_POINT


def _limits_of(pye57: ModuleType, header: Any) -> NDArray[np.float64] | None:  # noqa: ANN401
    """Return the limits of the colors of a scan, shape ``(2, 3)``, if it states all of them."""
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
    """Bring the colors of all scans into one range where some state theirs; return notes."""
    if all(each is None for each in limits):
        return ()
    channels, notes = [*_CHANNELS.values()], dict[str, None]()
    colors = dict[int, Values]()
    for i, (block, stated) in enumerate(zip(blocks, limits, strict=True)):
        if all(channel in block for channel in channels):
            color = np.stack([block[channel] for channel in channels], axis=1)
            colors[i], more = read_colors(path, color, stated)
            notes |= dict.fromkeys(more)
    is_wide = any(color.dtype == np.uint16 for color in colors.values())
    for i, color in colors.items():
        factor = WIDEN if is_wide and color.dtype == np.uint8 else 1
        columns = (color.astype(np.uint16) * factor if is_wide else color).T
        blocks[i].update(zip(channels, columns, strict=True))
    return tuple(notes)


def _joined(blocks: Sequence[_Block], name: str, counts: Sequence[int]) -> Values:
    """Return a column of all scans, zero where one lacks it, and take it out of the scans."""
    parts = [block.pop(name, None) for block in blocks]
    dtype = np.result_type(*(np.uint8 if column is None else column for column in parts))
    joined = np.zeros(sum(counts), dtype)
    for column, rows in zip(parts, _rows_of_scans(counts), strict=True):
        if column is not None:
            joined[rows] = column
    return joined


def _rows_of_scans(counts: Sequence[int]) -> list[slice]:
    """Return the rows of each scan."""
    return [slice(*ends) for ends in pairwise(accumulate(counts, initial=0))]


def _fronts(scans: Sequence[ScanPose], counts: Sequence[int], cloud: Cloud) -> Fronts:
    """Return the direction from each point to its scanner, and whose place is no scanner's.

    Programs that know no poses write one that moves nothing, which all scans have then, or use it
    to keep coordinates small, with a place outside of the points.
    """
    if not any(scan.is_moved for scan in scans) or not cloud.finite.any():
        return None, ()
    places = np.array([scan.translation for scan in scans])
    finite = cloud.coordinates[cloud.finite]
    inside = ((finite.min(axis=0) <= places) & (places <= finite.max(axis=0))).all(axis=1)
    notes: tuple[str, ...] = ()
    if not inside.all():
        notes = (
            f"the poses of {int((~inside).sum())} of {len(scans)} scans lie outside of the points, "
            "and are not taken for places of the scanner",
        )
    if not inside.any():
        return None, notes
    front = np.zeros((len(cloud), 3), np.float32)
    for place, is_inside, rows in zip(places, inside, _rows_of_scans(counts), strict=True):
        if is_inside:
            front[rows] = place - cloud.coordinates[rows]
    front[~cloud.finite] = 0
    return front, notes


def _check_pages(path: Path) -> None:
    """Check the checksum of each page, which libe57 does too, but too late.

    A reader that meets a damaged page while it is being made never gives back its two megabytes.
    libe57 says itself what is wrong with a file of no whole pages.
    """
    crc32c = require("google_crc32c", extra="e57", purpose="read E57 files")
    size = path.stat().st_size
    with path.open("rb") as stream:
        for start in range(0, size if size % _PAGE_BYTES == 0 else 0, _PAGE_BYTES):
            page = stream.read(_PAGE_BYTES)
            content, checksum = page[:_CONTENT_BYTES], page[_CONTENT_BYTES:]
            if crc32c.value(content) != int.from_bytes(checksum, "big"):
                raise FormatError(
                    f"{path}: byte {start}: expected a page that agrees with its checksum, got "
                    "another; the file is damaged, copy or write it again."
                )


def _check_tree(path: Path, size: int) -> None:
    """Check that libe57 reads the XML in time; what else is wrong with it libe57 says."""
    with path.open("rb") as stream:
        head = stream.read(_XML_ENTRY.size)
        if len(head) < _XML_ENTRY.size or not max(_XML_ENTRY.unpack(head)) <= size:
            return
        start, length = _XML_ENTRY.unpack(head)
        stream.seek(start - start % _PAGE_BYTES)
        num_pages = -(-(start % _PAGE_BYTES + length) // _CONTENT_BYTES)
        pages = [stream.read(_PAGE_BYTES)[:_CONTENT_BYTES] for _ in range(num_pages)]
    open_nodes: list[tuple[str | None, int]] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        kind, count = open_nodes.pop() if open_nodes else (None, 0)
        open_nodes.extend([(kind, count + 1), (attributes.get("type"), 0)])
        if len(open_nodes) > _MAX_DEPTH or (kind != "Vector" and count >= _MAX_CHILDREN):
            raise FormatError(
                f"{path}: expected XML of at most {_MAX_DEPTH} levels and {_MAX_CHILDREN:,} fields "
                f"of a structure, got more at {name}; write the file again."
            )

    parser = expat.ParserCreate()
    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda name: open_nodes.pop()
    with contextlib.suppress(expat.ExpatError):
        parser.Parse(b"".join(pages)[start % _PAGE_BYTES :][:length], True)


def _scan_of(path: Path, header: Any) -> ScanPose:  # noqa: ANN401
    """Return the name and the pose of a scan."""
    name = header["name"].value() if "name" in header.scan_fields else ""
    rotation = _numbers(header.node, "pose/rotation", "wxyz") or ScanPose().rotation
    translation = _numbers(header.node, "pose/translation", "xyz") or ScanPose().translation
    length = math.hypot(*rotation)
    if length and not 1 / _MAX_ROTATION <= length <= _MAX_ROTATION:
        raise FormatError(
            f"{path}: expected a rotation of length 1 as pose of scan {name!r}, got {length:.3g}; "
            "correct the pose or write the file again."
        )
    if not all(abs(value) <= FARTHEST for value in translation):
        raise FormatError(
            f"{path}: expected a pose of scan {name!r} within {FARTHEST:g}, got "
            f"{max(translation, key=abs):.3g}; correct the pose or write the file again."
        )
    return ScanPose(name, rotation, translation)


def _numbers(node: Any, place: str, names: Iterable[str]) -> tuple[float, ...]:  # noqa: ANN401
    """Return the numbers of a structure by name, whatever their order; none if it lacks any."""
    places = [f"{place}/{name}" for name in names]
    if not all(map(node.isDefined, places)):
        return ()
    return tuple(float(node[each].value()) for each in places)


def _read_points(path: Path, pye57: ModuleType, file: Any, header: Any) -> tuple[Values, _Block]:  # noqa: ANN401
    """Read the coordinates of a scan, shape ``(n, 3)``, and its fields by the standard's names.

    Texts are left out.
    """
    libe57, count = pye57.libe57, header.point_count
    prototype = libe57.StructureNode(header.points.prototype())
    nodes = {name: pye57.utils.get_node(prototype, name) for name in header.point_fields}
    for name, node in nodes.items():
        if name in (*_AXES, *_SPHERICAL) and isinstance(node, libe57.ScaledIntegerNode):
            check_grid(path, name, [node.scale()], [node.offset()])
    block = {
        name: np.empty(count, _letter(libe57, node))
        for name, node in nodes.items()
        if not isinstance(node, libe57.StringNode)
    }
    if count:
        buffers = libe57.VectorSourceDestBuffer()
        for name, column in block.items():
            buffers.append(
                libe57.SourceDestBuffer(file.image_file, name, column, count, True, True)
            )
        reader = header.points.reader(buffers)
        num_read = reader.read()
        if num_read < count:
            raise EOFError(f"{num_read:,} of {count:,} points")
        reader.close()
    if all(axis in block for axis in _AXES):
        points = np.stack([block.pop(axis) for axis in _AXES], axis=1)
    elif all(axis in block for axis in _SPHERICAL):
        spherical = [block.pop(axis).astype("d") for axis in _SPHERICAL]
        points = to_cartesian(np.stack(spherical, axis=1))
    else:
        raise FormatError(
            f"{path}: expected points with {', '.join(_AXES)}, got {', '.join(block) or 'none'}."
        )
    for name in _STATES:
        if name in block:
            points[block.pop(name) != 0] = np.nan
    return points, block


def _letter(libe57: Any, node: Any) -> str:  # noqa: ANN401
    """Return the letter of NumPy's type for a field; q is libe57's only one for 64 bits."""
    if isinstance(node, libe57.IntegerNode):
        return "q"
    single = isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE
    return "f" if single else "d"


def _to_world(points: Values, block: _Block, scan: ScanPose) -> _Block:
    """Move the points of a scan by its pose, and give the fields the names of columns."""
    if scan.is_moved and all(name in block for name in _NORMALS):
        normals = np.stack([block[name] for name in _NORMALS], axis=1)
        block.update(zip(_NORMALS, scan.turn(normals).astype(normals.dtype).T, strict=True))
    # The extension that a field belongs to is no part of its name, unless two have one name.
    plain = {name: _CHANNELS.get(name, name.rpartition(":")[2]) for name in block}
    times = Counter(plain.values())
    named = {plain[name] if times[plain[name]] == 1 else name: c for name, c in block.items()}
    return {**named, **dict(zip("xyz", scan.to_world(points).T, strict=True))}


def to_cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Cartesian coordinates of range, azimuth and elevation (radians), shape ``(N, 3)``."""
    distance, azimuth, elevation = spherical.T
    flat = distance * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )
