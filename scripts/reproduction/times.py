"""Table 3: how long the methods take."""

from reproduction.cells import Record, describe_surroundings
from reproduction.clouds import TITLES
from reproduction.methods import METHODS
from reproduction.paper_numbers import MINUTES, POINTS
from reproduction.runs import Run
from reproduction.sections import Block, claim, section, table, text
from reproduction.segmentations import segment

GOAL = 40
"""How many times faster than the paper's 9.84 minutes its method should be."""

STAGES = ("neighbors", "normals", "regions", "planes")


def reproduce(run: Run) -> Record:
    """Make Table 3."""
    records = [segment(run, key, preset) for key in TITLES for preset in METHODS]
    blocks = [
        text(
            "From points in memory to labels, normals and the plane table; reading files is not "
            "in. The ratio is the paper's time over ours, per point where the clouds differ in "
            "size. The paper used MATLAB on an AMD R7-4800U. Ours: "
            f"{describe_surroundings(records)}."
        ),
        ratio_table(run, records),
        *([] if run.quick else [speed_claim(records)]),
        stage_table(records),
    ]
    return section("Table 3: times", blocks, records)


def ratio(record: Record) -> float | None:
    """Return the paper's time over ours, per point; None where the paper has none."""
    minutes = MINUTES[record["cloud"]].get(record["preset"])
    if minutes is None:
        return None
    share: float = record["points"] / POINTS[record["cloud"]]
    return 60 * minutes * share / record["total"]


def ratio_table(run: Run, records: list[Record]) -> Block:
    """Return seconds of each cloud and method, with the paper's minutes and the ratio."""
    rows = []
    for key, title in TITLES.items():
        found = {record["preset"]: record for record in records if record["cloud"] == key}
        cloud = run.cloud(key).cloud
        cells = []
        for preset in METHODS:
            seconds, times = found[preset]["total"], ratio(found[preset])
            theirs = "" if times is None else f" ({MINUTES[key][preset]:g} min, {times:,.0f} x)"
            cells.append(f"{seconds:.1f} s{theirs}")
        rows.append([title if cloud.is_papers else f"{title}*", f"{len(cloud.points):,}", *cells])
    note = "Seconds, then the paper's minutes and how many times faster. * made cloud, or a piece."
    return table("**Table 3**", ["cloud", "points", *METHODS.values()], rows, note)


def stage_table(records: list[Record]) -> Block:
    """Return the seconds of each stage."""
    rows = [
        [
            TITLES[record["cloud"]],
            METHODS[record["preset"]],
            *(f"{record['seconds'][stage]:.1f}" for stage in STAGES),
            f"{100 * record['sharp_fraction']:.1f} %",
            f"{1e6 * record['total'] / record['points']:.1f}",
        ]
        for record in records
    ]
    head = ["cloud", "method", *STAGES, "sharp points", "µs a point"]
    return table("Seconds of each stage", head, rows)


def speed_claim(records: list[Record]) -> Block:
    """Return whether the paper's method is as much faster as it should be."""
    (record,) = (r for r in records if (r["cloud"], r["preset"]) == ("cory", "paper"))
    times = ratio(record) or 0.0
    return claim(
        f"The paper's method is {GOAL} times faster than its own 9.84 minutes, or more.",
        times >= GOAL,
        f"{record['total']:.1f} s for {record['points']:,} points: {times:.0f} times.",
    )
