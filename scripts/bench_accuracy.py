"""Score torchrg beside PCL's region growing and Open3D's planar patches by three known protocols.

    python scripts/bench_accuracy.py --peers FOLDER --open3d-python PYTHON --synpeb FILE.pcd
    python scripts/bench_accuracy.py --scale 0.1 --only classic consensus --out quick

Clouds with exact truth: made rooms at four levels of noise and at three densities, rendered depth
frames without noise and with a Kinect's, and a scan of SynPEB's test set if its file is given.
FOLDER holds the program ``pclrg`` (PCL's normals and region growing), PYTHON has Open3D; what is
missing is left out. Open3D finds boxes: a point goes to the nearest within 5 cm. ``depth`` sees a
frame as an image, all others as a cloud. Published figures stand below the table, and are of other
data.
"""

import argparse
import dataclasses
import json
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import torchrg
from tests.made import DepthFrame, cameras_around, render_depth
from torchrg.depth import segment_depth
from torchrg.depth.camera import depth_to_points
from torchrg.metrics import score_labels, score_voxels
from torchrg.scenes import build_room, make_room

PRESETS = ("classic", "paper", "consensus")
NOISES = (0.0005, 0.001, 0.003, 0.006)
"""Standard deviations of the points of made rooms, in metres,"""
POINTS = 300_000
"""with so many points each."""
DENSITIES = (100_000, 200_000, 1_000_000)
"""Points of the same room at 3 mm."""
NUM_FRAMES = 4
K, ANGLE_DEG, CURVATURE_PERCENTILE = 50, 5, 95
"""Settings of PCL's region growing: those of ``classic``."""
MIN_SIZE, SYNPEB_MIN_SIZE = 50, 10
"""Points of the smallest region. Of SynPEB also of the smallest face: others are void there."""
SYNPEB_VOID = 3
"""Label of SynPEB's points of no plane."""
VOXEL_SIZE = 0.05
"""Side of the voxels, in metres."""

PUBLISHED = """Published, of other data:

| by | data | measure |
|---|---|---|
| RSPD | 2D-3D-S, 148 rooms | voxel precision .85, recall .90, F1 .87 |
| OPS | 2D-3D-S | .89, .70, .78 |
| 3D-KHT | 2D-3D-S | .71, .78, .75 |
| OBRG | 2D-3D-S | .81, .67, .71 |
| Polylidar3D | SynPEB, noise 1 to 4 | correct .57, .55, .50, .45 |
| PCL region growing | EVOPS | precision .21, recall .67, mean IoU .25 |
| CAPE | EVOPS | precision about .5, recall about .2, mean IoU .67 |
"""

OPEN3D = """
import sys, numpy as np, open3d
points = np.load(sys.argv[1]).astype(np.float64)
cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
boxes = cloud.detect_planar_patches(search_param=open3d.geometry.KDTreeSearchParamKNN(30))
labels, least = np.full(len(points), -1), np.full(len(points), 0.05)
for number, box in enumerate(boxes):
    away = np.abs((points - box.center) @ box.R) - np.asarray(box.extent) / 2
    distance = np.linalg.norm(np.maximum(away, 0), axis=1)
    nearer = distance < least
    labels[nearer], least[nearer] = number, distance[nearer]
np.save(sys.argv[2], labels)
"""


class Labelled(NamedTuple):
    """A cloud with its truth.

    Attributes:
        points: Shape ``(N, 3)``.
        truth: Shape ``(N,)``, -1 for points of no plane.
        min_size: Points of the smallest region.
        frame: The depth image that the points are of, in the order of its pixels with depth.
    """

    points: Tensor
    truth: Tensor
    min_size: int = MIN_SIZE
    frame: DepthFrame | None = None


def made_room(num_points: int, noise: float) -> Labelled:
    """Return a room with all its faces."""
    room = make_room(num_points, noise=noise, seed=0)
    return Labelled(room.points, room.labels)


