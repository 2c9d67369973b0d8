"""Run one contender on one cloud in this process, warm, and print what it took as JSON.

    python -m peers.worker torchrg-classic cloud.npy

The cloud is in memory before the clock starts, and a small part of it has been through the same
call once.
"""

import json
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

K = 50
_WARM_UP = 5000

Points = NDArray[np.float32]
Seconds = dict[str, float]


def run_torchrg(preset: str) -> Callable[[Points], Seconds]:
    """Make a run of a preset, timed by stage."""
    import torch

    import torchrg

    config = torchrg.load_config(preset)

    def run(points: Points) -> Seconds:
        marks: list[tuple[str, float]] = []
        torchrg.segment_planes(
            torch.from_numpy(points),
            config,
            on_stage=lambda stage: marks.append((stage, time.perf_counter())),
        )
        return {stage: end - begin for (stage, begin), (_, end) in pairwise(marks)}

    return run


def run_torchrg_normals() -> Callable[[Points], Seconds]:
    """Make a run of neighbours and PCA normals, in the order of the points."""
    import torch

    import torchrg

    def run(points: Points) -> Seconds:
        begin = time.perf_counter()
        torchrg.estimate_normals(torch.from_numpy(points), method="pca", k=K)
        return {"normals": time.perf_counter() - begin}

    return run


def run_open3d(*, planes: bool) -> Callable[[Points], Seconds]:
    """Make a run of Open3D's normals, then of its planar patches."""
    import open3d

    def run(points: Points) -> Seconds:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
        begin = time.perf_counter()
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(K))
        seconds = {"normals": time.perf_counter() - begin}
        if planes:
            begin = time.perf_counter()
            cloud.detect_planar_patches(search_param=open3d.geometry.KDTreeSearchParamKNN(K))
            seconds["regions"] = time.perf_counter() - begin
        return seconds

    return run


CONTENDERS: dict[str, Callable[[], Callable[[Points], Seconds]]] = {
    "torchrg-classic": lambda: run_torchrg("classic"),
    "torchrg-paper": lambda: run_torchrg("paper"),
    "torchrg-consensus": lambda: run_torchrg("consensus"),
    "torchrg-pca": run_torchrg_normals,
    "open3d-pca": lambda: run_open3d(planes=False),
    "open3d-planes": lambda: run_open3d(planes=True),
}
"""What runs in a Python process, by name."""


def main(contender: str, file: str) -> None:
    """Run a contender on a file of points."""
    run = CONTENDERS[contender]()
    points = np.load(Path(file))
    run(points[:: max(1, len(points) // _WARM_UP)])
    print(json.dumps(run(points)))


if __name__ == "__main__":
    main(*sys.argv[1:])
