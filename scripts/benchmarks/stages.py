"""Seconds and memory of each stage of a preset, on a made room or a scan.

python scripts/bench.py stages --only paper --size 1000000
python scripts/bench.py stages --scan scan.pcd --threads 2
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

from torch import Tensor

import torchrg
from benchmarks.harness import Benchmark, Figures, Results, markdown, medians
from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.config import preset_names

WARM_UP = 5000
"""Points that a preset segments before it is timed."""


@dataclass(frozen=True)
class Case(Benchmark):
    """Profile the stages of presets."""

    only: tuple[str, ...] = ("classic", "paper", "consensus")
    scan: Path | None = None
    """Default: a made room."""
    size: int = 1_000_000
    """Points of the room."""

    def clouds(self) -> Mapping[str, Callable[[], Tensor]]:
        """Return the scan or the room."""
        if self.scan is not None:
            return {self.scan.stem: lambda: torchrg.read_cloud(self.scan).points}
        name = f"room, {self.size:,} points"
        return {name: lambda: torchrg.scenes.make_room(self.size, 0.003, 7).points}

    def contenders(self) -> Mapping[str, Callable[[Tensor], Figures]]:
        """Return all presets."""
        return {name: partial(_profile, name) for name in preset_names()}

    def report(self, results: Results) -> str:
        """Return a row for each stage."""
        rows = [
            [cloud, preset, stage, seconds, found["us"][stage], found["peak_gb"][stage]]
            for cloud, by in results.items()
            for preset, runs in by.items()
            for found in [medians(runs)]
            for stage, seconds in found["seconds"].items()
        ]
        return markdown(["cloud", "preset", "stage", "seconds", "us a point", "peak GB"], rows)


def _profile(preset: str, points: Tensor) -> Figures:
    config, marks = torchrg.load_config(preset), []
    torchrg.segment_planes(points[:WARM_UP], config)

    def note(stage: str) -> None:
        marks.append((stage, time.perf_counter(), peak_memory() / 1e9))
        reset_peak_memory()

    seg = torchrg.segment_planes(points, config, on_stage=note)
    seconds = {stage: end - begin for (stage, begin, _), (_, end, _) in pairwise(marks)}
    return {
        "sharp": float(seg.sharp.float().mean()),
        "seconds": seconds,
        "us": {stage: 1e6 * value / len(points) for stage, value in seconds.items()},
        "peak_gb": {stage: peak for (stage, _, _), (_, _, peak) in pairwise(marks)},
    }
