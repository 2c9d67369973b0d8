"""Clouds a second through a DataLoader with ``SegmentPlanes``, by number and start of workers.

Examples:
    python scripts/bench_loader.py
    python scripts/bench_loader.py --num-points 10000 --preset consensus --workers 0 1 2 4
"""

import argparse
import time

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from torchrg.datasets import collate_offset
from torchrg.scenes import make_room
from torchrg.transforms import SegmentPlanes


class Crops(Dataset[dict[str, Tensor]]):
    """Parts of a made room, each the points nearest to one of them.

    Args:
        count: Number of crops.
        num_points: Points of each.
        preset: Settings of the transform.
    """

    def __init__(self, count: int, num_points: int, preset: str) -> None:
        self.room = make_room(40 * num_points, 0.003, 7).points
        self.count, self.num_points = count, num_points
        self.transform = SegmentPlanes(preset)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        middle = self.room[index * 7919 % len(self.room)]
        distances = (self.room - middle).square().sum(dim=1)
        rows = distances.topk(self.num_points, largest=False).indices.sort().values
        return self.transform({"coord": self.room[rows]})


def main() -> None:
    """Print a line for each number of workers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--crops", type=int, default=60)
    parser.add_argument("--num-points", type=int, default=10_000)
    parser.add_argument("--preset", default="classic")
    parser.add_argument("--workers", type=int, nargs="*", default=[0, 1, 2])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    crops = Crops(arguments.crops, arguments.num_points, arguments.preset)
    print(f"crops of {arguments.num_points:,} points, {arguments.preset}, one thread a worker")
    single = 0.0
    runs = [(0, None)] if 0 in arguments.workers else []
    runs += [(n, start) for start in ("fork", "spawn") for n in arguments.workers if n > 0]
    for workers, start in runs:
        loader = DataLoader(
            crops,
            num_workers=workers,
            multiprocessing_context=start,
            persistent_workers=workers > 0,
            collate_fn=collate_offset,
        )
        for _ in loader:  # The first time starts the workers and loads their code.
            pass
        begin = time.perf_counter()
        num_planes = sum(int(batch["plane"].max()) + 1 for batch in loader)
        seconds = time.perf_counter() - begin
        rate = len(crops) / seconds
        single = single or rate
        print(
            f"{workers} workers {start or '':6} {rate:7.2f} crops a second ({rate / single:.2f} "
            f"of the first), {1e3 * seconds / len(crops):.0f} ms each, {num_planes} planes"
        )


if __name__ == "__main__":
    main()
