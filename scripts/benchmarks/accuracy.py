"""Plane accuracy of torchrg, PCL, Open3D, CGAL and GoCoPP by three published protocols.

Clouds with exact ground truth: synthetic rooms at four noise levels and three densities, rendered
depth frames without noise and with Kinect noise, a scan of SynPEB's test set, and planar patches of
scans with labeled parts (0 is none). Also folders of simulated scans and reconstructions of rooms,
``NAME_SEED.npz`` with ``points`` and ``labels`` (-1 is no plane).

FOLDER contains the programs ``pclrg`` (PCL's normals and region growing), ``cgalrg`` (CGAL's region
growing and Efficient RANSAC) and ``gocopp``; PYTHON has Open3D. Missing programs are skipped. CGAL
runs with PCA and ``consensus`` normals. Open3D returns boxes; a point belongs to the nearest box
within 5 cm. ``depth`` segments a frame as an image, all other contenders as a cloud. Settings for
room folders were chosen on one folder; another is held out. The first table has means over the
clouds of a kind. Published figures below the tables are for other data.

    python scripts/bench.py accuracy --programs FOLDER --open3d-python PYTHON --synpeb FILE.pcd
        --parts office_parts.pcd --rooms CHOSEN HELD_OUT --out accuracy.json
    python scripts/bench.py accuracy --scale 0.1 --only classic consensus

Your estimator of normals, of which ``classic`` grows regions, as the contender ``own``:

    python scripts/bench.py accuracy --scale 0.1 --estimator my_module:my_function
"""

import dataclasses
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
import torch
from estimator import Estimator, load_estimator
from torch import Tensor

import torchrg
from benchmarks.harness import Benchmark, Figures, Results, markdown, medians, run_program, table
from benchmarks.patches import label_patches
from benchmarks.peers import MIN_SIZE, OPEN3D, pcl_command
from benchmarks.protocols import count_segcomp, score_evops, score_voxels
from tests.made import DepthFrame, build_scanned_room, cameras_around, render_depth
from torchrg.depth import segment_depth
from torchrg.depth.camera import depth_to_points
from torchrg.metrics import contingency_table, score_labels
from torchrg.scenes import make_room

PRESETS = ("classic", "paper", "consensus")
NOISES = (0.0005, 0.001, 0.003, 0.006)
"""Noise levels of synthetic rooms, standard deviation in meters."""
POINTS = 300_000
"""Number of points per noise level."""
DENSITIES = (100_000, 200_000, 1_000_000)
"""Numbers of points of the same room with 3 mm noise."""
NUM_FRAMES = 4
FRAME_SEED = 21
SYNPEB_MIN_SIZE = 10
"""Minimum number of points of regions and surfaces; SynPEB ignores smaller ones."""
SYNPEB_VOID = 3
"""SynPEB's label of points without a plane."""
PATCH_TOLERANCES = (0.010, 0.015, 0.020)
"""Maximum distances of the points of a patch to its plane, in meters."""
ROOMS_MIN_SIZES = {"s3dis": 300, "laser": 300, "rgbd": 200, "scannet": 60}
"""Minimum number of points of a surface, by a substring of the room name."""
VOID = -2
"""Ground-truth label of ignored points."""
EVOPS = ("precision", "recall", "mean_iou")
"""Metrics of the EVOPS protocol."""
VOXEL_SIZE = 0.05
"""Voxel size, in meters."""

CGAL_K, CGAL_ANGLE_DEG = 20, 25
"""Neighbors and maximum angle of CGAL's region growing."""
CGAL = {
    "growing": ("rg", 0.02, ()),
    "RANSAC": ("ransac", 0.01, (0.05, 0.01)),
}
"""Mode, distance to a plane in meters, and for RANSAC the gap within a plane and the probability of
missing the largest plane. Distances of 10 and 20 mm were tried; these fit most clouds best."""

