"""E57 through pye57 (extra ``e57``): all scans of a file as one cloud, poses kept for writing.

Points go through pye57's ``libe57``, because ``pye57.E57`` itself (0.4.19) writes coordinates in
single precision and knows no field beyond colour, intensity, row and column. Normals are the
standard's extension ``nor``; labels, curvature and other fields are in an extension ``torchrg``.
Of what a file holds beside points, names and poses of scans and the coordinate system are kept.
"""

import re
import sys
import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.columns import Spelling, flatten_cloud
from torchrg.io.fields import Columns
from torchrg.io.files import DAMAGES, asking_system, atomic_path, check_promise, refusing
from torchrg.io.stream import CloudStream, Fronts, Table
from torchrg.structures import Cloud

_AXES = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_STATE = "cartesianInvalidState"
_STATES = (_STATE, "sphericalInvalidState")
_COLOR = ("colorRed", "colorGreen", "colorBlue")
_CHANNELS = dict(zip(_COLOR, ("red", "green", "blue"), strict=True))
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_SPELLING = Spelling(normals=_NORMALS, color=_COLOR)
_PLAIN = ("intensity", "rowIndex", "columnIndex", "returnIndex", "returnCount")
_STANDARD = {*_NORMALS, *_COLOR, *_PLAIN}
"""Names of fields that the standard knows. All others go into an extension."""
_EXTENSIONS = {
    "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt",
    "torchrg": "urn:torchrg:point-fields",
}
_SYSTEM_NODE, SYSTEM = "coordinateMetadata", "coordinate_metadata"
"""Where the coordinate reference system is in a file, and in the header of a cloud."""
_ENDS = ("Minimum", "Maximum")
_PAGE_BYTES = 1024
"""The standard's page, the last four bytes of which are the CRC-32C of the others."""
_BYTES_PER_POINT = 12
"""Bytes of a point to guess their number by the size of a file: three coordinates of 32 bits."""
_Block = dict[str, NDArray[Any]]
"""Columns of a scan by name."""


def open_e57(path: Path, size: int) -> Table:
    """Open an E57 file, all scans of it.

    Every scan is moved by its pose, and its normals with it. Points marked as invalid are kept as
    not-a-number. Of several scans, ``scan`` is the number of each point's; a field that some scans
    lack is zero there, and written for the others alone. The front of a point is where its scanner
    stood, as far as poses say so.
    """
    pye57 = _pye57("read")
    _check_pages(path)
    with _reading(pye57, path) as file:
        headers = [file.get_header(i) for i in range(file.scan_count)]
        counts = [header.point_count for header in headers]
        num_points = sum(counts)
        # Coordinates that differ at all take a bit.
        check_promise(
            path, 0, num_points // 8, f"{num_points:,} points", available=size, at_least=True
        )
        scans = tuple(_scan_of(header) for header in headers)
        system, num_pictures = _beside_points(file.root)
        empty = [
            _to_world(path, {name: np.empty(0, code) for name, code in _letters(pye57, h)}, scan)
            for h, scan in zip(headers, scans, strict=True)
        ]
    if not empty:
        raise FormatError(f"{path}: expected at least one scan, got none; fetch the file again.")
    dtypes = {
        name: np.result_type(*(block.get(name, np.uint8) for block in empty))
        for name in dict.fromkeys(name for block in empty for name in block)
    }
    scans = tuple(
        scan._replace(lacks=tuple(name for name in dtypes if name not in block))
        for scan, block in zip(scans, empty, strict=True)
    )
    lacking = [scan for scan in scans if scan.lacks]
    notes: tuple[str, ...] = ()
    if lacking:
        names = dict.fromkeys(name for scan in lacking for name in scan.lacks)
        notes += (f"{len(lacking)} of {len(scans)} scans lack {', '.join(names)}, zero there",)
    if num_pictures:
        notes += (f"pictures left out: {num_pictures}",)

    def conformed(block: _Block, number: int) -> _Block:
        count = len(block["x"])
        columns = {
            name: block[name].astype(dtype, copy=False) if name in block else np.zeros(count, dtype)
            for name, dtype in dtypes.items()
        }
        if len(scans) > 1:
            columns["scan"] = np.full(count, number, np.int32)
        return columns

    def read(chunk_size: int) -> Iterator[Columns]:
        if num_points == 0:
            yield conformed(empty[0], 0)
            return
        with _reading(pye57, path) as file:
            for number, scan in enumerate(scans):
                for block in _read_points(pye57, file, file.get_header(number), chunk_size):
                    yield conformed(_to_world(path, block, scan), number)

    header = {"scans": scans} | ({SYSTEM: system} if system else {})
    find = partial(_fronts, scans, counts)
    return Table(read, num_points, header=header, notes=notes, fronts=find)


