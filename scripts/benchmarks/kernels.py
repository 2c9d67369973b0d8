"""Where the time of a run goes, kernel by kernel: as written, compiled, and as memory allows.

A run is timed on one thread with each kernel's calls apart; what is left is in no kernel. The limit
of a kernel is the time to read its rows and to write what it returns, once, at the rate at which
this machine copies memory; tables that rows are gathered from are taken to be in the cache.

    python scripts/bench.py kernels
    python scripts/bench.py kernels --work consensus --num-points 1000000
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.harness import Benchmark, Figures, Results, markdown, medians
from benchmarks.steady import prepare
from torchrg._compile import ROWS, Kernel

COPIED_BYTES = 2**28
"""Of one tensor: more than any cache holds."""


@dataclass(frozen=True)
class Case(Benchmark):
    threads: int = 1
    work: tuple[str, ...] = ("consensus", "paper", "depth-kinect")
    """Presets, and kinds of depth frames."""
    num_points: int = 200_000
    """Of the room."""

    def clouds(self) -> Mapping[str, Callable[[], str]]:
        return {name: partial(str, name) for name in self.work}

    def contenders(self) -> Mapping[str, Callable[[str], Figures]]:
        return {
            "written": partial(_time_kernels, self.num_points, False),
            "compiled": partial(_time_kernels, self.num_points, True),
        }

    def report(self, results: Results) -> str:
        """Return milliseconds of each kernel, the slowest as written first."""
        rows = []
        for work, by in results.items():
            runs = [medians(figures) for figures in by.values()]
            names = dict.fromkeys(name for run in runs for name in run["ms"])
            table = [[work, name, *(run["ms"].get(name) for run in runs)] for name in names]
            for row in table:
                own = next(run for run in runs if row[1] in run["ms"])
                row += [own["calls"].get(row[1]), own["limit"].get(row[1])]
            rows += sorted(table, key=lambda row: -(row[2] or row[3]))
        columns = (f"{name}, ms" for name in next(iter(results.values())))
        return markdown(["work", "kernel", *columns, "calls", "limit, ms"], rows)


def _time_kernels(num_points: int, compiled: bool, work: str) -> Figures:
    """Return milliseconds, calls and limits by the names of kernels, in one run."""
    run = prepare(work, num_points, compiled)
    rate = _bytes_a_second()
    with _noted() as calls:
        begin = time.perf_counter()
        run()
        whole = time.perf_counter() - begin
    spent: dict[str, float] = {}
    limit: dict[str, float] = {}
    count: dict[str, int] = {}
    for name, seconds, moved in calls:
        spent[name] = spent.get(name, 0.0) + 1000 * seconds
        limit[name] = limit.get(name, 0.0) + 1000 * moved / rate
        count[name] = count.get(name, 0) + 1
    spent["in no kernel"] = 1000 * whole - sum(spent.values())
    return {"ms": spent, "limit": limit, "calls": count}


@contextmanager
def _noted() -> Iterator[list[tuple[str, float, int]]]:
    """Note the name, the seconds and the bytes of each call of a kernel that is in no other."""
    calls: list[tuple[str, float, int]] = []
    call, is_inside = Kernel.__call__, False

    def noted(self: Kernel, *arguments: Any) -> tuple[Tensor, ...]:  # noqa: ANN401
        nonlocal is_inside
        if is_inside:
            return call(self, *arguments)
        is_inside, begin = True, time.perf_counter()
        try:
            found = call(self, *arguments)
        finally:
            is_inside = False
        seconds = time.perf_counter() - begin
        pairs = zip(self.axes, arguments, strict=True)
        rows = [value for axes, value in pairs if isinstance(value, Tensor) and ROWS in axes]
        moved = sum(value.numel() * value.element_size() for value in (*rows, *found))
        calls.append((self.function.__name__, seconds, moved))
        return found

    with patch.object(Kernel, "__call__", noted):
        yield calls


def _bytes_a_second() -> float:
    """Return how fast memory is read and written, by copies of a large tensor."""
    source = torch.ones(COPIED_BYTES, dtype=torch.uint8)
    target = source.clone()
    begin = time.perf_counter()
    target.copy_(source)
    return 2 * COPIED_BYTES / (time.perf_counter() - begin)
