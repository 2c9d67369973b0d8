"""The results section of the README: made from a report, never by hand.

``results.json`` beside this file holds the numbers of the last report that was put there;
``python scripts/reproduce_paper.py --out DIR --readme`` replaces both.
"""

import json
from pathlib import Path

from reproduction.cells import Record, is_committed
from reproduction.clouds import HARD
from reproduction.faces import LARGE
from reproduction.methods import DRAWN
from reproduction.sections import mark_best
from torchrg.io import atomic_path

README = Path(__file__).parents[2] / "README.md"
RESULTS = Path(__file__).with_name("results.json")
BEGIN = "<!-- results: made by scripts/reproduce_paper.py --readme, not by hand -->"
END = "<!-- end of results -->"

SHOWN = ("classic", *DRAWN)
"""The methods in its columns."""

INDICES = {"ari": ".2f", "f1_large": ".0f", "mean_best_iou": ".2f"}
"""What the README shows of a cloud and a method, and how it is printed."""


def update(report: Record) -> None:
    """Put the numbers of a report beside this file and into the README.

    Args:
        report: All parts, as :func:`reproduction.report.write_report` returns it.

    Raises:
        ValueError: If it was made by code that is not committed, or by several commits.
    """
    commit = commit_of(report["made_with"])
    if not is_committed(commit) or "," in commit:
        raise ValueError(
            f"update: expected a report of one commit, got {commit or 'none'}; commit, then make "
            "the report again."
        )
    results = take_results(report)
    _write(RESULTS, json.dumps(results, indent=1) + "\n")
    _write(README, insert(README.read_text(encoding="utf-8"), results))


def commit_of(made_with: str) -> str:
    """Return the commit, or several, in a line that says how something was made.

    Example:
        >>> commit_of("torchrg 0.1.0; commit 2f26e94; python 3.11.7")
        '2f26e94'
    """
    fields = dict(field.partition(" ")[::2] for field in made_with.split("; "))
    return fields.get("commit", "")


def insert(readme: str, results: Record) -> str:
    """Return a README with its results section replaced."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not after:
        raise ValueError(f"insert: expected a README with {BEGIN!r} and {END!r}.")
    return f"{before}{BEGIN}\n{to_section(results)}\n{END}{after}"


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
                "share_labeled": record["share_labeled"],
                **{name: record["labels"][name] for name in ("ari", "f1", "mean_best_iou")},
                **{name: record["faces"].get(name) for name in ("f1_large", "f1_objects")},
            }
            for record in parts["segmentation"]["records"]["scores"]
            if "labels" in record
        ],
    }


def to_section(results: Record) -> str:
    """Return the results section: a row for each cloud with truth."""
    rows = []
    for key in dict.fromkeys(record["cloud"] for record in results["scores"]):
        if key not in HARD:
            found = {r["method"]: r for r in results["scores"] if r["cloud"] == key}
            columns = [
                mark_best([found[method][name] for method in SHOWN], form, higher=True)
                for name, form in INDICES.items()
            ]
            cells = map(" / ".join, zip(*columns, strict=True))
            rows.append([f"{found['paper']['title']} ({found['paper']['faces']} faces)", *cells])
    made = "small clouds (`--quick`)" if results["quick"] else "full size"
    title = (
        f"Adjusted Rand index / F1 of faces of {LARGE:,} points and more / mean best IoU; * made "
        f"in place of the paper's cloud. `scripts/reproduce_paper.py`, {made}, commit "
        f"{commit_of(results['made_with'])}:"
    )
    lines = [["cloud", *SHOWN], ["---", *["--:"] * len(SHOWN)], *rows]
    return "\n".join([title, "", *("| " + " | ".join(line) + " |" for line in lines)])


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as beside:
        beside.write_text(text, encoding="utf-8")
