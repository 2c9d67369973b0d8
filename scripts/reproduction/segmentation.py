"""Table 2 and Figures 7 to 9: evaluation of the methods on every cloud, and the claims."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

from reproduction.clouds import HARD, OTHERS, POINTS, TITLES, Run, title_of
from reproduction.evaluation import (
    DRAWN,
    LARGE,
    METHODS,
    PAPERS,
    SAMPLE_SIZE,
    count_regions,
    evaluate,
    evaluate_sphere,
    read_segmented,
    regrow,
)
from reproduction.pictures import draw_outcomes, draw_side_by_side
from reproduction.records import (
    Block,
    Outcome,
    Record,
    claim,
    figure,
    mark_best,
    rising,
    section,
    table,
    text,
)
from torchrg.metrics import METRICS, adjusted_rand_index, contingency_table
from torchrg.render.channels import OUTCOMES, point_outcomes

FIGURES = {
    "tutorial": "Figure 7",
    "hallway": "Figure 8",
    "cory": "Figure 9",
    "kinect": "Figure 9",
}
"""Figures of the paper's clouds."""

INDICES = {
    "tutorial": {
        "classic_increment": (0.2115, 0.5951, 2.0324, 10.002, 100.0, 49.3, 66.0),
        "detmm": (0.1061, 0.4139, 1.417, 4.7684, 78.4, 100.0, 87.9),
        "paper": (0.0903, 0.6337, 1.7324, 4.9920, 82.6, 100.0, 90.5),
    },
    "hallway": {
        "classic_increment": (0.1118, 0.4324, 1.9665, 6.7303, 51.9, 89.6, 62.9),
        "detmm": (0.1274, 0.4289, 1.4581, 4.7684, 90.7, 68.3, 77.9),
        "paper": (0.1009, 0.6253, 1.0637, 4.9174, 90.8, 100.0, 95.2),
    },
}
"""Table 2 as printed, in the order of :data:`INDEX_NAMES`."""

INDEX_NAMES = ("cp", "sp", "dbi", "dvi", "precision", "recall", "f1")

INTERNAL = INDEX_NAMES[:4]
"""The paper's internal indices."""

ANGLES_DEG = (2.0, 5.0, 8.0)
"""Angles of Figure 9; the paper gives only one, 5 degrees."""

Scores = Mapping[str, Mapping[str, Record]]
"""Records by cloud and method."""

Values = Mapping[str, Sequence[float | None]]
"""Values of several methods by the title of the cloud."""


class Metric(NamedTuple):
    """A metric of a segmentation, higher is better."""

    name: str
    form: str  # format of printed values
    take: Callable[[Record], float | None]  # value in a record


ARI = Metric("ARI", ".3f", lambda record: record["labels"]["ari"])
F1 = Metric("F1 of all surfaces", ".1f", lambda record: record["labels"]["f1"])
F1_LARGE = Metric(
    f"F1 of surfaces of at least {LARGE:,} points", ".1f", lambda r: r["faces"]["f1_large"]
)
F1_OBJECTS = Metric("F1 of objects", ".1f", lambda record: record["faces"].get("f1_objects"))
BEST_IOU = Metric("mean best IoU", ".3f", lambda record: record["labels"]["mean_best_iou"])
LABELED = Metric("fraction labeled", ".3f", lambda record: record["fraction_labeled"])
RIGHT = Metric("right at edges", ".3f", lambda record: record["faces"]["right_at_edges"])
UNLABELED = Metric("unlabeled at edges", ".3f", lambda r: r["faces"]["none_at_edges"])
REASONS = {
    F1.name: Metric(
        "F1 with 0 for unmatched surfaces", ".1f", lambda record: record["faces"]["f1_of_every"]
    ),
    F1_OBJECTS.name: Metric(
        "F1 of the ground-truth surfaces", ".1f", lambda r: r["faces"].get("f1_objects_exact")
    ),
}
"""Metrics that explain why another one does not rise."""

COLUMNS = (
    ARI,
    F1,
    F1_LARGE,
    F1_OBJECTS,
    LABELED,
    BEST_IOU,
    Metric("detected", ".3f", lambda record: record["labels"]["recall_iou50"]),
    RIGHT,
)


