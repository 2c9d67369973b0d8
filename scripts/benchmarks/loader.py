"""Clouds a second through a DataLoader with ``SegmentPlanes``, by number and start of workers.

python scripts/bench.py loader
python scripts/bench.py loader --num-points 10000 --preset consensus --workers 0 1 2 4
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from benchmarks.harness import Benchmark, Figures, Results, ratio, table
from torchrg.datasets import collate_offset
from torchrg.scenes import make_room
from torchrg.transforms import SegmentPlanes

STRIDE = 7919
"""A prime: rows of the room about which the crops lie."""


@dataclass(frozen=True)
class Case(Benchmark):
    threads: int = 1
    crops: int = 60
    num_points: int = 10_000
    """Of each crop."""
    preset: str = "classic"
    workers: tuple[int, ...] = (0, 1, 2)

    def clouds(self) -> Mapping[str, Callable[[], "Crops"]]:
        title = f"{self.crops} crops of {self.num_points:,} points, {self.preset}"
        return {title: lambda: Crops(self.crops, self.num_points, self.preset)}

    def contenders(self) -> Mapping[str, Callable[["Crops"], Figures]]:
        runs = {"0 workers": partial(_load_all, 0, None)} if 0 in self.workers else {}
        for start in ("fork", "spawn"):
            for number in filter(None, self.workers):
                runs[f"{number} workers, {start}"] = partial(_load_all, number, start)
        return runs

    def report(self, results: Results) -> str:
        """Return rates, and ratios to the first."""
        for by in results.values():
            first, *_ = by.values()
            for runs in by.values():
                runs[0]["to the first"] = ratio(runs, first, "crops a second")
        return table(results)


class Crops(Dataset[dict[str, Tensor]]):
    """Parts of a made room, each the points nearest to one of them."""

    def __init__(self, count: int, num_points: int, preset: str) -> None:
        self.room = make_room(40 * num_points, 0.003, 7).points
        self.count, self.num_points = count, num_points
        self.transform = SegmentPlanes(preset)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        middle = self.room[index * STRIDE % len(self.room)]
        distances = (self.room - middle).square().sum(dim=1)
        rows = distances.topk(self.num_points, largest=False).indices.sort().values
        return self.transform({"coord": self.room[rows]})


def _load_all(workers: int, start: str | None, crops: Crops) -> Figures:
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
    return {
        "crops a second": len(crops) / seconds,
        "ms a crop": 1e3 * seconds / len(crops),
        "planes": num_planes,
    }
