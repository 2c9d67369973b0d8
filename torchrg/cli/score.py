"""``torchrg score``: labels, normals, superpoints against a truth, of one scan or of folders."""

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import tyro
from tqdm import tqdm

from torchrg.batch.report import format_table
from torchrg.cli.console import ColumnNames, ColumnsFlag, parse, warn
from torchrg.datasets.folder import natural_key
from torchrg.errors import FormatError
from torchrg.io import FORMATS, atomic_path, read_cloud
from torchrg.io.files import check_place
from torchrg.metrics import score_labels, score_normals, score_partition

Scores: TypeAlias = dict[str, dict[str, Any]]
"""Indices by part (``labels``, ``normals``, ``superpoints``) and name."""

_SHOWN = {
    "labels": ("f1", "precision", "recall", "regions", "faces", "recall_iou50", "mean_best_iou"),
    "normals": ("rms", "mean", "under_10_deg"),
    "superpoints": ("count", "asa", "oracle_miou", "boundary_recall"),
}
"""What a table of scans shows of each; the mean, --json and --csv have everything."""
_MOST_NAMED = 5
"""Scans that an error names, so that it stays one line."""


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
    superpoints: bool = False
    """Score superpoints against the true labels, as torchrg segment --superpoints writes them."""
    ignore: int | None = None
    """True label of points that are not of any part, for superpoints. -1 always is one."""
    boundary_distance: float | None = None
    """How far apart borders of superpoints and true ones may be and still agree, in the unit of the
    cloud. Default: the median distance to the 8th nearest neighbour."""
    json: bool = False
    """Print one JSON object instead of a table; for folders with the keys "scans" and "mean"."""
    csv: Path | None = None
    """Also write a CSV file: a row for each scan in natural order, for folders the mean last."""
    columns: ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, score what both sides have, and print it."""
    arguments = parse(Arguments, argv, prog="torchrg score")
    predicted, truth = arguments.predicted, arguments.truth
    if predicted.is_dir() != truth.is_dir():
        file, folder = (truth, predicted) if predicted.is_dir() else (predicted, truth)
        raise FormatError(f"{file}: expected a folder, as {folder} is one; or give two files.")
    if arguments.csv is not None:
        check_place(arguments.csv)
    if predicted.is_dir():
        pairs = _pair_scans(predicted, truth).items()
        bar = tqdm(pairs, desc="score", unit="scan", leave=False, disable=None)
        scans = {name: _score_files(arguments, *files) for name, files in bar}
        scores = _mean(scans)
        rows, printed = {**scans, "mean": scores}, {"scans": scans, "mean": scores}
    else:
        scores = _score_files(arguments, predicted, truth)
        rows, printed = {predicted.stem: scores}, scores
    if arguments.csv is not None:
        with atomic_path(arguments.csv) as path:
            path.write_text(_as_csv(rows), encoding="utf-8")
    if arguments.json:
        print(json.dumps(printed))
        return 0
    if predicted.is_dir():
        _print_scans(scans)
    for part, values in scores.items():
        print(part)
        for name, value in values.items():
            print(f"  {name:<22}{_spelled(value)}")
    return 0


def _pair_scans(predicted: Path, truth: Path) -> dict[str, tuple[Path, Path]]:
    """Return both files of each scan of two folders by name, in natural order.

    The name is the path below the folder without its suffix.
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


def _named(names: Iterable[str]) -> str:
    """Return the first names, and how many more there are."""
    ordered = sorted(names, key=natural_key)
    more = len(ordered) - _MOST_NAMED
    return ", ".join(ordered[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _score_files(arguments: Arguments, predicted: Path, truth: Path) -> Scores:
    """Return the scores of whatever two files of the same points both have."""
    names = ColumnNames.parse(arguments.columns, (predicted, truth))
    ours, theirs = (read_cloud(path, columns=names.of(path)) for path in (predicted, truth))
    for cloud in (ours, theirs):
        for note in cloud.notes:
            warn(f"{cloud.source}: {note}.")
    if len(ours) != len(theirs):
        raise FormatError(
            f"{predicted}: expected as many points as {truth} ({len(theirs):,}), got {len(ours):,}."
        )
    scores: Scores = {}
    for part, score in (("labels", score_labels), ("normals", score_normals)):
        if part in ours.fields and part in theirs.fields:
            scores[part] = _known(score(ours.fields[part], theirs.fields[part])._asdict())
    if arguments.superpoints:
        for path, cloud, field in ((predicted, ours, "superpoints"), (truth, theirs, "labels")):
            if field not in cloud.fields:
                named = ", ".join(cloud.fields) or "points alone"
                raise FormatError(f"{path}: expected {field} for --superpoints, got {named}.")
        found = score_partition(
            ours.fields["superpoints"],
            theirs.fields["labels"],
            ours.points,
            boundary_distance=arguments.boundary_distance,
            ignore=arguments.ignore,
        )
        scores["superpoints"] = _known(found._asdict())
    if not scores:
        raise FormatError(f"{predicted}: shares neither labels nor normals with {truth}.")
    return scores


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores that were asked for; JSON knows null, but no NaN."""
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in values.items()
        if value is not None
    }


def _mean(scans: Mapping[str, Scores]) -> Scores:
    """Return the mean of each index over the scans that it is defined for.

    Each part also says over how many ``scans`` that have it.
    """
    means: Scores = {}
    for part in dict.fromkeys(part for scores in scans.values() for part in scores):
        rows = [scores[part] for scores in scans.values() if part in scores]
        means[part] = {"scans": len(rows)}
        for name in dict.fromkeys(name for row in rows for name in row):
            known = [row[name] for row in rows if row.get(name) is not None]
            means[part][name] = math.fsum(known) / len(known) if known else None
    return means


def _as_csv(rows: dict[str, Scores]) -> str:
    """Return scores as CSV, one row for each name; numbers in full."""
    flat = [
        {"scan": scan}
        | {
            f"{part}.{name}": value
            for part, values in scores.items()
            for name, value in values.items()
        }
        for scan, scores in rows.items()
    ]
    text = io.StringIO()
    columns = dict.fromkeys(column for row in flat for column in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


def _print_scans(scans: dict[str, Scores]) -> None:
    """Print a line for each scan."""
    columns = [
        (part, name)
        for part, names in _SHOWN.items()
        for name in names
        if any(part in scores for scores in scans.values())
    ]
    rows = [
        [scan, *(_spelled(scores.get(part, {}).get(name)) for part, name in columns)]
        for scan, scores in scans.items()
    ]
    print(format_table(["scan", *(name for _, name in columns)], rows))
    print(f"\nmean of {len(scans):,} scans")


def _spelled(value: float | None) -> str:
    """Return a number with four places at most."""
    if value is None:
        return "none"
    return f"{value:.4f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