def reproduce(run: Run) -> Record:
    """Make Table 2 and Figures 7 to 9, and tables of the other clouds."""
    keys = (*TITLES, *OTHERS, *HARD)
    scores = {key: {method: evaluate(run, key, method) for method in METHODS} for key in keys}
    scored = {key: found for key, found in scores.items() if "labels" in found["paper"]}
    sphere = {
        key: {method: evaluate_sphere(run, key, method) for method in METHODS} for key in INDICES
    }
    angles = {key: _angles(run, key) for key in ("tutorial", "cory", "kinect")}
    blocks = [
        text(
            "Methods are presets. classic selects seeds by curvature, as PCL does; "
            "classic_increment and detmm by its increment, as the paper describes region growing "
            "(II.B). In paper, neighbors that share less than 75 % of their neighbors with a seed "
            "join, and become seeds once a connected seed reaches them (text of the paper); "
            "algorithm2 drops them, as Algorithm 2 is printed. F1 is the paper's: mean precision "
            "and recall over the pairs of a region and a surface that are each other's largest "
            "overlap. It ignores unmatched regions and surfaces, and weighs a surface of 50 points "
            f"like a wall. F1 of surfaces of at least {LARGE:,} points, and of objects (a table or "
            "door is one, as in S3DIS), are therefore given as well. ARI and mean best IoU include "
            "everything. Detected: at IoU 0.5. Right at edges: the fraction of points with another "
            "surface among their 50 neighbors that lie in the region of their own surface."
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
    claims = segmentation_claims(scored, sphere, angles)
    return section("Table 2, Figures 7 to 9: segmentation", blocks, records, claims)


def cloud_table(run: Run) -> Block:
    """Return the clouds, and which substitutes are used."""
    rows = []
    for key in (*TITLES, *OTHERS, *HARD):
        cloud = run.cloud(key).cloud
        paper = f"{POINTS[key]:,}" if key in POINTS else ""
        here = "the paper's own" if cloud.is_papers else "**another**" if paper else ""
        rows.append([cloud.title, paper, here, cloud.origin])
    head = ["cloud", "points in the paper", "here", "description"]
    note = "Without the paper's own files, its figures and ours show different clouds."
    return table("Clouds", head, rows, note)


def index_table(run: Run, key: str, found: dict[str, Record]) -> Block:
    """Return the metrics of all methods on a cloud with ground truth."""
    columns = [
        mark_best([metric.take(record) for record in found.values()], metric.form, higher=True)
        for metric in COLUMNS
    ]
    faces = next(iter(found.values()))["labels"]["faces"]
    title = f"**{run.cloud(key).cloud.title}** ({faces} surfaces; {run.cloud(key).cloud.origin})"
    head = ["method", *(metric.name for metric in COLUMNS)]
    return table(title, head, zip(found, *columns, strict=True))


def sphere_table(run: Run, key: str, sphere: dict[str, Record], scores: dict[str, Record]) -> Block:
    """Return Table 2 of one cloud: printed numbers, then ours."""
    rows = []
    for column, name in enumerate(INDEX_NAMES):
        part = "clusters" if name in METRICS["clusters"] else "labels"
        higher = METRICS[part][name].higher_is_better
        ours = [
            sphere[method][name]
            if part == "clusters"
            else scores[method].get("labels", {}).get(name)
            for method in METHODS
        ]
        theirs = [INDICES[key][method][column] for method in PAPERS]
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
        f"Left: printed in the paper; right: on {run.cloud(key).cloud.origin}. "
        f"DBI uses subsamples of {SAMPLE_SIZE:,} points of larger clusters. "
        + dvi_note(one["dvi"] for one in sphere.values())
    )
    return table(f"**Table 2**, {run.cloud(key).cloud.title}", [*head, *METHODS], rows, note)


def draw_figures(run: Run, key: str, number: str) -> list[Block]:
    """Return the figures of a cloud: methods side by side, and their errors if known."""
    cloud = run.cloud(key).cloud
    labelings = {method: read_segmented(run, key, method).labels for method in DRAWN}
    name = f"{number.lower().replace(' ', '')}_{key}"
    file = draw_side_by_side(run.folder, name, cloud, labelings)
    blocks = [figure(file, f"**{number}**, {cloud.origin}. Unlabeled points are gray.")]
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
        figure(file, f"Outcome of each point of {cloud.origin}."),
        table("Fractions of the points in that figure", ["method", *meanings], fractions),
    ]


def _angles(run: Run, key: str) -> Record:
    """Render and evaluate the paper's method on a cloud at several angles."""
    cloud = run.cloud(key).cloud

    def compute() -> Record:
        labelings = {f"{angle:g}": regrow(run, key, "paper", angle, 0.95) for angle in ANGLES_DEG}
        titled = {f"paper, {angle} degrees": labels for angle, labels in labelings.items()}
        draw_side_by_side(run.folder, _angles_name(key), cloud, titled, with_input=False)
        found = {angle: count_regions(labels) for angle, labels in labelings.items()}
        if cloud.labels is not None:
            for angle, labels in labelings.items():
                overlaps = contingency_table(labels, cloud.labels)
                found[angle]["ari"] = adjusted_rand_index(overlaps)
        return {"title": cloud.title, "angles": found}

    image = run.folder.path / f"figures/{_angles_name(key)}.png"
    return run.folder.cell(f"angles-{cloud.name}", compute, needs=image)


