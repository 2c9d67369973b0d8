"""E57 through pye57 (extra ``e57``): all scans of a file as one cloud, poses kept for writing.

Points go through pye57's ``libe57``, because ``pye57.E57`` itself (0.4.19) writes coordinates in
single precision and knows no field beyond colour, intensity, row and column. Normals are the
standard's extension ``nor``; labels, curvature and other fields are in an extension ``torchrg``.
Pictures and what else a file holds beside points are not kept.
"""

import re
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.fields import Spelling, assemble_cloud, flatten_cloud, narrow_integers
from torchrg.io.files import DAMAGES, atomic_path, check_file, check_promise, first_line
from torchrg.structures import Cloud

SHORTEST_QUATERNION = 1e-300


class Scan(NamedTuple):
    """A scan of an E57 file: its name, and how its points were moved to where they are.

    Attributes:
        name: Its name.
        rotation: Quaternion w x y z.
        translation: What is added after the rotation.

    Example:
        >>> half_turn = Scan("s", rotation=(0.0, 0.0, 0.0, 1.0), translation=(0.0, 0.0, 2.0))
        >>> half_turn.to_world(np.array([[1.0, 5.0, 3.0]])).tolist()
        [[-1.0, -5.0, 5.0]]
    """

    name: str = "torchrg"
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def is_moved(self) -> bool:
        """Whether the pose changes anything; if not, points keep their bits."""
        return (self.rotation, self.translation) != (Scan().rotation, Scan().translation)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The rotation as a matrix, shape ``(3, 3)``."""
        length = max(float(np.linalg.norm(self.rotation)), SHORTEST_QUATERNION)
        w, x, y, z = np.array(self.rotation) / length
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    def to_world(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Move points of the scan to the world, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        moved: NDArray[np.float64] = points.astype(np.float64) @ self.matrix.T
        moved += np.array(self.translation)
        return moved

    def to_scan(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Move points of the world to the scan, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        moved: NDArray[np.float64] = points.astype(np.float64)
        moved -= np.array(self.translation)
        moved @= self.matrix
        return moved

    def rotate(self, vectors: NDArray[np.floating], *, back: bool = False) -> NDArray[np.floating]:
        """Turn vectors from the scan to the world, or back, shape ``(N, 3)``, in their own type."""
        if not self.is_moved:
            return vectors
        matrix = self.matrix if back else self.matrix.T
        turned: NDArray[np.float64] = vectors.astype(np.float64) @ matrix
        return turned.astype(vectors.dtype)


def to_cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Cartesian coordinates of range, azimuth and elevation (radians), shape ``(N, 3)``."""
    distance, azimuth, elevation = spherical.T
    flat = distance * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )


AXES = ("cartesianX", "cartesianY", "cartesianZ")
STATE = "cartesianInvalidState"
COLOR = ("colorRed", "colorGreen", "colorBlue")
Block = dict[str, NDArray[Any]]


def read_points(pye57: Any, file: Any, header: Any) -> Block:  # noqa: ANN401
    """Return what the points of a scan hold.

    Args:
        pye57: The module.
        file: The open ``pye57.E57``.
        header: The scan's ``pye57.ScanHeader``.

    Returns:
        Columns by the standard's names: int64, float32 or float64; texts are left out.
    """
    libe57, count = pye57.libe57, header.point_count
    prototype = libe57.StructureNode(header.points.prototype())
    block: Block = {}
    buffers = libe57.VectorSourceDestBuffer()
    for name in header.point_fields:
        node = pye57.utils.get_node(prototype, name)
        if isinstance(node, libe57.StringNode):
            continue
        block[name] = np.empty(count, _letter(libe57, node))
        if count:
            buffer = libe57.SourceDestBuffer(file.image_file, name, block[name], count, True, True)
            buffers.append(buffer)
    if count:
        reader = header.points.reader(buffers)
        found = reader.read()
        reader.close()
        if found != count:
            raise EOFError(f"{found:,} of {count:,} points")
    return block


def _letter(libe57: Any, node: Any) -> str:  # noqa: ANN401
    """Return the letter of NumPy's type for a field; q is libe57's only one for 64 bits."""
    if isinstance(node, libe57.IntegerNode):
        return "q"
    single = isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE
    return "f" if single else "d"


