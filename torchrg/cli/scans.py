"""Scans of two folders, pair by pair, and the mean of their scores."""

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from torchrg.errors import FormatError
from torchrg.io import FORMATS

Scores: TypeAlias = dict[str, dict[str, Any]]
"""Indices by part (``labels``, ``normals``) and name."""

_MOST_NAMED = 5


def pair_scans(predicted: Path, truth: Path) -> dict[str, tuple[Path, Path]]:
    """Return the files of two folders that belong together.

    Args:
        predicted: Folder of results.
        truth: Folder of truths.

    Returns:
        Both files of each scan by name, in natural order: ``scan2`` before ``scan10``. The name is
        the path below the folder without its suffix.

    Raises:
        FormatError: If a folder has no scan or two files of one name, or if a scan of one folder
            is not in the other.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("a/x10.npz", "a/x9.npz", "b/x10.ply", "b/x9.npz"):
        ...         path = Path(folder, name)
        ...         path.parent.mkdir(exist_ok=True)
        ...         path.touch()
        ...     list(pair_scans(Path(folder, "a"), Path(folder, "b")))
        ['x9', 'x10']
    """
    ours, theirs = _scans_of(predicted), _scans_of(truth)
    for folder, missing in (
        (truth, ours.keys() - theirs.keys()),
        (predicted, theirs.keys() - ours.keys()),
    ):
        if missing:
            raise FormatError(
                f"{folder}: expected a counterpart of every scan, got none of {_named(missing)}."
            )
    return {name: (path, theirs[name]) for name, path in ours.items()}


def _scans_of(folder: Path) -> dict[str, Path]:
    """Return the files of a folder, and of those below it, by name in natural order."""
    found: dict[str, Path] = {}
    for path in folder.rglob("*"):
        inside = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in inside.parts)
        if hidden or path.suffix.lower() not in FORMATS or not path.is_file():
            continue
        name = inside.with_suffix("").as_posix()
        if name in found:
            first, second = sorted((found[name].name, path.name))
            raise FormatError(
                f"{folder}: expected one file for each scan, got {first} and {second}; move one."
            )
        found[name] = path
    if not found:
        raise FormatError(f"{folder}: expected scans ({' '.join(FORMATS)}), got none.")
    return {name: found[name] for name in sorted(found, key=natural_key)}


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts numbers in names by value.

    Example:
        >>> sorted(["room10", "room9", "hall", "room09"], key=natural_key)
        ['hall', 'room9', 'room09', 'room10']
    """
    parts = re.split(r"([0-9]+)", name)
    key = [(1, int(p), p) if p.isdigit() else (0, 0, p) for p in parts if p]
    # Equal values with other digits (09 and 9) are told apart by the shorter one first.
    return [(kind, value, f"{len(p):09d}" if kind else p) for kind, value, p in key]


def _named(names: Iterable[str]) -> str:
    """Return the first names, and how many more there are."""
    ordered = sorted(names, key=natural_key)
    more = len(ordered) - _MOST_NAMED
    return ", ".join(ordered[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def mean_scores(scans: Mapping[str, Scores]) -> Scores:
    """Return the mean of each index over the scans that it is defined for.

    Args:
        scans: Scores of each scan.

    Returns:
        As the scores of one scan, with ``scans`` in each part: how many have that part.

    Example:
        >>> mean_scores({"a": {"labels": {"f1": 90.0}}, "b": {"labels": {"f1": 80.0}}})
        {'labels': {'scans': 2, 'f1': 85.0}}
    """
    parts = dict.fromkeys(part for scores in scans.values() for part in scores)
    means: Scores = {}
    for part in parts:
        rows = [scores[part] for scores in scans.values() if part in scores]
        means[part] = {"scans": len(rows)}
        for name in dict.fromkeys(name for row in rows for name in row):
            known = [row[name] for row in rows if row.get(name) is not None]
            means[part][name] = math.fsum(known) / len(known) if known else None
    return means
