"""Clouds whose large arrays are on a disk, against memory: time, peak of memory, same result.

Each run is a process of its own. The cloud is a building: made rooms of a million points each, in
rows, written to a file in the working directory once.

    python scripts/bench.py disk --points 4000000 --presets classic consensus
    python scripts/bench.py disk --points 50000000 --only "classic disk"
"""

import hashlib
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import Benchmark, Figures, Worker
from torchrg import scratch
from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.config import load_config
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room
from torchrg.structures import Cloud, Segmentation

ROOM_POINTS = 1_000_000
ROOM_METRES = 20.0
"""Distance from room to room."""


@dataclass(frozen=True)
class Case(Benchmark):
    points: int = 1_000_000
    presets: tuple[str, ...] = ("classic",)
    work: Path = Path("build/bench_disk")
    """Folder of buildings, and of the arrays on the disk."""

    def clouds(self) -> Mapping[str, Callable[[], str]]:
        return {f"{self.points:,} points": self._building}

    def contenders(self) -> Mapping[str, Callable[[str], Figures]]:
        return {
            f"{preset} {place}": partial(self._run, place, preset)
            for preset in self.presets
            for place in ("memory", "disk")
        }

    def _run(self, place: str, preset: str, path: str) -> Figures:
        with Worker("benchmarks.disk:prepare", path, preset, place, threads=self.threads) as worker:
            taken = worker.run()
        return taken | {f"us_{k}": 1e6 * taken[k] / self.points for k in ("seconds", "cpu")}

    def _building(self) -> str:
        """Return the file with the points of as many rooms as they fill."""
        self.work.mkdir(parents=True, exist_ok=True)
        path = self.work / f"building_{self.points}.npy"
        if not path.exists():
            width = int(np.ceil((self.points / ROOM_POINTS) ** 0.5))
            rooms = [
                make_room(min(ROOM_POINTS, self.points - start), seed=number).points.numpy()
                + np.float32([number % width * ROOM_METRES, number // width * ROOM_METRES, 0])
                for number, start in enumerate(range(0, self.points, ROOM_POINTS))
            ]
            np.save(path, np.concatenate(rooms))
        return str(path)


def prepare(file: str, preset: str, place: str) -> Callable[[], Figures]:
    """Return what segments a building, stage by stage."""
    path, config = Path(file), load_config(preset)

    def work() -> Figures:
        peaks: dict[str, float] = {}
        now = ["read"]

        def note(stage: str) -> None:
            peaks[now[0]] = peak_memory() / 1e9
            now[0] = stage
            reset_peak_memory()

        reset_peak_memory()
        begin = time.perf_counter()
        with scratch.on_disk(path.parent) if place == "disk" else nullcontext():
            seg = segment_planes(Cloud(np.load(path)).points, config, on_stage=note)
        seconds = time.perf_counter() - begin
        return {
            "seconds": seconds,
            "peak_gb": max(peaks.values()),
            "planes": len(seg.planes.count),
            "digest": digest(seg),
            "peaks": peaks,
        }

    return work


def digest(seg: Segmentation) -> str:
    """Return what tells results apart that differ in a bit."""
    found = hashlib.sha256()
    for values in (*seg[:5], *seg.planes[:10], *seg.planes.adjacency):
        found.update(values.contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return found.hexdigest()[:12]
