"""The two tables of figures in the README, from the files of three benchmarks.

    python scripts/bench.py peers --programs DIR --sizes 1000000 --out peers.json
    python scripts/bench.py accuracy --programs DIR --open3d-python PYTHON --synpeb FILE
        --rooms FOLDER --only consensus depth PCL Open3D --out accuracy.json
    python scripts/bench.py superpoints --parts FILE --peer cutpursuit.py --out superpoints.json
    python scripts/readme_tables.py peers.json accuracy.json superpoints.json

The figures are kept in ``figures.json`` beside this file. Times are medians of those of one round,
as multiples of torchrg's. Of planes the share of the true faces is shown that are found at an IoU
of 0.5, as a mean over the clouds of a kind; of some 300 superpoints the share of the points that
are in one of their own object. Without files the tables are made of the figures that are kept.
"""

import json
import sys
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
    "planes by `classic`, PCL's own method": ("torchrg-classic", "pclrg", "open3d-planes"),
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
    "4 frames, exact": "single depth frames, exact",
    "4 frames, kinect": "single depth frames of a Kinect",
}
"""Rows of the table of quality: the start of the name of their clouds, past any folder."""
IMAGES = "4 frames"
"""Clouds that torchrg sees as images."""
FEW = 300
"""Superpoints at which they are compared."""

Figures = dict[str, Any]


def take_figures(peers: Figures, accuracy: Figures, superpoints: Figures) -> Figures:
    """Return what the tables show, of the files of the three benchmarks."""
    times = {
        f"{work}, {cloud.split()[-1]} order": [_time(by, name) for name in names]
        for cloud, by in peers["results"].items()
        for work, names in WORK.items()
    }
    quality = {title: _shares(accuracy["results"], kind) for kind, title in KINDS.items()}
    partitions = {
        f"superpoints: {cloud}".replace("_", " "): [
            at_count(by[name][0]["levels"], FEW, "asa") for name in (OURS, PEER)
        ]
        for cloud, by in superpoints["results"].items()
    }
    made_with = {name: peers["made_with"][name] for name in ("commit", "processor", "cores")}
    return {
        "made_with": made_with,
        "times": times,
        "quality": {title: shares for title, shares in quality.items() if shares},
        "superpoints": partitions,
    }


def _time(by: Figures, name: str) -> float:
    """Return the median of the seconds of a contender, or of one of its stages."""
    contender, _, stage = name.partition(" ")
    return median(run["seconds"][stage] if stage else run["total"] for run in by[contender])


def _shares(results: Figures, kind: str) -> list[float]:
    """Return the mean shares of the faces that torchrg, PCL and Open3D find in clouds of a kind."""
    clouds = [by for name, by in results.items() if name.split("/")[-1].startswith(kind)]
    ours = "depth" if kind.startswith(IMAGES) else "consensus"
    return [
        fmean(median(run["recall_iou50"] for run in by[name]) for by in clouds)
        for name in (ours, "PCL", "Open3D")
        if clouds
    ]


def to_section(figures: Figures) -> str:
    """Return the tables in Markdown."""
    made = figures["made_with"]
    times = [
        [work, "1", *(f"{other / seconds:.1f}" for other in others)]
        for work, (seconds, *others) in figures["times"].items()
    ]
    quality = [
        [title, *(f"{share:.2f}" for share in shares), ""]
        for title, shares in figures["quality"].items()
    ]
    quality += [
        [title, f"{ours:.3f}", "", "", f"{peer:.3f}"]
        for title, (ours, peer) in figures["superpoints"].items()
    ]
    return "\n\n".join(
        [
            "Time for a million points as a multiple of torchrg's, with two threads, on "
            f"{made['processor']} with {made['cores']} cores (`scripts/bench.py peers`, commit "
            f"{made['commit']}). PCL computes normals and runs `RegionGrowing`; Open3D computes\n"
            "normals and detects planar patches:",
            markdown(["work", "torchrg", "PCL", "Open3D"], times),
            "Share of the true faces that are found at an IoU of 0.5 by the default (frames by "
            "`torchrg depth`; `scripts/bench.py\naccuracy`), and of the points in a superpoint of "
            f"their own object, of some {FEW} superpoints (`scripts/bench.py superpoints`):",
            markdown(["data", "torchrg", "PCL", "Open3D", "cut pursuit"], quality),
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
    """Put the figures of files, or those that are kept, into the README."""
    if files := sys.argv[1:]:
        figures = take_figures(*(json.loads(Path(file).read_text()) for file in files))
        FIGURES.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    figures = json.loads(FIGURES.read_text(encoding="utf-8"))
    README.write_text(insert(README.read_text(encoding="utf-8"), figures), encoding="utf-8")


if __name__ == "__main__":
    main()
