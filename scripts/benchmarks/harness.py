"""Benchmark harness: clouds, contenders, rounds, result file and table."""

import contextlib
import importlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import surroundings
from tqdm import tqdm

BENCH = Path(__file__).parents[1] / "bench.py"

Figures = dict[str, Any]
"""Figures of one run of a contender on a cloud."""
Results = dict[str, dict[str, list[Figures]]]
"""Figures of each round, by cloud and contender."""
Column = Callable[[Figures], object]
"""Function from figures to a table cell; None leaves the cell empty."""


@dataclass(frozen=True)
class Benchmark:
    """Base class with the settings common to all benchmarks."""

    only: tuple[str, ...] = ()
    """Contenders to run. Default: all."""
    rounds: int = 1
    """Number of runs of each contender on each cloud, in turn; tables show medians."""
    threads: int = os.cpu_count() or 1
    """Number of torch threads."""
    minutes: float = math.inf
    """Time after which no run starts, in minutes."""
    out: Path | None = None
    """JSON file of all figures. Existing figures are not measured again."""

    def clouds(self) -> Mapping[str, Callable[[], Any]]:
        """Return a function for each cloud that returns it, or a context manager for it."""
        raise NotImplementedError

    def contenders(self) -> Mapping[str, Callable[[Any], Figures | None]]:
        """Return the contenders, functions of a cloud; None if a contender does not apply."""
        raise NotImplementedError

    def report(self, results: Results) -> str:
        """Return the tables of all figures."""
        return table(results)


def run(benchmark: Benchmark) -> None:
    """Measure the missing figures and print the tables."""
    os.environ["OMP_NUM_THREADS"] = str(benchmark.threads)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(benchmark.threads)
    results, is_complete = measure(benchmark)
    print(", ".join(f"{k} {v}" for k, v in surroundings.describe(benchmark.threads).items()), "\n")
    print(benchmark.report(results))
    if not is_complete:
        print("\nIncomplete: run the same command again.")


def measure(benchmark: Benchmark) -> tuple[Results, bool]:
    """Return all figures, also from the file, and whether they are complete."""
    contenders = benchmark.contenders()
    unknown = set(benchmark.only) - set(contenders)
    if unknown:
        listed = f"{', '.join(contenders)}, got {', '.join(sorted(unknown))}"
        raise SystemExit(f"bench: expected --only among {listed}.")
    names = [name for name in contenders if not benchmark.only or name in benchmark.only]
    results, begin = _load(benchmark.out), time.perf_counter()
    for cloud, make in tqdm(benchmark.clouds().items(), disable=None):
        rows = results.setdefault(cloud, {})
        if all(len(rows.get(name, ())) >= benchmark.rounds for name in names):
            continue
        with contextlib.ExitStack() as stack:
            made = make()
            if hasattr(made, "__enter__"):
                made = stack.enter_context(made)
            left = [name for _ in range(benchmark.rounds) for name in names]
            for number, name in enumerate(left):
                if len(rows.get(name, ())) > number // len(names):
                    continue
                if time.perf_counter() - begin > 60 * benchmark.minutes:
                    return results, False
                figures = contenders[name](made)
                if figures is not None:
                    rows.setdefault(name, []).append(figures)
                    _save(benchmark, results)
    return results, True


def _load(path: Path | None) -> Results:
    if path is None or not path.exists():
        return {}
    results: Results = json.loads(path.read_text(encoding="utf-8"))["results"]
    return results


def _save(benchmark: Benchmark, results: Results) -> None:
    if benchmark.out is not None:
        benchmark.out.parent.mkdir(parents=True, exist_ok=True)
        record = {"made_with": surroundings.describe(benchmark.threads), "results": results}
        benchmark.out.write_text(json.dumps(record, indent=1), encoding="utf-8")


def medians(rows: Sequence[Figures]) -> Figures:
    """Return the medians of figures over rounds; other values are those of the first round."""
    found = {}
    for name, value in rows[0].items():
        if isinstance(value, dict):
            found[name] = medians([row[name] for row in rows])
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = median(row[name] for row in rows)
        else:
            found[name] = value
    return found


