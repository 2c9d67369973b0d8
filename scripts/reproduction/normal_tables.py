"""Table 1, and tables and claims about the errors of normals."""

from collections.abc import Iterable
from statistics import fmean

from reproduction.cells import Record
from reproduction.paper_numbers import NORMAL_SECONDS
from reproduction.sections import Block, claim, mark_best, table

PLAIN, ROBUST = ("pca", "jet"), ("irls", "detmm")
"""What the paper compares with its own: "fast but inaccurate", and the others."""

OURS = {"paper": "the two-stage method", "libra": "the two-stage method with LIBRA's DetMCD"}
"""The paper's method: the preset, and with the DetMCD that its MATLAB very probably called."""

WHY = (
    "At 0.25 %, the least noise that the paper draws, its deviation is a tenth to a sixth of the "
    "radius of 50 neighbours, and robust fits cannot tell faces from noise; at half of it they do. "
    "Of a robust fit the error at an edge is 0 or that of the other face, 90 degrees, which a mean "
    "of squares counts most: DetMCD as published, on half of the neighbours, takes the other face "
    "more often than LIBRA's, on three quarters. The mean angle is on its side."
)
"""Why the order of Figure 4 does not come out, as tried on less noise and with both fits."""

TENTH = 0.1
"""An order of magnitude, of times."""


def mean_score(records: Iterable[Record], field: str, **fields: object) -> float | None:
    """Return the mean over seeds of an index of records with some values; None without any."""
    found = [record["score"][field] for record in where(records, **fields)]
    return fmean(found) if found and None not in found else None


def summary_table(records: list[Record]) -> Block:
    """Return MSAE and mean angle by shape and noise, a column for each estimator."""
    variants, rows = values(records, "variant"), []
    for shape in values(records, "shape"):
        for noise in values(where(records, shape=shape), "noise_percent"):
            cells = []
            for field, form in (("msae", ".1f"), ("mean", ".2f")):
                means = [
                    mean_score(records, field, shape=shape, noise_percent=noise, variant=variant)
                    for variant in variants
                ]
                cells.append(mark_best(means, form, higher=False))
            both = [" / ".join(pair) for pair in zip(*cells, strict=True)]
            rows.append([shape.replace("_", " "), f"{noise:g} %", *both])
    note = "Degrees squared / degrees; noise in percent of the diagonal of the bounding box."
    points = records[0]["num_points"]
    title = f"MSAE / mean angle (Figure 4), {points:,} points a shape, k = 50"
    return table(title, ["shape", "noise", *variants], rows, note)


def time_table(records: list[Record]) -> Block:
    """Return Table 1: seconds on the cuboid, beside those of the paper."""
    noises = values(records, "noise_percent")
    rows = []
    for variant in values(records, "variant"):
        row = [variant]
        for noise in noises:
            ours = _seconds(records, noise_percent=noise, variant=variant)
            theirs = NORMAL_SECONDS.get(variant, {}).get(noise)
            row.append(f"{ours:.2f}" + (f" ({theirs:.1f})" if theirs else ""))
        rows.append(row)
    note = "The paper's in brackets; it does not say how many points its clouds have."
    head = ["estimator", *(f"{noise:g} %" for noise in noises)]
    points = records[0]["num_points"]
    return table(f"**Table 1**, seconds on the cuboid of {points:,} points", head, rows, note)


def normal_claims(records: list[Record], *, with_times: bool) -> list[Block]:
    """Return the paper's claims about normals.

    Args:
        records: What was measured.
        with_times: Whether the clouds are large enough for times to mean something.
    """
    papers = [record for record in records if record["shape"] in ("cuboid", "dodecahedron")]
    others = [record for record in records if record not in papers]
    claims = []
    for ours, name in OURS.items():
        every = f"DetMM, weighted PCA and {name} are below PCA and jets by"
        claims += [
            claim(
                "II.A, Figure 4", f"{every} MSAE.", _robust_below(papers, ours, "msae", ".1f"), WHY
            ),
            claim("beyond", f"{every} the mean angle.", _robust_below(papers, ours, "mean", ".2f")),
            claim(
                "II.A",
                f"{every} MSAE: on other shapes.",
                _robust_below(others, ours, "msae", ".1f"),
                WHY,
                quick_tells=False,
            ),
            claim(
                "II.A, Figure 4",
                f"Second-lowest MSAE of the five has {name}.",
                _second_lowest(papers, ours),
                f"Means over seeds, lowest first. {WHY}",
            ),
        ]
    if with_times:
        claims.append(
            claim(
                "II.A, Table 1",
                "The two-stage method takes a tenth of DetMM's time, or less.",
                _tenth(where(records, shape="cuboid")),
                "Its share is that of sharp points, which is large on small clouds.",
            )
        )
    return claims


def _robust_below(
    records: list[Record], ours: str, field: str, form: str
) -> dict[str, tuple[bool, str]]:
    """Return where all robust estimators are below all plain ones, for every seed."""
    found = {}
    for place, some in _by_place(records).items():
        below = all(
            max(_scores(one, field, (*ROBUST, ours))) < min(_scores(one, field, PLAIN))
            for one in (where(some, seed=seed) for seed in values(some, "seed"))
        )
        means = {name: mean_score(some, field, variant=name) for name in (*PLAIN, *ROBUST, ours)}
        found[place] = (below, ", ".join(f"{name} {mean:{form}}" for name, mean in means.items()))
    return found


def _second_lowest(records: list[Record], ours: str) -> dict[str, tuple[bool, str]]:
    """Return where the two-stage method is second of the paper's five, or first."""
    found = {}
    for place, some in _by_place(records).items():
        means = {name: mean_score(some, "msae", variant=name) for name in (*PLAIN, *ROBUST, ours)}
        order = sorted(means, key=means.__getitem__)
        found[place] = (order.index(ours) <= 1, " < ".join(order))
    return found


def _tenth(records: list[Record]) -> dict[str, tuple[bool, str]]:
    """Return at which noise the two-stage method takes a tenth of DetMM's time."""
    found = {}
    for noise in values(records, "noise_percent"):
        ours, detmm = (
            _seconds(records, noise_percent=noise, variant=name) for name in ("paper", "detmm")
        )
        found[f"{noise:g} %"] = (ours <= TENTH * detmm, f"{ours:.2f} s of {detmm:.2f} s")
    return found


def _by_place(records: list[Record]) -> dict[str, list[Record]]:
    """Return records by shape and noise."""
    return {
        f"{shape.replace('_', ' ')} {noise:g} %": where(records, shape=shape, noise_percent=noise)
        for shape in values(records, "shape")
        for noise in values(where(records, shape=shape), "noise_percent")
    }


def _scores(records: list[Record], field: str, variants: Iterable[str]) -> list[float]:
    """Return an index of some estimators."""
    return [record["score"][field] for name in variants for record in where(records, variant=name)]


def _seconds(records: list[Record], **fields: object) -> float:
    """Return the mean time of records with some values."""
    return fmean(record["seconds"] for record in where(records, **fields))


def values(records: Iterable[Record], field: str) -> list:  # type: ignore[type-arg]
    """Return the values of a field in the order in which they come."""
    return list(dict.fromkeys(record[field] for record in records))


def where(records: Iterable[Record], **fields: object) -> list[Record]:
    """Return the records with some values."""
    return [r for r in records if all(r[name] == value for name, value in fields.items())]
