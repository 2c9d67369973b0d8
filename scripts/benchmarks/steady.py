"""Relative times on a busy machine, on one thread, and on larger clouds.

Each contender is a separate warm process. They run in turn under several conditions: alone, two at
once, next to one or two busy processes, and on one thread. ``depth`` is a noise-free rendered frame
of 640 x 480 pixels, ``depth-kinect`` has Kinect noise, and ``depth-large`` has 1280 x 960 pixels.
The remaining contenders are presets on a synthetic room.

    python scripts/bench.py steady --out steady.json --minutes 8     # repeat until complete
    python scripts/bench.py steady --work consensus --sizes 100000 1000000 --only alone
"""

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import torch

import torchrg
from benchmarks.harness import Benchmark, Figures, Results, Worker, markdown, medians, ratio
from tests.made import build_scanned_room, cameras_around, render_depth

PRESETS = ("classic", "paper", "consensus")
FRAMES = {"depth": (480, "exact"), "depth-kinect": (480, "kinect"), "depth-large": (960, "exact")}
"""Height of a frame in pixels, and its sensor."""
BUSY = [sys.executable, "-c", "while True: pass"]
NOISE, SEED = 0.003, 7
WARM_UP = 5000
"""Approximate number of points for the warm-up run of a preset."""


@dataclass(frozen=True)
class Case(Benchmark):
    rounds: int = 5
    work: tuple[str, ...] = (*FRAMES, *PRESETS)
    """Presets and depth frames."""
    sizes: tuple[int, ...] = (200_000,)
    """Numbers of points of the room."""

    def clouds(self) -> Mapping[str, Callable[[], object]]:
        keys = [(name, size) for name in self.work for size in (self.sizes, (0,))[name in FRAMES]]
        return {
            f"{name}, {size:,} points" if size else name: partial(Workers, name, size, self.threads)
            for name, size in keys
        }

    def contenders(self) -> Mapping[str, Callable[["Workers"], Figures]]:
        return {
            "alone": lambda workers: workers.get().run() | {"points": workers.size},
            "twice": _run_both,
            "one busy process": lambda workers: _run_under_load(workers, 1),
            "two busy processes": lambda workers: _run_under_load(workers, 2),
            "one thread": lambda workers: workers.get(threads=1).run(),
        }

    def report(self, results: Results) -> str:
        """Return times relative to the time alone, and the cost per point."""
        rows = []
        for cloud, by in results.items():
            if "alone" in by:
                alone = medians(by["alone"])
                million = alone["points"] / 1e6 or None
                cost = [alone["seconds"] / million, alone["peak_gb"] / million] if million else []
                ratios = [ratio(by.get(name, []), by["alone"], "seconds") for name in CONDITIONS]
                rows.append([cloud, alone["seconds"], *ratios, *(cost or [None, None])])
        head = ["time relative to alone", "alone, s", *CONDITIONS]
        return markdown([*head, "us per point", "GB per million points"], rows)


CONDITIONS = ("twice", "one busy process", "two busy processes", "one thread")


class Workers(contextlib.ExitStack):
    """Processes with the same task, each started on first use."""

    def __init__(self, name: str, size: int, threads: int) -> None:
        super().__init__()
        self.name, self.size, self.threads = name, size, threads
        self._found: dict[tuple[int, int], Worker] = {}

    def get(self, number: int = 0, threads: int | None = None) -> Worker:
        """Return the worker with an index and a number of threads."""
        key = (number, threads or self.threads)
        if key not in self._found:
            work = "benchmarks.steady:prepare", self.name, self.size
            worker = Worker(*work, threads=key[1])
            self._found[key] = self.enter_context(worker)
        return self._found[key]


def _run_both(workers: Workers) -> Figures:
    pair = (workers.get(0), workers.get(1))
    for worker in pair:
        worker.begin()
    return max((worker.wait() for worker in pair), key=lambda figures: figures["seconds"])


def _run_under_load(workers: Workers, number: int) -> Figures:
    first = workers.get()
    with _busy(number):
        return first.run()


@contextlib.contextmanager
def _busy(number: int) -> Iterator[None]:
    """Run busy processes in the background."""
    others = [subprocess.Popen(BUSY) for _ in range(number)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def prepare(name: str, size: int) -> Callable[[], None]:
    """Return the task of a process, after a warm-up run."""
    if name in FRAMES:
        height, sensor = FRAMES[name]
        model = build_scanned_room(SEED)
        camera = cameras_around(model, 1, width=height * 4 // 3, height=height)[0]
        depth = render_depth(model, camera, sensor=sensor).depth
        segment = partial(torchrg.depth.segment_depth, depth, camera.intrinsics)
        segment()
        return lambda: segment() and None
    config = torchrg.load_config(name)
    points: torch.Tensor = torchrg.scenes.make_room(size, noise=NOISE, seed=SEED).points
    torchrg.segment_planes(points[:: max(size // WARM_UP, 1)], config, orient="none")
    return lambda: torchrg.segment_planes(points, config, orient="none") and None
