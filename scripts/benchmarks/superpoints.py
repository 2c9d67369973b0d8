"""Superpoints of torchrg and cut pursuit: accuracy by number, and run time.

Clouds: real rooms with labeled parts (``--parts``, label 0 is none), and synthetic ones with
objects. The latter are a room on 3 cm voxels, a room of pieces with equal numbers of points (the
density jumps), a room scanned from few positions, and fused depth frames. The cloud of pieces is
also tested with voxels. The peer's file defines ``partition(points, strength)``, which returns
labels and seconds. It runs in a separate Python (numpy below 2, pgeof, pycut-pursuit); without it
only torchrg is measured. Seconds are for all levels, from points to superpoints, including planes.

    python scripts/bench.py superpoints --parts office_parts.pcd --peer cutpursuit.py
        --peer-python VENV/bin/python --out superpoints.json
"""

import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Benchmark, Figures, Results, markdown
from tests.made import (
    CurvedLayout,
    build_scanned_room,
    in_pieces,
    make_kinect_room,
    objects_of,
    on_voxels,
    scan_scene,
)
from torchrg import make_superpoints, read_cloud, segment_planes
from torchrg.config import SuperpointsConfig
from torchrg.metrics import score_partition
from torchrg.scenes import Scene, make_room
from torchrg.structures import UNLABELED

VOXEL = 0.03
"""Voxel size, in meters."""
STRENGTHS = (0.1, 0.25, 0.5, 1.0, 1.5, 2.5, 4.0, 7.0, 12.0, 20.0, 35.0)
PEER_STRENGTHS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
LAYOUT = CurvedLayout(
    size=(9.0, 7.0, 2.8), num_tables=5, num_columns=1, num_round_tables=1, num_balls=1, num_lamps=1
)
NOISE = 0.003
"""Standard deviation in meters."""
SPARE = 8
"""Ratio of the numbers of points of a room before and after thinning its pieces."""
SHOWN = ("asa", "oracle_miou", "boundary_recall")
"""Metrics in the table."""
OURS, VOXELS_FIRST, PEER = "torchrg", "torchrg, voxels first", "cut pursuit"
PIECES = "pieces of equally many points"

PEER_SCRIPT = """
import json, sys, numpy as np
sys.path.insert(0, sys.argv[1])
partition = __import__(sys.argv[2]).partition
points = np.load("points.npy").astype(np.float32)
seconds = {}
for strength in json.loads(sys.argv[3]):
    labels, seconds[strength] = partition(points, strength)
    np.save(f"{strength}.npy", labels)
print(json.dumps(list(seconds.values())))
"""

LabeledCloud = tuple[Tensor, Tensor, str]
"""Points ``(N, 3)``, their objects ``(N,)`` (-1 for none), and the name of the cloud."""


