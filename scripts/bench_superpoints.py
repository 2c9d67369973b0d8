"""Superpoints beside those of cut pursuit: accuracy over their number, and seconds.

    python scripts/bench_superpoints.py --parts office_parts.pcd --peer-python VENV/bin/python
        --peer cutpursuit.py --out superpoints

Clouds: real rooms with labelled parts (``--parts``, label 0 is none), and made ones with objects: a
room on voxels of 3 cm, one put together from pieces of equally many points, so that its density
jumps, one scanned from few places, near and far, and depth frames fused. The cloud of pieces is
also voxelled first. The peer's file has ``partition(points, strength)``, which returns labels and
seconds, and runs in a Python of its own (numpy below 2, pgeof, pycut-pursuit); without it only
torchrg is measured. Seconds are from points to superpoints, planes included, for all levels.
"""

import argparse
import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from numpy.typing import NDArray
from reproduction.plotting import settings
from reproduction.scenes import make_kinect_room, scan_scene
from torch import Tensor
from tqdm import tqdm

from torchrg import make_superpoints, read_cloud, segment_planes
from torchrg.config import SuperpointsConfig
from torchrg.metrics import PartitionScore, score_partition
from torchrg.neighbors import sample_voxels
from torchrg.scenes import RoomLayout, Scene, build_room, make_room
from torchrg.structures import UNLABELED

COLORS = {"torchrg": "C0", "torchrg, voxels first": "C2", "cut pursuit": "C1"}
VOXEL = 0.03
"""Side of voxels, metres."""
STRENGTHS = (0.1, 0.25, 0.5, 1.0, 1.5, 2.5, 4.0, 7.0, 12.0, 20.0, 35.0)
PEER_STRENGTHS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
LAYOUT = RoomLayout(
    size=(9.0, 7.0, 2.8), num_tables=5, num_columns=1, num_round_tables=1, num_balls=1, num_lamps=1
)
NUM_PIECES = 40
"""Of them a room is put together."""
SPARE = 8
"""Points that a room has before pieces are thinned, for one that is left."""
SHOWN = ("asa", "oracle_miou", "boundary_recall")

PEER = """
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

Labelled = tuple[Tensor, Tensor]
"""Points ``(N, 3)``, and the object of each, ``(N,)``, -1 for none."""


def with_objects(scene: Scene) -> Labelled:
    """Return a scene with objects in place of faces."""
    objects = torch.cat([scene.objects, torch.tensor([UNLABELED])])
    return scene.points, objects[scene.labels]


def voxelled_room(num_points: int) -> Labelled:
    """Return one point of each voxel of a room."""
    points, truth = with_objects(make_room(2 * num_points, noise=0.003, seed=11, layout=LAYOUT))
    rows = sample_voxels(points, VOXEL).rows
    return points[rows], truth[rows]


def room_of_pieces(num_points: int) -> Labelled:
    """Return a room cut into boxes that keep equally many points each, as S3DIS is put together."""
    scene = make_room(SPARE * num_points, noise=0.003, seed=12, layout=LAYOUT)
    points, truth = with_objects(scene)
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


CLOUDS: dict[str, Callable[[int], Labelled]] = {
    "room on voxels of 3 cm": voxelled_room,
    "pieces of equally many points": room_of_pieces,
    "scan near and far": lambda num_points: with_objects(
        scan_scene(build_room(13, layout=LAYOUT), num_points, noise=0.003, seed=13)
    ),
    "depth frames fused": lambda num_points: with_objects(
        make_kinect_room(num_points, num_frames=8, seed=14)
    ),
}


def read_parts(path: Path) -> Labelled:
    """Return a real room with its parts."""
    cloud = read_cloud(path)
    labels = torch.from_numpy(cloud.fields["labels"])
    return cloud.points, torch.where(labels == 0, UNLABELED, labels)


def run_ours(points: Tensor, voxel: float | None) -> tuple[list[Tensor], list[float]]:
    """Return partitions for all strengths, and the seconds that they took together."""
    config = SuperpointsConfig(strengths=STRENGTHS)
    begin = time.perf_counter()
    seg = segment_planes(points, voxel=voxel)
    found = make_superpoints(points, seg, config, voxel=voxel)
    seconds = time.perf_counter() - begin
    return [found.labels, *found.levels], [seconds] * len(STRENGTHS)


def run_peer(points: Tensor, peer: Path, python: str) -> tuple[list[Tensor], list[float]]:
    """Return the peer's partitions for its strengths, and the seconds of each."""
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "points.npy", points.numpy())
        strengths = json.dumps(PEER_STRENGTHS)
        command = [python, "-c", PEER, str(peer.resolve().parent), peer.stem, strengths]
        done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
        labels = [
            torch.from_numpy(np.load(Path(folder) / f"{strength}.npy").astype(np.int64))
            for strength in PEER_STRENGTHS
        ]
    return labels, json.loads(done.stdout.splitlines()[-1])


