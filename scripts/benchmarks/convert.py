"""``torchrg convert s3dis`` on synthetic rooms: speed, memory, and byte-identical results.

Writes rooms in the raw layout of S3DIS (100,000 to 1,000,000 points in a geometric sequence), and
converts them with one worker, two workers, and Ray. Reports points per second, in total and per
worker, the time extrapolated to the 273 million points of S3DIS, the peak memory of a worker
relative to 2 GB + 1.2 GB per million points, and whether all runs are byte-identical.

    python scripts/bench.py convert
    python scripts/bench.py convert --rooms 6 --smallest 20000 --largest 50000 --only 1 2
    python scripts/bench.py convert --folder /data/made --out figures.json
"""

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.harness import Benchmark, Figures, Results, table
from torchrg.scenes import make_room

S3DIS_POINTS = 273_000_000
CLASSES = ("wall", "table", "chair", "bookcase", "board", "door", "window", "clutter")
REPORTED = ("points", "seconds", "points_per_second", "points_per_second_of_a_worker")
"""Fields of ``report.json``."""
MAX_BYTES, MAX_BYTES_PER_POINT = 2e9, 1200.0
"""Maximum memory of a worker: constant and per point, in bytes."""


@dataclass(frozen=True)
class Case(Benchmark):
    rooms: int = 24
    smallest: int = 100_000
    """Number of points of the first room."""
    largest: int = 1_000_000
    """Number of points of the last room."""
    noise: float = 0.003
    """Standard deviation in meters."""
    preset: str = "consensus"
    folder: Path | None = None
    """Folder that keeps the rooms and the results. Default: a temporary folder."""

    def clouds(self) -> Mapping[str, Callable[[], object]]:
        return {f"{self.rooms} rooms, {self.preset}": self._make_tree}

    def contenders(self) -> Mapping[str, Callable[[Path], Figures]]:
        return {
            "1": partial(self._convert, ["--workers", "1"]),
            "2": partial(self._convert, ["--workers", "2"]),
            "ray": partial(self._convert, ["--engine", "ray", "--workers", "2"]),
        }

    def report(self, results: Results) -> str:
        """Return a table.

        Raises:
            SystemExit: If the runs are not byte-identical.
        """
        runs = [figures for by in results.values() for rows in by.values() for figures in rows]
        if len({figures["sha256"] for figures in runs}) > 1:
            raise SystemExit(f"{table(results)}\nRUNS WROTE DIFFERENT BYTES")
        return f"{table(results)}\n\nall runs are byte-identical"

    @contextlib.contextmanager
    def _make_tree(self) -> Iterator[Path]:
        """Write rooms as ``Area_i/room_j/Annotations/*.txt``; complete rooms are reused."""
        sizes = np.geomspace(self.smallest, self.largest, self.rooms).astype(int)
        with tempfile.TemporaryDirectory() as temporary:
            folder = self.folder or Path(temporary)
            for index, num_points in enumerate(sizes):
                room = folder / "raw" / f"Area_{index % 6 + 1}" / f"room_{index + 1}"
                if not (room / "done").exists():
                    _write_room(room / "Annotations", index, int(num_points), self.noise)
                    (room / "done").touch()
            yield folder

    def _convert(self, options: list[str], folder: Path) -> Figures:
        """Convert the rooms and return figures of the report."""
        out = folder / options[-1] if "ray" not in options else folder / "ray"
        command = [sys.executable, "-m", "torchrg", "convert", "s3dis", folder / "raw", out]
        begin = time.perf_counter()
        subprocess.run(
            [*map(str, command), "--preset", self.preset, "--force", *options],
            check=True,
            env=os.environ | {"PYTHONWARNINGS": "ignore"},
            stdout=subprocess.DEVNULL,
        )
        seconds = time.perf_counter() - begin
        report = json.loads((out / "report.json").read_text())
        limits = [MAX_BYTES + MAX_BYTES_PER_POINT * scan["num_points"] for scan in report["scans"]]
        fractions = [s["peak_memory"] / p for s, p in zip(report["scans"], limits, strict=True)]
        return {
            **{name: report[name] for name in REPORTED},
            "with start-up and checks": seconds,
            "minutes for S3DIS": S3DIS_POINTS / report["points_per_second"] / 60,
            "GB": report["peak_memory"] / 1e9,
            "fraction of maximum": max(fractions),
            "sha256": _digest(out),
        }


def _write_room(folder: Path, seed: int, num_points: int, noise: float) -> None:
    """Write each surface of a room as an object."""
    folder.mkdir(parents=True, exist_ok=True)
    made = make_room(num_points=num_points, noise=noise, seed=seed)
    points, labels = np.asarray(made.points), np.asarray(made.labels)
    order = np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels[order], np.unique(labels)[1:])
    colors = np.random.default_rng(seed).integers(0, 256, (len(points), 3))
    for face, rows in enumerate(np.split(order, bounds)):
        name = f"{CLASSES[face % len(CLASSES)]}_{face + 1}.txt"
        values = np.hstack([points[rows], colors[rows]])
        np.savetxt(folder / name, values, fmt="%.3f %.3f %.3f %d %d %d")


def _digest(out: Path) -> str:
    """Return a hash of all results, including records."""
    total = hashlib.sha256()
    for path in sorted(out.rglob("*.*")):
        if path.name not in ("report.json", ".torchrg.lock"):
            total.update(str(path.relative_to(out)).encode() + path.read_bytes())
    return total.hexdigest()
