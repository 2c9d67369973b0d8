"""The two tables of figures in the README, from the files of three benchmarks.

    python scripts/bench.py peers --programs DIR --sizes 1000000 --out peers.json
    python scripts/bench.py accuracy --programs DIR --open3d-python PYTHON --synpeb FILE
        --parts FILE --rooms FOLDER --out accuracy.json
    python scripts/bench.py superpoints --parts FILE --peer cutpursuit.py --out superpoints.json
    python scripts/readme_tables.py --peers peers.json --accuracy accuracy.json
        --superpoints superpoints.json

``figures.json`` in the same folder keeps the figures; a file that is not given keeps its part.
Times are medians over the rounds, as multiples of torchrg's. A row on planes shows the fraction of
the ground-truth planes detected at an IoU of 0.5, as a mean over the clouds of a kind; for CGAL it
is the better one of region growing and RANSAC with PCA normals. A row on superpoints shows the
fraction of points whose superpoint matches their object, for about 300 superpoints.
"""

import argparse
import json
from pathlib import Path
from statistics import fmean, median
from typing import Any

from benchmarks.harness import markdown
from benchmarks.superpoints import OURS, PEER, at_count

README = Path(__file__).parents[1] / "README.md"
FIGURES = Path(__file__).with_name("figures.json")
BEGIN = "<!-- figures: made by scripts/readme_tables.py, not by hand -->"
END = "<!-- end of figures -->"

WORK = {
    "planes by `classic`, as PCL's": ("torchrg-classic", "pclrg", "open3d-planes"),
    "planes by `paper`": ("torchrg-paper", "pclrg", "open3d-planes"),
    "planes by `consensus`, the default": ("torchrg-consensus", "pclrg", "open3d-planes"),
    "normals by `pca`": ("torchrg-pca", "pclrg normals", "open3d-pca"),
}
"""Rows of the table of times: who does the work of each column."""
KINDS = {
    "room": "made rooms, seven noises and densities",
    "SynPEB": "a simulated scan of SynPEB",
    "laser_like": "rooms, laser scanner",
    "rgbd_like": "rooms, fused depth frames",
    "s3dis_like": "rooms, points of a mesh, as S3DIS",
    "scannet_like": "rooms, vertices of a mesh, as ScanNet",
    "office_parts": "a real office, its labeled parts",
    "4 frames, exact": "single depth frames, exact",
    "4 frames, kinect": "single depth frames of a Kinect",
}
"""Rows of the table of quality: the start of the name of their clouds, past any folder."""
PEERS = {
    "PCL": ("PCL",),
    "Open3D": ("Open3D",),
    "CGAL": ("CGAL growing, pca", "CGAL RANSAC, pca"),
}
"""Columns of the table of quality: the contenders of which the better one is shown."""
IMAGES = "4 frames"
"""Clouds that torchrg sees as images."""
FEW = 300
"""Superpoints at which they are compared."""
PARTITIONED = ("office_parts", "depth frames fused")
"""Clouds whose superpoints are shown."""
ORDERS = ("random", "sorted")
"""Orders of the points of the room: at random, and along a space-filling curve."""

Figures = dict[str, Any]


def times_of(peers: Figures) -> Figures:
    """Return what the table of times shows, from the file of its benchmark."""
    rooms = {cloud.split()[-1]: by for cloud, by in peers["results"].items()}
    return {
        "made_with": {name: peers["made_with"][name] for name in ("commit", "processor", "cores")},
        "times": {
            work: [_time(rooms[order], name) for order in ORDERS for name in names]
            for work, names in WORK.items()
        },
    }


def quality_of(accuracy: Figures) -> Figures:
    """Return the fractions of detected planes, from the file of their benchmark."""
    quality = {title: _fractions(accuracy["results"], kind) for kind, title in KINDS.items()}
    return {"quality": {title: fractions for title, fractions in quality.items() if fractions}}


def partitions_of(superpoints: Figures) -> Figures:
    """Return the fractions of points in the right superpoint, from the file of their benchmark."""
    return {
        "superpoints": {
            f"superpoints: {cloud}".replace("_", " "): [
                at_count(by[name][0]["levels"], FEW, "asa") for name in (OURS, PEER)
            ]
            for cloud, by in superpoints["results"].items()
            if cloud in PARTITIONED
        }
    }


def _time(by: Figures, name: str) -> float:
    """Return the median of the seconds of a contender, or of one of its stages."""
    contender, _, stage = name.partition(" ")
    return median(run["seconds"][stage] if stage else run["total"] for run in by[contender])


def _fractions(results: Figures, kind: str) -> list[float]:
    """Return the mean fractions of the planes that torchrg and its peers detect in a kind."""
    clouds = [by for name, by in results.items() if name.split("/")[-1].startswith(kind)]
    ours = "depth" if kind.startswith(IMAGES) else "consensus"
    columns = [(ours,), *PEERS.values()] if clouds else []

    def mean(name: str) -> float:
        return fmean(median(run["recall_iou50"] for run in by[name]) for by in clouds)

    return [max(map(mean, names)) for names in columns]


def to_section(figures: Figures) -> str:
    """Return the tables in Markdown."""
    made = figures["made_with"]
    times = [
        [work, "1", *(f"{row[i] / row[i - i % 3]:.1f}" for i in (1, 2, 4, 5))]
        for work, row in figures["times"].items()
    ]
    quality = [
        [title, *(f"{fraction:.2f}" for fraction in fractions), ""]
        for title, fractions in figures["quality"].items()
    ]
    quality += [
        [title, f"{ours:.2f}", *[""] * len(PEERS), f"{peer:.2f}"]
        for title, (ours, peer) in figures["superpoints"].items()
    ]
    return "\n\n".join(
        [
            "Time for the normals and planes of a million points, as a multiple of torchrg's, on "
            f"{made['processor']} (`bench.py peers`, {made['commit']}):",
            markdown(["work", "torchrg", "PCL", "Open3D", "PCL, sorted", "Open3D, sorted"], times),
            "Fraction of ground-truth planes detected at an IoU of 0.5 (`bench.py accuracy`), or "
            f"of points whose superpoint matches their object, of {FEW} superpoints:",
            markdown(["data", "torchrg", *PEERS, "cut pursuit"], quality),
        ]
    )


def insert(readme: str, figures: Figures) -> str:
    """Return a README with its figures replaced; ValueError if it has no place for them."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not after:
        raise ValueError(f"insert: expected a README with {BEGIN!r} and {END!r}.")
    return f"{before}{BEGIN}\n{to_section(figures)}\n{END}{after}"


def main() -> None:
    """Put the figures of the files given, and those kept, into the README."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    tables = {"peers": times_of, "accuracy": quality_of, "superpoints": partitions_of}
    for name in tables:
        parser.add_argument(f"--{name}", type=Path)
    figures = json.loads(FIGURES.read_text(encoding="utf-8"))
    for name, path in vars(parser.parse_args()).items():
        if path is not None:
            figures |= tables[name](json.loads(path.read_text(encoding="utf-8")))
    FIGURES.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    README.write_text(insert(README.read_text(encoding="utf-8"), figures), encoding="utf-8")


if __name__ == "__main__":
    main()
