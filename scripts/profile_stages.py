"""Seconds and memory of each stage of one run.

python scripts/profile_stages.py --preset paper --num-points 1000000
python scripts/profile_stages.py scan.pcd --preset consensus --threads 2
"""

import argparse
import json
import threading
import time
from pathlib import Path
from typing import Any

import torch

import torchrg

_INTERVAL_S = 0.002
_MIB = 2**20


def resident_bytes() -> int:
    """Return what of this process is in memory now (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


class Stages:
    """Follows the stages of a run, and how much memory each has at most and at its end."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self._begun = time.perf_counter()
        self._peak = 0
        self._running = True
        self._watch = threading.Thread(target=self._sample, daemon=True)
        self._watch.start()

    def _sample(self) -> None:
        while self._running:
            self._peak = max(self._peak, resident_bytes())
            time.sleep(_INTERVAL_S)

    def begin(self, stage: str) -> None:
        """End the stage before, and begin another; ``"done"`` begins none."""
        now, resident = time.perf_counter(), resident_bytes()
        if self.rows:
            row = self.rows[-1]
            row["seconds"] = now - self._begun
            row["peak_mib"] = max(self._peak, resident) / _MIB
            row["end_mib"] = resident / _MIB
        if stage == "done":
            self._running = False
            return
        self.rows.append({"stage": stage, "start_mib": resident / _MIB})
        self._begun, self._peak = now, resident


def main() -> None:
    """Profile one run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scan", type=Path, nargs="?", help="default: a made room")
    parser.add_argument("--preset", default=torchrg.config.DEFAULT_PRESET)
    parser.add_argument("--num-points", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    if arguments.scan is None:
        points = torchrg.scenes.make_room(arguments.num_points, 0.003, 7).points
    else:
        points = torchrg.read_cloud(arguments.scan).points
    config = torchrg.load_config(arguments.preset)
    torchrg.segment_planes(points[:5000], config)
    stages = Stages()
    seg = torchrg.segment_planes(points, config, on_stage=stages.begin)
    if arguments.json:
        print(json.dumps({"points": len(points), "stages": stages.rows}, indent=1))
        return
    sharp = float(seg.sharp.float().mean())
    print(f"{len(points):,} points, {arguments.preset}, {100 * sharp:.1f} % sharp")
    print("stage        seconds  us/point  MiB at most  of it new  MiB kept")
    for row in stages.rows:
        print(
            f"{row['stage']:10} {row['seconds']:9.2f} {row['seconds'] / len(points) * 1e6:9.2f} "
            f"{row['peak_mib']:12,.0f} {row['peak_mib'] - row['start_mib']:10,.0f} "
            f"{row['end_mib'] - row['start_mib']:9,.0f}"
        )
    total = sum(row["seconds"] for row in stages.rows)
    print(f"{'all':10} {total:9.2f} {total / len(points) * 1e6:9.2f}")


if __name__ == "__main__":
    main()
