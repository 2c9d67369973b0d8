"""The report of all parts that are there: a page, by ``report.html.jinja``, and JSON.

The numbers of the last full report are a page of the documentation as well.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from reproduction.cells import Folder, Record, describe_surroundings
from reproduction.faces import LARGE
from reproduction.methods import METHODS
from reproduction.sections import Block, mark_best, verdict

TEMPLATE = Path(__file__).with_name("report.html.jinja")

TITLE = "Indoor point cloud segmentation: the paper's evaluation, made again"
INTRO = (
    "Every number here was made by scripts/reproduce_paper.py of torchrg. The paper is: Indoor "
    "Point Cloud Segmentation Using a Modified Region Growing Algorithm and Accurate Normal "
    "Estimation. First each of its claims, where it holds and the numbers behind that; then the "
    'tables and figures. "Beyond" marks what the paper does not say; * marks a made cloud in the '
    "place of the paper's, or a piece of it. The default of torchrg, consensus, is not in the "
    "paper."
)

SCORES = (
    ("Adjusted Rand index", "ari", ".2f"),
    (f"F1 of faces of {LARGE:,} points and more", "f1_large", ".0f"),
    ("Mean best IoU", "mean_best_iou", ".2f"),
)
"""What the page shows of each cloud and method: its title, its name and how it is printed."""


def write_report(folder: Folder, names: Sequence[str], *, quick: bool) -> Record:
    """Write ``report.html`` and ``report.json`` of the parts in a folder.

    Args:
        folder: Where parts and pictures are.
        names: Parts in the order of the report; those that are not there are left out.
        quick: Whether they are of small clouds.

    Returns:
        The report, as in ``report.json``.
    """
    parts: Record = {}
    for name in names:
        path = folder.path / "parts" / f"{name}.json"
        if path.exists():
            parts[name] = json.loads(path.read_text())
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
    """Yield every record inside that says how it was made."""
    if isinstance(value, dict):
        if "made_with" in value:
            yield value
        value = list(value.values())
    if isinstance(value, list):
        for inner in value:
            yield from _find_made(inner)


def to_html(report: Mapping[str, Any]) -> str:
    """Return a report as one page; its pictures are files beside it."""
    environment = Environment(autoescape=True, trim_blocks=True, undefined=StrictUndefined)
    environment.globals = {"verdict": verdict, "figures": _figures}
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(report)


def _figures(claim: Block) -> str:
    """Return the numbers behind a claim, and what else is to be known."""
    numbers = "; ".join(f"{place}: {number}" for place, number in claim["numbers"].items())
    return f"{numbers}. {claim['why']}".strip()


def to_markdown(results: Mapping[str, Any]) -> str:
    """Return the results that are kept beside this file as a part of a page.

    Args:
        results: Scores and claims, as ``results.json`` has them.
    """
    parts = ["## Scores"]
    for title, name, form in SCORES:
        parts += [f"### {title}", _rows(["cloud", *METHODS], _score_rows(results, name, form))]
    parts.append("## Claims")
    for claim in results["claims"]:
        numbers = claim["numbers"].items()
        rows = [
            [place, "yes" if place in claim["holds"] else "no", found] for place, found in numbers
        ]
        parts += [f"### {claim['text']}", f"{claim['where']}: **{verdict(claim)}**. {claim['why']}"]
        parts.append(_rows(["tried on", "holds", "numbers"], rows))
    return re.sub(r"(?<!\*)\*(?!\*)", r"\\*", "\n\n".join(parts))


def _score_rows(results: Mapping[str, Any], name: str, form: str) -> Iterator[list[str]]:
    """Yield a row for each cloud: a score of each method, the best bold."""
    for cloud in dict.fromkeys(score["cloud"] for score in results["scores"]):
        found = {score["method"]: score for score in results["scores"] if score["cloud"] == cloud}
        values = [found[method][name] for method in METHODS]
        yield [found["paper"]["title"], *mark_best(values, form, higher=True)]


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
