"""Tables of normal errors and times, in Markdown."""

from collections.abc import Callable, Iterable

from reproduction.cells import Folder, Record

PAPER_SECONDS = {
    "pca": {0.25: 5.253, 1.2: 6.858, 2.4: 7.567},
    "jet": {0.25: 9.235, 1.2: 10.259, 2.4: 8.236},
    "irls": {0.25: 6.858, 1.2: 8.075, 2.4: 7.567},
    "detmm": {0.25: 602.491, 1.2: 621.695, 2.4: 710.536},
    "paper": {0.25: 38.58, 1.2: 37.613, 2.4: 43.817},
}
"""The paper's Table 1: C++ for the first two, MPI for the third, MATLAB for the rest, AMD R7-4800U;
it does not say how many points."""

COLUMNS: dict[str, tuple[str, Callable[[Record], str]]] = {
    "MSAE": ("msae", lambda x: f"{x:.1f}"),
    "RMS": ("rms", lambda x: f"{x:.2f}"),
    "mean": ("mean", lambda x: f"{x:.2f}"),
    "median": ("median", lambda x: f"{x:.2f}"),
    "< 5": ("under_5_deg", lambda x: f"{100 * x:.1f} %"),
    "< 10": ("under_10_deg", lambda x: f"{100 * x:.1f} %"),
    "< 20": ("under_20_deg", lambda x: f"{100 * x:.1f} %"),
    "MSAE at edges": ("sharp_msae", lambda x: "" if x is None else f"{x:.1f}"),
    "elsewhere": ("regular_msae", lambda x: "" if x is None else f"{x:.1f}"),
}
"""Columns of a table of errors: field of the score, and how it is printed. Degrees."""


def write_tables(folder: Folder, records: list[Record]) -> None:
    """Write ``normals.md``: a summary, times, and the errors of every cloud."""
    sizes = _values(records, "num_points")
    made = [_surroundings(records), *(_summary(records, size) for size in sizes)]
    made += [_times(records, size) for size in sizes]
    for size in sizes:
        for shape in _values(records, "shape"):
            made.append(_errors(records, shape, size))
    folder.write("normals.md", "\n\n".join(["# Errors and times of normals", *made]) + "\n")


def _summary(records: list[Record], size: int) -> str:
    """Return MSAE by shape and noise, one column for each estimator, the least in bold."""
    variants, rows = _values(records, "variant"), []
    for shape in _values(records, "shape"):
        for noise in _values(records, "noise_percent"):
            found = {
                r["variant"]: r["score"]["msae"]
                for r in _where(records, shape=shape, noise_percent=noise, num_points=size)
            }
            if found:
                least = min(found.values())
                cells = (_bold(f"{found[v]:.1f}", found[v] == least) for v in variants)
                rows.append([shape, f"{noise:g} %", *cells])
    return f"## MSAE, {size:,} points\n\n" + _table(["shape", "noise", *variants], rows)


def _times(records: list[Record], size: int) -> str:
    """Return Table 1: seconds on the cuboid, beside those of the paper."""
    noises = _values(_where(records, shape="cuboid", num_points=size), "noise_percent")
    rows = []
    for variant in _values(records, "variant"):
        row = [variant]
        for noise in noises:
            (record,) = _where(
                records, shape="cuboid", num_points=size, noise_percent=noise, variant=variant
            )
            theirs = PAPER_SECONDS.get(variant, {}).get(noise)
            row.append(f"{record['seconds']:.2f}" + (f" ({theirs:.1f})" if theirs else ""))
        rows.append(row)
    title = f"## Seconds on the cuboid, {size:,} points (the paper's, points not given)"
    return f"{title}\n\n" + _table(["", *(f"{noise:g} %" for noise in noises)], rows)


def _errors(records: list[Record], shape: str, size: int) -> str:
    """Return all indices of one shape."""
    rows = [
        [
            f"{record['noise_percent']:g} %",
            record["variant"],
            *(show(record["score"][field]) for field, show in COLUMNS.values()),
            f"{record['seconds']:.2f}",
        ]
        for noise in _values(records, "noise_percent")
        for record in _where(records, shape=shape, num_points=size, noise_percent=noise)
    ]
    head = ["noise", "method", *COLUMNS, "seconds"]
    return f"## {shape}, {size:,} points\n\n" + _table(head, rows)


def _surroundings(records: list[Record]) -> str:
    """Return how the records were made."""
    made = [record["made_with"] for record in records]
    parts = {
        name: ", ".join(dict.fromkeys(str(m[name]) for m in made))
        for name in ("torchrg", "commit", "torch", "processor", "threads")
    }
    return "Errors in degrees, k = 50. Made with " + "; ".join(f"{k} {v}" for k, v in parts.items())


def _values(records: Iterable[Record], field: str) -> list:  # type: ignore[type-arg]
    """Return the values of a field in the order in which they come."""
    return list(dict.fromkeys(record[field] for record in records))


def _where(records: list[Record], **fields: object) -> list[Record]:
    """Return the records with some values."""
    return [r for r in records if all(r[name] == value for name, value in fields.items())]


def _bold(text: str, condition: bool) -> str:
    return f"**{text}**" if condition else text


def _table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
