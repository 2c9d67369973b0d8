"""``torchrg score``: evaluate results against ground truth, for a scan or for folders."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
from tqdm import tqdm

from torchrg import metrics
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import print_warnings, warn
from torchrg.cli.flags import ColumnsFlag, check_columns, read_noted
from torchrg.datasets.folder import FolderOfClouds, is_scene, natural_key
from torchrg.errors import ConfigError, FormatError
from torchrg.io.files import list_some
from torchrg.structures import UNLABELED, Cloud

Scores: TypeAlias = dict[str, dict[str, float | None]]
"""Metrics by part (``labels``, ``normals``, ``superpoints``) and name."""
_MAX_NAMED = 5
"""Maximum number of scans listed in an error."""


@dataclass(frozen=True)
class Arguments:
    """Evaluate labels and normals against ground truth for the same points.

    Both arguments are scans, or both are folders. For folders, scans with the same name are
    compared and the mean is printed. A scan is a file, or a folder written by torchrg convert.

    Examples:
        torchrg score planes.npz room.npz
        torchrg score planes.npz truth.ply --match-distance 0.001 --json
        torchrg score results truth
    """

    predicted: Annotated[Path, Argument("PREDICTED", is_positional=True)]
    """Scan with labels or normals, of torchrg segment or convert, or a folder of scans."""
    ground_truth: Annotated[Path, Argument("TRUTH", is_positional=True)]
    """File with ground-truth labels or normals, or a folder with one such file per result."""
    match_distance: float | None = None
    """Match each ground-truth point to the nearest predicted point within this distance, in units
    of the cloud. Every ground-truth point counts once; without a match it counts as unlabeled.
    Unmatched predicted points are ignored. Default: the points must be the same, row by row."""
    superpoints: bool = False
    """Also evaluate superpoints against the ground-truth labels."""
    ignore: int | None = None
    """Ground-truth label of points to ignore in the evaluation of superpoints, in addition to
    -1."""
    boundary_distance: float | None = None
    """Maximum distance between matching superpoint and ground-truth boundaries, in units of the
    cloud. Default: the median distance to the 8th nearest neighbor."""
    json: bool = False
    """Print a JSON object instead of text; for folders with the keys "scans" and "mean"."""
    columns: ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, evaluate and print the scores."""
    arguments = parse(Arguments, argv, prog="torchrg score")
    if arguments.match_distance is not None and not arguments.match_distance > 0:
        raise ConfigError(f"expected --match-distance > 0, got {arguments.match_distance}.")
    predicted, ground_truth = arguments.predicted, arguments.ground_truth
    for path in (predicted, ground_truth):
        if not path.exists():
            raise FormatError(f"{path}: file not found.")
    are_folders = _is_data_set(predicted)
    if are_folders != _is_data_set(ground_truth):
        file, folder = (ground_truth, predicted) if are_folders else (predicted, ground_truth)
        raise FormatError(f"{file}: expected a folder like {folder}; or pass two files.")
    if are_folders:
        with print_warnings():
            pairs = _pair_scans(predicted, ground_truth).items()
        bar = tqdm(pairs, desc="score", unit="scan", leave=False, disable=None)
        scans = {name: _score_files(arguments, *files) for name, files in bar}
        scores = _mean(scans)
    else:
        scans, scores = {}, _score_files(arguments, predicted, ground_truth)
    if arguments.json:
        print(json.dumps({"scans": scans, "mean": scores} if are_folders else scores))
        return 0
    if are_folders:
        print(f"mean of {len(scans):,} scans")
    for part, values in scores.items():
        print(part)
        for name, value in values.items():
            print(f"  {name:<22}{_format(value, metrics.METRICS.get(part, {}).get(name))}")
    return 0


def _is_data_set(path: Path) -> bool:
    """Return whether a path is a folder of scans rather than a single scan."""
    return path.is_dir() and not is_scene(path)


def _pair_scans(predicted: Path, ground_truth: Path) -> dict[str, tuple[Path, Path]]:
    """Pair the scans of two folders by name, in natural order."""
    ours, theirs = (
        {scene.name: scene.path for scene in FolderOfClouds(folder).scenes}
        for folder in (predicted, ground_truth)
    )
    for folder, missing in ((ground_truth, {*ours} - {*theirs}), (predicted, {*theirs} - {*ours})):
        if missing:
            names = list_some(sorted(missing, key=natural_key), _MAX_NAMED)
            raise FormatError(f"{folder}: no scan found for {names}.")
    return {name: (path, theirs[name]) for name, path in ours.items()}