def rendered_frame(number: int, sensor: str, scale: float) -> Labelled:
    """Return what a depth camera sees of a made room."""
    model = build_room(21)
    height = max(round(480 * scale**0.5), 60)
    cameras = cameras_around(model, NUM_FRAMES, seed=21, width=height * 4 // 3, height=height)
    frame = render_depth(model, cameras[number], sensor=sensor, seed=number)
    seen = frame.depth.flatten() > 0
    points = depth_to_points(frame.depth[None], _intrinsics(frame)[None])[0].view(-1, 3)
    # Columns and balls are no planes.
    planar = torch.cat([frame.planar, torch.tensor([False])])
    truth = torch.where(planar[frame.labels], frame.labels, -1).flatten()
    return Labelled(points[seen].float(), truth[seen], frame=frame)


def read_synpeb(path: Path) -> Labelled:
    """Return a scan of SynPEB: its labels are in the field ``intensity``."""
    cloud = torchrg.read_cloud(path)
    labels = torch.as_tensor(cloud.fields["intensity"]).long()
    known = (labels != SYNPEB_VOID) & (torch.bincount(labels)[labels] >= SYNPEB_MIN_SIZE)
    return Labelled(torch.as_tensor(cloud.points)[known], labels[known], SYNPEB_MIN_SIZE)


def run_preset(name: str, cloud: Labelled) -> Tensor:
    """Return the labels of a preset."""
    config = torchrg.load_config(name)
    growing = dataclasses.replace(config.growing, min_size=cloud.min_size)
    return torchrg.segment_planes(cloud.points, dataclasses.replace(config, growing=growing)).labels


def run_depth(cloud: Labelled) -> Tensor:
    """Return the labels of the image's pixels with depth."""
    found = segment_depth(cloud.frame.depth, _intrinsics(cloud.frame))
    return found.labels.flatten()[cloud.frame.depth.flatten() > 0]


def run_pcl(program: Path, cloud: Labelled) -> Tensor:
    """Return the labels of PCL's region growing."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "cloud.f32", Path(folder) / "labels.i32"
        cloud.points.float().numpy().tofile(source)
        settings = (K, ANGLE_DEG, CURVATURE_PERCENTILE, cloud.min_size)
        command = [program, source, *settings, result]
        subprocess.run([str(part) for part in command], check=True, capture_output=True)
        return torch.from_numpy(np.fromfile(result, dtype=np.int32)).long()


def run_open3d(python: str, cloud: Labelled) -> Tensor:
    """Return the box of Open3D's planar patches that is nearest to each point."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "cloud.npy", Path(folder) / "labels.npy"
        np.save(source, cloud.points.numpy())
        command = [python, "-c", OPEN3D, str(source), str(result)]
        subprocess.run(command, check=True, capture_output=True)
        return torch.from_numpy(np.load(result)).long()


def score(cloud: Labelled, labels: Tensor) -> dict[str, float]:
    """Return the indices of all protocols."""
    found = score_labels(labels, cloud.truth)
    voxels = score_voxels(cloud.points, labels, cloud.truth, voxel_size=VOXEL_SIZE)
    return {
        "regions": found.regions,
        "faces": found.faces,
        "mean best IoU": found.mean_best_iou,
        "recall 50": found.recall_iou50,
        "voxel P": voxels.precision,
        "voxel R": voxels.recall,
        "voxel F1": voxels.f1,
        **{
            name: getattr(found, name) / max(found.faces, 1)
            for name in ("correct", "over_segmented", "under_segmented", "missed", "noise")
        },
        "EVOPS P": found.evops_precision,
        "EVOPS R": found.evops_recall,
        "EVOPS IoU": found.evops_mean_iou,
    }


def as_table(results: dict[str, dict[str, dict[str, float]]]) -> str:
    """Return a row for each cloud and contender."""
    names = [*next(iter(next(iter(results.values())).values()))][2:]
    heads = ["cloud", "by", "regions / faces", *(name.replace("_", "-") for name in names)]
    lines = ["| " + " | ".join(heads) + " |", "|---|---|" + "--:|" * (len(names) + 1)]
    for cloud, rows in results.items():
        for contender, row in rows.items():
            counts = f"{row['regions']:.0f} / {row['faces']:.0f}"
            cells = [cloud, contender, counts, *(f"{row[name]:.2f}" for name in names)]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n\nCorrect to noise: SynPEB's at 80 %, of the true faces.\n"


def mean_rows(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each index."""
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def _intrinsics(frame: DepthFrame) -> Tensor:
    camera = frame.camera
    cx, cy = camera.principal_point
    return torch.tensor([[camera.fx, 0, cx], [0, camera.fy, cy], [0, 0, 1]], dtype=torch.float64)


def clouds_of(arguments: argparse.Namespace) -> dict[str, Callable[[], list[Labelled]]]:
    """Return what makes the clouds of each row; indices are means over them."""
    scale = arguments.scale
    makers: dict[str, Callable[[], list[Labelled]]] = {}
    for noise in NOISES:
        name = f"room, {1000 * noise:g} mm"
        makers[name] = lambda noise=noise: [made_room(round(scale * POINTS), noise)]
    for number in DENSITIES:
        name = f"room, {number:,} points"
        makers[name] = lambda number=number: [made_room(round(scale * number), 0.003)]
    for sensor in ("exact", "kinect"):
        makers[f"{NUM_FRAMES} frames, {sensor}"] = lambda sensor=sensor: [
            rendered_frame(number, sensor, scale) for number in range(NUM_FRAMES)
        ]
    if arguments.synpeb is not None:
        makers["SynPEB, test 100"] = lambda: [read_synpeb(arguments.synpeb)]
    return makers


def main() -> None:
    """Score all contenders on all clouds, and write ``accuracy.json`` and ``accuracy.md``."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--peers", type=Path, help="folder of the program pclrg")
    parser.add_argument("--open3d-python", help="a Python that has Open3D")
    parser.add_argument("--synpeb", type=Path, help="a scan with labels in the field intensity")
    parser.add_argument("--scale", type=float, default=1.0, help="share of the points")
    parser.add_argument("--only", nargs="*", help="contenders; default: all there are")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("accuracy"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    runs: dict[str, Callable[[Labelled], Tensor]] = {
        name: lambda cloud, name=name: run_preset(name, cloud) for name in PRESETS
    }
    runs["depth"] = run_depth
    if arguments.peers is not None and (arguments.peers / "pclrg").exists():
        runs["PCL"] = lambda cloud: run_pcl(arguments.peers / "pclrg", cloud)
    if arguments.open3d_python is not None:
        runs["Open3D"] = lambda cloud: run_open3d(arguments.open3d_python, cloud)
    results: dict[str, dict[str, dict[str, Any]]] = {}
    for title, make in tqdm(clouds_of(arguments).items(), disable=None):
        clouds, results[title] = make(), {}
        for name, run in runs.items():
            has_frames = clouds[0].frame is not None
            if (name == "depth" and not has_frames) or name not in (arguments.only or runs):
                continue
            results[title][name] = mean_rows([score(cloud, run(cloud)) for cloud in clouds])
        (arguments.out / "accuracy.json").write_text(json.dumps(results, indent=1))
        (arguments.out / "accuracy.md").write_text(f"{as_table(results)}\n{PUBLISHED}")
    print(as_table(results), PUBLISHED, sep="\n")


if __name__ == "__main__":
    main()
