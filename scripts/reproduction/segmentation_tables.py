"""Table 2 and Figures 7 and 8: how well the methods segment two clouds."""

from collections.abc import Sequence

from reproduction.cells import Record
from reproduction.clouds import TITLES
from reproduction.methods import DRAWN, METHODS
from reproduction.paper_numbers import INDEX_NAMES, INDICES, POINTS
from reproduction.pictures import draw_outcomes, draw_side_by_side, write_pair
from reproduction.runs import Run
from reproduction.sections import Block, figure, mark_best, section, table, text
from reproduction.segmentations import SAMPLE_SIZE, read_segmented, score
from reproduction.trends import INTERNAL, face_recalls, internal_claim, trend_claims
from torchrg.metrics import METRICS
from torchrg.render.outcomes import OUTCOMES, outcomes_of

CLOUDS = {"tutorial": "Figure 7", "hallway": "Figure 8"}
"""Clouds of Table 2, and the figures that show them."""

MORE = {
    "pairs": ("pairs", "d"),
    "regions": ("regions", "d"),
    "faces": ("true faces", "d"),
    "mean_best_iou": ("mean best IoU over all faces", ".3f"),
    "recall_iou50": ("faces found at IoU 0.5", ".3f"),
    "recall_iou80": ("faces found at IoU 0.8", ".3f"),
    "precision_iou50": ("regions that are a face at IoU 0.5", ".3f"),
    "over_segmented": ("faces split (SegComp, 80 %)", "d"),
    "under_segmented": ("regions that merge faces (SegComp, 80 %)", "d"),
    "share_labeled": ("share of points labelled", ".3f"),
    "ari": ("adjusted Rand index", ".3f"),
}
"""What stands below the paper's indices: they say nothing about regions and faces without a
partner."""

PRINTED = {"classic": "[28]", "detmm": "[38]", "paper": "proposed"}
"""Names of the methods in the paper's Table 2."""


def reproduce(run: Run) -> Record:
    """Make Table 2 with Figures 7 and 8."""
    blocks = [
        text(
            "Precision, recall and F1 are the paper's: means over the pairs of a region and a face "
            "that are each other's largest overlap. Regions and faces without a partner do not "
            "enter them, so a method that finds six of fifty faces can have 95; the rows below "
            "count them. CP, SP, DBI and DVI are taken on the Gaussian sphere as the paper writes "
            "them. Two parallel walls share their centre there, hence DBI grows without bound and "
            'DVI is 0 in any room; the rows "of directions" first merge regions of one direction. '
            "The paper's figures and ours are of different clouds wherever its own are not given: "
            "compare methods, not tables."
        )
    ]
    blocks.append(cloud_table(run))
    records = []
    for key, number in CLOUDS.items():
        cloud = run.cloud(key).cloud
        found = {preset: score(run, key, preset, internal=True) for preset in METHODS}
        records += list(found.values())
        blocks += [index_table(key, cloud.origin, found), internal_claim(key, found)]
        if cloud.labels is not None:
            blocks += trend_claims(
                found,
                {preset: face_recalls(run, key, preset) for preset in METHODS},
                cloud.origin,
            )
        blocks += draw_figures(run, key, number, DRAWN)
    return section("Table 2, Figures 7 and 8: segmentation", blocks, records)


def cloud_table(run: Run) -> Block:
    """Return which clouds are the paper's own, and what stands in for the others."""
    clouds = [run.cloud(key).cloud for key in TITLES]
    rows = [
        [
            TITLES[cloud.key],
            f"{POINTS[cloud.key]:,}",
            "the paper's own" if cloud.is_papers else "**another**",
            cloud.origin,
            "yes" if cloud.labels is not None else "no",
        ]
        for cloud in clouds
    ]
    head = ["cloud of the paper", "its points", "here", "what it is", "truth known"]
    return table("Clouds, and where they differ from the paper's", head, rows)


def draw_figures(run: Run, key: str, number: str, presets: Sequence[str]) -> list[Block]:
    """Return the figures of a cloud: methods side by side, and with truth what is wrong."""
    cloud = run.cloud(key).cloud
    labelings = {METHODS[preset]: read_segmented(run, key, preset).labels for preset in presets}
    name = f"{number.lower().replace(' ', '')}_{key}"
    file = draw_side_by_side(run.folder, name, cloud, labelings)
    page = write_pair(run.folder, name, cloud, labelings)
    words = f"**{number}**, {cloud.origin}. Points of no region are gray."
    if cloud.labels is None:
        return [figure(file, words, page)]
    file2 = draw_outcomes(run.folder, f"{name}_errors", cloud, labelings)
    shares = []
    for title, labels in labelings.items():
        counts = outcomes_of(labels, cloud.labels).bincount(minlength=len(OUTCOMES)).double()
        shares.append([title, *(f"{100 * value:.1f} %" for value in counts / counts.sum())])
    meanings = [meaning for _, meaning in OUTCOMES.values()]
    return [
        figure(file, words, page),
        figure(file2, f"What became of each point of {cloud.origin}."),
        table(
            "Share of the points of that figure",
            ["method", *meanings],
            shares,
            "A face that shadows cut into pieces is often found in pieces.",
        ),
    ]


def index_table(key: str, origin: str, found: dict[str, Record]) -> Block:
    """Return Table 2 for one cloud: the paper's numbers, then ours."""
    papers = INDICES[key]
    rows = []
    for place, name in enumerate(INDEX_NAMES):
        part = "clusters" if name in INTERNAL else "labels"
        higher = METRICS[part][name].higher_is_better
        form = ".4g" if part == "clusters" else ".1f"
        theirs = [papers[preset][place] for preset in papers]
        ours = [_index(record, part, name) for record in found.values()]
        title = INTERNAL.get(name, name.capitalize())
        rows.append(
            [
                f"{title} {'↑' if higher else '↓'}",
                *mark_best(theirs, form, higher=higher),
                *mark_best(ours, form, higher=higher),
            ]
        )
    for name, title in INTERNAL.items():
        higher = METRICS["clusters"][name].higher_is_better
        ours = [_index(record, "directions", name) for record in found.values()]
        row = [f"{title} of directions {'↑' if higher else '↓'}", *[""] * len(papers)]
        rows.append(row + mark_best(ours, ".4g", higher=higher))
    rows += more_rows(found, len(papers))
    head = [f"**{key}**", *(f"printed: {PRINTED[preset]}" for preset in papers), *METHODS.values()]
    note = (
        f"Left, the paper's printed numbers; right, ours on {origin}. Clusters of more than "
        f"{SAMPLE_SIZE:,} points enter DBI by a subsample of that size."
    )
    if all("labels" not in record for record in found.values()):
        note += " The paper's hand-made truth is not public: no external indices."
    return table(f"**Table 2**, {key}", head, rows, note)


def more_rows(found: dict[str, Record], empty: int = 0) -> list[list[str]]:
    """Return the rows of :data:`MORE`, after some empty columns."""
    rows = []
    for name, (title, form) in MORE.items():
        values = [_index(record, "labels", name) for record in found.values()]
        if name in ("regions", "share_labeled") and values[0] is None:
            values = [record[name] for record in found.values()]
        if any(value is not None for value in values):
            higher = METRICS["labels"][name].higher_is_better
            rows.append([title, *[""] * empty, *mark_best(values, form, higher=higher)])
    return rows


def _index(record: Record, part: str, name: str) -> float | None:
    """Return an index, None where it was not made or has no value."""
    value: float | None = record.get(part, {}).get(name)
    return None if value is None or value != value else value
