"""Memory per point of each stage of ``torchrg segment``, and the largest tensors at its peak.

    python scripts/memory_table.py building.laz --out planes.laz --limit-memory 1.6

The arguments go to ``torchrg segment``. Anonymous memory, which the system cannot reclaim,
is measured every 10 ms, above that of the loaded program. Arrays on disk take none of it and are
not listed.
"""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

import torchrg
from torchrg import scratch
from torchrg.cli import segment

_SECONDS = 0.01
_NUM_LISTED = 5
"""Number of tensors listed for each stage."""
_STEP = 4e6
"""Growth of a peak after which the tensors are listed again, in bytes."""
_STAGES = {"read_cloud": "reading", "write_cloud": "writing", "_draw": "picture"}
"""Stages by the function of the command that runs them; the others report themselves."""


def anonymous_memory() -> int:
    """Return the memory of this process that is not part of a file, in bytes."""
    status = Path("/proc/self/status").read_text(encoding="ascii").split()
    entries = (int(status[status.index(name) + 1]) for name in ("RssAnon:", "RssShmem:"))
    return 1024 * sum(entries)


def tensors_of(value: object, name: str, depth: int = 2) -> Iterator[tuple[int, int, str]]:
    """Yield address, bytes and description of the tensors and arrays in a value."""
    if isinstance(value, np.ndarray):
        kind, base = str(value.dtype), value
        while isinstance(base.base, np.ndarray):
            base = base.base
        yield base.ctypes.data, base.nbytes, f"{name} {kind}"
    elif isinstance(value, torch.Tensor):
        memory = value.untyped_storage()
        yield memory.data_ptr(), memory.nbytes(), f"{name} {str(value.dtype)[6:]}"
    elif depth and isinstance(value, dict | list | tuple) and len(value) < 100:
        named = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in list(named):
            yield from tensors_of(item, f"{name}.{key}", depth - 1)
    elif depth and type(value).__module__.startswith("torchrg"):
        yield from tensors_of(dict(getattr(value, "__dict__", {})), name, depth - 1)


def largest_tensors() -> list[tuple[int, str]]:
    """Return size and name of the tensors of all running functions, largest first."""
    maps = [np.frombuffer(each, np.uint8) for each in list(scratch._maps)]  # noqa: SLF001
    on_disk, found = {each.ctypes.data for each in maps}, dict[int, tuple[int, str]]()
    for frame in sys._current_frames().values():  # noqa: SLF001
        while frame is not None:
            if "torchrg" in frame.f_code.co_filename:
                for variable, value in list(frame.f_locals.items()):
                    name = f"{frame.f_code.co_name}.{variable}"
                    for address, size, text in tensors_of(value, name):
                        if address not in on_disk:
                            found.setdefault(address, (size, text))
            frame = frame.f_back
    return sorted(found.values(), reverse=True)


class Peaks:
    """Peak memory of each stage, measured by a thread."""

    def __init__(self) -> None:
        self.stage, self.num_points = "start", 0
        self.peaks: dict[str, tuple[int, list[tuple[int, str]]]] = {}
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        while not self._done.wait(_SECONDS):
            memory, (peak, tensors) = anonymous_memory(), self.peaks.get(self.stage, (0, []))
            if memory > peak + _STEP:
                tensors = largest_tensors()
            self.peaks[self.stage] = max(memory, peak), tensors

    def during(self, name: str, work: Callable) -> Callable:
        """Return a function that measures as a stage."""

        def measured(*arguments: object, **options: object) -> object:
            self.stage = name
            result = work(*arguments, **options)
            self.num_points = max(self.num_points, len(getattr(result, "coordinates", ())))
            self.stage = "between"
            return result

        return measured

    def run(self, arguments: list[str]) -> None:
        """Run ``torchrg segment`` and print the table."""
        torchrg.segment_planes(torch.rand(3000, 3), "classic", **{"planes.up": "z"})
        base, begin, segment_cloud = anonymous_memory(), time.process_time(), segment.segment_cloud
        for function, stage in _STAGES.items():
            setattr(segment, function, self.during(stage, getattr(segment, function)))

        def segment_measured(
            *values: object, begin: Callable[[str], None], **options: object
        ) -> object:
            def enter(stage: str) -> None:
                self.stage = stage
                begin(stage)

            return segment_cloud(*values, begin=enter, **options)

        segment.segment_cloud = segment_measured
        self._thread.start()
        segment.run(arguments)
        self._done.set()
        self._thread.join()
        seconds, peak = time.process_time() - begin, max(peak for peak, _ in self.peaks.values())
        print(
            f"{self.num_points:,} points, {seconds:.0f} s of CPU, {peak / 1e9:.2f} GB at the peak"
        )
        print("| stage | bytes per point | largest tensors, in bytes per point |\n|---|---|---|")
        for stage, (peak, tensors) in self.peaks.items():
            named = [(text, round(size / self.num_points)) for size, text in tensors]
            shown = [f"{text} {size}" for text, size in named[:_NUM_LISTED] if size]
            print(f"| {stage} | {(peak - base) / self.num_points:.0f} | {', '.join(shown)} |")


if __name__ == "__main__":
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    Peaks().run(sys.argv[1:])