def at_count(rows: list[dict[str, Any]], count: float, name: str) -> float:
    """Return a score at so many superpoints, between those measured by their logarithms."""
    ordered = sorted(rows, key=lambda row: row["count"])
    counts: NDArray[np.float64] = np.log([row["count"] for row in ordered])
    return float(np.interp(np.log(count), counts, [row[name] for row in ordered]))


def as_table(results: dict[str, dict[str, list[dict[str, Any]]]]) -> str:
    """Return a row for each partition of the peer, or of ours where there is none."""
    lines = ["| cloud | superpoints | " + " | ".join(SHOWN) + " |", "|---|--:|--:|--:|--:|"]
    for cloud, runs in results.items():
        rivals = [name for name in runs if name != "torchrg"]
        for rival in rivals or ["torchrg"]:
            for row in sorted(runs[rival], key=lambda row: row["count"]):
                ours = [f"{at_count(runs['torchrg'], row['count'], name):.3f}" for name in SHOWN]
                theirs = [f" ({rival} {row[name]:.3f})" if rivals else "" for name in SHOWN]
                cells = [a + b for a, b in zip(ours, theirs, strict=True)]
                lines.append(f"| {cloud} | {row['count']:,} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "| cloud | points | seconds for all levels, or of each strength |",
        "|---|--:|---|",
    ]
    for cloud, runs in results.items():
        taken = "; ".join(
            f"{name} " + ", ".join(f"{s:.1f}" for s in dict.fromkeys(r["seconds"] for r in rows))
            for name, rows in runs.items()
        )
        lines.append(f"| {cloud} | {runs['torchrg'][0]['cloud_points']:,} | {taken} |")
    return "\n".join(lines) + "\n"


def plot(results: dict[str, dict[str, list[dict[str, Any]]]], path: Path) -> None:
    """Draw each score over the number of superpoints, a column for each cloud."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with settings():
        size = (2.1 * len(results), 1.7 * len(SHOWN))
        figure, axes = plt.subplots(
            len(SHOWN), len(results), figsize=size, squeeze=False, layout="constrained"
        )
        for column, (cloud, runs) in zip(axes.T, results.items(), strict=True):
            column[0].set_title(cloud)
            column[-1].set_xlabel("superpoints")
            for axis, name in zip(column, SHOWN, strict=True):
                for run, rows in runs.items():
                    ordered = sorted(rows, key=lambda row: row["count"])
                    values = [row[name] for row in ordered]
                    counts = [row["count"] for row in ordered]
                    axis.semilogx(counts, values, "o-", label=run, color=COLORS[run])
        for axis, name in zip(axes[:, 0], SHOWN, strict=True):
            axis.set_ylabel(name.replace("_", " "))
        handles = {line.get_label(): line for axis in axes[0] for line in axis.get_lines()}
        figure.legend(
            handles=list(handles.values()), loc="outside lower center", ncols=len(handles)
        )
        figure.savefig(path)
        plt.close(figure)


def main() -> None:
    """Measure all clouds, and write ``superpoints.json``, ``.md`` and ``.png``."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--parts", type=Path, nargs="*", default=[], help="rooms with parts")
    parser.add_argument("--points", type=int, default=300_000, help="of each made cloud")
    parser.add_argument("--only", nargs="*", help="made clouds; default: all")
    parser.add_argument("--peer", type=Path, help="file of the peer")
    parser.add_argument("--peer-python", default="python", help="Python that the peer runs in")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("superpoints"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    names = list(CLOUDS) if arguments.only is None else arguments.only
    makers = {path.stem: lambda path=path: read_parts(path) for path in arguments.parts}
    makers |= {name: lambda name=name: CLOUDS[name](arguments.points) for name in names}
    results: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for cloud, make in tqdm(makers.items(), disable=None):
        points, truth = make()
        runs = {"torchrg": lambda points=points: run_ours(points, None)}
        if cloud == "pieces of equally many points":
            runs["torchrg, voxels first"] = lambda points=points: run_ours(points, VOXEL)
        if arguments.peer is not None:
            runs["cut pursuit"] = lambda points=points: run_peer(
                points, arguments.peer, arguments.peer_python
            )
        results[cloud] = {}
        for name, run in runs.items():
            partitions, seconds = run()
            scores: list[PartitionScore] = [score_partition(p, truth, points) for p in partitions]
            results[cloud][name] = [
                {**score._asdict(), "seconds": taken, "cloud_points": len(points)}
                for score, taken in zip(scores, seconds, strict=True)
            ]
        (arguments.out / "superpoints.json").write_text(json.dumps(results, indent=1))
        (arguments.out / "superpoints.md").write_text(as_table(results))
        plot(results, arguments.out / "superpoints.png")
    print(as_table(results))


if __name__ == "__main__":
    main()