def _fronts(scans: Sequence["ScanPose"], counts: Sequence[int], cloud: Cloud) -> Fronts:
    """Return the direction from each point to its scanner, and whose place is no scanner's.

    Programs that know no poses write one that moves nothing, or use it to keep coordinates small.
    The first kind is known by being that of all scans, the second by a place outside of the points.
    """
    if not any(scan.is_moved for scan in scans) or not cloud.finite.any():
        return None, ()
    places = np.array([scan.translation for scan in scans])
    kept = cloud.coordinates[cloud.finite]
    inside = ((kept.min(axis=0) <= places) & (places <= kept.max(axis=0))).all(axis=1)
    notes: tuple[str, ...] = ()
    if not inside.all():
        notes = (
            f"the poses of {int((~inside).sum())} of {len(scans)} scans lie outside of the points, "
            "and are not taken for places of the scanner",
        )
    if not inside.any():
        return None, notes
    front = np.repeat(places, counts, axis=0) - cloud.coordinates
    front[~np.repeat(inside, counts) | ~cloud.finite] = 0
    return front.astype(np.float32), notes


def _beside_points(root: Any) -> tuple[str, int]:  # noqa: ANN401
    """Return the coordinate reference system of a file, empty if it names none, and its pictures.

    The system is WKT as a rule.
    """
    system = root[_SYSTEM_NODE].value() if root.isDefined(_SYSTEM_NODE) else ""
    return system, len(root["images2D"]) if root.isDefined("images2D") else 0


@contextmanager
def _reading(pye57: Any, path: Path) -> Iterator[Any]:  # noqa: ANN401
    """Open a file; what is wrong with it is an error that names it."""
    errors = (pye57.libe57.E57Exception, *DAMAGES)
    with (
        refusing(f"{path}: expected an E57 file, got: ", *errors, repair="; fetch it again"),
        pye57.E57(str(path)) as file,
    ):
        yield file


def check_e57(path: Path, cloud: Cloud | CloudStream | None) -> None:
    """Check that pye57 is installed; E57 holds any cloud."""
    _pye57("write")


def write_e57(path: Path, stream: CloudStream) -> None:
    """Write an E57 file; points that are not finite are marked as invalid.

    If the cloud came from an E57 file, its scans are written with their poses, otherwise one is.
    """
    pye57 = _pye57("write")
    groups, is_numbered = _groups(path, stream)
    summaries = [_Summary(group.scan) for group in groups]
    give_blocks = partial(_scan_blocks, path, stream, groups, is_numbered=is_numbered)
    for number, block in give_blocks():
        summaries[number].add(block)
    errors = (pye57.libe57.E57Exception, ValueError, RuntimeError)
    with (
        refusing(f"{path}: cannot be written: ", *errors),
        atomic_path(path) as beside,
        _writing(pye57.libe57, beside) as image,
    ):
        scans = _write_header(pye57.libe57, image, stream.header.get(SYSTEM, ""))
        for number, blocks in groupby(give_blocks(), key=itemgetter(0)):
            points = (block for _, block in blocks)
            scan = groups[number].scan
            _write_points(pye57.libe57, image, scans, scan, summaries[number], points)


@contextmanager
def _writing(libe57: Any, path: Path) -> Iterator[Any]:  # noqa: ANN401
    """Open a file to write; of one that fails, the first error is told, not that of closing it."""
    image = None
    try:
        with asking_system(path, libe57.E57Exception):
            image = libe57.ImageFile(str(path), "w")
            yield image
            image.close()
    except BaseException:
        if image is not None:
            with suppress(libe57.E57Exception):
                image.close()
        raise


def _write_header(libe57: Any, image: Any, system: str) -> Any:  # noqa: ANN401
    """Write what is said about a file as a whole, and return the node of its scans.

    There is no date, so that equal clouds differ in their identifiers alone.
    """
    for prefix, uri in {"": libe57.E57_V1_0_URI, **_EXTENSIONS}.items():
        image.extensionsAdd(prefix, uri)
    facts = {
        "formatName": "ASTM E57 3D Imaging Data File",
        "guid": f"{{{uuid.uuid4()}}}",
        "versionMajor": libe57.E57_FORMAT_MAJOR,
        "versionMinor": libe57.E57_FORMAT_MINOR,
        "e57LibraryVersion": libe57.E57_LIBRARY_ID,
        _SYSTEM_NODE: system,
        "creationDateTime": {"dateTimeValue": 0.0, "isAtomicClockReferenced": 0},
    }
    _set_facts(libe57, image, image.root(), facts)
    scans, pictures = libe57.VectorNode(image, True), libe57.VectorNode(image, True)
    image.root().set("data3D", scans)
    image.root().set("images2D", pictures)
    return scans


