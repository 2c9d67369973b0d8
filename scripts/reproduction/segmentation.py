"""Table 2 and Figures 7 to 9: how well the methods segment, on every cloud."""

from collections.abc import Callable
from itertools import chain

from reproduction.cells import Record
from reproduction.claims import segmentation_claims
from reproduction.clouds import HARD, OTHERS, TITLES
from reproduction.faces import LARGE
from reproduction.methods import DRAWN, METHODS, PAPERS
from reproduction.paper_numbers import INDEX_NAMES, INDICES, POINTS
from reproduction.pictures import draw_outcomes, draw_side_by_side
from reproduction.runs import Run
from reproduction.sections import Block, figure, mark_best, section, table, text
from reproduction.segmentations import (
    SAMPLE_SIZE,
    count_regions,
    read_segmented,
    regrow,
    score,
    score_sphere,
)
from torchrg.metrics import METRICS, adjusted_rand_index, contingency_table
from torchrg.render.channels import OUTCOMES, point_outcomes

FIGURES = {
    "tutorial": "Figure 7",
    "hallway": "Figure 8",
    "cory": "Figure 9",
    "kinect": "Figure 9",
}
"""The figures that show the paper's clouds."""

ANGLES_DEG = (2.0, 5.0, 8.0)
"""Of Figure 9. The paper does not print those of its second row; the third is at 5 degrees."""

COLUMNS: dict[str, tuple[str, Callable[[Record], float | None]]] = {
    "ARI": (".3f", lambda record: record["labels"]["ari"]),
    "F1, all faces": (".1f", lambda record: record["labels"]["f1"]),
    f"F1, {LARGE:,} points and more": (".1f", lambda record: record["faces"]["f1_large"]),
    "F1, objects": (".1f", lambda record: record["faces"].get("f1_objects")),
    "labelled": (".3f", lambda record: record["fraction_labeled"]),
    "mean best IoU": (".3f", lambda record: record["labels"]["mean_best_iou"]),
    "faces found": (".3f", lambda record: record["labels"]["recall_iou50"]),
    "right at edges": (".3f", lambda record: record["faces"]["right_at_edges"]),
}
"""Indices of a segmentation: how they are printed, and where the record has them. More is better
in all."""

DVI_REMARK = (
    "The printed DVI has very probably lost its exponent: 4.7684e-07 is 2^-21, a rounding error of "
    "single precision; ours are as small (two parallel walls share their centre on the sphere); "
    "and by the paper's own formulas DVI is at most (pi/2) / CP, which the printed 10.0 exceeds. "
    "An order by DVI is one of rounding errors."
)


def reproduce(run: Run) -> Record:
    """Make Table 2, Figures 7 to 9, and the same table of other clouds."""
    keys = (*TITLES, *OTHERS, *HARD)
    scores = {key: {method: score(run, key, method) for method in METHODS} for key in keys}
    scored = {key: found for key, found in scores.items() if "labels" in found["paper"]}
    sphere = {
        key: {method: score_sphere(run, key, method) for method in METHODS} for key in INDICES
    }
    angles = {key: _angles(run, key) for key in ("tutorial", "cory", "kinect")}
    blocks = [
        text(
            "Methods are presets. classic chooses seeds by curvature as PCL does; "
            "classic_increment and detmm by its increment, as the paper describes region growing "
            "(II.B). In paper, neighbours that share less than 75 % of their neighbours with a "
            "seed join and become seeds once a connected seed reaches them (text of the paper); "
            "algorithm2 drops them, as Algorithm 2 is printed. F1 is the paper's: of mean "
            "precision and recall over the pairs of a region and a face that are each other's "
            "largest overlap. Regions and faces without a partner do not enter it, and a face of "
            "50 points weighs as much as a wall: hence "
            "F1 of faces of 1,000 points and more, and F1 of objects, where a table or a door is "
            "one, as in S3DIS. ARI and mean best IoU count everything. Faces found: at IoU 0.5. "
            "Right at edges: points with another face among their 50 neighbours that lie in the "
            "region of their face."
        ),
        cloud_table(run),
        *(index_table(run, key, found) for key, found in scored.items()),
        *(sphere_table(run, key, sphere[key], scores[key]) for key in INDICES),
    ]
    for key, number in FIGURES.items():
        blocks += draw_figures(run, key, number)
        if key in angles:
            blocks += angle_blocks(run, key, angles[key])
    records = {
        "scores": list(chain.from_iterable(found.values() for found in scores.values())),
        "sphere": sphere,
        "angles": angles,
    }
    claims = segmentation_claims(scored, sphere, angles, DVI_REMARK)
    return section("Table 2, Figures 7 to 9: segmentation", blocks, records, claims)


def cloud_table(run: Run) -> Block:
    """Return what the clouds are, and what stands in for the paper's."""
    rows = []
    for key in (*TITLES, *OTHERS, *HARD):
        cloud = run.cloud(key).cloud
        paper = f"{POINTS[key]:,}" if key in POINTS else ""
        here = "the paper's own" if cloud.is_papers else "**another**" if paper else ""
        rows.append([cloud.title, paper, here, cloud.origin])
    head = ["cloud", "points in the paper", "here", "what it is"]
    note = "The paper's figures and ours are of different clouds where its own are not given."
    return table("Clouds", head, rows, note)


