"""``torchrg score``: labels and normals against a truth."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrg.cli.console import parse
from torchrg.errors import FormatError
from torchrg.io import read_cloud
from torchrg.metrics import score_labels, score_normals


@dataclass(frozen=True)
class Arguments:
    """Score labels and normals against a truth of the same points in the same order."""

    predicted: Annotated[Path, tyro.conf.Positional]
    """File with labels or normals, as torchrg segment writes it."""
    truth: Annotated[Path, tyro.conf.Positional]
    """File with the true labels or normals."""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(argv: list[str]) -> int:
    """Parse the arguments, score what both files have, and print it."""
    arguments = parse(Arguments, argv, prog="torchrg score")
    scores = score_files(arguments.predicted, arguments.truth)
    if arguments.json:
        print(json.dumps(scores))
        return 0
    for part, values in scores.items():
        print(part)
        for name, value in values.items():
            shown = f"{value:.4f}".rstrip("0").rstrip(".") if isinstance(value, float) else value
            print(f"  {name:<22}{shown}")
    return 0


def score_files(predicted: Path, truth: Path) -> dict[str, dict[str, Any]]:
    """Return the scores of whatever two files both have.

    Raises:
        FormatError: If they differ in their number of points, or share neither labels nor normals.
    """
    ours, theirs = read_cloud(predicted), read_cloud(truth)
    if len(ours) != len(theirs):
        raise FormatError(
            f"{predicted}: expected as many points as {truth} ({len(theirs):,}), got {len(ours):,}."
        )
    scores: dict[str, dict[str, Any]] = {}
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
