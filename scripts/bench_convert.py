"""Time ``torchrg convert s3dis`` on a made S3DIS: workers, stages, memory, and equal bytes.

Makes a tree of rooms in the raw layout of S3DIS (100,000 to 1,000,000 points, geometrically), and
converts it with one worker, with two, and on Ray. Prints points a second, of the whole and of each
stage, what S3DIS with its 273 million points would take, the peak memory of a worker against 2 GB +
1.2 GB per million points, and whether all runs wrote the same bytes. ``--json`` keeps the figures.

Examples:
    python scripts/bench_convert.py
    python scripts/bench_convert.py --rooms 6 --smallest 20000 --largest 50000 --runs 1 2
    python scripts/bench_convert.py --folder /data/made --json figures.json
"""

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes import make_room

S3DIS_POINTS = 273_000_000
CLASSES = ("wall", "table", "chair", "bookcase", "board", "door", "window", "clutter")
PROMISED_BASE, PROMISED_PER_POINT = 2e9, 1200.0


def make_tree(root: Path, sizes: NDArray[np.int64], noise: float) -> None:
    """Write rooms as ``Area_i/room_j/Annotations/*.txt``; what is there already is kept."""
    for index, num_points in enumerate(sizes):
        room = root / f"Area_{index % 6 + 1}" / f"room_{index + 1}"
        if (room / "done").exists():
            continue
        (room / "Annotations").mkdir(parents=True, exist_ok=True)
        made = make_room(num_points=int(num_points), noise=noise, seed=index)
        points, labels = np.asarray(made.points), np.asarray(made.labels)
        order = np.argsort(labels, kind="stable")
        bounds = np.searchsorted(labels[order], np.unique(labels)[1:])
        colors = np.random.default_rng(index).integers(0, 256, (len(points), 3))
        for face, rows in enumerate(np.split(order, bounds)):
            name = f"{CLASSES[face % len(CLASSES)]}_{face + 1}.txt"
            table = np.hstack([points[rows], colors[rows]])
            np.savetxt(room / "Annotations" / name, table, fmt="%.3f %.3f %.3f %d %d %d")
        (room / "done").touch()


def convert(root: Path, out: Path, run: str, preset: str) -> dict[str, Any]:
    """Convert the tree and return the report; ``run`` is ``ray`` or a number of workers."""
    options = ["--engine", "ray", "--workers", "2"] if run == "ray" else ["--workers", run]
    command = [sys.executable, "-m", "torchrg", "convert", "s3dis", str(root), str(out)]
    environment = os.environ | {"PYTHONWARNINGS": "ignore"}
    begin = time.perf_counter()
    subprocess.run(
        [*command, "--preset", preset, "--force", *options],
        check=True,
        env=environment,
        stdout=subprocess.DEVNULL,
    )
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    return report | {"command_seconds": time.perf_counter() - begin}


def digest(out: Path) -> str:
    """Return a hash over all results, the records among them."""
    total = hashlib.sha256()
    for path in sorted(out.rglob("*.*")):
        if path.name not in ("report.json", ".torchrg.lock"):
            total.update(str(path.relative_to(out)).encode() + path.read_bytes())
    return total.hexdigest()


def print_run(run: str, report: dict[str, Any]) -> None:
    """Print the figures of a run."""
    rate = report["points_per_second"]
    print(f"{run if run == 'ray' else run + ' worker(s)'}: {report['points']:,} points in")
    print(f"  {report['seconds']:8.1f} s ({report['command_seconds']:.1f} s with start and checks)")
    print(f"  {rate:8,.0f} points a second; S3DIS: {S3DIS_POINTS / rate / 60:.0f} minutes")
    for stage, stage_rate in report["points_per_second_of_a_worker"].items():
        share = report["stage_seconds"][stage] / sum(report["stage_seconds"].values())
        print(f"    {stage:<10}{stage_rate:12,.0f} points a second of a worker, {share:6.1%}")
    nearest = max(report["scans"], key=share_of_promise)
    print(
        f"    memory: {report['peak_memory'] / 1e9:.2f} GB at most; at least "
        f"{1 - share_of_promise(nearest):.0%} below what is promised ({nearest['name']}, "
        f"{nearest['num_points']:,} points: {nearest['peak_memory'] / 1e9:.2f} GB)"
    )


def share_of_promise(scan: dict[str, Any]) -> float:
    """Return the peak memory of a scan as a share of what is promised."""
    promised = PROMISED_BASE + PROMISED_PER_POINT * scan["num_points"]
    return float(scan["peak_memory"] / promised)


def main() -> int:
    """Make the tree, convert it in every way asked for, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--smallest", type=int, default=100_000, help="points of the first room")
    parser.add_argument("--largest", type=int, default=1_000_000, help="points of the last room")
    parser.add_argument("--noise", type=float, default=0.003, help="metres")
    parser.add_argument("--preset", default="consensus")
    parser.add_argument("--runs", nargs="+", default=["1", "2", "ray"], help="workers, or ray")
    parser.add_argument("--folder", type=Path, help="keeps the tree and the results")
    parser.add_argument("--json", type=Path, help="file for all reports")
    arguments = parser.parse_args()
    sizes = np.geomspace(arguments.smallest, arguments.largest, arguments.rooms).astype(np.int64)
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        make_tree(folder / "raw", sizes, arguments.noise)
        reports, digests = {}, set()
        for run in arguments.runs:
            reports[run] = convert(folder / "raw", folder / run, run, arguments.preset)
            digests.add(digest(folder / run))
            print_run(run, reports[run])
    if {"1", "2"} <= reports.keys():
        gain = reports["1"]["seconds"] / reports["2"]["seconds"]
        print(f"2 workers: {gain:.2f} times the throughput of 1")
    print("all runs wrote the same bytes" if len(digests) == 1 else "RUNS WROTE DIFFERENT BYTES")
    if arguments.json:
        machine = {"machine": platform.platform(), "cores": os.cpu_count()}
        arguments.json.write_text(json.dumps(machine | {"runs": reports}, indent=1))
    return 0 if len(digests) == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
