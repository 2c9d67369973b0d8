"""Clouds in tiles against clouds in memory: time, peak of resident memory, disk, same result.

Each run is a process of its own. The cloud is a building: made rooms of a million points each, in
rows, written to a file in the working directory once.

    python scripts/bench_tiling.py --points 1e6 --preset classic paper consensus --tile-size 1e5
    python scripts/bench_tiling.py --points 1e7 --limit-memory 3
    python scripts/bench_tiling.py --points 5e7 --limit-memory 6 --no-memory
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import torch

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
RESULTS = ("labels", "normals", "curvature", "sharp", "valid")


def make_building(path: Path, num_points: int) -> None:
    """Write the points of as many rooms as they fill."""
    beside = path.with_suffix(".part.npy")
    shape = (num_points, 3)
    points = np.lib.format.open_memmap(beside, mode="w+", dtype=np.float32, shape=shape)
    width = int(np.ceil((num_points / ROOM_POINTS) ** 0.5))
    for number, start in enumerate(range(0, num_points, ROOM_POINTS)):
        count = min(ROOM_POINTS, num_points - start)
        place = np.array([number % width, number // width, 0], dtype=np.float32) * ROOM_METRES
        points[start : start + count] = make_room(count, seed=number).points.numpy() + place
        points.flush()
    beside.replace(path)


def read_chunks(path: Path) -> Iterator[Cloud]:
    """Read a building in chunks."""
    for start in range(0, len(np.load(path, mmap_mode="r")), READ_AT_ONCE):
        yield Cloud(np.array(np.load(path, mmap_mode="r")[start : start + READ_AT_ONCE]))


def values_of(seg: Segmentation) -> dict[str, torch.Tensor]:
    """Return all tensors of a segmentation by name."""
    planes = {k: v for k, v in seg.planes._asdict().items() if isinstance(v, torch.Tensor)}
    meetings = {f"adjacency_{k}": v for k, v in seg.planes.adjacency._asdict().items()}
    return {name: getattr(seg, name) for name in RESULTS} | planes | meetings


def run_in_memory(path: Path, preset: str, result: Path) -> dict[str, object]:
    """Segment in memory, keep the result, and return what it took."""
    begin = time.perf_counter()
    seg = segment_planes(Cloud(np.load(path)).points, load_config(preset))
    taken = {
        "seconds": time.perf_counter() - begin,
        "cpu": cpu_seconds(),
        "peak_gb": peak_memory() / 1e9,
    }
    result.mkdir(exist_ok=True)
    for name, values in values_of(seg).items():
        np.save(result / f"{name}.npy", values.numpy())
    return taken | {"planes": len(seg.planes.count)}


def run_in_tiles(
    path: Path, preset: str, result: Path, work: Path, tile_size: int, memory_limit: int
) -> dict[str, object]:
    """Segment in tiles, compare, and return what it took, stage by stage."""
    peaks: dict[str, float] = {}
    seconds: dict[str, float] = {}
    disk, now = 0, ["", time.perf_counter()]

    def note(stage: str, done: int, of: int) -> None:
        nonlocal disk
        if now[0]:
            workers = sum(peak_memory(worker.pid) for worker in active_children())
            peaks[now[0]] = max(peaks.get(now[0], 0.0), (peak_memory() + workers) / 1e9)
            seconds[now[0]] = seconds.get(now[0], 0.0) + time.perf_counter() - now[1]
        disk = max(disk, sum(file.stat().st_blocks * 512 for file in work.glob("*")))
        now[0], now[1] = stage, time.perf_counter()
        print(f"  {stage} {done}/{of}", file=sys.stderr)
        reset_peak_memory()

    begin = time.perf_counter()
    num_points = len(np.load(path, mmap_mode="r"))
    with segmented_in_tiles(
        [path],
        read_chunks(path),
        work,
        load_config(preset),
        tile_size=tile_size,
        workers=choose_workers(num_points, tile_size, memory_limit),
        on_stage=note,
    ) as seg:
        taken = {"seconds": time.perf_counter() - begin, "cpu": cpu_seconds()}
        note("", 1, 1)
        taken |= {"peak_gb": max(peaks.values()), "disk_gb": disk / 1e9, "tile_size": tile_size}
        taken |= {"planes": len(seg.planes.count), "peaks": peaks, "stages": seconds}
        if result.exists():
            found = values_of(seg)
            taken["differ"] = [
                name
                for name, values in found.items()
                if not np.array_equal(
                    values.numpy(), np.load(result / f"{name}.npy", mmap_mode="r")
                )
            ]
    return taken


def cpu_seconds() -> float:
    """Return the CPU time of this process and of those it has waited for."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def main() -> None:
    """Run each preset in memory and in tiles, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--points", type=float, default=1e6)
    parser.add_argument("--preset", nargs="+", default=["classic"])
    parser.add_argument("--limit-memory", type=float, default=3.0, help="gigabytes")
    parser.add_argument("--tile-size", type=float, help="points; default: by --limit-memory")
    parser.add_argument("--no-memory", action="store_true", help="tiles only")
    parser.add_argument("--work", type=Path, default=Path("build/bench_tiling"))
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    given = parser.parse_args()
    num_points = int(given.points)
    given.work.mkdir(parents=True, exist_ok=True)
    path = given.work / f"building_{num_points}.npy"
    if not path.exists():
        make_building(path, num_points)
    if given.serve:
        preset = given.preset[0]
        result = given.work / f"{preset}_{num_points}"
        size = given.tile_size
        limit = int(given.limit_memory * 1e9)
        size = choose_tile_size(num_points, limit) if not size else int(size)
        if given.serve == "memory":
            taken = run_in_memory(path, preset, result)
        else:
            taken = run_in_tiles(path, preset, result, given.work / "tiles", size, limit)
        print(json.dumps(taken))
        return
    for preset in given.preset:
        for mode in ["tiles"] if given.no_memory else ["memory", "tiles"]:
            arguments = [arg for arg in sys.argv[1:] if arg not in given.preset]
            arguments = [arg for arg in arguments if arg != "--preset"]
            command = [sys.executable, __file__, *arguments, "--preset", preset, "--serve", mode]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            taken = json.loads(done.stdout)
            rate = taken["seconds"] / num_points * 1e6
            same = ""
            if "differ" in taken:
                same = f", differs: {taken['differ']}" if taken["differ"] else ", identical"
            disk = f", {taken['disk_gb']:.1f} GB of disk" if "disk_gb" in taken else ""
            print(
                f"{preset} {mode}: {num_points:,} points, {taken['planes']:,} planes, "
                f"{rate:.2f} us a point ({taken['cpu'] / num_points * 1e6:.2f} of CPU), peak "
                f"{taken['peak_gb']:.2f} GB{disk}{same}"
            )
            for stage, peak in taken.get("peaks", {}).items():
                print(f"    {stage}: {taken['stages'][stage]:.1f} s, peak {peak:.2f} GB")


if __name__ == "__main__":
    main()
