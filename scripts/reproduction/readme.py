"""The results section of the README: made from a report, never by hand.

``results.json`` beside this file holds the numbers of the last report that was put there;
``python scripts/reproduce_paper.py --out DIR --readme`` replaces both.
"""

import json
from pathlib import Path
from typing import Any

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
SHAPES = ("cuboid", "dodecahedron")
VARIANTS = {
    "pca": "PCA",
    "jet": "2-jet",
    "irls": "weighted PCA",
    "detmm": "DetMM",
    "paper": "paper",
    "consensus": "consensus",
}
NOISE = 0.25


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
    missing = {"normals", "segmentation", "large", "times"} - parts.keys()
    if missing:
        raise ValueError(f"take_results: expected all parts, got none of {sorted(missing)}.")
    scored = [*parts["segmentation"]["records"], *parts["large"]["records"]]
    normals = parts["normals"]["records"]
    size = max(record["num_points"] for record in normals)
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
        "normals": {
            "num_points": size,
            "errors": [
                {
                    "shape": record["shape"],
                    "variant": record["variant"],
                    "seconds": record["seconds"],
                    **{name: record["score"][name] for name in ("msae", "median", "under_10_deg")},
                }
                for record in normals
                if (record["num_points"], record["noise_percent"]) == (size, NOISE)
                and record["shape"] in SHAPES
                and record["variant"] in VARIANTS
            ],
        },
        "claims": [
            {name: block[name] for name in ("text", "numbers", "why")}
            for part in parts.values()
            for block in part["blocks"]
            if block["kind"] == "claim" and not block["holds"]
        ],
    }


def to_section(results: Record) -> str:
    """Return the results section: tables, and what of the paper does not come out.

    Times of small clouds are those of fixed costs, and stay out.
    """
    made = "small clouds: `--quick`" if results["quick"] else "full size"
    fails = "\n".join(
        " ".join(filter(None, ["*", claim["text"], claim["numbers"], claim["why"]]))
        for claim in results["claims"]
    )
    parts = [
        f"From the report of `scripts/reproduce_paper.py` ({made}): {results['made_with']}.",
        _scores(results["scores"]),
        _normals(results["normals"], with_times=not results["quick"]),
    ]
    if not results["quick"]:
        parts.insert(2, _times(results["times"]))
    if fails:
        parts.append(f"What the paper says and does not come out on these clouds:\n\n{fails}")
    return "\n\n".join(parts)


def _scores(scores: list[Record]) -> str:
    """Return the external indices of the clouds with truth."""
    rows = []
    for key in dict.fromkeys(record["cloud"] for record in scores):
        found = {record["preset"]: record for record in scores if record["cloud"] == key}
        for name, (title, form) in EXTERNAL.items():
            values = [found[preset][name] for preset in METHODS]
            faces = next(iter(found.values()))["faces"]
            rows.append(
                [f"{TITLES[key]} ({faces} faces)", title, *mark_best(values, form, higher=True)]
            )
    head = ["cloud in place of", "index", *METHODS.values()]
    return markdown_table(table("Segmentation of clouds with known truth:", head, rows))


def _times(times: list[Record]) -> str:
    """Return seconds, and how many times faster than the paper's."""
    rows = []
    for key in dict.fromkeys(record["cloud"] for record in times):
        found = {record["preset"]: record for record in times if record["cloud"] == key}
        cells = []
        for preset in METHODS:
            times_faster = ratio(found[preset])
            more = "" if times_faster is None else f" ({times_faster:,.0f} x)"
            cells.append(f"{found[preset]['total']:.1f}{more}")
        rows.append([TITLES[key], f"{next(iter(found.values()))['points']:,}", *cells])
    title = (
        "Seconds from points to planes (how many times faster than the paper's MATLAB, per point):"
    )
    return markdown_table(table(title, ["cloud", "points", *METHODS.values()], rows))


def _normals(normals: dict[str, Any], *, with_times: bool) -> str:
    """Return errors of normals on two shapes."""
    rows = []
    for shape in SHAPES:
        found = {r["variant"]: r for r in normals["errors"] if r["shape"] == shape}
        msae = [found[name]["msae"] for name in VARIANTS]
        share = [100 * found[name]["under_10_deg"] for name in VARIANTS]
        rows.append([shape, "MSAE (degrees²)", *mark_best(msae, ".1f", higher=False)])
        rows.append([shape, "errors under 10° (%)", *mark_best(share, ".1f", higher=True)])
        if with_times:
            seconds = (f"{found[name]['seconds']:.2f}" for name in VARIANTS)
            rows.append([shape, "seconds", *seconds])
    title = f"Normals of {normals['num_points']:,} points, {NOISE} % noise, k = 50:"
    return markdown_table(table(title, ["shape", "", *VARIANTS.values()], rows))


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as beside:
        beside.write_text(text, encoding="utf-8")
