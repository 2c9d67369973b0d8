r"""S3DIS rooms as released, with a text file per object.

A file has ``x y z r g b`` on each line. The two releases contain six known corrupt bytes. Each of
them lost its bit 0x20 (``\x10`` for ``0``, ``\x00`` for a space), so setting that bit repairs it
exactly; the common fix of inserting a space would split a number in two. Each repair is reported,
and any other line that is not six numbers is an error.
"""

import filecmp
import hashlib
import itertools
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg._optional import require
from torchrg.datasets.folder import SceneDataset, SceneFiles, Transform, check_folder, list_dir
from torchrg.errors import ConfigError, FormatError, warn
from torchrg.io import estimate_points
from torchrg.io.arrow import parse_numbers
from torchrg.io.files import check_file, local_path
from torchrg.structures import Cloud
from torchrg.structures.colors import find_white, narrow_colors, read_colors

CLASS_ORDERS: dict[str, tuple[str, ...]] = {
    "pointcept": (
        "ceiling", "floor", "wall", "beam", "column", "window", "door",
        "table", "chair", "sofa", "bookcase", "board", "clutter",
    ),
    "spt": (
        "ceiling", "floor", "wall", "beam", "column", "window", "door",
        "chair", "table", "bookcase", "sofa", "board", "clutter",
    ),
}  # fmt: skip
"""Class names by index, in the order of Pointcept, MMDetection3D and PointNet, which torchrg reads
and writes, and in the order of Superpoint Transformer and KPConv."""
ROOMS_PER_AREA = {1: 44, 2: 40, 3: 23, 4: 49, 5: 68, 6: 48}
"""Number of rooms per area in the release, 272 in all."""
ANNOTATIONS = "Annotations"
_OBJECT = re.compile(r"([A-Za-z]+)_([0-9]+)(?: \(([0-9]+)\))?")
"""Names of object files and their copies."""
_NUM_COLUMNS = 6
_CONTROL_BYTES = bytes(sorted(set(range(32)) - set(b"\t\n\r")))
"""Bytes that never occur in a text of numbers."""
_MAX_COORDINATE = float(np.finfo(np.float32).max)
"""Largest coordinate, in meters, that float32 arrays can store."""
_NUMBER = re.compile(rb"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


class S3DIS(SceneDataset):
    """Rooms of S3DIS, read from ``ROOT/Area_i/<room>/Annotations/*.txt``, aligned or not.

    A sample has ``coord``, ``color``, ``segment`` and ``instance`` of :func:`read_room`, the last
    two as int64, and ``name``, as in ``Area_1/office_1``. Points are in the order of the objects,
    not in the order of the room's text file.

    The text is parsed on every access; ``torchrg convert s3dis`` writes arrays, which
    :class:`torchrg.datasets.FolderOfClouds` reads much faster.

    Args:
        root: The folder that contains ``Area_1`` to ``Area_6``.
        areas: Numbers of the areas to use.
        transform: Applied to each sample.

    Attributes:
        scenes: Name, folder and input files of each room, in natural order.
        classes: Class names by index.

    Raises:
        FormatError: If an area is missing.
        ConfigError: If an area is unknown.

    Warns:
        UserWarning: If the number of rooms in an area differs from the release.

    References:
        [1] I. Armeni et al. 3D semantic parsing of large-scale indoor spaces. CVPR, 2016.
    """

    kind = "s3dis"

    def __init__(
        self,
        root: str | os.PathLike[str],
        areas: Sequence[int] = tuple(ROOMS_PER_AREA),
        *,
        transform: Transform | None = None,
    ) -> None:
        self.root = local_path(root)
        self.classes = CLASS_ORDERS["pointcept"]
        self.transform = transform
        self.scenes = [scene for area in areas for scene in _list_area(self.root, area)]

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return the cloud of a room; see :func:`read_room`."""
        return read_room(scene.path)

    def count_points(self, scene: SceneFiles) -> int:
        """Estimate the number of points from the file sizes and the lines of the largest file."""
        sizes = {file: file.stat().st_size for file in scene.files}
        largest = max(sizes, key=lambda file: sizes[file])
        return round(sum(sizes.values()) * estimate_points(largest) / max(sizes[largest], 1))


def _list_area(root: Path, area: int) -> list[SceneFiles]:
    """Return the rooms of an area, and warn if their number differs from the release."""
    if area not in ROOMS_PER_AREA:
        choices = ", ".join(map(str, ROOMS_PER_AREA))
        raise ConfigError(f"S3DIS: expected areas among {choices}, got {area!r}.")
    folder = root / f"Area_{area}"
    check_folder(root)
    if not folder.is_dir():
        others = [path.parent for path in root.glob("*/Area_[1-6]")]
        others += [path for path in root.absolute().parents if any(path.glob("Area_[1-6]"))]
        repair = f"pass {others[0]}" if others else "select existing areas, or download it again"
        raise FormatError(f"{root}: expected a folder {folder.name}, got none; {repair}.")
    entries = [path for path in list_dir(folder) if path.is_dir() and not path.name.startswith(".")]
    rooms = [path for path in entries if (path / ANNOTATIONS).is_dir()]
    if len(rooms) != ROOMS_PER_AREA[area]:
        bare = [path.name for path in entries if path not in rooms]
        missing = f" ({', '.join(bare)}: no {ANNOTATIONS})" if bare else ""
        warn(
            f"{folder}: expected {ROOMS_PER_AREA[area]} rooms, got {len(rooms)}{missing}; "
            "download the missing rooms unless this is intended."
        )
    return [
        SceneFiles(f"{folder.name}/{room.name}", room, object_files(room), "S3DIS")
        for room in rooms
    ]


def find_areas(root: Path) -> tuple[int, ...]:
    """Return the existing areas; all six if there are none, so that the error names them."""
    return tuple(n for n in ROOMS_PER_AREA if (root / f"Area_{n}").is_dir()) or (*ROOMS_PER_AREA,)


def read_room(path: Path) -> Cloud:
    """Read a room from the raw release. Points of an object are contiguous.

    Args:
        path: Folder of the room, the parent of ``Annotations``.

    Returns:
        The cloud, in float32, with ``color`` ``(N, 3)`` uint8, ``segment`` ``(N,)`` int16, an index
        into ``CLASS_ORDERS["pointcept"]``, and ``instance`` ``(N,)``. The latter is the object
        index in natural order of the file names, int16, or int32 if it does not fit. ``repairs``
        has a line for each repaired byte: file, line and column (from one), and the line before and
        after; the file itself is unchanged.
        ``notes`` has a line for each folder entry that is not an object, and for each file of an
        unknown class, for example ``stairs``.

    Raises:
        FormatError: If there is no object, or a line is not a point.
        MissingDependencyError: If pyarrow is not installed.
    """
    classes = CLASS_ORDERS["pointcept"]
    objects, notes = _list_room(path)
    coords, colors, repairs = zip(*(read_annotation(file) for _, file in objects), strict=True)
    numbers = [classes.index(name if name in classes else "clutter") for name, _ in objects]
    notes += [f"{file.name} read as clutter" for name, file in objects if name not in classes]
    first: dict[bytes, str] = {}
    for (_, file), coord in zip(objects, coords, strict=True):
        other = first.setdefault(hashlib.sha256(coord.tobytes()).digest(), file.name)
        notes += [] if other == file.name else [f"{file.name} has the same points as {other}"]
    color, more = read_colors(path, np.concatenate(colors))
    counts = [len(coord) for coord in coords]
    dtype = np.int16 if len(objects) <= np.iinfo(np.int16).max else np.int32
    fields: dict[str, NDArray[Any]] = {
        "color": narrow_colors(color),
        "segment": np.repeat(np.array(numbers, np.int16), counts),
        "instance": np.repeat(np.arange(len(objects), dtype=dtype), counts),
    }
    return Cloud(
        np.concatenate(coords),
        fields,
        source=str(path),
        notes=(*notes, *more),
        repairs=tuple(itertools.chain.from_iterable(repairs)),
    )


def object_files(room: Path) -> tuple[Path, ...]:
    """Return the object files of a room; none for a corrupt room, which fails when it is read."""
    with suppress(FormatError):
        return tuple(file for _, file in _list_room(room)[0])
    return ()


def _list_room(path: Path) -> tuple[list[tuple[str, Path]], list[str]]:
    """Return class and file of each object in natural order, and notes on skipped files.

    Skipped are hidden files, files not named ``CLASS_NUMBER.txt``, and copies named
    ``CLASS_NUMBER (2).txt`` of an existing file.
    """
    folder = path / ANNOTATIONS
    if not folder.is_dir():
        raise FormatError(f"{path}: expected a folder {ANNOTATIONS}, got none; it may be corrupt.")
    objects, notes = [], []
    for file in list_dir(folder):
        match = _OBJECT.fullmatch(file.stem)
        if file.name.startswith(".") or file.suffix != ".txt" or not match or file.is_dir():
            notes.append(f"{file.name} not read: not named CLASS_NUMBER.txt")
        elif match[3] and (original := folder / f"{match[1]}_{match[2]}.txt").is_file():
            equal = filecmp.cmp(file, original, shallow=False)
            but = "" if equal else " by its name, but it differs"
            notes.append(f"{file.name} not read: a copy of {original.name}{but}")
        else:
            objects.append((match[1], file))
    if not objects:
        raise FormatError(f"{folder}: expected CLASS_NUMBER.txt, got none; it may be corrupt.")
    return objects, notes


def read_annotation(
    path: Path,
) -> tuple[NDArray[np.float32], NDArray[np.uint8] | NDArray[np.float64], list[str]]:
    """Read coordinates and colors of one object in file order, and list the repairs.

    Numbers are separated by spaces or tabs, lines end in LF or CR LF, blank lines are skipped.
    Colors are 0 to 255, possibly written as ``106.000000``, and are rounded to uint8. Colors in
    0..1, most of them fractions, stay float64, because the range must be the same in the room.
    """
    check_file(path)
    original = path.read_bytes()
    content, repairs = _restore_bits(path, original)
    table = _parse_fast(content)
    if table is None or not _are_points(table):
        table = _parse_lines(path, content, original)
    coord, color = table[:, :3].astype(np.float32), table[:, 3:]
    is_fraction = bool((color % 1).any()) and find_white(color) == 1
    return coord, color if is_fraction else np.rint(color).astype(np.uint8), repairs


def _restore_bits(path: Path, original: bytes) -> tuple[bytes, list[str]]:
    """Restore the lost bit 0x20 of control bytes, and list the repairs."""
    if len(original.translate(None, _CONTROL_BYTES)) == len(original):
        return original, []
    table = bytes(byte | 0x20 if byte in _CONTROL_BYTES else byte for byte in range(256))
    content = original.translate(table)
    bad = np.flatnonzero(np.frombuffer(original, np.uint8) != np.frombuffer(content, np.uint8))
    ends = np.flatnonzero(np.frombuffer(original, np.uint8) == ord("\n"))
    repairs = []
    for byte, line in zip(bad.tolist(), np.searchsorted(ends, bad).tolist(), strict=True):
        begin = int(ends[line - 1]) + 1 if line else 0
        end = int(ends[line]) if line < len(ends) else len(original)
        before, after = (text[begin:end].rstrip(b"\r") for text in (original, content))
        column = byte - begin + 1
        repairs.append(
            f"{path.name}: line {line + 1}, column {column}: {before!r} read as {after!r}"
        )
    return content, repairs


def _parse_fast(content: bytes) -> NDArray[np.float64] | None:
    """Parse lines of six numbers; None if any line differs."""
    # Arrow treats a lone CR as a line end, but it is a minus sign that lost its bit.
    if content.count(b"\r") != content.count(b"\r\n"):
        return None
    require("pyarrow", extra="text", purpose="read S3DIS")
    table = parse_numbers(content, _NUM_COLUMNS)
    return None if table is None or len(table) == 0 else table


def _are_points(table: NDArray[np.float64]) -> bool:
    """Whether rows are float32 coordinates and byte-sized colors."""
    lows, highs = [-_MAX_COORDINATE] * 3 + [0.0] * 3, [_MAX_COORDINATE] * 3 + [255.0] * 3
    low, high = np.rint([table.min(axis=0), table.max(axis=0)])
    return bool((low >= lows).all() and (high <= highs).all())


def _parse_lines(path: Path, content: bytes, original: bytes) -> NDArray[np.float64]:
    """Parse line by line; an error names the first line that is not a point."""
    rows: list[list[float]] = []
    for number, line in enumerate(content.split(b"\n"), start=1):
        text = line.removesuffix(b"\r")
        words = text.split()
        if not words:
            continue
        row = [float(word) for word in words if _NUMBER.fullmatch(word)]
        is_row = len(words) == len(row) == _NUM_COLUMNS and b"\r" not in text
        if not is_row or not _are_points(np.array([row])):
            shown = original.split(b"\n")[number - 1].removesuffix(b"\r")
            shown = shown if len(shown) <= 80 else shown[:77] + b"..."
            raise FormatError(
                f"{path}: line {number}: expected x y z and colors in 0 to 255, six numbers, "
                f"got {shown!r}; correct or delete this line in a copy."
            )
        rows.append(row)
    if not rows:
        raise FormatError(f"{path}: expected at least one point, got none; it may be corrupt.")
    return np.array(rows)
