"""Table 3: run times of the methods."""

from reproduction.clouds import POINTS, TITLES, Run
from reproduction.evaluation import METHODS, PAPERS, segment
from reproduction.records import (
    Block,
    Record,
    claim,
    describe_surroundings,
    section,
    table,
    text,
)

MINUTES = {
    "tutorial": {"classic_increment": 0.06, "detmm": 30.96, "paper": 1.92},
    "hallway": {"classic_increment": 0.33, "detmm": 165.92, "paper": 3.06},
    "cory": {"classic_increment": 0.42, "detmm": 314.44, "paper": 9.84},
    "kinect": {"classic_increment": 0.56, "detmm": 277.39, "paper": 7.75},
}
"""Table 3 as printed: minutes in MATLAB, without acceleration, on an AMD R7-4800U."""

GOAL = 40
"""Target speedup over the paper's 9.84 minutes."""


def reproduce(run: Run) -> Record:
    """Make Table 3."""
    records = [segment(run, key, method) for key in TITLES for method in METHODS]
    blocks = [
        text(
            "From points in memory to labels, normals and the plane table, without reading files. "
            "The speedup is the paper's time over ours, per point where the clouds differ in size. "
            "The paper used MATLAB on an AMD R7-4800U; this report: "
            f"{describe_surroundings(records)}."
        ),
        ratio_table(run, records),
    ]
    claims = time_claims(records) if not run.quick else []
    return section("Table 3: times", blocks, records, claims)


def ratio(record: Record) -> float | None:
    """Return the speedup over the paper per point; None if the paper gives no time."""
    minutes = MINUTES[record["cloud"]].get(record["method"])
    if minutes is None:
        return None
    fraction: float = record["points"] / POINTS[record["cloud"]]
    return 60 * minutes * fraction / record["total"]


def ratio_table(run: Run, records: list[Record]) -> Block:
    """Return seconds by cloud and method, with the paper's minutes and the speedup."""
    rows = []
    for key in TITLES:
        cloud = run.cloud(key).cloud
        cells = []
        for record in (record for record in records if record["cloud"] == key):
            times = ratio(record)
            theirs = f" ({MINUTES[key][record['method']]:g} min, {times:,.0f} x)" if times else ""
            cells.append(f"{record['total']:.1f} s{theirs}")
        rows.append([cloud.title, f"{len(cloud.points):,}", *cells])
    note = "Seconds; in parentheses the paper's minutes and the speedup. *: a substitute cloud."
    return table("**Table 3**", ["cloud", "points", *METHODS], rows, note)


def time_claims(records: list[Record]) -> list[Block]:
    """Return the paper's claims on times, and the speedup of its method."""
    between = {}
    for key in TITLES:
        found = {record["method"]: record for record in records if record["cloud"] == key}
        classic, detmm, paper = (found[method]["total"] for method in PAPERS)
        between[found["paper"]["title"]] = (
            classic < paper < detmm,
            f"{classic:.1f}, {paper:.1f} and {detmm:.1f} s",
        )
    (record,) = (r for r in records if (r["cloud"], r["method"]) == ("cory", "paper"))
    title, times, normals = record["title"], ratio(record) or 0.0, record["seconds"]["normals"]
    total = f"{record['total']:.1f} s for {record['points']:,} points: {times:.1f} times"
    fastest = "Classic is the fastest method and DetMM the slowest."
    minute = "Normals of a cloud take less than a minute."
    goal = f"The paper's method is at least {GOAL} times faster than its published 9.84 minutes."
    return [
        claim("Table 3", fastest, between, "Classic, paper and DetMM."),
        claim("II.A", minute, {title: (normals < 60, f"{normals:.1f} s")}),
        claim("beyond", goal, {title: (times >= GOAL, total)}),
    ]
