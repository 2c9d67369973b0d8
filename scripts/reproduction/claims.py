"""What the paper says about segmentations, and where it comes out."""

from collections.abc import Callable, Mapping

from reproduction.cells import Record
from reproduction.clouds import HARD, title_of
from reproduction.faces import LARGE
from reproduction.methods import PAPERS
from reproduction.paper_numbers import INDEX_NAMES, INDICES
from reproduction.sections import Block, claim, rising
from torchrg.metrics import METRICS

Scores = Mapping[str, Mapping[str, Record]]
"""Scores of clouds with truth, by cloud and method."""

INTERNAL = ("cp", "sp", "dbi", "dvi")
"""The paper's internal indices."""

_RISING = (
    ("ARI", ".3f", lambda record: record["labels"]["ari"]),
    (f"F1 of faces of {LARGE:,} points and more", ".1f", lambda r: r["faces"]["f1_large"]),
    ("F1 of all faces", ".1f", lambda record: record["labels"]["f1"]),
    ("F1 of objects", ".1f", lambda record: record["faces"].get("f1_objects")),
)
"""Indices in which the paper's method should be ahead."""

_AHEAD = (
    *_RISING[:2],
    ("mean best IoU", ".3f", lambda record: record["labels"]["mean_best_iou"]),
)
"""Indices in which consensus is compared to the paper's method."""


def segmentation_claims(
    scores: Scores, sphere: Scores, angles: Mapping[str, Record], dvi_remark: str
) -> list[Block]:
    """Return the claims of the paper, then how the methods do beyond it.

    Args:
        scores: Of clouds with truth.
        sphere: Internal indices, by cloud and method.
        angles: Of the paper's method at several angles, by cloud and angle.
        dvi_remark: What to know about DVI.
    """
    usual = {key: found for key, found in scores.items() if key not in HARD}
    hard = {key: found for key, found in scores.items() if key in HARD}
    return [
        *(_rise("Table 2, V", name, form, take, usual) for name, form, take in _RISING),
        _printed_best(),
        *_sphere_claims(sphere, dvi_remark),
        *_edge_claims(usual),
        _smoother_tutorial(scores),
        _five_degrees(angles),
        *([_curved(scores["curved"])] if "curved" in scores else []),
        _small(usual),
        *(_rise("beyond", name, form, take, hard) for name, form, take in _RISING[:2]),
        *(_ahead("algorithm2", "paper", *index, scores) for index in _RISING[:2]),
        *(_ahead("paper", "consensus", *index, scores) for index in _AHEAD),
    ]


def _each(
    scores: Scores, test: Callable[[Mapping[str, Record]], tuple[bool, str]]
) -> dict[str, tuple[bool, str]]:
    """Return what a test says of each cloud, by the name of the cloud."""
    return {found["paper"]["title"]: test(found) for found in scores.values()}


def _rise(
    where: str, name: str, form: str, take: Callable[[Record], float | None], scores: Scores
) -> Block:
    """Return where an index rises from classic over DetMM to the paper's method."""
    known = {key: found for key, found in scores.items() if take(found["paper"]) is not None}
    on_hard = " on clouds unlike the paper's" if where == "beyond" else ""
    return claim(
        where,
        f"Classic < DetMM < the paper's method by {name}{on_hard}.",
        _each(known, lambda found: rising([take(found[method]) for method in PAPERS], form)),
    )


def _printed_best() -> Block:
    """Return how often the paper's method is the best in the paper's own Table 2."""
    found = {}
    for key, printed in INDICES.items():
        best = [
            name.upper()
            for place, name in enumerate(INDEX_NAMES)
            if name in INTERNAL
            and _order({method: values[place] for method, values in printed.items()}, name)[0]
            == "paper"
        ]
        found[title_of(key)] = (len(best) >= 3, f"best in {len(best)}: {', '.join(best)}")
    return claim(
        "IV, Table 2",
        "The paper's method is best in at least three of the four internal indices, as printed.",
        found,
        "The text claims it of both clouds; the printed table has it for one.",
    )


def _sphere_claims(sphere: Scores, dvi_remark: str) -> list[Block]:
    """Return which internal indices order the paper's three methods as it prints them."""
    best, order = {}, {}
    for key, printed in INDICES.items():
        for place, name in enumerate(INDEX_NAMES[: len(INTERNAL)]):
            theirs = _order({method: printed[method][place] for method in PAPERS}, name)
            values = {method: sphere[key][method][name] for method in PAPERS}
            ours = _order(values, name)
            listed = ", ".join(f"{method} {values[method]:.3g}" for method in ours)
            title = f"{name.upper()} of {sphere[key]['paper']['title']}"
            order[title] = (theirs == ours, listed)
            if theirs[0] == "paper":
                best[title] = (ours[0] == "paper", listed)
    return [
        claim(
            "Table 2",
            "The paper's method is best in the internal indices in which the printed table has it "
            "best.",
            best,
            "Best first.",
        ),
        claim(
            "Table 2",
            "The internal indices put classic, DetMM and the paper's method in the printed order.",
            order,
            f"Best first. {dvi_remark}",
        ),
    ]


