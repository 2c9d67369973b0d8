"""Table 2 and Figures 7 and 8: how well the methods segment two clouds."""

from collections.abc import Sequence

from reproduction.cells import Record
from reproduction.paper_numbers import INDEX_NAMES, INDICES
from reproduction.pictures import OUTCOMES, draw_outcomes, draw_side_by_side, outcomes_of
from reproduction.sections import Block, claim, figure, mark_best, section, table, text
from reproduction.segmentations import METHODS, SAMPLE_SIZE, Run, read_segmented, score
from torchrg.metrics import METRICS

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

_UNITS = {"cp": "CP", "sp": "SP", "dbi": "DBI", "dvi": "DVI"}


def reproduce(run: Run) -> Record:
    """Make Table 2 with Figures 7 and 8.

    Args:
        run: The call.

    Returns:
        The section.
    """
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
    records = []
    for key, number in CLOUDS.items():
        cloud = run.cloud(key).cloud
        found = {preset: score(run, key, preset, internal=True) for preset in METHODS}
        records += list(found.values())
        blocks.append(index_table(key, cloud.origin, found))
        if cloud.labels is not None:
            blocks += trend_claims(key, found, cloud.origin)
        blocks += draw_figures(run, key, number, METHODS)
    return section("Table 2, Figures 7 and 8: segmentation", blocks, records)


def draw_figures(run: Run, key: str, number: str, presets: Sequence[str]) -> list[Block]:
    """Return the figures of a cloud: methods side by side, and with truth what is wrong."""
    cloud = run.cloud(key).cloud
    labelings = {METHODS[preset]: read_segmented(run, key, preset).labels for preset in presets}
    file = draw_side_by_side(
        run.folder, f"{number.lower().replace(' ', '')}_{key}", cloud, labelings
    )
    words = f"**{number}**, {cloud.origin}. Points of no region are gray."
    if cloud.labels is None:
        return [figure(file, words)]
    file2 = draw_outcomes(
        run.folder, f"{number.lower().replace(' ', '')}_{key}_errors", cloud, labelings
    )
    shares = []
    for title, labels in labelings.items():
        counts = outcomes_of(labels, cloud.labels).bincount(minlength=len(OUTCOMES)).double()
        shares.append([title, *(f"{100 * value:.1f} %" for value in counts / counts.sum())])
    meanings = [meaning for _, meaning in OUTCOMES.values()]
    return [
        figure(file, words),
        figure(file2, f"What became of each point of {cloud.origin}."),
        table("Share of the points of that figure", ["method", *meanings], shares),
    ]


def index_table(key: str, origin: str, found: dict[str, Record]) -> Block:
    """Return Table 2 for one cloud: the paper's numbers, then ours."""
    papers = INDICES[key]
    rows = []
    for place, name in enumerate(INDEX_NAMES):
        part = "clusters" if name in _UNITS else "labels"
        higher = METRICS[part][name].higher_is_better
        form = ".4f" if part == "clusters" else ".1f"
        theirs = [papers[preset][place] for preset in papers]
        ours = [_index(record, part, name) for record in found.values()]
        title = _UNITS.get(name, name.capitalize())
        rows.append(
            [
                f"{title} {'↑' if higher else '↓'}",
                *mark_best(theirs, form, higher=higher),
                *mark_best(ours, form, higher=higher),
            ]
        )
    for name, title in _UNITS.items():
        higher = METRICS["clusters"][name].higher_is_better
        ours = [_index(record, "directions", name) for record in found.values()]
        row = [f"{title} of directions {'↑' if higher else '↓'}", *[""] * len(papers)]
        rows.append(row + mark_best(ours, ".4f", higher=higher))
    rows += more_rows(found, len(papers))
    head = [f"**{key}**", *(f"paper: {METHODS[preset]}" for preset in papers), *METHODS.values()]
    note = (
        f"Left, the paper's printed numbers; right, ours on {origin}. Clusters of more than "
        f"{SAMPLE_SIZE:,} points enter DBI by a subsample of that size."
    )
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


def trend_claims(key: str, found: dict[str, Record], origin: str) -> list[Block]:
    """Return whether the paper's trends come out on a cloud with truth."""
    f1 = {preset: found[preset]["labels"]["f1"] for preset in METHODS}
    recall = {preset: found[preset]["labels"]["recall"] for preset in METHODS}
    ordered = f1["classic"] < f1["detmm"] < f1["paper"]
    iou = {preset: found[preset]["labels"]["recall_iou50"] for preset in METHODS}
    pairs = {preset: found[preset]["labels"]["pairs"] for preset in METHODS}
    faces = found["classic"]["labels"]["faces"]
    why = (
        ""
        if ordered
        else (
            f"F1 is a mean over matched pairs only, and these are {_listed(pairs, 'd')} of "
            f"{faces} faces; the share of faces found at IoU 0.5 is {_listed(iou, '.3f')}. The "
            "picture of errors below shows which points are lost, and to what."
        )
    )
    blocks = [
        claim(
            f"F1 rises from classic over DetMM to the paper's method ({origin}).",
            ordered,
            f"F1: {_listed(f1, '.1f')}.",
            why,
        )
    ]
    blocks += [
        claim(
            f"Recall of {METHODS[preset]} is above that of classic ({origin}).",
            recall[preset] > recall["classic"],
            f"Recall: {recall[preset]:.1f} against {recall['classic']:.1f}.",
            ""
            if recall[preset] > recall["classic"]
            else f"Pairs: {pairs[preset]} against {pairs['classic']} of {faces} faces; the hard "
            "faces that only one method finds count in its mean alone.",
        )
        for preset in ("paper", "consensus")
    ]
    return blocks


def _listed(values: dict[str, float], form: str) -> str:
    return ", ".join(f"{METHODS[preset]} {format(value, form)}" for preset, value in values.items())


def _index(record: Record, part: str, name: str) -> float | None:
    """Return an index, None where it was not made or has no value."""
    value: float | None = record.get(part, {}).get(name)
    return None if value is None or value != value else value
