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

NOISY = (
    "Where points are noisy for their number its regions break up: the rules of eq. (10) and (11) "
    "are met by chance. Of one room at k = 50 it is so on raw frames of a first Kinect, and on a "
    "map whose frames are misplaced by millimetres, not on a map whose frames agree."
)
"""Why the paper's method is behind on some clouds."""

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
        *(
            _rise("Table 2, V", *index, usual, why)
            for index, why in zip(_RISING, _why_not_rising(usual), strict=True)
        ),
        _printed_best(),
        *_sphere_claims(sphere, dvi_remark),
        *_edge_claims(usual),
        _smoother_tutorial(scores),
        _five_degrees(angles),
        *([_curved(scores["curved"])] if "curved" in scores else []),
        _small(usual),
        *(_rise("beyond", *index, hard, NOISY) for index in _RISING[:2]),
        *(_ahead("algorithm2", "paper", *index, scores) for index in _RISING[:2]),
        *(_ahead("paper", "consensus", *index, scores) for index in _AHEAD),
    ]


def _each(
    scores: Scores, test: Callable[[Mapping[str, Record]], tuple[bool, str]]
) -> dict[str, tuple[bool, str]]:
    """Return what a test says of each cloud, by the name of the cloud."""
    return {found["paper"]["title"]: test(found) for found in scores.values()}


def _rise(
    where: str,
    name: str,
    form: str,
    take: Callable[[Record], float | None],
    scores: Scores,
    why: str,
) -> Block:
    """Return where an index rises from classic over DetMM to the paper's method."""
    known = {key: found for key, found in scores.items() if take(found["paper"]) is not None}
    on_hard = " on clouds unlike the paper's" if where == "beyond" else ""
    return claim(
        where,
        f"Classic < DetMM < the paper's method by {name}{on_hard}.",
        _each(known, lambda found: rising([take(found[method]) for method in PAPERS], form)),
        why,
        quick_tells=name != "F1 of all faces",
    )


def _why_not_rising(scores: Scores) -> list[str]:
    """Return why each index of :data:`_RISING` may not rise, as tried on the clouds themselves."""
    every = _numbers(scores, "f1_of_every")
    exact = {
        key: found for key, found in scores.items() if "f1_objects_exact" in found["paper"]["faces"]
    }
    objects = "; ".join(
        f"{title} {found['paper']['faces']['f1_objects_exact']:.1f}"
        for title, found in _titled(exact).items()
    )
    return [
        NOISY,
        f"{NOISY} And leaves of doors, 4 cm thick and seen from both sides, break up; of classic "
        "both sides are one region, which still pairs with one of them, at half the precision.",
        "F1 is of pairs alone, and the paper's method pairs more small faces than the others, with "
        "the lower precision that small faces have. Where a face without a region counts as 0 it "
        f"is: {every}.",
        "An object has several faces, which a method that parts them at edges cannot join: the "
        f"true faces themselves have {objects}.",
    ]


def _titled(scores: Scores) -> dict[str, Mapping[str, Record]]:
    return {found["paper"]["title"]: found for found in scores.values()}


def _numbers(scores: Scores, name: str) -> str:
    """Return an index of the faces by the paper's three methods, of each cloud."""
    parts = []
    for title, found in _titled(scores).items():
        values = [found[method]["faces"].get(name) for method in PAPERS]
        parts.append(f"{title} {rising(values, '.1f')[1]}")
    return "; ".join(parts)


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
            f"Best first. {_over_directions(sphere)}",
        ),
        claim(
            "Table 2",
            "The internal indices put classic, DetMM and the paper's method in the printed order.",
            order,
            f"Best first. {_over_directions(sphere)} {dvi_remark}",
        ),
    ]


def _over_directions(sphere: Scores) -> str:
    """Return SP and DBI over distinct directions: parallel walls have one centre on the sphere."""
    parts = []
    for found in sphere.values():
        for name in ("sp", "dbi"):
            values = {method: found[method]["directions"][name] for method in PAPERS}
            listed = ", ".join(f"{m} {values[m]:.3g}" for m in _order(values, name))
            parts.append(f"{name.upper()} of {found['paper']['title']}: {listed}")
    return (
        "Parallel walls share their centre on the sphere, where DBI divides by nothing and SP "
        "counts the same two directions for every pair of walls. With one cluster for each "
        f"direction: {'; '.join(parts)}."
    )


def _order(values: Mapping[str, float], name: str) -> list[str]:
    """Return methods from the best to the worst by an internal index."""
    higher = bool(METRICS["clusters"][name].higher_is_better)
    return sorted(values, key=values.__getitem__, reverse=higher)


def _edge_claims(scores: Scores) -> list[Block]:
    """Return what the paper says of points near edges and corners."""

    def more_right(found: Mapping[str, Record]) -> tuple[bool, str]:
        right = [found[method]["faces"]["right_at_edges"] for method in PAPERS]
        return right[2] > max(right[:2]), ", ".join(f"{fraction:.3f}" for fraction in right)

    def blank(found: Mapping[str, Record]) -> tuple[bool, str]:
        none = [found[method]["faces"]["none_at_edges"] for method in PAPERS]
        return none[0] > max(none[1:]), ", ".join(f"{fraction:.3f}" for fraction in none)

    def more_regions(found: Mapping[str, Record]) -> tuple[bool, str]:
        regions = [found[method]["regions"] for method in PAPERS]
        listed = ", ".join(str(count) for count in regions)
        return regions[1] > regions[2], f"{listed} for {found['paper']['labels']['faces']} faces"

    wrong = {
        title: ", ".join(
            f"{1 - faces['right_at_edges'] - faces['none_at_edges']:.3f}"
            for faces in (found[method]["faces"] for method in PAPERS)
        )
        for title, found in _titled(scores).items()
    }

    return [
        claim(
            "IV",
            "More points near edges and corners are in the region of their face than by the other "
            "two methods.",
            _each(scores, more_right),
            "Shares of the points at edges, of classic, DetMM and paper.",
            quick_tells=False,
        ),
        claim(
            "IV",
            "Classic leaves more points near edges blank than the other two.",
            _each(scores, blank),
            "Shares of the points at edges that are in no region. Classic's are not blank but in "
            "a region of another face, or in a smaller one, as it runs over edges: "
            f"{'; '.join(f'{title} {fractions}' for title, fractions in wrong.items())}.",
            quick_tells=False,
        ),
        claim(
            "IV",
            "DetMM makes more regions than the paper's method (over-segmentation).",
            _each(scores, more_regions),
            "Regions of classic, DetMM and paper. DetMM joins faces here rather than parting them; "
            "what it has less is small: parts at edges, and faces that others lose.",
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
    return claim(
        "II.B, IV, Figure 9",
        "The desired segmentation comes at 5 degrees.",
        found,
        "It does where edges are rounded, as scanned ones are: there a larger angle joins faces. "
        "Made edges are sharp; a larger angle then only takes in more of the points beside them.",
        quick_tells=False,
    )


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
        "at IoU 0.5. Bent walls are. Columns are not, by eq. (10): without it, or at 8 degrees, "
        "they are found. Small clouds have too few points on columns and balls for these to count.",
        quick_tells=False,
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