def write_points(libe57: Any, file: Any, scan: Scan, block: Block) -> None:  # noqa: ANN401
    """Add a scan to a file.

    Args:
        libe57: The module.
        file: The ``pye57.E57`` open for writing.
        scan: Name and pose.
        block: Columns by the standard's names, in the frame of the scan.
    """
    image, count = file.image_file, len(block[AXES[0]])
    prototype = libe57.StructureNode(image)
    buffers = libe57.VectorSourceDestBuffer()
    # libe57 keeps the addresses of the columns, so they have to live until it is done.
    kept = []
    for name, column in block.items():
        if column.dtype.kind == "f":
            precision = libe57.E57_DOUBLE if column.dtype.itemsize > 4 else libe57.E57_SINGLE
            prototype.set(name, libe57.FloatNode(image, 0.0, precision))
            kept.append(np.ascontiguousarray(column))
        else:
            low, high = int(column.min()), int(column.max())
            prototype.set(name, libe57.IntegerNode(image, low, low, high))
            kept.append(np.ascontiguousarray(column, dtype="q"))
        buffers.append(libe57.SourceDestBuffer(image, name, kept[-1], count, True, True))
    node = _tree(libe57, image, _facts(scan, block))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    node.set("points", points)
    file.data3d.append(node)
    writer = points.writer(buffers)
    writer.write(count)
    writer.close()


def _facts(scan: Scan, block: Block) -> dict[str, Any]:
    """Return what is said about a scan as a whole: identity, pose, limits."""
    there = block.get(STATE, np.zeros(len(block[AXES[0]]))) == 0
    facts: dict[str, Any] = {
        "guid": f"{{{uuid.uuid4()}}}",
        "name": scan.name,
        "pose": {
            "rotation": dict(zip("wxyz", map(float, scan.rotation), strict=True)),
            "translation": dict(zip("xyz", map(float, scan.translation), strict=True)),
        },
        "cartesianBounds": {
            f"{axis[-1].lower()}{end}": float(limit(block[axis][there])) if there.any() else 0.0
            for axis in AXES
            for end, limit in (("Minimum", np.min), ("Maximum", np.max))
        },
    }
    if "intensity" in block:
        known = block["intensity"][np.isfinite(block["intensity"])]
        facts["intensityLimits"] = {
            "intensityMinimum": float(known.min()) if known.size else 0.0,
            "intensityMaximum": float(known.max()) if known.size else 0.0,
        }
    if all(name in block for name in COLOR):
        facts["colorLimits"] = {
            f"{name}{end}": value
            for name in COLOR
            for end, value in (("Minimum", 0), ("Maximum", 255))
        }
    return facts


def _tree(libe57: Any, image: Any, facts: dict[str, Any]) -> Any:  # noqa: ANN401
    """Return a node for each fact."""
    kinds = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}
    node = libe57.StructureNode(image)
    for name, fact in facts.items():
        if isinstance(fact, dict):
            node.set(name, _tree(libe57, image, fact))
        else:
            node.set(name, kinds[type(fact)](image, fact))
    return node


SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
STATES = (STATE, "sphericalInvalidState")
NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
CHANNELS = ("red", "green", "blue")
SPELLING = Spelling(normals=NORMALS, color=COLOR)
STANDARD = {*NORMALS, *COLOR, "intensity", "rowIndex", "columnIndex", "returnIndex", "returnCount"}
EXTENSIONS = {
    "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt",
    "torchrg": "urn:torchrg:point-fields",
}


def read_e57(path: Path) -> Cloud:
    """Read all scans of an E57 file.

    Args:
        path: The file.

    Returns:
        The cloud, every scan moved by its pose, and its normals with it. Points marked as invalid
        are kept as not-a-number. Of several scans, ``scan`` is the number of each point's; a field
        that some scans lack is zero there.

    Raises:
        FormatError: If the file is damaged or has no points.
        MissingDependencyError: If pye57 is not installed.
    """
    pye57 = require("pye57", extra="e57", purpose="read E57 files")
    size = check_file(path)
    try:
        with pye57.E57(str(path)) as file:
            headers = [file.get_header(i) for i in range(file.scan_count)]
            num_points = sum(header.point_count for header in headers)
            check_promise(
                path,
                byte=0,
                # Coordinates that differ at all take a bit.
                promised=num_points // 8,
                available=size,
                content=f"{num_points:,} points",
                at_least=True,
            )
            scans = tuple(_pose(header) for header in headers)
            blocks = [
                _to_world(path, read_points(pye57, file, header), scan)
                for header, scan in zip(headers, scans, strict=True)
            ]
    except FormatError:
        raise
    except (pye57.libe57.E57Exception, *DAMAGES) as error:
        raise FormatError(
            f"{path}: expected an E57 file, got: {first_line(error)}; fetch it again."
        ) from error
    if not blocks:
        raise FormatError(f"{path}: expected at least one scan, got none; fetch the file again.")
    return assemble_cloud(path, _joined(blocks), header={"scans": scans})


def check_e57(path: Path, cloud: Cloud | None) -> None:
    """Check that pye57 is installed; E57 holds any cloud.

    Raises:
        MissingDependencyError: If pye57 is not installed.
    """
    require("pye57", extra="e57", purpose="write E57 files")