def count_e57(stream: BinaryIO, size: int) -> int:
    """Return about the number of points by the size: opening a file checks all of its pages."""
    return size // _BYTES_PER_POINT


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
            if crc32c.value(page[:-4]) != int.from_bytes(page[-4:], "big"):
                raise FormatError(
                    f"{path}: byte {start}: expected a page that agrees with its checksum, got "
                    "another; the file is damaged, fetch it again."
                )


def _pye57(verb: str) -> Any:  # noqa: ANN401
    """Return the module."""
    return require("pye57", extra="e57", purpose=f"{verb} E57 files")


class ScanPose(NamedTuple):
    """A scan of an E57 file: its name, and how its points were moved to where they are.

    The rotation is a quaternion w x y z of any length, where zero turns nothing; the translation is
    added after it. ``lacks`` are the columns that other scans of the file have and this one has
    not.
    """

    name: str = "torchrg"
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)
    lacks: tuple[str, ...] = ()

    @property
    def is_moved(self) -> bool:
        """Whether the pose changes anything; if not, points keep their bits."""
        return (self.rotation, self.translation) != (ScanPose().rotation, ScanPose().translation)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The rotation as a matrix, shape ``(3, 3)``."""
        from scipy.spatial.transform import Rotation

        w, x, y, z = self.rotation if any(self.rotation) else ScanPose().rotation
        matrix: NDArray[np.float64] = Rotation.from_quat([x, y, z, w]).as_matrix()
        return matrix

    def to_world(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Move points of the scan to the world, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        turned = _turned(points, self.matrix)
        turned += np.array(self.translation)
        return turned

    def to_scan(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Move points of the world to the scan, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        return _turned(points - np.array(self.translation), self.matrix.T)

    def turn_normals(self, block: _Block, *, back: bool = False) -> None:
        """Turn the normals of a block, if it has any, to the world or back, in their own type."""
        if self.is_moved and all(name in block for name in _NORMALS):
            normals = np.stack([block[name] for name in _NORMALS], axis=1)
            turned = _turned(normals, self.matrix.T if back else self.matrix)
            block.update(zip(_NORMALS, turned.astype(normals.dtype).T, strict=True))


def _turned(points: NDArray[np.floating], matrix: NDArray[np.float64]) -> NDArray[np.floating]:
    """Return each point times a matrix, the same bits however many points there are.

    BLAS rounds a product in an order that depends on its size.
    """
    x, y, z = points.T
    turned: NDArray[np.floating] = np.empty(points.shape)
    for i, (a, b, c) in enumerate(matrix):
        turned[:, i] = x * a + y * b + z * c
    return turned


def _scan_of(header: Any) -> ScanPose:  # noqa: ANN401
    """Return the name and the pose of a scan."""
    name = header["name"].value() if "name" in header.scan_fields else ""
    if not header.has_pose():
        return ScanPose(name)
    return ScanPose(name, tuple(header.rotation.tolist()), tuple(map(float, header.translation)))


def _read_points(pye57: Any, file: Any, header: Any, chunk_size: int) -> Iterator[_Block]:  # noqa: ANN401
    """Read what the points of a scan hold, so many at a time, by the standard's names."""
    libe57, count = pye57.libe57, header.point_count
    if count == 0:
        return
    at_once = min(count, chunk_size)
    block = {name: np.empty(at_once, code) for name, code in _letters(pye57, header)}
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in block.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, column, at_once, True, True))
    reader = header.points.reader(buffers)
    found = 0
    while found < count:
        num_read = reader.read()
        if num_read == 0:
            raise EOFError(f"{found:,} of {count:,} points")
        found += num_read
        # The reader fills the same memory again.
        yield block if num_read == count else {n: c[:num_read].copy() for n, c in block.items()}
    reader.close()


def _letters(pye57: Any, header: Any) -> list[tuple[str, str]]:  # noqa: ANN401
    """Return the fields of a scan and the letters of NumPy's types for them; texts are left out."""
    prototype = pye57.libe57.StructureNode(header.points.prototype())
    nodes = [(name, pye57.utils.get_node(prototype, name)) for name in header.point_fields]
    return [
        (name, _letter(pye57.libe57, node))
        for name, node in nodes
        if not isinstance(node, pye57.libe57.StringNode)
    ]


