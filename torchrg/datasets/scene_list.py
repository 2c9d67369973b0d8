"""Scenes of a data set, in an order that is the same on every platform."""

import os
import re
from pathlib import Path
from typing import NamedTuple


class Scene(NamedTuple):
    """One item of a data set, and what it is made from.

    Attributes:
        name: Unique within the data set and fit for a path below an output folder, with forward
            slashes: ``Area_1/office_1``.
        path: The file or folder that is read.
        files: Every input file, in the order they are read; their bytes decide the result.
    """

    name: str
    path: Path
    files: tuple[Path, ...]


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a key that sorts names with numbers as people do, without regard to the locale.

    Example:
        >>> sorted(["chair_10.txt", "chair_2.txt", "Chair_1.txt"], key=natural_key)
        ['Chair_1.txt', 'chair_2.txt', 'chair_10.txt']
    """
    parts = re.split(r"([0-9]+)", name)
    key: list[tuple[int, int | str]] = [
        (0, int(part)) if part.isdigit() else (1, part.lower()) for part in parts if part
    ]
    # Names that differ in case or leading zeros only still have one order.
    return (*key, (2, name))


def listed(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the entries of a folder in natural order, hidden ones included."""
    return sorted(Path(folder).iterdir(), key=lambda path: natural_key(path.name))