def write_e57(path: Path, cloud: Cloud) -> None:
    """Write a cloud as an E57 file.

    Args:
        path: The file.
        cloud: The cloud. If it came from an E57 file, its scans are written with their poses,
            otherwise one scan is. Points that are not finite are marked as invalid.

    Raises:
        FormatError: If a field has no place in an E57 file, or the file cannot be written.
        MissingDependencyError: If pye57 is not installed.
    """
    pye57 = require("pye57", extra="e57", purpose="write E57 files")
    stored = cloud.header.get("scans", ())
    columns = flatten_cloud(path, cloud, SPELLING)
    for name, column in columns.items():
        columns[name] = column = narrow_integers(column, ("i8",))
        if column.dtype == np.uint64:
            raise FormatError(f"{path}: expected field {name} below 2^63; leave it out.")
    try:
        with atomic_path(path) as beside, pye57.E57(str(beside), "w") as file:
            for prefix, uri in EXTENSIONS.items():
                file.image_file.extensionsAdd(prefix, uri)
            for scan, rows in _groups(columns, stored):
                block = {name: column[rows] for name, column in columns.items()}
                write_points(pye57.libe57, file, scan, _to_scan(block, scan))
    except (pye57.libe57.E57Exception, ValueError, RuntimeError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{path}: cannot be written: {first_line(error)}.") from error


def _pose(header: Any) -> Scan:  # noqa: ANN401
    """Return the name and the pose of a scan."""
    name = header["name"].value() if "name" in header.scan_fields else ""
    if not header.has_pose():
        return Scan(name)
    return Scan(name, tuple(header.rotation.tolist()), tuple(map(float, header.translation)))


def _to_world(path: Path, block: Block, scan: Scan) -> Block:
    """Move the points of a scan by its pose, and give the fields the names of columns."""
    if all(axis in block for axis in AXES):
        points = np.stack([block.pop(axis) for axis in AXES], axis=1)
    elif all(axis in block for axis in SPHERICAL):
        points = to_cartesian(np.stack([block.pop(axis).astype("d") for axis in SPHERICAL], axis=1))
    else:
        raise FormatError(
            f"{path}: expected points with {', '.join(AXES)}, got {', '.join(block) or 'none'}."
        )
    for name in STATES:
        if name in block:
            points[block.pop(name) != 0] = np.nan
    if all(name in block for name in NORMALS):
        normals = scan.rotate(np.stack([block[name] for name in NORMALS], axis=1))
        block |= dict(zip(NORMALS, normals.T, strict=True))
    channels = dict(zip(COLOR, CHANNELS, strict=True))
    named = {channels.get(name, name.rpartition(":")[2]): c for name, c in block.items()}
    return {**named, **dict(zip("xyz", scan.to_world(points).T, strict=True))}


def _joined(blocks: Sequence[Block]) -> Block:
    """Put scans one after the other; number them if there are several."""
    counts = [len(block["x"]) for block in blocks]
    names = dict.fromkeys(name for block in blocks for name in block)
    columns = {
        name: np.concatenate(
            [b.get(name, np.zeros(n, np.uint8)) for b, n in zip(blocks, counts, strict=True)]
        )
        for name in names
    }
    if len(blocks) > 1:
        columns["scan"] = np.repeat(np.arange(len(blocks), dtype=np.int32), counts)
    return columns


def _groups(columns: Block, scans: Sequence[Scan]) -> Iterator[tuple[Scan, slice]]:
    """Give the rows of each scan, and take ``scan`` out if it says no more than they do."""
    count = len(columns["x"])
    number = columns.get("scan")
    if len(scans) > 1 and number is not None and (np.diff(number) >= 0).all():
        bounds = np.searchsorted(number, np.arange(len(scans) + 1))
        if bounds[0] == 0 and bounds[-1] == count:
            del columns["scan"]
            for scan, start, stop in zip(scans, bounds, bounds[1:], strict=False):
                if start < stop:
                    yield scan, slice(start, stop)
            return
    yield scans[0] if len(scans) == 1 else Scan(), slice(0, count)


def _to_scan(block: Block, scan: Scan) -> Block:
    """Move points back to the frame of their scan, and give the fields the standard's names."""
    points = scan.to_scan(np.stack([block.pop(axis) for axis in "xyz"], axis=1))
    if all(name in block for name in NORMALS):
        normals = scan.rotate(np.stack([block[name] for name in NORMALS], axis=1), back=True)
        block |= dict(zip(NORMALS, normals.T, strict=True))
    named: Block = {}
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        points = np.where(finite[:, None], points, 0)
        # 2: there is nothing meaningful in the coordinates.
        named[STATE] = np.where(finite, 0, 2)
    for name, column in block.items():
        word = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
        named[name if name in STANDARD else f"torchrg:{word}"] = column
    return {**dict(zip(AXES, points.T, strict=True)), **named}
