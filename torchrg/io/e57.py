"""E57 through pye57 (extra ``e57``): all scans of a file as one cloud, poses kept for writing.

Points go through pye57's ``libe57``, because ``pye57.E57`` itself (0.4.19) writes coordinates in
single precision and knows no field beyond colour, intensity, row and column. Normals are the
standard's extension ``nor``; labels, curvature and other fields are in an extension ``torchrg``.
Pictures and what else a file holds beside points are not kept.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.atomic import atomic_path
from torchrg.io.columns import Spelling, flatten_cloud, narrow_integers
from torchrg.io.e57_points import AXES, COLOR, STATE, Block, read_points, write_points
from torchrg.io.e57_pose import Scan, to_cartesian
from torchrg.io.fields import assemble_cloud
from torchrg.io.files import DAMAGES, check_file, check_promise, first_line
from torchrg.structures import Cloud

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
