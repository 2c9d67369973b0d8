"""Medians and ratios of the runs, as a table and a plot."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from peers.contenders import Run

REFERENCES = ("pclrg", "open3d-pca")
"""What ratios are taken to: PCL's normals and region growing, Open3D's normals."""

Runs = Mapping[str, Mapping[str, Sequence[Run]]]
"""Runs by cloud and contender, in the order they were made."""


def summarize(runs: Runs) -> dict[str, dict[str, Any]]:
    """Return medians by cloud and contender; ratios are medians of those of the same round."""
    summary: dict[str, dict[str, Any]] = {}
    for cloud, by_name in runs.items():
        summary[cloud] = {}
        for name, repeats in by_name.items():
            if not repeats:
                continue
            stages = {
                stage: median(run.seconds[stage] for run in repeats) for stage in repeats[0].seconds
            }
            row: dict[str, Any] = {
                "seconds": stages,
                "whole_seconds": median(run.whole_seconds for run in repeats),
                "peak_mib": median(run.peak_mib for run in repeats),
                "runs": len(repeats),
            }
            for reference in REFERENCES:
                others = by_name.get(reference, ())
                kind = "whole_seconds" if name.endswith("-command") else "total"
                ratios = [
                    _time(run, kind) / _time(other, kind)
                    for run, other in zip(repeats, others, strict=False)
                ]
                if ratios:
                    row[f"ratio to {reference}"] = median(ratios)
            summary[cloud][name] = row
    return summary


def _time(run: Run, kind: str) -> float:
    return run.whole_seconds if kind == "whole_seconds" else run.seconds["total"]


def markdown(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """Write the summary as a table; a ratio above 1 is where we lose."""
    lines = [
        "| cloud | what | seconds | stages | whole process, s | peak MiB | to PCL | to Open3D |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for cloud, rows in summary.items():
        for name, row in rows.items():
            stages = ", ".join(
                f"{stage} {value:.2f}"
                for stage, value in row["seconds"].items()
                if stage != "total"
            )
            ratios = [_ratio(row, name, reference) for reference in REFERENCES]
            lines.append(
                f"| {cloud} | {name} | {row['seconds']['total']:.2f} | {stages} "
                f"| {row['whole_seconds']:.2f} | {row['peak_mib']:,.0f} | {' | '.join(ratios)} |"
            )
    return "\n".join(lines) + "\n"


def _ratio(row: Mapping[str, Any], name: str, reference: str) -> str:
    """Return a ratio of like to like: normals to normals, planes to planes."""
    normals_only = name.endswith("-pca") or name == "cgaln"
    value = row.get(f"ratio to {reference}")
    if value is None or name == reference or normals_only != reference.endswith("-pca"):
        return ""
    return f"{value:.2f}" + (" (slower)" if value > 1 else "")


def plot(summary: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draw a bar of seconds for each contender, a panel for each cloud, stages side by side."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        len(summary), 1, figsize=(7.5, 0.6 + 2.4 * len(summary)), squeeze=False
    )
    stages = sorted(
        {s for rows in summary.values() for row in rows.values() for s in row["seconds"]}
        - {"total"}
    )
    colors = dict(zip(stages, plt.get_cmap("tab10").colors, strict=False))
    for axis, (cloud, rows) in zip(axes[:, 0], summary.items(), strict=True):
        for place, row in enumerate(rows.values()):
            left = 0.0
            for stage, value in row["seconds"].items():
                if stage != "total":
                    axis.barh(place, value, left=left, color=colors[stage])
                    left += value
            axis.text(left, place, f" {left:.1f}", va="center", fontsize=8)
        axis.set_yticks(range(len(rows)), list(rows), fontsize=8)
        axis.invert_yaxis()
        axis.margins(x=0.08)
        axis.set_title(cloud, loc="left", fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1, 0].set_xlabel("seconds")
    handles = [plt.Rectangle((0, 0), 1, 1, color=colors[stage]) for stage in stages]
    figure.legend(handles, stages, loc="lower center", ncols=len(stages), fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.6 / figure.get_figheight(), 1, 1))
    figure.savefig(path, dpi=150)
    plt.close(figure)