def _letter(libe57: Any, node: Any) -> str:  # noqa: ANN401
    """Return the letter of NumPy's type for a field; q is libe57's only one for 64 bits."""
    if isinstance(node, libe57.IntegerNode):
        return "q"
    single = isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE
    return "f" if single else "d"


def _to_world(path: Path, block: _Block, scan: ScanPose) -> _Block:
    """Move the points of a scan by its pose, and give the fields the names of columns."""
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
    scan.turn_normals(block)
    plain = Counter(map(_plain, block))
    named = {_plain(name) if plain[_plain(name)] == 1 else name: c for name, c in block.items()}
    return {**named, **dict(zip("xyz", scan.to_world(points).T, strict=True))}


def _plain(name: str) -> str:
    """Return the name of a column by that of a field, without the extension it belongs to."""
    return _CHANNELS.get(name, name.rpartition(":")[2])


def to_cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Cartesian coordinates of range, azimuth and elevation (radians), shape ``(N, 3)``."""
    distance, azimuth, elevation = spherical.T
    flat = distance * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )


class _Group(NamedTuple):
    """Points that become a scan, and how many they are at most."""

    scan: ScanPose
    count: int  # type: ignore[assignment]


def _groups(path: Path, stream: CloudStream) -> tuple[list[_Group], bool]:
    """Return the scans that a cloud is cut into, and whether its field ``scan`` numbers them.

    They are the scans that it came from if the field numbers these in order, which a pass over the
    points tells. The field says no more then, and is left out.
    """
    scans = stream.header.get("scans", ())
    if len(scans) < 2:
        return [_Group(scans[0] if scans else ScanPose(), sys.maxsize)], False
    counts, last = np.zeros(len(scans), np.int64), 0
    for chunk in stream:
        number = flatten_cloud(path, chunk, _SPELLING).get("scan", np.full(1, -1))
        bounds = np.searchsorted(number, np.arange(len(scans) + 1))
        counts += np.diff(bounds)
        is_sorted = number[0] >= last and (number[1:] >= number[:-1]).all()
        if not is_sorted or bounds[0] != 0 or bounds[-1] != len(chunk):
            return [_Group(ScanPose(), sys.maxsize)], False
        last = number[-1]
    return [_Group(scan, int(count)) for scan, count in zip(scans, counts, strict=True)], True


def _scan_blocks(
    path: Path, stream: CloudStream, groups: Sequence[_Group], *, is_numbered: bool
) -> Iterator[tuple[int, _Block]]:
    """Give the columns of each chunk in the frame of its scan, cut where the next scan begins.

    Raises:
        FormatError: If a field is not of numbers that E57 holds.
    """
    number, left = 0, groups[0].count
    for chunk in stream:
        columns = flatten_cloud(path, chunk, _SPELLING)
        for name, column in columns.items():
            if column.dtype == np.uint64 and (column >= 2**63).any():
                raise FormatError(f"{path}: expected field {name} below 2^63; leave it out.")
        if is_numbered:
            del columns["scan"]
        start = 0
        while start < len(chunk):
            while left == 0:
                number += 1
                left = groups[number].count
            stop = min(start + left, len(chunk))
            block = {name: column[start:stop] for name, column in columns.items()}
            yield number, _to_scan(path, block, groups[number].scan)
            left -= stop - start
            start = stop


def _to_scan(path: Path, block: _Block, scan: ScanPose) -> _Block:
    """Move points back to the frame of their scan, and give the fields the standard's names."""
    points = scan.to_scan(np.stack([block.pop(axis) for axis in "xyz"], axis=1))
    scan.turn_normals(block, back=True)
    finite = np.isfinite(points).all(axis=1)
    # 2: there is nothing meaningful in the coordinates.
    named: _Block = {_STATE: np.where(finite, np.uint8(0), np.uint8(2))}
    for name, column in block.items():
        word = re.sub(r"[^A-Za-z0-9_.-]|^(?=[^A-Za-z_])", "_", name)
        new = name if name in _STANDARD else f"torchrg:{word}"
        if new in named:
            raise FormatError(
                f"{path}: expected fields of different names in letters and digits, got {word!r} "
                "twice; rename one."
            )
        named[new] = column
    if not finite.all():
        points = np.where(finite[:, None], points, 0)
    return {**dict(zip(_AXES, points.T, strict=True)), **named}


