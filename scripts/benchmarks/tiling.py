"""Clouds in tiles against clouds in memory: time, peak of resident memory, disk, same result.

Each run is a process of its own. The cloud is a building: made rooms of a million points each, in
rows, written to a file in the working directory once. The peak is that of all processes together,
the largest of those of the stages.

    python scripts/bench.py tiling --points 1000000 --tile-size 100000
    python scripts/bench.py tiling --points 10000000 --limit-memory 3 --presets classic
    python scripts/bench.py tiling --points 50000000 --limit-memory 6 --only "classic tiles"
"""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import Benchmark, Figures, Worker
from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.batch.tiles import choose_tile_size, choose_workers, segmented_in_tiles
from torchrg.config import load_config
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room
from torchrg.structures import Cloud, Segmentation

ROOM_POINTS = 1_000_000
ROOM_METRES = 20.0
"""Distance from room to room."""
READ_AT_ONCE = 1_000_000
"""Points of a chunk of the file."""
RESULTS = ("labels", "normals", "curvature", "sharp", "valid")


@dataclass(frozen=True)
class Case(Benchmark):
    points: int = 1_000_000
    presets: tuple[str, ...] = ("classic",)
    limit_memory: float = 3.0
    """Gigabytes."""
    tile_size: int | None = None
    """Points. Default: by the limit of memory."""
    work: Path = Path("build/bench_tiling")
    """Folder of buildings, results in memory, and tiles."""

    def clouds(self) -> Mapping[str, Callable[[], str]]:
        return {f"{self.points:,} points": self._building}

    def contenders(self) -> Mapping[str, Callable[[str], Figures]]:
        return {
            f"{preset} {mode}": partial(self._run, mode, preset)
            for preset in self.presets
            for mode in ("memory", "tiles")
        }

    def _run(self, mode: str, preset: str, path: str) -> Figures:
        settings = [self.tile_size, self.limit_memory] if mode == "tiles" else []
        target = f"benchmarks.tiling:prepare_{mode}"
        with Worker(target, path, preset, *settings, threads=self.threads) as worker:
            taken = worker.run()
        return taken | {f"us_{k}": 1e6 * taken[k] / self.points for k in ("seconds", "cpu")}

    def _building(self) -> str:
        """Return the file with the points of as many rooms as they fill."""
        self.work.mkdir(parents=True, exist_ok=True)
        path = self.work / f"building_{self.points}.npy"
        if path.exists():
            return str(path)
        beside = path.with_suffix(".part.npy")
        shape = (self.points, 3)
        points = np.lib.format.open_memmap(beside, mode="w+", dtype=np.float32, shape=shape)
        width = int(np.ceil((self.points / ROOM_POINTS) ** 0.5))
        for number, start in enumerate(range(0, self.points, ROOM_POINTS)):
            count = min(ROOM_POINTS, self.points - start)
            place = np.array([number % width, number // width, 0], dtype=np.float32) * ROOM_METRES
            points[start : start + count] = make_room(count, seed=number).points.numpy() + place
            points.flush()
        return str(beside.replace(path))


def _result_folder(path: Path, preset: str) -> Path:
    """Return where the result in memory is kept."""
    return path.with_name(f"{preset}_{path.stem}")


def prepare_memory(file: str, preset: str) -> Callable[[], Figures]:
    """Return what segments in memory, and keeps the result."""
    path = Path(file)

    def work() -> Figures:
        begin = time.perf_counter()
        seg = segment_planes(Cloud(np.load(path)).points, load_config(preset))
        taken = {"seconds": time.perf_counter() - begin, "peak_gb": peak_memory() / 1e9}
        result = _result_folder(path, preset)
        result.mkdir(exist_ok=True)
        for name, values in _values_of(seg).items():
            np.save(result / f"{name}.npy", values.numpy())
        return taken | {"planes": len(seg.planes.count)}

    return work


def prepare_tiles(
    file: str, preset: str, tile_size: int | None, limit_memory: float
) -> Callable[[], Figures]:
    """Return what segments in tiles, stage by stage, and compares with the result in memory."""
    path, limit = Path(file), int(limit_memory * 1e9)
    num_points = len(np.load(path, mmap_mode="r"))
    tile_size = tile_size or choose_tile_size(num_points, limit)
    folder = path.with_name("tiles")

    def work() -> Figures:
        peaks: dict[str, float] = {}
        seconds: dict[str, float] = {}
        disk, now = 0, ["", time.perf_counter()]

        def note(stage: str, done: int, of: int) -> None:
            nonlocal disk
            if now[0]:
                workers = sum(peak_memory(worker.pid) for worker in active_children())
                peaks[now[0]] = max(peaks.get(now[0], 0.0), (peak_memory() + workers) / 1e9)
                seconds[now[0]] = seconds.get(now[0], 0.0) + time.perf_counter() - now[1]
            disk = max(disk, sum(file.stat().st_blocks * 512 for file in folder.glob("*")))
            now[0], now[1] = stage, time.perf_counter()
            print(f"  {stage} {done}/{of}", file=sys.stderr)
            reset_peak_memory()

        begin = time.perf_counter()
        with segmented_in_tiles(
            [path],
            _read_chunks(path),
            folder,
            load_config(preset),
            tile_size=tile_size,
            workers=choose_workers(num_points, tile_size, limit),
            on_stage=note,
        ) as seg:
            taken: Figures = {"seconds": time.perf_counter() - begin}
            note("", 1, 1)
            taken |= {"peak_gb": max(peaks.values()), "disk_gb": disk / 1e9}
            taken |= {"tile_size": tile_size, "planes": len(seg.planes.count)}
            taken |= {"differs": _differences(seg, _result_folder(path, preset))}
            return taken | {"peaks": peaks, "stages": seconds}

    return work


def _differences(seg: Segmentation, result: Path) -> str:
    """Return the names of the arrays that differ from the result in memory."""
    if not result.exists():
        return "unknown"
    names = [
        name
        for name, values in _values_of(seg).items()
        if not np.array_equal(values.numpy(), np.load(result / f"{name}.npy", mmap_mode="r"))
    ]
    return ", ".join(names) or "nowhere"


def _read_chunks(path: Path) -> Iterator[Cloud]:
    """Read a building in chunks."""
    for start in range(0, len(np.load(path, mmap_mode="r")), READ_AT_ONCE):
        yield Cloud(np.array(np.load(path, mmap_mode="r")[start : start + READ_AT_ONCE]))


def _values_of(seg: Segmentation) -> dict[str, torch.Tensor]:
    """Return all tensors of a segmentation by name."""
    planes = {k: v for k, v in seg.planes._asdict().items() if isinstance(v, torch.Tensor)}
    meetings = {f"adjacency_{k}": v for k, v in seg.planes.adjacency._asdict().items()}
    return {name: getattr(seg, name) for name in RESULTS} | planes | meetings