def _score_files(arguments: Arguments, predicted: Path, ground_truth: Path) -> Scores:
    """Evaluate all parts present in both scans."""
    check_columns(arguments.columns, (predicted, ground_truth))
    ours, theirs = (read_noted(path, arguments.columns).cloud for path in (predicted, ground_truth))
    scores: Scores = {}
    if arguments.match_distance is None:
        _check_rows(predicted, ground_truth, ours, theirs)
    else:
        distance = arguments.match_distance
        ours, scores["match"] = _match_nearest(distance, predicted, ground_truth, ours, theirs)
    for part, score in (("labels", metrics.score_labels), ("normals", metrics.score_normals)):
        if part in ours.fields and part in theirs.fields:
            scores[part] = _defined(score(ours.fields[part], theirs.fields[part])._asdict())
    if arguments.superpoints:
        needed = (predicted, ours, "superpoint"), (ground_truth, theirs, "labels")
        for path, cloud, field in needed:
            if field not in cloud.fields:
                has = ", ".join(cloud.fields) or "points alone"
                raise FormatError(f"{path}: missing {field}, required by --superpoints; has {has}.")
        indices = metrics.score_partition(
            ours.fields["superpoint"],
            theirs.fields["labels"],
            ours.points,
            boundary_distance=arguments.boundary_distance,
            ignore=arguments.ignore,
        )
        scores["superpoints"] = _defined(indices._asdict())
    if not scores.keys() - {"match"}:
        raise FormatError(
            f"{predicted}: has neither labels nor normals in common with {ground_truth}; pass a "
            "result of torchrg segment, and ground truth with the field label or normals."
        )
    return scores


def _check_rows(predicted: Path, ground_truth: Path, ours: Cloud, theirs: Cloud) -> None:
    """Raise unless both scans have the same points in the same rows."""
    repair = "to compare each point with the nearest one within D, pass --match-distance D."
    if len(ours) != len(theirs):
        raise FormatError(
            f"{predicted}: expected {len(theirs):,} points as in {ground_truth}, got "
            f"{len(ours):,}; {repair}"
        )
    rows = metrics.differing_rows(ours, theirs)
    if len(rows):
        points = (cloud.coordinates[rows[0]] for cloud in (ours, theirs))
        got, expected = (" ".join(f"{value:.9g}" for value in point) for point in points)
        raise FormatError(
            f"{predicted}: expected the same points as {ground_truth} in every row, got "
            f"{len(rows):,} of {len(ours):,} that differ (row {rows[0]}: {got} for {expected}); "
            f"{repair}"
        )


def _match_nearest(
    distance: float, predicted: Path, ground_truth: Path, ours: Cloud, theirs: Cloud
) -> tuple[Cloud, dict[str, float | None]]:
    """Transfer the results to the nearest ground-truth points, and count unmatched points."""
    rows = metrics.match_points(ours, theirs, distance)
    is_matched = rows >= 0
    num_lost = int(np.count_nonzero(~is_matched))
    if num_lost == len(rows):
        raise FormatError(
            f"{predicted}: no points within the distance of {ground_truth}; check position and "
            "unit of both, or raise --match-distance."
        )
    if num_lost:
        warn(
            f"{ground_truth}: {num_lost:,} of {len(rows):,} points have no match in {predicted} "
            "and count as unlabeled."
        )
    fields = {}
    for name in ("labels", "normals", "superpoint"):
        if name in ours.fields:
            values = ours.fields[name][rows].astype(np.result_type(ours.fields[name], np.int8))
            values[~is_matched] = UNLABELED if values.ndim == 1 else 0
            fields[name] = values
    unused = len(ours) - len(np.unique(rows[is_matched]))
    matched = {"points": len(rows), "unmatched": num_lost, "unused": unused}
    return Cloud(theirs.coordinates, fields, source=ours.source), {**matched}


def _defined(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """Drop scores that were not computed; replace NaN by None, as JSON has no NaN."""
    known = {name: value for name, value in values.items() if value is not None}
    return {name: None if math.isnan(value) else value for name, value in known.items()}


def _mean(scans: Mapping[str, Scores]) -> Scores:
    """Average each metric over the scans for which it is defined.

    The entry ``scans`` of a part is the number of scans that have the part.
    """
    means: Scores = {}
    for part in dict.fromkeys(part for scores in scans.values() for part in scores):
        rows = [scores[part] for scores in scans.values() if part in scores]
        means[part] = {"scans": len(rows)}
        for name in dict.fromkeys(name for row in rows for name in row):
            values = [value for row in rows if (value := row.get(name)) is not None]
            means[part][name] = math.fsum(values) / len(values) if values else None
    return means


def _format(value: float | None, index: metrics.Index | None) -> str:
    """Format a value with its unit; fractions are printed in percent."""
    unit = "" if index is None else index.unit
    if value is None:
        return "none"
    if unit == "fraction":
        value, unit = 100 * value, "%"
    if unit in ("", "count"):
        return f"{value:.4f}".rstrip("0").rstrip(".")
    return f"{value:.1f} {unit}" if unit == "%" else f"{value:.2f} {unit}"