PUBLISHED = """Correct to noise: fractions of surfaces, SegComp at 80 %. Published for other data:

| by | data | measure |
|---|---|---|
| RSPD | 2D-3D-S, 148 rooms | voxel precision .85, recall .90, F1 .87 |
| OPS | 2D-3D-S | .89, .70, .78 |
| 3D-KHT | 2D-3D-S | .71, .78, .75 |
| OBRG | 2D-3D-S | .81, .67, .71 |
| Polylidar3D | SynPEB, noise 1 to 4 | correct .57, .55, .50, .45 |
| PCL region growing | EVOPS | precision .21, recall .67, mean IoU .25 |
| CAPE | EVOPS | precision about .5, recall about .2, mean IoU .67 |"""


class LabeledCloud(NamedTuple):
    """Point cloud with ground truth."""

    points: Tensor  # shape ``(N, 3)``
    ground_truth: Tensor  # shape ``(N,)``, -1 for no plane, VOID for ignored points
    # Minimum region size, unless the preset measures it.
    min_size: int = MIN_SIZE
    # Source depth image; points are in the order of its pixels with depth.
    frame: DepthFrame | None = None


Clouds = Sequence[LabeledCloud]
"""Clouds of one table row; metrics are averaged over them."""


@dataclass(frozen=True)
class Case(Benchmark):
    programs: Path | None = None
    """Folder of the peer programs."""
    open3d_python: str | None = None
    """Python executable with Open3D."""
    synpeb: Path | None = None
    """Scan with labels in the field intensity."""
    parts: tuple[Path, ...] = ()
    """Scans with labeled parts."""
    rooms: tuple[Path, ...] = ()
    """Folders of rooms with ground truth."""
    estimator: str | None = None
    """Function from points to normals and curvature, as module:function."""
    scale: float = 1.0
    """Fraction of the default number of points of synthetic data."""

    def clouds(self) -> Mapping[str, Callable[[], Clouds]]:
        rooms = {f"room, {1000 * noise:g} mm": (POINTS, noise) for noise in NOISES}
        rooms |= {f"room, {number:,} points": (number, 0.003) for number in DENSITIES}
        makers: dict[str, Callable[[], Clouds]] = {
            name: partial(_synthetic_room, round(self.scale * number), noise)
            for name, (number, noise) in rooms.items()
        }
        for sensor in ("exact", "kinect"):
            makers[f"{NUM_FRAMES} frames, {sensor}"] = partial(_frames, sensor, self.scale)
        if self.synpeb is not None:
            makers["SynPEB, test 100"] = partial(_read_synpeb, self.synpeb)
        for path in self.parts:
            for size in PATCH_TOLERANCES:
                name = f"{path.stem}, patches at {1000 * size:g} mm"
                makers[name] = partial(_read_patches, path, size)
        for folder in self.rooms:
            for path in sorted(folder.glob("*.npz")):
                makers[f"{folder.name}/{path.stem}"] = partial(_read_room, path)
        return makers

    def contenders(self) -> Mapping[str, Callable[[Clouds], Figures | None]]:
        runs: dict[str, Callable[[LabeledCloud], Tensor]] = {
            name: partial(_run_preset, name) for name in PRESETS
        }
        runs["depth"] = _run_depth
        if self.estimator is not None:
            runs["own"] = partial(_run_estimator, load_estimator(self.estimator))
        if self.programs is not None and (self.programs / "pclrg").exists():
            runs["PCL"] = partial(_run_pcl, self.programs / "pclrg")
        if self.programs is not None and (program := self.programs / "cgalrg").exists():
            for method, settings in CGAL.items():
                for normals in ("pca", "consensus"):
                    run = partial(_run_cgal, program, settings, normals)
                    runs[f"CGAL {method}, {normals}"] = run
        if self.programs is not None and (program := self.programs / "gocopp").exists():
            runs["GoCoPP"] = partial(_run_gocopp, program)
        if self.open3d_python is not None:
            runs["Open3D"] = partial(_run_open3d, self.open3d_python)
        return {name: partial(_mean_scores, run) for name, run in runs.items()}

    def report(self, results: Results) -> str:
        """Return the mean and worst scores of each kind, all rows, and published figures."""
        kinds: dict[str, list[str]] = {}
        for cloud in results:
            kinds.setdefault(re.split(r", |_[^_]*$", cloud)[0], []).append(cloud)
        names = list(dict.fromkeys(name for by in results.values() for name in by))
        rows = [
            [kind, *(_summary([results[cloud].get(name) for cloud in clouds]) for name in names)]
            for kind, clouds in kinds.items()
        ]
        head = ["detected / mean best IoU (worst) / regions", *names]
        return f"{markdown(head, rows)}\n\n{table(results)}\n\n{PUBLISHED}"


