"""The report: an HTML page, by ``report.html.jinja``, JSON, and results kept for the guides.

``python scripts/reproduce_paper.py --out DIR --keep`` replaces the kept results.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from reproduction.evaluation import LARGE, METHODS
from reproduction.records import (
    Block,
    Folder,
    Record,
    describe_surroundings,
    is_committed,
    mark_best,
    verdict,
)
from torchrg.io.files import atomic_path

TEMPLATE = Path(__file__).with_name("report.html.jinja")
RESULTS = Path(__file__).with_name("results.json")

TITLE = "Indoor point cloud segmentation: reproduction of the paper's evaluation"
INTRO = (
    "All numbers were computed by scripts/reproduce_paper.py of torchrg. The paper is: Indoor "
    "Point Cloud Segmentation Using a Modified Region Growing Algorithm and Accurate Normal "
    "Estimation. The claims come first, with verdicts and numbers; tables and figures follow. "
    '"beyond" marks comparisons that are not in the paper, such as with consensus, the default of '
    "torchrg. * marks a synthetic substitute for the paper's cloud, or a part of it."
)

SCORES = (
    ("Adjusted Rand index", "ari", ".2f"),
    (f"F1 of surfaces of at least {LARGE:,} points", "f1_large", ".0f"),
    ("Mean best IoU", "mean_best_iou", ".2f"),
)
"""Metrics in the guide: title, key and format."""


def write_report(folder: Folder, names: Sequence[str], *, quick: bool) -> Record:
    """Write ``report.html`` and ``report.json`` of the parts in a folder.

    Args:
        folder: Folder with parts and images.
        names: Parts in the order of the report; missing ones are skipped.
        quick: Whether the clouds are small.

    Returns:
        The content of ``report.json``.
    """
    paths = {name: folder.path / "parts" / f"{name}.json" for name in names}
    parts = {name: json.loads(path.read_text()) for name, path in paths.items() if path.exists()}
    made = list(_find_made(parts))
    report = {
        "title": TITLE + (" (quick: small clouds)" if quick else ""),
        "intro": INTRO,
        "quick": quick,
        "made_with": describe_surroundings(made) if made else "",
        "claims": sorted(
            (claim for part in parts.values() for claim in part["claims"]),
            key=lambda claim: claim["where"] == "beyond",
        ),
        "parts": parts,
    }
    folder.write("report.json", json.dumps(report, indent=1))
    folder.write("report.html", to_html(report))
    return report


def _find_made(value: Any) -> Iterator[Record]:  # noqa: ANN401
    """Yield every nested record with ``made_with``."""
    if isinstance(value, dict):
        if "made_with" in value:
            yield value
        value = list(value.values())
    if isinstance(value, list):
        for inner in value:
            yield from _find_made(inner)


def to_html(report: Mapping[str, Any]) -> str:
    """Return a report as an HTML page; its images are separate files."""
    environment = Environment(autoescape=True, trim_blocks=True, undefined=StrictUndefined)
    environment.globals = {"verdict": verdict, "remarks": remarks}
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(report)


def remarks(claim: Block) -> str:
    """Return what the numbers of a claim are, and why it fails if it does."""
    return " ".join(part for part in (claim["note"], claim["why"]) if part)


def keep(report: Record) -> None:
    """Replace the kept results by the results of a report.

    Args:
        report: All parts, as returned by :func:`write_report`.

    Raises:
        ValueError: If the report was made by uncommitted code or by several commits.
    """
    fields = dict(field.partition(" ")[::2] for field in report["made_with"].split("; "))
    commit = fields.get("commit", "")
    if not is_committed(commit):
        raise ValueError(
            f"keep: expected a report of one commit, got {commit or 'none'}; commit, then make the "
            "report again."
        )
    text = json.dumps(take_results(report), indent=1) + "\n"
    with atomic_path(RESULTS) as path:
        path.write_text(text, encoding="utf-8")


def take_results(report: Record) -> Record:
    """Return the results of a report to keep: claims and metrics.

    Raises:
        ValueError: If the part ``segmentation`` is missing.
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


def to_markdown(results: Mapping[str, Any]) -> str:
    """Return the kept results as a part of a guide."""
    parts = ["## Scores"]
    for title, name, form in SCORES:
        parts += [f"### {title}", _rows(["cloud", *METHODS], _score_rows(results, name, form))]
    parts.append("## Claims")
    for claim in results["claims"]:
        parts += [
            f"### {claim['text']}",
            f"{claim['where']}: **{verdict(claim)}**. {remarks(claim)}".strip(),
        ]
        if claim["numbers"]:
            rows = [
                [place, "yes" if place in claim["holds"] else "no", numbers]
                for place, numbers in claim["numbers"].items()
            ]
            parts.append(_rows(["tried on", "holds", "numbers"], rows))
    return re.sub(r"(?<!\*)\*(?!\*)", r"\\*", "\n\n".join(parts))


def _score_rows(results: Mapping[str, Any], name: str, form: str) -> Iterator[list[str]]:
    """Yield a row per cloud: a metric of each method, the best in bold."""
    for cloud in dict.fromkeys(score["cloud"] for score in results["scores"]):
        found = {score["method"]: score for score in results["scores"] if score["cloud"] == cloud}
        values = [found[method][name] for method in METHODS]
        yield [found["paper"]["title"], *mark_best(values, form, higher=True)]


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