def _order(values: Mapping[str, float], name: str) -> list[str]:
    """Return methods from the best to the worst by an internal index."""
    higher = bool(METRICS["clusters"][name].higher_is_better)
    return sorted(values, key=values.__getitem__, reverse=higher)


def _edge_claims(scores: Scores) -> list[Block]:
    """Return what the paper says of points near edges and corners."""

    def more_right(found: Mapping[str, Record]) -> tuple[bool, str]:
        right = [found[method]["faces"]["right_at_edges"] for method in PAPERS]
        return right[2] > max(right[:2]), ", ".join(f"{share:.3f}" for share in right)

    def blank(found: Mapping[str, Record]) -> tuple[bool, str]:
        none = [found[method]["faces"]["none_at_edges"] for method in PAPERS]
        return none[0] > max(none[1:]), ", ".join(f"{share:.3f}" for share in none)

    def more_regions(found: Mapping[str, Record]) -> tuple[bool, str]:
        regions = [found[method]["regions"] for method in PAPERS]
        return regions[1] > regions[2], ", ".join(str(count) for count in regions)

    return [
        claim(
            "IV",
            "More points near edges and corners are in the region of their face than by the other "
            "two methods.",
            _each(scores, more_right),
            "Shares of the points at edges, of classic, DetMM and paper.",
        ),
        claim(
            "IV",
            "Classic leaves more points near edges blank than the other two.",
            _each(scores, blank),
            "Shares of the points at edges that are in no region.",
        ),
        claim(
            "IV",
            "DetMM makes more regions than the paper's method (over-segmentation).",
            _each(scores, more_regions),
            "Regions of classic, DetMM and paper.",
        ),
    ]


def _smoother_tutorial(scores: Scores) -> Block:
    """Return whether the tutorial's cloud has lower external indices than the hallway's."""
    f1 = [scores[key]["paper"]["labels"]["f1"] for key in INDICES if key in scores]
    return claim(
        "IV",
        "F1 of the tutorial's cloud is below that of the hallway (paper's method).",
        {"all faces": rising(f1, ".1f")} if len(f1) == len(INDICES) else {},
        "The truths differ in kind: colours of the file, and faces of a made hallway.",
    )


def _five_degrees(angles: Mapping[str, Record]) -> Block:
    """Return whether 5 degrees is the best angle."""
    found = {}
    for record in angles.values():
        aris = {angle: one["ari"] for angle, one in record["angles"].items() if "ari" in one}
        if aris:
            listed = ", ".join(f"{angle} deg {ari:.3f}" for angle, ari in aris.items())
            found[record["title"]] = (max(aris, key=aris.__getitem__) == "5", f"ARI {listed}")
    return claim("IV, Figure 9", "The desired segmentation comes at 5 degrees.", found)


def _curved(scores: Mapping[str, Record]) -> Block:
    """Return whether curved surfaces are found as well as planes."""
    faces = scores["paper"]["faces"]
    flat, curved = faces["found_flat"], faces["found_curved"]
    holds = None not in (flat, curved) and curved >= flat
    return claim(
        "IV, V",
        "Regular curved surfaces are segmented as properly as planes.",
        {title_of("curved"): (holds, rising([flat, curved], ".2f")[1])},
        f"Shares of the plane and of the curved faces of {LARGE:,} points and more that are found "
        "at IoU 0.5.",
    )


def _small(scores: Scores) -> Block:
    """Return whether small faces are lost, as the paper says itself."""

    def lost(found: Mapping[str, Record]) -> tuple[bool, str]:
        faces = found["paper"]["faces"]
        return rising([faces["found_small"], faces["found_large"]], ".2f")

    return claim(
        "V",
        "The paper's method cannot segment small objects.",
        _each(scores, lost),
        f"Shares of the faces of fewer than {LARGE:,} points, and of the others, that are found at "
        "IoU 0.5.",
    )


def _ahead(
    low: str,
    high: str,
    name: str,
    form: str,
    take: Callable[[Record], float | None],
    scores: Scores,
) -> Block:
    """Return where a method is ahead of another one by an index."""
    return claim(
        "beyond",
        f"{low} < {high} by {name}.",
        _each(scores, lambda found: rising([take(found[low]), take(found[high])], form)),
    )
