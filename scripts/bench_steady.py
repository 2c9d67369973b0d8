"""Times on a machine that is not idle, on more threads and on larger clouds, as ratios in one run.

    python scripts/bench_steady.py --out steady.json --minutes 8     # again, until nothing is left
    python scripts/bench_steady.py --only consensus depth --rounds 3 --sizes 100000 1000000

What the file of ``--out`` has is not measured again; tables are of all that it has.
Each contender runs in a process of its own that is warm, and in turn with all others: alone, twice
at once, and beside one and two processes that only count. ``depth`` is a noise-free rendered frame
of 640 x 480 pixels, ``depth-kinect`` one with a Kinect's noise, ``depth-large`` one of 1280 x 960;
the others are presets, on a made room.
"""

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median

import torch
from tqdm import tqdm

import torchrg
from tests.made import cameras_around, render_depth
from torchrg.batch.memory import peak_memory, reset_peak_memory

PRESETS = ("classic", "paper", "consensus")
FRAMES = {"depth": (480, "exact"), "depth-kinect": (480, "kinect"), "depth-large": (960, "exact")}
"""Rows of a frame, and the sensor that sees it."""
CONDITIONS = ("alone", "twice", "beside one", "beside two")
PARTS = ("beside", "threads", "sizes")
BUSY = [sys.executable, "-c", "while True: pass"]
NOISE = 0.003
"""Standard deviation of a made room's points, in metres."""


Key = tuple[str, str, int]
"""Part, contender, number of points."""
Measurement = Callable[[], dict[str, float]]


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
    for _ in tqdm(range(rounds), desc=f"{name}, beside others", leave=False, disable=None):
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


def time_threads(
    name: str, rounds: int, num_points: int, counts: Sequence[int]
) -> dict[str, float]:
    """Return the median seconds with each number of threads."""
    contenders = {count: Contender(name, num_points, count) for count in counts}
    times = [
        {count: contender.run()["seconds"] for count, contender in contenders.items()}
        for _ in tqdm(range(rounds), desc=f"{name}, threads", leave=False, disable=None)
    ]
    for contender in contenders.values():
        contender.stop()
    return {str(count): median(row[count] for row in times) for count in counts}


def time_size(name: str, rounds: int, num_points: int) -> dict[str, float]:
    """Return microseconds and peak bytes for each point of a cloud."""
    contender = Contender(name, num_points, torch.get_num_threads())
    description = f"{name}, {num_points:,} points"
    runs = [
        contender.run() for _ in tqdm(range(rounds), desc=description, leave=False, disable=None)
    ]
    contender.stop()
    return {
        "us": median(run["seconds"] for run in runs) / num_points * 1e6,
        "bytes": max(run["bytes"] for run in runs) / num_points,
    }


def list_measurements(arguments: argparse.Namespace) -> dict[Key, Measurement]:
    """Return what is asked for, by part, contender and number of points, which frames have not."""
    found: dict[Key, Measurement] = {}
    names = arguments.only or [*FRAMES, *PRESETS]
    for name in names if arguments.rounds else []:
        beside, threads = (
            0 if name in FRAMES else number
            for number in (arguments.num_points, arguments.thread_points)
        )
        found["beside", name, beside] = partial(time_beside_others, name, arguments.rounds, beside)
        if arguments.threads:
            found["threads", name, threads] = partial(
                time_threads, name, arguments.rounds, threads, arguments.threads
            )
    for size in arguments.sizes:
        for name in names:
            if name in PRESETS:
                found["sizes", name, size] = partial(time_size, name, arguments.size_rounds, size)
    return found


def print_tables(figures: Mapping[Key, Mapping[str, float]]) -> None:
    """Print in Markdown what was measured."""
    parts = {part: {key: v for key, v in figures.items() if key[0] == part} for part in PARTS}
    print_table(
        "times the time alone",
        ["alone, s", *CONDITIONS[1:]],
        {
            _title(name, size): [
                f"{times['alone']:.2f}",
                *(f"{times[condition] / times['alone']:.2f}" for condition in CONDITIONS[1:]),
            ]
            for (_, name, size), times in parts["beside"].items()
        },
    )
    print_table(
        "times faster, by threads",
        list(dict.fromkeys(count for times in parts["threads"].values() for count in times)),
        {
            _title(name, size): [f"{next(iter(times.values())) / t:.2f}" for t in times.values()]
            for (_, name, size), times in parts["threads"].items()
        },
    )
    print_table(
        "cost by size",
        ["us a point", "GB a million points"],
        {
            _title(name, size): [f"{cost['us']:.1f}", f"{cost['bytes'] / 1e3:.2f}"]
            for (_, name, size), cost in sorted(parts["sizes"].items())
        },
    )


def _title(name: str, num_points: int) -> str:
    return f"{name}, {num_points:,} points" if num_points else name


def print_table(title: str, columns: list[str], rows: Mapping[str, list[str]]) -> None:
    """Print a table, if it has rows."""
    if rows:
        print(f"\n| {title} | {' | '.join(columns)} |\n| --- |{' --: |' * len(columns)}")
    for name, cells in rows.items():
        print(f"| {name} | {' | '.join(cells)} |")


def load_figures(path: Path | None) -> dict[Key, dict[str, float]]:
    """Return what was measured before."""
    if path is None or not path.exists():
        return {}
    rows = json.loads(path.read_text())
    return {(row["part"], row["name"], row["points"]): row["figures"] for row in rows}


def save_figures(path: Path, figures: Mapping[Key, Mapping[str, float]]) -> None:
    """Write what was measured so far."""
    rows = [
        {"part": part, "name": name, "points": size, "figures": values}
        for (part, name, size), values in figures.items()
    ]
    path.write_text(json.dumps(rows, indent=1))


def main() -> None:
    """Time what is asked for and not known yet, print tables, and write the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="*", choices=[*FRAMES, *PRESETS])
    parser.add_argument("--rounds", type=int, default=5, help="0: sizes alone")
    parser.add_argument("--num-points", type=int, default=200_000, help="beside others")
    parser.add_argument("--sizes", type=int, nargs="*", default=[100_000, 1_000_000, 10_000_000])
    parser.add_argument("--size-rounds", type=int, default=1)
    parser.add_argument("--thread-points", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--minutes", type=float, help="begin nothing after so many")
    parser.add_argument("--out", type=Path, help="JSON file of all figures, to go on from")
    parser.add_argument("--serve", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve is not None:
        name, num_points, threads = arguments.serve
        serve(name, int(num_points), int(threads))
        return
    begin, figures = time.perf_counter(), load_figures(arguments.out)
    wanted = list_measurements(arguments)
    left = [key for key in wanted if key not in figures]
    bar = tqdm(total=len(wanted), initial=len(wanted) - len(left), disable=None)
    for key in left:
        is_late = time.perf_counter() - begin > 60 * (arguments.minutes or math.inf)
        if is_late:
            break
        figures[key] = wanted[key]()
        bar.update()
        if arguments.out is not None:
            save_figures(arguments.out, figures)
    bar.close()
    print_tables(figures)
    num_left = sum(key not in figures for key in wanted)
    if num_left:
        print(f"\n{num_left} of {len(wanted)} measurements are left: run it again.")


if __name__ == "__main__":
    main()