def ratio(rows: Iterable[Figures], others: Iterable[Figures], name: str) -> float | None:
    """Return the median over rounds of the ratio of a figure; None without rounds."""
    ratios = [mine[name] / other[name] for mine, other in zip(rows, others, strict=False)]
    return median(ratios) if ratios else None


def table(results: Results, columns: Mapping[str, Column] | None = None) -> str:
    """Return a table with a row of medians per cloud and contender; default: all figures."""
    rows = [
        (cloud, name, medians(runs)) for cloud, by in results.items() for name, runs in by.items()
    ]
    if columns is None:
        names = dict.fromkeys(key for _, _, figures in rows for key in figures)
        columns = {name: lambda figures, name=name: figures.get(name) for name in names}
    return markdown(
        ["cloud", "by", *columns],
        [
            [cloud, name, *(show(figures) for show in columns.values())]
            for cloud, name, figures in rows
        ],
    )


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [" | ".join(["", *map(_shown, cells), ""]).strip() for cells in (head, *rows)]
    return "\n".join([lines[0], "|" + " --- |" * len(head), *lines[1:]])


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(part)}" for name, part in value.items())
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return "" if value is None else f"{value:,}" if type(value) is int else str(value)


class Finished(NamedTuple):
    """Output, run time and peak resident memory of a finished program."""

    text: str
    seconds: float
    peak_bytes: int
    cpu_seconds: float


def run_program(command: Sequence[object], stdin: str = "") -> Finished:
    """Run a program and wait for it.

    The peak memory reported by the system includes the memory of the parent at the start.
    Benchmarks that measure memory therefore must not load torch.

    Raises:
        RuntimeError: If the program fails.
    """
    begin = time.perf_counter()
    process = subprocess.Popen(
        [str(part) for part in command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None  # noqa: S101
    assert process.stdout is not None  # noqa: S101
    with contextlib.suppress(BrokenPipeError), process.stdin:
        process.stdin.write(stdin)
    with process.stdout:
        text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begin
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{command[0]}: exit code {process.returncode}: {text}")
    cpu_seconds = usage.ru_utime + usage.ru_stime
    return Finished(text, seconds, usage.ru_maxrss * 1024, cpu_seconds)


def serve_command(target: str, *arguments: object, python: str = sys.executable) -> list[str]:
    """Return the command that serves a function; see :func:`serve`."""
    return [python, str(BENCH), "--serve", target, json.dumps(arguments)]


def serve(target: str, arguments: Sequence[Any]) -> None:
    """Call ``module:function``; run the returned function per input line and print figures."""
    module, _, name = target.partition(":")
    work = getattr(importlib.import_module(module), name)(*arguments)
    # torch must not add to the memory of another library.
    memory = importlib.import_module("torchrg.batch.memory") if "torchrg" in sys.modules else None
    print("{}", flush=True)
    for _ in sys.stdin:
        if memory:
            memory.reset_peak_memory()
        begin, cpu = time.perf_counter(), _cpu_seconds()
        found = work()
        taken = {"seconds": time.perf_counter() - begin, "cpu": _cpu_seconds() - cpu}
        if memory:
            taken["peak_gb"] = memory.peak_memory() / 1e9
        print(json.dumps(taken | (found if isinstance(found, dict) else {})), flush=True)


def _cpu_seconds() -> float:
    """Return the CPU time of this process and its finished children."""
    return sum(os.times()[:4])


class Worker:
    """Process that repeats one task on request; see :func:`serve`."""

    def __init__(self, target: str, *arguments: object, threads: int | None = None) -> None:
        environment = {} if threads is None else {"OMP_NUM_THREADS": str(threads)}
        self._process = subprocess.Popen(
            serve_command(target, *arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | environment,
        )
        self.wait()

    def begin(self) -> None:
        """Start the task once."""
        print(file=self._process.stdin, flush=True)

    def wait(self) -> Figures:
        """Wait for the task and return its figures."""
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            raise SystemExit("bench: a contender failed; see its error above.")
        result: Figures = json.loads(line)
        return result

    def run(self) -> Figures:
        """Run the task once and return its figures."""
        self.begin()
        return self.wait()

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *raised: object) -> None:
        self._process.kill()
        self._process.communicate()
