"""Speed and memory of torchrg, PCL, CGAL and Open3D on the same clouds.

FOLDER of ``--programs`` contains ``pclrg`` (PCL's normals and region growing) and ``cgaln`` (CGAL's
PCA and jet normals); missing programs are skipped. ``torchrg-*`` and ``open3d-*`` are warm calls in
one process; ``*-command`` is the complete command, compared with PCL's complete process. Contenders
run in turn, round by round; ratios are medians of the ratios within a round.

    python scripts/bench.py peers --programs FOLDER --out peers.json
    python scripts/bench.py peers --programs FOLDER --sizes 100000 --only pclrg torchrg-classic
"""

import contextlib
import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

from benchmarks.harness import (
    Benchmark,
    Figures,
    Finished,
    Results,
    markdown,
    medians,
    ratio,
    run_program,
    serve_command,
)

K, MAX_ANGLE_DEG, CURVATURE_PERCENTILE, MIN_SIZE = 50, 5, 95, 50
"""Settings of PCL's region growing, as in ``classic``."""
OPEN3D = """
import sys, numpy as np, open3d
points = np.load(sys.argv[1]).astype(np.float64)
cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
boxes = cloud.detect_planar_patches(search_param=open3d.geometry.KDTreeSearchParamKNN(30))
labels, closest = np.full(len(points), -1), np.full(len(points), 0.05)
for number, box in enumerate(boxes):
    away = np.abs((points - box.center) @ box.R) - np.asarray(box.extent) / 2
    distance = np.linalg.norm(np.maximum(away, 0), axis=1)
    nearer = distance < closest
    labels[nearer], closest[nearer] = number, distance[nearer]
np.save(sys.argv[2], labels)
"""
"""Open3D's planar patches: script from a point file to a label file."""
PRESETS = ("classic", "paper", "consensus")
SEED, NOISE = 7, 0.003
WARM_UP = 5000
"""Approximate number of points for the warm-up run."""


def pcl_command(program: Path, cloud: Path, labels: Path, min_size: int = MIN_SIZE) -> list[object]:
    """Return the command for PCL's normals and region growing."""
    return [program, cloud, K, MAX_ANGLE_DEG, CURVATURE_PERCENTILE, min_size, labels]


@dataclass(frozen=True)
class Case(Benchmark):
    rounds: int = 3
    programs: Path | None = None
    """Folder of the programs pclrg and cgaln."""
    open3d_python: str | None = None
    """Python executable with Open3D. Default: this one, if it has Open3D."""
    scans: tuple[Path, ...] = ()
    """Additional scans."""
    sizes: tuple[int, ...] = (100_000, 1_000_000, 4_000_000)
    """Numbers of points of synthetic rooms, in random order and along a space-filling curve."""

    def clouds(self) -> Mapping[str, Callable[[], object]]:
        rooms = [f"room {size} {order}" for size in self.sizes for order in ("random", "sorted")]
        names = [*map(str, self.scans), *rooms]
        return {Path(name).stem: partial(cloud_files, name) for name in names}

    def contenders(self) -> Mapping[str, Callable[[Path], Figures]]:
        runs: dict[str, Callable[[Path], Figures]] = {
            f"torchrg-{preset}": partial(_run_warm, f"preset {preset}") for preset in PRESETS
        }
        runs["torchrg-pca"] = partial(_run_warm, "normals")
        python = self.open3d_python or (sys.executable if find_spec("open3d") else None)
        if python is not None:
            runs["open3d-pca"] = partial(_run_warm, "open3d normals", python=python)
            runs["open3d-planes"] = partial(_run_warm, "open3d planes", python=python)
            runs["open3d-command"] = partial(_run_open3d, python)
        runs |= {f"torchrg-{preset}-command": partial(_run_command, preset) for preset in PRESETS}
        for name in ("pclrg", "cgaln"):
            if self.programs is not None and (self.programs / name).exists():
                runs[name] = partial(_run_peer, self.programs / name)
        return runs

    def report(self, results: Results) -> str:
        """Return seconds, memory, and ratios of comparable runs; above 1 torchrg is slower."""
        rows = []
        for cloud, by_name in results.items():
            for name, runs in by_name.items():
                found, kind = medians(runs), "whole" if name.endswith("-command") else "total"
                is_normals = name.endswith("-pca") or name == "cgaln"
                ratios = [
                    ratio(runs, by_name.get(other, []), kind)
                    if name != other and is_normals == other.endswith("-pca")
                    else None
                    for other in ("pclrg", "open3d-pca")
                ]
                rows.append([cloud, name, *(found[key] for key in FIELDS), *ratios])
        return markdown(["cloud", "contender", *FIELDS.values(), "to PCL", "to Open3D"], rows)


