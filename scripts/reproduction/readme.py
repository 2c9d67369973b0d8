"""The results section of the README: made from a report, never by hand.

``results.json`` beside this file holds the numbers of the last report that was put there;
``python scripts/reproduce_paper.py --out DIR --readme`` replaces both.
"""

import json
from pathlib import Path

from reproduction.cells import Record
from reproduction.clouds import TITLES
from reproduction.methods import METHODS
from reproduction.rendering import markdown_table
from reproduction.sections import mark_best, table
from reproduction.times import ratio
from torchrg.io import atomic_path

README = Path(__file__).parents[2] / "README.md"
RESULTS = Path(__file__).with_name("results.json")
BEGIN = "<!-- results: made by scripts/reproduce_paper.py --readme, not by hand -->"
END = "<!-- end of results -->"

EXTERNAL = {
    "f1": ("F1 of matched pairs", ".1f"),
    "recall_iou50": ("faces found (IoU 0.5)", ".2f"),
    "mean_best_iou": ("mean best IoU", ".2f"),
}


def update(report: Record) -> None:
    """Put the numbers of a report beside this file and into the README.

    Args:
        report: All parts, as :func:`reproduction.report.write_report` returns it.
    """
    results = take_results(report)
    _write(RESULTS, json.dumps(results, indent=1) + "\n")
    _write(README, insert(README.read_text(encoding="utf-8"), results))


def insert(readme: str, results: Record) -> str:
    """Return a README with its results section replaced."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not after:
        raise ValueError(f"insert: expected a README with {BEGIN!r} and {END!r}.")
    return f"{before}{BEGIN}\n{to_section(results)}\n{END}{after}"


def take_results(report: Record) -> Record:
    """Return the numbers of a report that the README shows.

    Raises:
        ValueError: If a part that it needs is not there.
    """
    parts = report["parts"]
    missing = {"segmentation", "large", "times"} - parts.keys()
    if missing:
        raise ValueError(f"take_results: expected all parts, got none of {sorted(missing)}.")
    scored = [*parts["segmentation"]["records"], *parts["large"]["records"]]
    return {
        "quick": report["quick"],
        "made_with": report["made_with"],
        "scores": [
            {
                "cloud": record["cloud"],
                "preset": record["preset"],
                "faces": record["labels"]["faces"],
                **{name: record["labels"][name] for name in EXTERNAL},
            }
            for record in scored
            if "labels" in record
        ],
        "times": [
            {name: record[name] for name in ("cloud", "preset", "points", "total")}
            for record in parts["times"]["records"]
        ],
    }


def to_section(results: Record) -> str:
    """Return the results section: one table of the clouds with truth.

    Times of small clouds are those of fixed costs, and stay out.
    """
    made = "small clouds: `--quick`" if results["quick"] else "full size"
    rows = []
    for key in dict.fromkeys(record["cloud"] for record in results["scores"]):
        found = {record["preset"]: record for record in results["scores"] if record["cloud"] == key}
        name = f"{TITLES[key]} ({next(iter(found.values()))['faces']} faces)"
        for index, (title, form) in EXTERNAL.items():
            values = [found[preset][index] for preset in METHODS]
            rows.append([name, title, *mark_best(values, form, higher=True)])
        if not results["quick"]:
            rows.append([name, "times faster than published", *_speedups(results["times"], key)])
    head = ["cloud in place of", "index", *METHODS.values()]
    title = (
        f"Clouds with known truth, from the report of `scripts/reproduce_paper.py` ({made}; "
        f"{results['made_with']}):"
    )
    return markdown_table(table(title, head, rows))


def _speedups(times: list[Record], cloud: str) -> list[str]:
    """Return how many times faster, per point, each method is than the paper's MATLAB code."""
    found = {record["preset"]: record for record in times if record["cloud"] == cloud}
    ratios = [ratio(found[preset]) for preset in METHODS]
    return ["" if value is None else f"{value:,.0f}" for value in ratios]


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as beside:
        beside.write_text(text, encoding="utf-8")
