"""``torchrg score``: labels and normals against a truth, of one scan or of folders of scans."""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import tyro
from tqdm import tqdm

from torchrg.cli.console import parse
from torchrg.errors import FormatError
from torchrg.io import FORMATS, atomic_path, read_cloud
from torchrg.io.files import check_place
from torchrg.metrics import score_labels, score_normals

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


SHOWN = {
    "labels": ("f1", "precision", "recall", "regions", "faces", "recall_iou50", "mean_best_iou"),
    "normals": ("rms", "mean", "under_10_deg"),
}
"""What a table of scans shows of each; the mean, --json and --csv have everything."""


@dataclass(frozen=True)
class Arguments:
    """Score labels and normals against a truth of the same points in the same order.

    Two files, or two folders: then files of the same name are compared, and the mean over the
    scans is printed below them.
    """

    predicted: Annotated[Path, tyro.conf.Positional]
    """File with labels or normals, as torchrg segment writes it, or a folder of such files."""
    truth: Annotated[Path, tyro.conf.Positional]
    """File with the true labels or normals, or a folder with such a file for each result."""
    json: bool = False
    """Print one JSON object instead of a table; for folders with the keys "scans" and "mean"."""
    csv: Path | None = None
    """Also write a CSV file: a row for each scan in natural order, for folders the mean last."""


def run(argv: list[str]) -> int:
    """Parse the arguments, score what both sides have, and print it."""
    arguments = parse(Arguments, argv, prog="torchrg score")
    predicted, truth = arguments.predicted, arguments.truth
    if predicted.is_dir() != truth.is_dir():
        file, folder = (truth, predicted) if predicted.is_dir() else (predicted, truth)
        raise FormatError(f"{file}: expected a folder, as {folder} is one; or give two files.")
    if arguments.csv is not None:
        check_place(arguments.csv)
    if not predicted.is_dir():
        scores = score_files(predicted, truth)
        rows, printed = {predicted.stem: scores}, scores
    else:
        scans = score_folders(predicted, truth)
        mean = mean_scores(scans)
        rows, printed = {**scans, "mean": mean}, {"scans": scans, "mean": mean}
    if arguments.csv is not None:
        with atomic_path(arguments.csv) as path:
            path.write_text(_table_of(rows), encoding="utf-8")
    if arguments.json:
        print(json.dumps(printed))
    elif predicted.is_dir():
        _print_scans(scans)
        _print_scores(mean)
    else:
        _print_scores(scores)
    return 0


def score_folders(predicted: Path, truth: Path) -> dict[str, Scores]:
    """Return the scores of each scan of two folders, in natural order.

    Raises:
        FormatError: If a scan has no counterpart, or a pair cannot be compared.
    """
    pairs = pair_scans(predicted, truth)
    bar = tqdm(pairs.items(), desc="score", unit="scan", leave=False, disable=None)
    return {name: score_files(*files) for name, files in bar}


def score_files(predicted: Path, truth: Path) -> Scores:
    """Return the scores of whatever two files both have.

    Raises:
        FormatError: If they differ in their number of points, or share neither labels nor normals.
    """
    ours, theirs = read_cloud(predicted), read_cloud(truth)
    if len(ours) != len(theirs):
        raise FormatError(
            f"{predicted}: expected as many points as {truth} ({len(theirs):,}), got {len(ours):,}."
        )
    scores: Scores = {}
    if "labels" in ours.fields and "labels" in theirs.fields:
        labels = score_labels(ours.fields["labels"], theirs.fields["labels"])
        scores["labels"] = _defined(labels._asdict())
    if "normals" in ours.fields and "normals" in theirs.fields:
        normals = score_normals(ours.fields["normals"], theirs.fields["normals"])
        scores["normals"] = _defined(normals._asdict())
    if not scores:
        raise FormatError(f"{predicted}: shares neither labels nor normals with {truth}.")
    return scores


def _defined(values: dict[str, Any]) -> dict[str, Any]:
    """Return scores without those that were not asked for; JSON knows null, but no NaN."""
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in values.items()
        if value is not None
    }


def _table_of(rows: dict[str, Scores]) -> str:
    """Return scores as CSV, one row for each name; numbers in full."""
    columns = dict.fromkeys(
        (part, name)
        for scores in rows.values()
        for part, values in scores.items()
        for name in values
    )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scan", *(f"{part}.{name}" for part, name in columns)])
    for name, scores in rows.items():
        writer.writerow([name, *(scores.get(part, {}).get(index) for part, index in columns)])
    return text.getvalue()


def _print_scans(scans: dict[str, Scores]) -> None:
    """Print a line for each scan."""
    columns = [
        (part, name)
        for part, names in SHOWN.items()
        for name in names
        if any(part in scores for scores in scans.values())
    ]
    width = max(len(name) for name in ("scan", *scans)) + 2
    widths = [max(len(name), 8) + 2 for _, name in columns]
    heads = "".join(f"{name:>{size}}" for (_, name), size in zip(columns, widths, strict=True))
    print(f"{'scan':<{width}}{heads}")
    for name, scores in scans.items():
        values = (_spelled(scores.get(part, {}).get(index)) for part, index in columns)
        cells = "".join(f"{value:>{size}}" for value, size in zip(values, widths, strict=True))
        print(f"{name:<{width}}{cells}")
    print(f"\nmean of {len(scans):,} scans")


def _print_scores(scores: Scores) -> None:
    """Print all indices of a scan, one in a line."""
    for part, values in scores.items():
        print(part)
        for name, value in values.items():
            print(f"  {name:<22}{_spelled(value)}")


def _spelled(value: float | None) -> str:
    """Return a number with four places at most."""
    if value is None:
        return "none"
    return f"{value:.4f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
