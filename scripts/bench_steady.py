"""Times on a machine that is not idle, on more threads and on larger clouds, as ratios in one run.

    python scripts/bench_steady.py --out steady.json
    python scripts/bench_steady.py --only consensus depth --rounds 3 --sizes 100000 1000000

Each contender runs in a process of its own that is warm, and in turn with all others: alone, twice
at once, and beside one and two processes that only count. ``depth`` is a noise-free rendered frame
of 640 x 480 pixels, ``depth-kinect`` one with a Kinect's noise, ``depth-large`` one of 1280 x 960;
the others are presets, on a made room.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import torch
from reproduction.scenes import cameras_around, render_depth
from tqdm import tqdm

import torchrg
from torchrg.batch.memory import peak_memory, reset_peak_memory

PRESETS = ("classic", "paper", "consensus")
FRAMES = {"depth": (480, "exact"), "depth-kinect": (480, "kinect"), "depth-large": (960, "exact")}
"""Rows of a frame, and the sensor that sees it."""
CONDITIONS = ("alone", "twice", "beside one", "beside two")
BUSY = [sys.executable, "-c", "while True: pass"]
NOISE = 0.003
"""Standard deviation of a made room's points, in metres."""


class Contender:
    """A process that does one kind of work whenever it is told to."""

    def __init__(self, name: str, num_points: int, threads: int) -> None:
        command = [sys.executable, __file__, "--serve", name, str(num_points), str(threads)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.wait()

    def begin(self) -> None:
        """Let it work once."""
        print(file=self._process.stdin, flush=True)

    def wait(self) -> dict[str, float]:
        """Return the seconds and the peak memory, in bytes, of what it did last."""
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("bench_steady: a contender died; its error is above.")
        result: dict[str, float] = json.loads(line)
        return result

    def run(self) -> dict[str, float]:
        """Work once, and return what :meth:`wait` does."""
        self.begin()
        return self.wait()

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


def serve(name: str, num_points: int, threads: int) -> None:
    """Be the process of a contender: work once for each line, and say how long it took."""
    torch.set_num_threads(threads)
    work = prepare(name, num_points)
    print(json.dumps({}), flush=True)
    for _ in sys.stdin:
        reset_peak_memory()
        begin = time.perf_counter()
        work()
        seconds = time.perf_counter() - begin
        print(json.dumps({"seconds": seconds, "bytes": peak_memory()}), flush=True)


def prepare(name: str, num_points: int) -> Callable[[], object]:
    """Return the work of a contender, done once already on little."""
    if name in FRAMES:
        height, sensor = FRAMES[name]
        model = torchrg.scenes.build_room(7)
        camera = cameras_around(model, 1, width=height * 4 // 3, height=height)[0]
        depth = render_depth(model, camera, sensor=sensor).depth
        intrinsics = torchrg.depth.make_intrinsics(camera.fx, camera.fy, *camera.principal_point)
        torchrg.depth.segment_depth(depth, intrinsics)
        return lambda: torchrg.depth.segment_depth(depth, intrinsics)
    config = torchrg.load_config(name)
    points = torchrg.scenes.make_room(num_points, noise=NOISE, seed=7).points
    torchrg.segment_planes(points[:: max(num_points // 5000, 1)], config)
    return lambda: torchrg.segment_planes(points, config)


def time_beside_others(name: str, rounds: int, num_points: int) -> dict[str, float]:
    """Return the median seconds under each condition."""
    threads = torch.get_num_threads()
    pair = [Contender(name, num_points, threads) for _ in range(2)]
    times: dict[str, list[float]] = {condition: [] for condition in CONDITIONS}
    for _ in tqdm(range(rounds), desc=name, leave=False, disable=None):
        times["alone"].append(pair[0].run()["seconds"])
        for contender in pair:
            contender.begin()
        times["twice"].append(max(contender.wait()["seconds"] for contender in pair))
        for number, condition in enumerate(CONDITIONS[2:], start=1):
            others = [subprocess.Popen(BUSY) for _ in range(number)]
            try:
                times[condition].append(pair[0].run()["seconds"])
            finally:
                for other in others:
                    other.kill()
                    other.wait()
    for contender in pair:
        contender.stop()
    return {condition: median(seconds) for condition, seconds in times.items()}


def time_threads(name: str, rounds: int, num_points: int, counts: list[int]) -> dict[int, float]:
    """Return the median seconds with each number of threads."""
    contenders = {count: Contender(name, num_points, count) for count in counts}
    times = [
        {count: contender.run()["seconds"] for count, contender in contenders.items()}
        for _ in tqdm(range(rounds), desc=f"{name}, threads", leave=False, disable=None)
    ]
    for contender in contenders.values():
        contender.stop()
    return {count: median(row[count] for row in times) for count in counts}


def time_sizes(name: str, rounds: int, sizes: list[int]) -> dict[int, dict[str, float]]:
    """Return microseconds and peak bytes for each point, for each number of points."""
    result = {}
    for size in tqdm(sizes, desc=f"{name}, sizes", leave=False, disable=None):
        contender = Contender(name, size, torch.get_num_threads())
        runs = [contender.run() for _ in range(rounds)]
        contender.stop()
        result[size] = {
            "us": median(run["seconds"] for run in runs) / size * 1e6,
            "bytes": max(run["bytes"] for run in runs) / size,
        }
    return result


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print a table in Markdown."""
    print(f"\n| {title} | {' | '.join(columns)} |\n| --- |{' --: |' * len(columns)}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def main() -> None:
    """Time what is asked for, print tables, and write the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="*", choices=[*FRAMES, *PRESETS])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--num-points", type=int, default=200_000, help="beside others")
    parser.add_argument("--sizes", type=int, nargs="*", default=[100_000, 1_000_000, 10_000_000])
    parser.add_argument("--size-rounds", type=int, default=1)
    parser.add_argument("--thread-points", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--out", type=Path, help="JSON file of all figures")
    parser.add_argument("--serve", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve is not None:
        name, num_points, threads = arguments.serve
        serve(name, int(num_points), int(threads))
        return
    names = arguments.only or [*FRAMES, *PRESETS]
    clouds = [name for name in names if name in PRESETS]
    figures: dict[str, dict[str, object]] = {"beside": {}, "threads": {}, "sizes": {}}

    if arguments.rounds:
        rows = []
        for name in names:
            times = time_beside_others(name, arguments.rounds, arguments.num_points)
            figures["beside"][name] = times
            alone = times["alone"]
            rows.append(
                [name, f"{alone:.2f}", *(f"{times[c] / alone:.2f}" for c in CONDITIONS[1:])]
            )
        print_table("times the time alone", ["alone, s", *CONDITIONS[1:]], rows)
    if arguments.threads:
        rows = []
        for name in names:
            seconds = time_threads(
                name, max(arguments.rounds, 1), arguments.thread_points, arguments.threads
            )
            figures["threads"][name] = seconds
            first = seconds[arguments.threads[0]]
            rows.append([name, *(f"{first / seconds[count]:.2f}" for count in arguments.threads)])
        print_table("times faster, by threads", [str(n) for n in arguments.threads], rows)
    if arguments.sizes:
        rows = []
        for name in clouds:
            costs = time_sizes(name, arguments.size_rounds, arguments.sizes)
            figures["sizes"][name] = costs
            rows.append([f"{name}, us a point", *(f"{c['us']:.1f}" for c in costs.values())])
            memory = (f"{c['bytes'] / 1e3:.2f}" for c in costs.values())
            rows.append([f"{name}, GB a million points", *memory])
        print_table("cost", [f"{size:,}" for size in arguments.sizes], rows)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