class _Summary:
    """What has to be known of all points of a scan before the first is written.

    Attributes:
        longest: Points of its longest block.
        limits: Least and largest values of whole numbers, of an intensity that is finite, and of
            coordinates that are not marked as invalid.
        lacks: Columns that the scan came without and that are still zero.
    """

    def __init__(self, scan: ScanPose) -> None:
        self.longest = 0
        self.lacks = set(scan.lacks)
        self.limits: dict[str, tuple[Any, Any]] = {}

    def add(self, block: _Block) -> None:
        """Look at a block."""
        self.longest = max(self.longest, len(block[_STATE]))
        there = block[_STATE] == 0
        for name, column in block.items():
            if _plain(name) in self.lacks and column.any():
                self.lacks.remove(_plain(name))
            if name in _AXES:
                column = column[there]
            elif name == "intensity":
                column = column[np.isfinite(column)]
            elif column.dtype.kind == "f":
                continue
            if column.size:
                low, high = column.min(), column.max()
                known_low, known_high = self.limits.get(name, (low, high))
                self.limits[name] = (min(low, known_low), max(high, known_high))


def _write_points(
    libe57: Any,  # noqa: ANN401
    image: Any,  # noqa: ANN401
    scans: Any,  # noqa: ANN401
    scan: ScanPose,
    summary: _Summary,
    blocks: Iterator[_Block],
) -> None:
    """Add a scan to those of a file, its columns by the standard's names and in its own frame."""
    first = next(blocks)
    is_marked = summary.limits[_STATE] != (0, 0)
    names = [
        name
        for name in first
        if _plain(name) not in summary.lacks and (name != _STATE or is_marked)
    ]
    prototype = libe57.StructureNode(image)
    buffers = libe57.VectorSourceDestBuffer()
    # libe57 keeps the addresses of the columns, so they have to live until it is done.
    kept: _Block = {}
    for name in names:
        dtype = first[name].dtype
        if dtype.kind == "f":
            precision = libe57.E57_DOUBLE if dtype.itemsize > 4 else libe57.E57_SINGLE
            prototype.set(name, libe57.FloatNode(image, 0.0, precision))
            kept[name] = np.empty(summary.longest, dtype)
        else:
            low, high = map(int, summary.limits[name])
            prototype.set(name, libe57.IntegerNode(image, low, low, high))
            kept[name] = np.empty(summary.longest, "q")
        buffer = libe57.SourceDestBuffer(image, name, kept[name], summary.longest, True, True)
        buffers.append(buffer)
    node = _set_facts(libe57, image, libe57.StructureNode(image), _facts(scan, names, summary))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    node.set("points", points)
    scans.append(node)
    writer = points.writer(buffers)
    for block in chain([first], blocks):
        count = len(block[_STATE])
        for name, column in kept.items():
            column[:count] = block[name]
        writer.write(count)
    writer.close()


def _facts(scan: ScanPose, names: Sequence[str], summary: _Summary) -> dict[str, Any]:
    """Return what is said about a scan as a whole: identity, pose, limits."""
    nothing = (0.0, 0.0)
    facts: dict[str, Any] = {
        "guid": f"{{{uuid.uuid4()}}}",
        "name": scan.name,
        "pose": {
            "rotation": dict(zip("wxyz", map(float, scan.rotation), strict=True)),
            "translation": dict(zip("xyz", map(float, scan.translation), strict=True)),
        },
        "cartesianBounds": {
            f"{axis[-1].lower()}{end}": float(limit)
            for axis in _AXES
            for end, limit in zip(_ENDS, summary.limits.get(axis, nothing), strict=True)
        },
    }
    if "intensity" in names:
        facts["intensityLimits"] = {
            f"intensity{end}": float(limit)
            for end, limit in zip(_ENDS, summary.limits.get("intensity", nothing), strict=True)
        }
    if all(name in names for name in _COLOR):
        facts["colorLimits"] = {
            f"{name}{end}": value
            for name in _COLOR
            for end, value in zip(_ENDS, (0, 255), strict=True)
        }
    return facts


def _set_facts(libe57: Any, image: Any, node: Any, facts: dict[str, Any]) -> Any:  # noqa: ANN401
    """Add a node for each fact to another, and return that."""
    kinds = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}
    for name, fact in facts.items():
        if isinstance(fact, dict):
            node.set(name, _set_facts(libe57, image, libe57.StructureNode(image), fact))
        else:
            node.set(name, kinds[type(fact)](image, fact))
    return node
