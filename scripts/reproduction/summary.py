"""The main numbers of a report, which are kept beside this file for the page of the report.

``python scripts/reproduce_paper.py --out DIR --keep`` replaces them.
"""

import json
from pathlib import Path

from reproduction.cells import Record, is_committed
from torchrg.io import atomic_path

RESULTS = Path(__file__).with_name("results.json")


def keep(report: Record) -> None:
    """Put the numbers of a report beside this file.

    Args:
        report: All parts, as :func:`reproduction.report.write_report` returns it.

    Raises:
        ValueError: If it was made by code that is not committed, or by several commits.
    """
    commit = commit_of(report["made_with"])
    if not is_committed(commit) or "," in commit:
        raise ValueError(
            f"keep: expected a report of one commit, got {commit or 'none'}; commit, then make the "
            "report again."
        )
    text = json.dumps(take_results(report), indent=1) + "\n"
    with atomic_path(RESULTS) as beside:
        beside.write_text(text, encoding="utf-8")


def commit_of(made_with: str) -> str:
    """Return the commit, or several, in a line that says how something was made.

    Example:
        >>> commit_of("torchrg 0.1.0; commit 2f26e94; python 3.11.7")
        '2f26e94'
    """
    fields = dict(field.partition(" ")[::2] for field in made_with.split("; "))
    return fields.get("commit", "")


def take_results(report: Record) -> Record:
    """Return the numbers of a report that are kept: claims and scores.

    Raises:
        ValueError: If the part that it needs is not there.
    """
    parts = report["parts"]
    if "segmentation" not in parts:
        raise ValueError("take_results: expected the part segmentation, got a report without it.")
    return {
        "quick": report["quick"],
        "made_with": report["made_with"],
        "claims": report["claims"],
        "scores": [
            {
                "cloud": record["cloud"],
                "title": record["title"],
                "method": record["method"],
                "faces": record["labels"]["faces"],
                "fraction_labeled": record["fraction_labeled"],
                **{name: record["labels"][name] for name in ("ari", "f1", "mean_best_iou")},
                **{name: record["faces"].get(name) for name in ("f1_large", "f1_objects")},
            }
            for record in parts["segmentation"]["records"]["scores"]
            if "labels" in record
        ],
    }
