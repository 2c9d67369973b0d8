"""The study of section II.B: what the limits of angle and curvature do."""

from pathlib import Path

from matplotlib import pyplot as plt
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from reproduction.cells import Record
from reproduction.pictures import draw_side_by_side, settings
from reproduction.runs import Run
from reproduction.sections import Block, claim, figure, section, text
from reproduction.segmentations import count_regions, regrow
from torchrg.metrics import adjusted_rand_index, contingency_table, score_labels

ANGLES_DEG = tuple(float(angle) for angle in range(2, 11))
QUANTILES = (0.95, 0.98)
STUDIED = ("classic_increment", "paper", "consensus")
DRAWN_DEG = (2.0, 5.0, 8.0)
KEY = "tutorial"
SAME_ARI = 0.99
"""From this adjusted Rand index on, two segmentations are called nearly identical here."""

_COLORS = {"classic_increment": "#4878a8", "paper": "#c44e52", "consensus": "#2a7f3f"}


def reproduce(run: Run) -> Record:
    """Make the study of section II.B on the cloud of the tutorial."""
    cloud = run.cloud(KEY).cloud
    records = [_measure(run, method, angle) for method in STUDIED for angle in ANGLES_DEG]
    _draw(run.folder.place("figures/study.png"), records)
    labelings = {f"paper, {angle:g} degrees": _labels(run, "paper", angle) for angle in DRAWN_DEG}
    picture = draw_side_by_side(
        run.folder, "study_angles", cloud, labelings, with_input=cloud.labels is None
    )
    blocks = [
        text(
            "The paper grows regions on region_growing_tutorial at angles from 2 to 10 degrees, "
            "with the curvature limit at the 95th and the 98th percentile. It finds the two "
            "percentiles nearly identical, too little joined at 2 degrees and too much at 8, and "
            f"gives no numbers. Here: {cloud.origin}. The angle is the paper's one theta: that of "
            "sharp points (eq. 9) and of growth (--angle-deg)."
        ),
        figure(
            "figures/study.png", "Section II.B: lines at the 95th, dots at the 98th percentile."
        ),
        figure(picture, "The paper's method at several angles, 95th percentile."),
    ]
    return section(
        "Section II.B: the limits of angle and curvature", blocks, records, _claims(records)
    )


def _labels(run: Run, method: str, angle: float, quantile: float = QUANTILES[0]) -> Tensor:
    return regrow(run, KEY, method, angle, quantile)


def _measure(run: Run, method: str, angle: float) -> Record:
    """Return regions, share and scores at an angle for both percentiles, and how alike they are."""
    cloud = run.cloud(KEY).cloud

    def work() -> Record:
        both = [_labels(run, method, angle, quantile) for quantile in QUANTILES]
        found = []
        for labels in both:
            found.append(count_regions(labels))
            found[-1]["largest"] = float((labels == 0).double().mean())
            if cloud.labels is not None:
                score = score_labels(labels, cloud.labels)
                found[-1] |= {"f1": score.f1, "mean_best_iou": score.mean_best_iou}
        ari = adjusted_rand_index(contingency_table(*both))
        print(
            f"{cloud.name}, {method} at {angle:g} degrees: {found[0]['regions']} regions",
            flush=True,
        )
        return {"method": method, "angle": angle, "quantiles": found, "ari": ari}

    return run.folder.cell(f"study-{cloud.name}-{method}-{angle:g}", work)


def _claims(records: list[Record]) -> list[Block]:
    """Return whether the paper's observations come out."""
    alike, joined, largest = {}, {}, {}
    for method in ("classic_increment", "paper"):
        mine = {record["angle"]: record for record in records if record["method"] == method}
        least = min(mine.values(), key=lambda record: record["ari"])
        alike[method] = (
            least["ari"] >= SAME_ARI,
            f"ARI of the two at least {least['ari']:.3f} (at {least['angle']:g} degrees)",
        )
        low, middle, high = (mine[angle]["quantiles"][0] for angle in DRAWN_DEG)
        fractions = [f"{100 * found['fraction_labeled']:.1f} %" for found in (low, middle)]
        fewer = low["fraction_labeled"] < middle["fraction_labeled"]
        joined[method] = (fewer, " < ".join(fractions))
        fractions = [f"{100 * found['largest']:.1f} %" for found in (middle, high)]
        largest[method] = (high["largest"] > middle["largest"], " < ".join(fractions))
    return [
        claim(
            "II.B",
            "The 95th and 98th percentiles give nearly identical segments.",
            alike,
            quick_tells=False,
        ),
        claim("II.B", "At 2 degrees fewer points are labelled than at 5.", joined),
        claim("II.B", "At 8 degrees the largest region is larger than at 5.", largest),
    ]


def _draw(path: Path, records: list[Record]) -> None:
    """Plot what the limits do."""
    panels = {
        "regions": "regions",
        "fraction_labeled": "points labelled (%)",
        "largest": "points in the largest region (%)",
    }
    if "f1" in records[0]["quantiles"][0]:
        panels |= {"f1": "F1 (%)", "mean_best_iou": "mean best IoU (%)"}
    with settings():
        figure_, axes = plt.subplots(
            1, len(panels), figsize=(2.3 * len(panels), 2.5), layout="constrained"
        )
        for axis, (name, title) in zip(axes, panels.items(), strict=True):
            scale = 1 if name in ("regions", "f1") else 100
            for method in STUDIED:
                mine = [record for record in records if record["method"] == method]
                for place, line in enumerate(("-", "o")):
                    heights = [scale * record["quantiles"][place][name] for record in mine]
                    axis.plot(
                        [record["angle"] for record in mine],
                        heights,
                        line,
                        color=_COLORS[method],
                        label=method if place == 0 else None,
                        markerfacecolor="none",
                    )
            axis.set_title(title)
            axis.set_xlabel("angle (degrees)")
            axis.set_xticks([2, 4, 6, 8, 10])
            if name == "regions":
                axis.yaxis.set_major_locator(MaxNLocator(integer=True))
        figure_.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        figure_.savefig(path)
        plt.close(figure_)