def index_table(run: Run, key: str, found: dict[str, Record]) -> Block:
    """Return the external indices of all methods on a cloud with truth."""
    columns = [
        mark_best([take(record) for record in found.values()], form, higher=True)
        for form, take in COLUMNS.values()
    ]
    faces = next(iter(found.values()))["labels"]["faces"]
    title = f"**{run.cloud(key).cloud.title}** ({faces} faces; {run.cloud(key).cloud.origin})"
    return table(title, ["method", *COLUMNS], zip(found, *columns, strict=True))


def sphere_table(run: Run, key: str, sphere: dict[str, Record], scores: dict[str, Record]) -> Block:
    """Return Table 2 for one cloud: the paper's numbers, then ours."""
    rows = []
    for place, name in enumerate(INDEX_NAMES):
        part = "clusters" if name in METRICS["clusters"] else "labels"
        higher = METRICS[part][name].higher_is_better
        ours = [
            sphere[method][name] if part == "clusters" else _external(scores[method], name)
            for method in METHODS
        ]
        theirs = [INDICES[key][method][place] for method in PAPERS]
        title = name.upper() if part == "clusters" else name.capitalize()
        form = ".4g" if part == "clusters" else ".1f"
        rows.append(
            [
                f"{title} {'↑' if higher else '↓'}",
                *mark_best(theirs, ".4f" if part == "clusters" else ".1f", higher=higher),
                *mark_best(ours, form, higher=higher),
            ]
        )
    head = [key, *(f"printed: {title}" for title in PAPERS)]
    note = (
        f"Left, the paper's printed numbers; right, ours on {run.cloud(key).cloud.origin}. "
        f"Clusters of more than {SAMPLE_SIZE:,} points enter DBI by a subsample of that size. "
        f"{DVI_REMARK}"
    )
    return table(f"**Table 2**, {run.cloud(key).cloud.title}", [*head, *METHODS], rows, note)


def _external(record: Record, name: str) -> float | None:
    """Return an external index, None without a truth."""
    value: float | None = record.get("labels", {}).get(name)
    return value


def draw_figures(run: Run, key: str, number: str) -> list[Block]:
    """Return the figures of a cloud: methods side by side, and with truth what is wrong."""
    cloud = run.cloud(key).cloud
    labelings = {method: read_segmented(run, key, method).labels for method in DRAWN}
    name = f"{number.lower().replace(' ', '')}_{key}"
    file = draw_side_by_side(run.folder, name, cloud, labelings)
    blocks = [figure(file, f"**{number}**, {cloud.origin}. Points of no region are gray.")]
    if cloud.labels is None:
        return blocks
    fractions = []
    for title, labels in labelings.items():
        counts = point_outcomes(labels, cloud.labels).bincount(minlength=len(OUTCOMES)).double()
        fractions.append([title, *(f"{100 * value:.1f} %" for value in counts / counts.sum())])
    meanings = [meaning for _, meaning in OUTCOMES.values()]
    file = draw_outcomes(run.folder, f"{name}_errors", cloud, labelings)
    return [
        *blocks,
        figure(file, f"What became of each point of {cloud.origin}."),
        table("Share of the points of that figure", ["method", *meanings], fractions),
    ]


def _angles(run: Run, key: str) -> Record:
    """Draw what the paper's method makes of a cloud at several angles, and score it."""
    cloud = run.cloud(key).cloud

    def work() -> Record:
        labelings = {f"{angle:g}": regrow(run, key, "paper", angle, 0.95) for angle in ANGLES_DEG}
        titled = {f"paper, {angle} degrees": labels for angle, labels in labelings.items()}
        draw_side_by_side(run.folder, _angles_name(key), cloud, titled, with_input=False)
        found = {angle: count_regions(labels) for angle, labels in labelings.items()}
        if cloud.labels is not None:
            for angle, labels in labelings.items():
                overlaps = contingency_table(labels, cloud.labels)
                found[angle]["ari"] = adjusted_rand_index(overlaps)
        return {"title": cloud.title, "angles": found}

    picture = run.folder.path / f"figures/{_angles_name(key)}.png"
    return run.folder.cell(f"angles-{cloud.name}", work, needs=picture)


def _angles_name(key: str) -> str:
    """Return the name of a picture."""
    return f"figure9_{key}_angles"


def angle_blocks(run: Run, key: str, record: Record) -> list[Block]:
    """Return picture and table of the paper's method at several angles."""
    rows = [
        [
            angle,
            f"{one['regions']:,}",
            f"{100 * one['fraction_labeled']:.1f} %",
            f"{one['ari']:.3f}" if "ari" in one else "-",
        ]
        for angle, one in record["angles"].items()
    ]
    caption = (
        f"{run.cloud(key).cloud.origin}: the paper's method at several angles (Figure 9), "
        "which are those of sharp points and of growth."
    )
    return [
        figure(f"figures/{_angles_name(key)}.png", caption),
        table("", ["degrees", "regions", "labelled", "ARI"], rows),
    ]
