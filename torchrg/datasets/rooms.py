"""One room of S3DIS: the objects of its ``Annotations`` folder, in natural order."""

import filecmp
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.datasets.annotations import Repair, read_annotation
from torchrg.datasets.scene_list import listed
from torchrg.errors import ConfigError, FormatError

CLASS_ORDERS = {
    "pointcept": (
        "ceiling", "floor", "wall", "beam", "column", "window", "door",
        "table", "chair", "sofa", "bookcase", "board", "clutter",
    ),
    "spt": (
        "ceiling", "floor", "wall", "beam", "column", "window", "door",
        "chair", "table", "bookcase", "sofa", "board", "clutter",
    ),
}  # fmt: skip
"""Names of the classes by number: the order of Pointcept, MMDetection3D and PointNet, and that of
Superpoint Transformer and KPConv."""
OTHER_CLASS = "clutter"
ANNOTATIONS = "Annotations"
_OBJECT = re.compile(r"([A-Za-z]+)_([0-9]+)(?: \(([0-9]+)\))?")


class Skipped(NamedTuple):
    """A file beside the objects that is not read.

    Attributes:
        file: The file.
        reason: Why.
    """

    file: Path
    reason: str


class RoomReport(NamedTuple):
    """What was unusual about a room.

    Attributes:
        repairs: Bytes that were read as others.
        skipped: Entries of the folder that are no objects.
        as_clutter: Files whose class is not among the 13, ``stairs`` for example.
    """

    repairs: tuple[Repair, ...] = ()
    skipped: tuple[Skipped, ...] = ()
    as_clutter: tuple[Path, ...] = ()


class Room(NamedTuple):
    """The points of a room; those of an object follow each other.

    Attributes:
        coord: Coordinates in metres, shape ``(N, 3)``, float32.
        color: Colours, shape ``(N, 3)``, uint8.
        segment: Class of each point, a place in :data:`CLASS_ORDERS`, shape ``(N,)``, int16.
        instance: Object of each point, counted from zero in natural order of the file names, shape
            ``(N,)``, int16, or int32 with more objects than that holds.
        report: What was unusual.
    """

    coord: NDArray[np.float32]
    color: NDArray[np.uint8]
    segment: NDArray[np.signedinteger]
    instance: NDArray[np.signedinteger]
    report: RoomReport


class RoomFiles(NamedTuple):
    """What the ``Annotations`` folder of a room holds.

    Attributes:
        objects: Class and file of each object, in natural order.
        skipped: What is no object.
    """

    objects: tuple[tuple[str, Path], ...]
    skipped: tuple[Skipped, ...]


def list_room(path: Path) -> RoomFiles:
    """List the objects of a room without reading them.

    Args:
        path: Folder of the room, the one above ``Annotations``.

    Returns:
        Objects, and the entries that are not: hidden files, files that are not named
        ``CLASS_NUMBER.txt``, and copies named ``CLASS_NUMBER (2).txt`` of a file that is there.

    Raises:
        FormatError: If there is no object.
    """
    folder = path / ANNOTATIONS
    if not folder.is_dir():
        raise FormatError(f"{path}: expected a folder {ANNOTATIONS}, got none; fetch it again.")
    objects, skipped = [], []
    for file in listed(folder):
        match = _OBJECT.fullmatch(file.stem)
        if file.name.startswith(".") or file.suffix != ".txt" or not match or file.is_dir():
            skipped.append(Skipped(file, "not named CLASS_NUMBER.txt"))
        elif match[3] and (original := folder / f"{match[1]}_{match[2]}.txt").is_file():
            equal = filecmp.cmp(file, original, shallow=False)
            reason = f"a copy of {original.name}" + (
                "" if equal else " by its name, but it differs"
            )
            skipped.append(Skipped(file, reason))
        else:
            objects.append((match[1], file))
    if not objects:
        raise FormatError(
            f"{folder}: expected objects as CLASS_NUMBER.txt, got none; fetch it again."
        )
    return RoomFiles(tuple(objects), tuple(skipped))


def read_room(path: Path, *, class_order: str = "pointcept") -> Room:
    """Read a room from the raw release; nothing is written.

    Args:
        path: Folder of the room, the one above ``Annotations``.
        class_order: What the numbers in ``segment`` mean: a key of :data:`CLASS_ORDERS`.

    Returns:
        The room and what was unusual about it.

    Raises:
        FormatError: If there is no object, or a line of one is not a point.
        ConfigError: If the class order is unknown.
        MissingDependencyError: If pyarrow is not installed.
    """
    classes = class_names(class_order)
    files = list_room(path)
    parts = [read_annotation(file) for _, file in files.objects]
    known = [name if name in classes else OTHER_CLASS for name, _ in files.objects]
    counts = [len(part.coord) for part in parts]
    dtype = np.int16 if len(parts) <= np.iinfo(np.int16).max else np.int32
    return Room(
        np.concatenate([part.coord for part in parts]),
        np.concatenate([part.color for part in parts]),
        np.repeat(np.array([classes.index(name) for name in known], np.int16), counts),
        np.repeat(np.arange(len(parts), dtype=dtype), counts),
        RoomReport(
            tuple(repair for part in parts for repair in part.repairs),
            files.skipped,
            tuple(file for name, file in files.objects if name not in classes),
        ),
    )


def class_names(class_order: str) -> tuple[str, ...]:
    """Return the names of the classes in an order.

    Args:
        class_order: A key of :data:`CLASS_ORDERS`.

    Returns:
        13 names.

    Raises:
        ConfigError: If there is no such order.

    Example:
        >>> class_names("pointcept")[7], class_names("spt")[7]
        ('table', 'chair')
    """
    if class_order not in CLASS_ORDERS:
        raise ConfigError(
            f"S3DIS: expected class_order to be one of {', '.join(CLASS_ORDERS)}, got "
            f"{class_order!r}."
        )
    return CLASS_ORDERS[class_order]