@dataclass(frozen=True)
class Case(Benchmark):
    parts: tuple[Path, ...] = ()
    """Rooms with labeled parts."""
    points: int = 300_000
    """Number of points of each synthetic cloud."""
    made: tuple[str, ...] = ("voxels", "pieces", "scan", "frames")
    """Synthetic clouds."""
    peer: Path | None = None
    """Python file of the peer."""
    peer_python: str = "python"
    """Python executable of the peer."""

    def clouds(self) -> Mapping[str, Callable[[], LabeledCloud]]:
        makers: dict[str, Callable[[], LabeledCloud]] = {
            path.stem: partial(_read_parts, path) for path in self.parts
        }
        return makers | {CLOUDS[key][0]: partial(_make, key, self.points) for key in self.made}

    def contenders(self) -> Mapping[str, Callable[[LabeledCloud], Figures | None]]:
        runs: dict[str, Callable[[LabeledCloud], Figures | None]] = {
            OURS: lambda cloud: _score(cloud, *_run_ours(cloud[0], None)),
            VOXELS_FIRST: lambda cloud: (
                _score(cloud, *_run_ours(cloud[0], VOXEL)) if cloud[2] == PIECES else None
            ),
        }
        if self.peer is not None:
            runs[PEER] = lambda cloud: _score(cloud, *self._run_peer(cloud[0]))
        return runs

    def _run_peer(self, points: Tensor) -> tuple[list[Tensor], list[float]]:
        """Return the peer's partition and seconds for each of its strengths."""
        with tempfile.TemporaryDirectory() as folder:
            np.save(Path(folder) / "points.npy", points.numpy())
            file = (self.peer or Path()).resolve()
            arguments = [str(file.parent), file.stem, json.dumps(PEER_STRENGTHS)]
            command = [self.peer_python, "-c", PEER_SCRIPT, *arguments]
            done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
            labels = [
                torch.from_numpy(np.load(Path(folder) / f"{strength}.npy").astype(np.int64))
                for strength in PEER_STRENGTHS
            ]
        return labels, json.loads(done.stdout.splitlines()[-1])

    def report(self, results: Results) -> str:
        """Compare torchrg at the numbers of superpoints of its peers, or at its own numbers."""
        rows, taken = [], []
        for cloud, by in results.items():
            levels = {name: runs[0]["levels"] for name, runs in by.items()}
            for rival in [name for name in levels if name != OURS] or [OURS]:
                for row in sorted(levels[rival], key=lambda row: row["count"]):
                    ours = [f"{at_count(levels[OURS], row['count'], name):.3f}" for name in SHOWN]
                    theirs = [f" ({rival} {row[name]:.3f})" * (rival != OURS) for name in SHOWN]
                    cells = [a + b for a, b in zip(ours, theirs, strict=True)]
                    rows.append([cloud, row["count"], *cells])
            for name, runs in by.items():
                seconds = ", ".join(f"{value:.1f}" for value in dict.fromkeys(runs[0]["seconds"]))
                taken.append([cloud, runs[0]["points"], name, seconds])
        head = ["cloud", "points", "by", "seconds for all levels, or per strength"]
        return f"{markdown(['cloud', 'superpoints', *SHOWN], rows)}\n\n{markdown(head, taken)}"


CLOUDS: dict[str, tuple[str, Callable[[int], Scene]]] = {
    "voxels": (
        "room on voxels of 3 cm",
        lambda size: on_voxels(make_room(2 * size, NOISE, 11, layout=LAYOUT), VOXEL),
    ),
    "pieces": (
        PIECES,
        lambda size: in_pieces(make_room(SPARE * size, NOISE, 12, layout=LAYOUT), size),
    ),
    "scan": (
        "scan near and far",
        lambda size: scan_scene(build_scanned_room(13, layout=LAYOUT), size, noise=NOISE, seed=13),
    ),
    "frames": ("depth frames fused", lambda size: make_kinect_room(size, num_frames=8, seed=14)),
}
"""Titles of the synthetic clouds and functions that generate them."""


def _make(key: str, num_points: int) -> LabeledCloud:
    """Return a synthetic cloud with its objects."""
    name, make = CLOUDS[key]
    scene = make(num_points)
    return scene.points, objects_of(scene), name


def _read_parts(path: Path) -> LabeledCloud:
    """Read a scanned room with its parts."""
    cloud = read_cloud(path)
    labels = torch.from_numpy(cloud.fields["labels"])
    return cloud.points, torch.where(labels == 0, UNLABELED, labels), path.stem


def _run_ours(points: Tensor, voxel: float | None) -> tuple[list[Tensor], list[float]]:
    """Return the partitions for all strengths, and their total seconds."""
    config = SuperpointsConfig(strengths=STRENGTHS)
    begin = time.perf_counter()
    seg = segment_planes(points, voxel=voxel)
    found = make_superpoints(points, seg, config, voxel=voxel)
    return [found.labels, *found.levels], [time.perf_counter() - begin]


def _score(cloud: LabeledCloud, partitions: Sequence[Tensor], seconds: list[float]) -> Figures:
    """Return the metrics of each partition."""
    points, ground_truth, _ = cloud
    levels = [
        score_partition(partition, ground_truth, points)._asdict() for partition in partitions
    ]
    return {"points": len(points), "seconds": seconds, "levels": levels}


def at_count(rows: Sequence[Figures], count: float, name: str) -> float:
    """Interpolate a metric at a number of superpoints, linearly in its logarithm."""
    ordered = sorted(rows, key=lambda row: row["count"])
    counts = np.log([row["count"] for row in ordered])
    return float(np.interp(np.log(count), counts, [row[name] for row in ordered]))