def _synthetic_room(num_points: int, noise: float) -> Clouds:
    """Return a synthetic room with its surfaces."""
    room = make_room(num_points, noise=noise, seed=0)
    return [LabeledCloud(room.points, room.labels)]


def _frames(sensor: str, scale: float) -> Clouds:
    """Return depth frames of a synthetic room as clouds."""
    model = build_scanned_room(FRAME_SEED)
    height = max(round(480 * scale**0.5), 60)
    size = {"width": height * 4 // 3, "height": height}
    clouds = []
    for number, camera in enumerate(cameras_around(model, NUM_FRAMES, seed=FRAME_SEED, **size)):
        frame = render_depth(model, camera, sensor=sensor, seed=number)
        seen = frame.depth.flatten() > 0
        points = depth_to_points(frame.depth[None], camera.intrinsics[None])[0].view(-1, 3)
        # Columns and balls are not planar.
        planar = torch.cat([frame.planar, torch.tensor([False])])
        ground_truth = torch.where(planar[frame.labels], frame.labels, -1).flatten()
        clouds.append(LabeledCloud(points[seen].float(), ground_truth[seen], frame=frame))
    return clouds


def _read_synpeb(path: Path) -> Clouds:
    """Read a SynPEB scan, whose labels are in the field ``intensity``."""
    cloud = torchrg.read_cloud(path)
    labels = torch.as_tensor(cloud.fields["intensity"]).long()
    known = (labels != SYNPEB_VOID) & (torch.bincount(labels)[labels] >= SYNPEB_MIN_SIZE)
    return [LabeledCloud(torch.as_tensor(cloud.points)[known], labels[known], SYNPEB_MIN_SIZE)]


def _read_patches(path: Path, tolerance: float) -> Clouds:
    """Read a scan whose field ``labels`` has the part of each point, 0 for none."""
    cloud = torchrg.read_cloud(path)
    points = torch.as_tensor(cloud.points)
    parts = np.asarray(cloud.fields["labels"]).astype(np.int64) - 1
    patches = label_patches(points.double().numpy(), parts, tolerance)
    return [LabeledCloud(points, torch.from_numpy(patches))]


def _read_room(path: Path) -> Clouds:
    """Read a room; points of surfaces too small to be detected are ignored."""
    sizes = (size for kind, size in ROOMS_MIN_SIZES.items() if kind in path.stem)
    with np.load(path) as room:
        ground_truth = _large_faces(torch.as_tensor(room["labels"]).long(), next(sizes, MIN_SIZE))
        return [LabeledCloud(torch.as_tensor(room["points"]).float(), ground_truth)]


def _large_faces(ground_truth: Tensor, min_size: int) -> Tensor:
    """Return ground truth in which points of smaller surfaces are ignored."""
    is_face = ground_truth >= 0
    sizes = torch.bincount(ground_truth[is_face])
    return ground_truth.where(~is_face | (sizes[ground_truth.clamp(min=0)] >= min_size), VOID)


def _summary(runs: Sequence[Sequence[Figures] | None]) -> str:
    """Return the means of detected fraction, best IoU (and its minimum), and regions."""
    figures = [medians(rows) for rows in runs if rows]
    if not figures:
        return ""
    found, iou, regions = (
        [each[name] for each in figures] for name in ("recall_iou50", "mean_best_iou", "regions")
    )
    return f"{fmean(found):.3f} / {fmean(iou):.3f} ({min(iou):.3f}) / {fmean(regions):.0f}"


def _run_preset(name: str, cloud: LabeledCloud) -> Tensor:
    """Segment with a preset."""
    config = torchrg.load_config(name)
    growing = config.growing
    if growing.min_size != "auto":
        growing = dataclasses.replace(growing, min_size=cloud.min_size)
    return torchrg.segment_planes(cloud.points, dataclasses.replace(config, growing=growing)).labels


def _run_estimator(estimate: Estimator, cloud: LabeledCloud) -> Tensor:
    """Grow the regions of ``classic`` from other normals."""
    config = torchrg.load_config("classic")
    growing = dataclasses.replace(config.growing, min_size=cloud.min_size)
    neighbors = torchrg.search_knn(cloud.points, config.normals.k)
    return torchrg.grow_regions(cloud.points, *estimate(cloud.points), neighbors, growing)


def _run_depth(cloud: LabeledCloud) -> Tensor:
    """Segment the depth image; return labels of pixels with depth."""
    depth = cloud.frame.depth
    return segment_depth(depth, cloud.frame.camera.intrinsics).labels.flatten()[depth.flatten() > 0]


def _run_pcl(program: Path, cloud: LabeledCloud) -> Tensor:
    """Segment with PCL's region growing."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "cloud.f32", Path(folder) / "labels.i32"
        cloud.points.float().numpy().tofile(source)
        run_program(pcl_command(program, source, result, cloud.min_size))
        return torch.from_numpy(np.fromfile(result, dtype=np.int32)).long()


def _run_cgal(
    program: Path, settings: tuple[str, float, tuple[float, ...]], normals: str, cloud: LabeledCloud
) -> Tensor:
    """Segment with CGAL's region growing or RANSAC, given normals from torchrg."""
    mode, distance, more = settings
    with tempfile.TemporaryDirectory() as folder:
        source, result, turned = (Path(folder) / name for name in ("p.f32", "l.i32", "n.f32"))
        points = cloud.points.float()
        points.numpy().tofile(source)
        torchrg.estimate_normals(points, method=normals).normals.numpy().tofile(turned)
        numbers = (CGAL_K, distance, CGAL_ANGLE_DEG, cloud.min_size)
        run_program([program, mode, source, result, *numbers, turned, *more])
        return torch.from_numpy(np.fromfile(result, dtype=np.int32)).long()


def _run_gocopp(program: Path, cloud: LabeledCloud) -> Tensor:
    """Segment with GoCoPP and its default settings."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "cloud.f32", Path(folder) / "labels.i32"
        cloud.points.float().numpy().tofile(source)
        run_program([program, source, result])
        return torch.from_numpy(np.fromfile(result, dtype=np.int32)).long()


def _run_open3d(python: str, cloud: LabeledCloud) -> Tensor:
    """Return the nearest box of Open3D's planar patches for each point."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "cloud.npy", Path(folder) / "labels.npy"
        np.save(source, cloud.points.numpy())
        run_program([python, "-c", OPEN3D, source, result])
        return torch.from_numpy(np.load(result)).long()


def _mean_scores(run: Callable[[LabeledCloud], Tensor], clouds: Clouds) -> Figures | None:
    """Return the means of all metrics over clouds; None for ``depth`` without images."""
    if run is _run_depth and clouds[0].frame is None:
        return None
    rows = [_score(cloud, run(cloud)) for cloud in clouds]
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def _score(cloud: LabeledCloud, labels: Tensor) -> Figures:
    """Return the metrics of all protocols."""
    counts = cloud.ground_truth != VOID
    cloud, labels = LabeledCloud(cloud.points[counts], cloud.ground_truth[counts]), labels[counts]
    found = score_labels(labels, cloud.ground_truth)
    voxels = score_voxels(cloud.points, labels, cloud.ground_truth, voxel_size=VOXEL_SIZE)
    table = contingency_table(labels, cloud.ground_truth)
    evops = score_evops(table)
    return {
        **{name: getattr(found, name) for name in ("regions", "faces", "mean_best_iou")},
        "recall_iou50": found.recall_iou50,
        **{f"voxel {name}": getattr(voxels, name) for name in ("precision", "recall", "f1")},
        **{n: count / max(found.faces, 1) for n, count in count_segcomp(table)._asdict().items()},
        **{f"EVOPS {name}": getattr(evops, name) for name in EVOPS},
    }
