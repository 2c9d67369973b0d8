"""Superpoints beside those of cut pursuit: accuracy over their number, and seconds.

Clouds: real rooms with labelled parts (``--parts``, label 0 is none), and made ones with objects: a
room on voxels of 3 cm, one put together from pieces of equally many points, so that its density
jumps, one scanned from few places, near and far, and depth frames fused. The cloud of pieces is
also voxelled first. The peer's file has ``partition(points, strength)``, which returns labels and
seconds, and runs in a Python of its own (numpy below 2, pgeof, pycut-pursuit); without it only
torchrg is measured. Seconds are from points to superpoints, planes included, for all levels.

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
from tests.made import make_kinect_room, scan_scene
from torchrg import make_superpoints, read_cloud, segment_planes
from torchrg.config import SuperpointsConfig
from torchrg.metrics import score_partition
from torchrg.neighbors import sample_voxels
from torchrg.scenes import RoomLayout, Scene, build_room, make_room
from torchrg.structures import UNLABELED
from torchrg.transforms import partition_voxels, segment_voxels

VOXEL = 0.03
"""Side of voxels, metres."""
STRENGTHS = (0.1, 0.25, 0.5, 1.0, 1.5, 2.5, 4.0, 7.0, 12.0, 20.0, 35.0)
PEER_STRENGTHS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
LAYOUT = RoomLayout(
    size=(9.0, 7.0, 2.8), num_tables=5, num_columns=1, num_round_tables=1, num_balls=1, num_lamps=1
)
NUM_PIECES = 40
"""Pieces that a room is put together from."""
SPARE = 8
"""Points that a room has before pieces are thinned, for one that is left."""
SHOWN = ("asa", "oracle_miou", "boundary_recall")
"""Scores in the table."""
OURS, VOXELLED, PEER = "torchrg", "torchrg, voxels first", "cut pursuit"
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

Labelled = tuple[Tensor, Tensor, str]
"""Points ``(N, 3)``, the object of each, ``(N,)``, -1 for none, and the name of the cloud."""


@dataclass(frozen=True)
class Case(Benchmark):
    """Score superpoints."""

    parts: tuple[Path, ...] = ()
    """Rooms with parts."""
    points: int = 300_000
    """Points of each made cloud."""
    made: tuple[str, ...] = ("voxels", "pieces", "scan", "frames")
    """Made clouds."""
    peer: Path | None = None
    """File of the peer."""
    peer_python: str = "python"
    """Python that the peer runs in."""

    def clouds(self) -> Mapping[str, Callable[[], Labelled]]:
        """Return rooms with parts, then made ones."""
        makers: dict[str, Callable[[], Labelled]] = {
            path.stem: partial(_read_parts, path) for path in self.parts
        }
        for key in self.made:
            name, make = CLOUDS[key]
            makers[name] = lambda name=name, make=make: (*make(self.points), name)
        return makers

    def contenders(self) -> Mapping[str, Callable[[Labelled], Figures | None]]:
        """Return torchrg, and the peer if it is there."""
        runs: dict[str, Callable[[Labelled], Figures | None]] = {
            OURS: lambda cloud: _score(cloud, *_run_ours(cloud[0], None)),
            VOXELLED: lambda cloud: (
                _score(cloud, *_run_ours(cloud[0], VOXEL)) if cloud[2] == PIECES else None
            ),
        }
        if self.peer is not None:
            runs[PEER] = lambda cloud: _score(cloud, *self._run_peer(cloud[0]))
        return runs

    def _run_peer(self, points: Tensor) -> tuple[list[Tensor], list[float]]:
        """Return the peer's partitions for its strengths, and the seconds of each."""
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
        """Return ours at the numbers of superpoints of others, or at our own without any."""
        rows, taken = [], []
        for cloud, by in results.items():
            levels = {name: runs[0]["levels"] for name, runs in by.items()}
            for rival in [name for name in levels if name != OURS] or [OURS]:
                for row in sorted(levels[rival], key=lambda row: row["count"]):
                    ours = [f"{_at_count(levels[OURS], row['count'], name):.3f}" for name in SHOWN]
                    theirs = [f" ({rival} {row[name]:.3f})" * (rival != OURS) for name in SHOWN]
                    cells = [a + b for a, b in zip(ours, theirs, strict=True)]
                    rows.append([cloud, row["count"], *cells])
            for name, runs in by.items():
                seconds = ", ".join(f"{value:.1f}" for value in dict.fromkeys(runs[0]["seconds"]))
                taken.append([cloud, runs[0]["points"], name, seconds])
        head = ["cloud", "points", "by", "seconds for all levels, or of each strength"]
        return f"{markdown(['cloud', 'superpoints', *SHOWN], rows)}\n\n{markdown(head, taken)}"