def _angles_name(key: str) -> str:
    return f"figure9_{key}_angles"


def angle_blocks(run: Run, key: str, record: Record) -> list[Block]:
    """Return image and table of the paper's method at several angles."""
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
        "for sharp points and for growth."
    )
    return [
        figure(f"figures/{_angles_name(key)}.png", caption),
        table("", ["degrees", "regions", "labeled", "ARI"], rows),
    ]


def segmentation_claims(
    scores: Scores, sphere: Scores, angles: Mapping[str, Record]
) -> list[Block]:
    """Return the paper's claims about segmentations, then comparisons beyond the paper.

    Args:
        scores: Records of clouds with ground truth.
        sphere: Internal indices.
        angles: Records of the paper's method at several angles, by cloud.
    """
    usual = {key: found for key, found in scores.items() if key not in HARD}
    hard = {key: found for key, found in scores.items() if key in HARD}
    curved = {key: found for key, found in hard.items() if key == "curved"}
    edges = "Fractions of the points near edges: classic, DetMM, paper."
    right, unlabeled = _values(usual, RIGHT.take), _values(usual, UNLABELED.take)
    other = {
        title: [1 - sum(both) for both in zip(row, unlabeled[title], strict=True)]
        for title, row in right.items()
    }
    f1 = [F1.take(scores[key]["paper"]) if key in scores else None for key in INDICES]
    return [
        *(_rise("Table 2, V", metric, usual) for metric in (ARI, F1_LARGE, F1, F1_OBJECTS)),
        printed_best(),
        *_sphere_claims(sphere),
        claim(
            "IV",
            "The paper's method assigns more points near edges and corners to their surface than "
            "the other two.",
            _tried(right, ".3f", lambda row: row[2] > max(row[:2])),
            edges,
            quick_tells=False,
        ),
        claim(
            "IV",
            "Classic leaves more points near edges unlabeled than the other two.",
            _tried(unlabeled, ".3f", lambda row: row[0] > max(row[1:])),
            edges,
            partial(listed, "In other regions", other, ".3f"),
            quick_tells=False,
        ),
        claim(
            "IV",
            "DetMM makes more regions than the paper's method (over-segmentation).",
            _tried(_values(usual, lambda r: r["regions"]), "d", lambda row: row[1] > row[2]),
            "Classic, DetMM, paper.",
        ),
        claim(
            "IV",
            "F1 of the tutorial's cloud is below that of the hallway (paper's method).",
            {"all surfaces": rising(f1, ".1f")},
        ),
        _five_degrees(angles),
        claim(
            "IV, V",
            "Regular curved surfaces are segmented as well as planes.",
            _tried(
                _faces(curved, "found_flat", "found_curved"), ".2f", lambda row: row[0] <= row[1]
            ),
            f"Fractions detected of planes and of curved surfaces of at least {LARGE:,} points.",
            quick_tells=False,
        ),
        claim(
            "V",
            "The paper's method cannot segment small objects.",
            _tried(_faces(usual, "found_small", "found_large"), ".2f"),
            f"Fractions detected of surfaces below {LARGE:,} points, and of larger ones.",
        ),
        *(_rise("beyond", metric, hard) for metric in (ARI, F1_LARGE)),
        *(
            claim(
                "beyond",
                f"{low} < {high} by {metric.name}.",
                _tried(_values(scores, metric.take, (low, high)), metric.form),
            )
            for low, high, metrics in (
                ("algorithm2", "paper", (ARI, F1_LARGE)),
                ("paper", "consensus", (ARI, F1_LARGE, BEST_IOU)),
            )
            for metric in metrics
        ),
    ]


def _values(
    scores: Scores, take: Callable[[Record], float | None], methods: Sequence[str] = PAPERS
) -> Values:
    """Return a value of several methods, by the title of the cloud."""
    return {
        found["paper"]["title"]: [take(found[method]) for method in methods]
        for found in scores.values()
    }


def _faces(scores: Scores, *names: str) -> Values:
    """Return metrics of the paper's method, by the title of the cloud."""
    return {
        found["paper"]["title"]: [found["paper"]["faces"].get(name) for name in names]
        for found in scores.values()
    }


def _tried(
    values: Values, form: str, test: Callable[[Sequence[float]], bool] | None = None
) -> dict[str, Outcome | None]:
    """Return where values rise, or pass a test."""
    found = {title: rising(row, form) for title, row in values.items()}
    if test is None:
        return found
    return {
        title: outcome and (test(values[title]), outcome[1].replace(" <", ","))
        for title, outcome in found.items()
    }