FIELDS = {
    "total": "seconds",
    "seconds": "stages",
    "whole": "whole process, s",
    "cpu": "CPU of the process, s",
    "peak_mib": "peak MiB",
}
"""Figures of a run and their column titles."""


@contextlib.contextmanager
def cloud_files(cloud: str) -> Iterator[Path]:
    """Write a cloud as ``cloud.npy`` and ``cloud.f32`` in a separate process."""
    with tempfile.TemporaryDirectory() as folder:
        run_program(serve_command("benchmarks.peers:write_cloud", cloud, folder))
        yield Path(folder)


def write_cloud(cloud: str, folder: str) -> None:
    """Read a scan or generate a room, and write its points for all contenders."""
    import numpy as np
    import torch

    import torchrg
    from torchrg.neighbors import canonical_order

    if cloud.startswith("room "):
        _, size, order = cloud.split()
        points = torchrg.scenes.make_room(int(size), NOISE, SEED).points
        points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(SEED))]
        points = points[canonical_order(points)] if order == "sorted" else points
    else:
        points = torchrg.read_cloud(cloud).points
        points = points[points.isfinite().all(dim=1)].float()
    np.save(Path(folder) / "cloud.npy", points.numpy())
    points.numpy().tofile(Path(folder) / "cloud.f32")


def _figures(seconds: dict[str, float], done: Finished) -> Figures:
    return {
        "seconds": seconds,
        "total": sum(seconds.values()),
        "whole": done.seconds,
        "cpu": done.cpu_seconds,
        "peak_mib": done.peak_bytes / 2**20,
    }


def _run_warm(work: str, folder: Path, *, python: str = sys.executable) -> Figures:
    """Run a warm call of a Python library in a separate process."""
    arguments = work, str(folder / "cloud.npy")
    command = serve_command("benchmarks.peers:prepare", *arguments, python=python)
    done = run_program(command, stdin="\n")
    return _figures(json.loads(done.text.splitlines()[-1])["stages"], done)


def _run_command(preset: str, folder: Path) -> Figures:
    """Run ``torchrg segment``."""
    files = [folder / "cloud.npy", "--out", folder / f"{preset}.npz"]
    done = run_program([sys.executable, "-m", "torchrg", "segment", *files, "--preset", preset])
    return _figures({"command": done.seconds}, done)


def _run_open3d(python: str, folder: Path) -> Figures:
    """Run Open3D's planar patches from file to file."""
    done = run_program([python, "-c", OPEN3D, folder / "cloud.npy", folder / "labels.npy"])
    return _figures({"command": done.seconds}, done)


def _run_peer(program: Path, folder: Path) -> Figures:
    """Run a program that prints the seconds of its stages."""
    cloud = folder / "cloud.f32"
    # CGAL adds the point itself to its neighbors.
    command = [program, cloud, K - 1]
    if program.name == "pclrg":
        command = pcl_command(program, cloud, folder / "labels.i32")
    done = run_program(command)
    stages = re.findall(r"([a-z][a-z ]*?) (\d+\.\d+) s", done.text)
    seconds = {stage.replace("region growing", "regions"): float(value) for stage, value in stages}
    return _figures(seconds, done)


def prepare(work: str, file: str) -> Callable[[], Figures]:
    """Return a timed call of a library on a file of points, after a warm-up run."""
    import numpy as np

    points = np.load(file)
    kind, _, name = work.partition(" ")
    marks: list[tuple[str, float]] = []

    def note(stage: str) -> None:
        marks.append((stage, time.perf_counter()))

    if kind == "open3d":
        import open3d

        search = open3d.geometry.KDTreeSearchParamKNN(K)

        def run(points: np.ndarray) -> None:
            vectors = open3d.utility.Vector3dVector(points.astype(np.float64))
            cloud = open3d.geometry.PointCloud(vectors)
            note("normals")
            cloud.estimate_normals(search)
            if name == "planes":
                note("regions")
                cloud.detect_planar_patches(search_param=search)
            note("done")
    else:
        import torch

        import torchrg

        config = torchrg.load_config(name if kind == "preset" else "classic")

        def run(points: np.ndarray) -> None:
            if kind == "preset":
                cloud = torch.from_numpy(points)
                torchrg.segment_planes(cloud, config, orient="none", on_stage=note)
            else:
                note("normals")
                torchrg.estimate_normals(torch.from_numpy(points), method="pca", k=K)
                note("done")

    def timed() -> Figures:
        marks.clear()
        run(points)
        return {"stages": {stage: end - begin for (stage, begin), (_, end) in pairwise(marks)}}

    run(points[:: max(1, len(points) // WARM_UP)])
    return timed