def _with_objects(scene: Scene) -> tuple[Tensor, Tensor]:
    """Return a scene with objects in place of faces."""
    objects = torch.cat([scene.objects, torch.tensor([UNLABELED])])
    return scene.points, objects[scene.labels]


def _voxelled_room(num_points: int) -> tuple[Tensor, Tensor]:
    """Return one point of each voxel of a room."""
    points, truth = _with_objects(make_room(2 * num_points, noise=0.003, seed=11, layout=LAYOUT))
    rows = sample_voxels(points, VOXEL).rows
    return points[rows], truth[rows]


def _room_of_pieces(num_points: int) -> tuple[Tensor, Tensor]:
    """Return a room cut into boxes that keep equally many points each, as S3DIS is put together."""
    scene = make_room(SPARE * num_points, noise=0.003, seed=12, layout=LAYOUT)
    points, truth = _with_objects(scene)
    rng = np.random.default_rng(12)
    places, pieces = points.numpy(), [np.arange(len(points))]
    while len(pieces) < NUM_PIECES:
        longest = int(np.argmax([np.ptp(places[rows], axis=0).max() for rows in pieces]))
        rows = pieces.pop(longest)
        column = places[rows, int(np.argmax(np.ptp(places[rows], axis=0)))]
        below = column <= column.min() + np.ptp(column) * rng.uniform(0.25, 0.75)
        pieces += [rows[below], rows[~below]]
    share = num_points // NUM_PIECES
    kept = torch.from_numpy(np.concatenate([rng.permutation(rows)[:share] for rows in pieces]))
    return points[kept], truth[kept]


CLOUDS: dict[str, tuple[str, Callable[[int], tuple[Tensor, Tensor]]]] = {
    "voxels": ("room on voxels of 3 cm", _voxelled_room),
    "pieces": (PIECES, _room_of_pieces),
    "scan": (
        "scan near and far",
        lambda num_points: _with_objects(
            scan_scene(build_room(13, layout=LAYOUT), num_points, noise=0.003, seed=13)
        ),
    ),
    "frames": (
        "depth frames fused",
        lambda num_points: _with_objects(make_kinect_room(num_points, num_frames=8, seed=14)),
    ),
}
"""What the made clouds are, and what makes them."""


def _read_parts(path: Path) -> Labelled:
    """Return a scanned room with its parts."""
    cloud = read_cloud(path)
    labels = torch.from_numpy(cloud.fields["labels"])
    return cloud.points, torch.where(labels == 0, UNLABELED, labels), path.stem


def _run_ours(points: Tensor, voxel: float | None) -> tuple[list[Tensor], list[float]]:
    """Return partitions for all strengths, and the seconds that they took together."""
    config = SuperpointsConfig(strengths=STRENGTHS)
    begin = time.perf_counter()
    if voxel is None:
        found = make_superpoints(points, segment_planes(points), config)
    else:
        voxels = sample_voxels(points, voxel)
        found = partition_voxels(points, voxels, segment_voxels(points, voxels), config)
    return [found.labels, *found.levels], [time.perf_counter() - begin]


def _score(cloud: Labelled, partitions: Sequence[Tensor], seconds: list[float]) -> Figures:
    """Return the scores of each partition."""
    points, truth, _ = cloud
    levels = [score_partition(partition, truth, points)._asdict() for partition in partitions]
    return {"points": len(points), "seconds": seconds, "levels": levels}


def _at_count(rows: Sequence[Figures], count: float, name: str) -> float:
    """Return a score at so many superpoints, between those measured by their logarithms."""
    ordered = sorted(rows, key=lambda row: row["count"])
    counts = np.log([row["count"] for row in ordered])
    return float(np.interp(np.log(count), counts, [row[name] for row in ordered]))
