"""Table 3: how long the methods take."""

from reproduction.cells import Record, describe_surroundings
from reproduction.clouds import TITLES
from reproduction.methods import METHODS, PAPERS
from reproduction.paper_numbers import MINUTES, POINTS
from reproduction.runs import Run
from reproduction.sections import Block, claim, section, table, text
from reproduction.segmentations import segment

GOAL = 40
"""How many times faster than the paper's 9.84 minutes its method should be."""


def reproduce(run: Run) -> Record:
    """Make Table 3."""
    records = [segment(run, key, method) for key in TITLES for method in METHODS]
    blocks = [
        text(
            "From points in memory to labels, normals and the plane table; reading files is not "
            "in. The ratio is the paper's time over ours, per point where the clouds differ in "
            "size. The paper used MATLAB on an AMD R7-4800U. Ours: "
            f"{describe_surroundings(records)}."
        ),
        ratio_table(run, records),
    ]
    claims = time_claims(records) if not run.quick else []
    return section("Table 3: times", blocks, records, claims)


def ratio(record: Record) -> float | None:
    """Return the paper's time over ours, per point; None where the paper has none."""
    minutes = MINUTES[record["cloud"]].get(record["method"])
    if minutes is None:
        return None
    fraction: float = record["points"] / POINTS[record["cloud"]]
    return 60 * minutes * fraction / record["total"]


def ratio_table(run: Run, records: list[Record]) -> Block:
    """Return seconds of each cloud and method, with the paper's minutes and the ratio."""
    rows = []
    for key in TITLES:
        cloud = run.cloud(key).cloud
        cells = []
        for record in (record for record in records if record["cloud"] == key):
            times = ratio(record)
            theirs = f" ({MINUTES[key][record['method']]:g} min, {times:,.0f} x)" if times else ""
            cells.append(f"{record['total']:.1f} s{theirs}")
        rows.append([cloud.title, f"{len(cloud.points):,}", *cells])
    note = "Seconds, then the paper's minutes and how many times faster. * made cloud, or a piece."
    return table("**Table 3**", ["cloud", "points", *METHODS], rows, note)


def time_claims(records: list[Record]) -> list[Block]:
    """Return the paper's claims on times, and how many times faster its method is here."""
    between = {}
    for key in TITLES:
        found = {record["method"]: record for record in records if record["cloud"] == key}
        classic, detmm, paper = (found[method]["total"] for method in PAPERS)
        between[found["paper"]["title"]] = (
            classic < paper < detmm,
            f"{classic:.1f}, {paper:.1f} and {detmm:.1f} s",
        )
    (record,) = (r for r in records if (r["cloud"], r["method"]) == ("cory", "paper"))
    times = ratio(record) or 0.0
    normals = record["seconds"]["normals"]
    return [
        claim(
            "Table 3",
            "Classic takes least time, DetMM most.",
            between,
            "Seconds of classic, paper and DetMM. Most of classic's are the search of neighbours "
            "and the table of planes, which are the same for all: where few points are sharp the "
            "paper's method takes hardly more, and noise of the machine decides.",
        ),
        claim(
            "II.A",
            "Normals of a cloud take less than a minute.",
            {record["title"]: (normals < 60, f"{normals:.1f} s")},
        ),
        claim(
            "beyond",
            f"The paper's method takes its own 9.84 minutes over {GOAL}, or less.",
            {
                record["title"]: (
                    times >= GOAL,
                    f"{record['total']:.1f} s for {record['points']:,} points: {times:.1f} times",
                )
            },
        ),
    ]