def _rise(where: str, metric: Metric, scores: Scores) -> Block:
    """Return where a metric rises from classic over DetMM to the paper's method."""
    more = REASONS.get(metric.name, LABELED)
    on = " on clouds unlike the paper's" if where == "beyond" else ""
    return claim(
        where,
        f"Classic < DetMM < the paper's method by {metric.name}{on}.",
        _tried(_values(scores, metric.take), metric.form),
        why=partial(listed, more.name.capitalize(), _values(scores, more.take), more.form),
        quick_tells=metric is not F1,
    )


def listed(label: str, values: Values, form: str, fails: list[str]) -> str:
    """Return values of some clouds; equal values of the methods are printed once."""
    rows = []
    for title in fails:
        shown = [format(value, form) for value in values[title] if value is not None]
        rows.append(f"{title} {', '.join(shown[:1] if len(set(shown)) == 1 else shown)}")
    return f"{label}: {'; '.join(rows)}."


def printed_best() -> Block:
    """Return how often the paper's method is the best in the printed Table 2."""
    found = {}
    for key, printed in INDICES.items():
        best = [
            name.upper()
            for column, name in enumerate(INTERNAL)
            if _ranked({m: row[column] for m, row in printed.items()}, name)[0][0] == "paper"
        ]
        found[title_of(key)] = (len(best) >= 3, f"best in {len(best)}: {', '.join(best)}")
    words = "The paper's method is best in at least three of the four internal indices, as printed."
    return claim("IV, Table 2", words, found)


def _sphere_claims(sphere: Scores) -> list[Block]:
    """Return which internal indices order the paper's methods as printed."""
    best, order, merged = {}, {}, {}
    for key, printed in INDICES.items():
        for column, name in enumerate(INTERNAL):
            theirs, _ = _ranked({method: printed[method][column] for method in PAPERS}, name)
            title = f"{name.upper()} of {sphere[key]['paper']['title']}"
            ours, words = _ranked({method: sphere[key][method][name] for method in PAPERS}, name)
            order[title] = (theirs == ours, words)
            if theirs[0] == "paper":
                best[title] = (ours[0] == "paper", words)
            directions = {method: sphere[key][method]["directions"] for method in PAPERS}
            if name in directions["paper"]:
                by = {method: found[name] for method, found in directions.items()}
                merged[title] = _ranked(by, name)[1]
    dvi = [found[method]["dvi"] for found in sphere.values() for method in PAPERS]
    why = partial(why_not_ordered, merged, dvi)
    return [
        claim("Table 2", words, found, "Best first.", why)
        for words, found in (
            ("The paper's method is best in the internal indices that are best in print.", best),
            ("The internal indices order classic, DetMM and the paper's method as printed.", order),
        )
    ]


def why_not_ordered(merged: Mapping[str, str], dvi: Iterable[float], fails: list[str]) -> str:
    """Return SP and DBI with one cluster per direction, and the note on DVI if it fails."""
    rows = "; ".join(f"{title}: {merged[title]}" for title in fails if title in merged)
    words = f"With one cluster per direction: {rows}. " if rows else ""
    return words + (dvi_note(dvi) if any(title.startswith("DVI") for title in fails) else "")


def dvi_note(ours: Iterable[float]) -> str:
    """Return which printed DVI exceed their bound, and the maximum of ours."""
    exceeding = [
        f"{row[3]:g} > {math.pi / 2 / row[0]:.1f} ({method}, {title_of(key)})"
        for key, by in INDICES.items()
        for method, row in by.items()
        if row[3] > math.pi / 2 / row[0]
    ]
    return (
        "The printed DVI probably lost its exponent: 4.7684e-07 is 2^-21, a rounding error of "
        "float32. By the paper's formulas DVI is at most (pi / 2) / CP, but the table has "
        f"{', '.join(exceeding)}. Here it is at most {max(ours):.1e}."
    )


def _ranked(values: Mapping[str, float], name: str) -> tuple[list[str], str]:
    """Return methods from best to worst by an internal index, and the same with values."""
    higher = bool(METRICS["clusters"][name].higher_is_better)
    order = sorted(values, key=values.__getitem__, reverse=higher)
    return order, ", ".join(f"{method} {values[method]:.3g}" for method in order)


def _five_degrees(angles: Mapping[str, Record]) -> Block:
    """Return whether 5 degrees is the best angle."""
    found = {}
    for record in angles.values():
        aris = {angle: one["ari"] for angle, one in record["angles"].items() if "ari" in one}
        if aris:
            words = ", ".join(f"{angle} deg {ari:.3f}" for angle, ari in aris.items())
            best = max(aris, key=aris.__getitem__)
            found[record["title"]] = (best == "5", f"ARI {words}; best: {best} deg")
    words = "The best segmentation is at 5 degrees."
    return claim("II.B, IV, Figure 9", words, found, quick_tells=False)
