"""A source whose input files say what goes wrong, importable by worker processes."""

import errno
import os
import signal
import time
from dataclasses import dataclass, field

from torchrg.batch.scans import Job, Source
from torchrg.batch.task import TaskReport
from torchrg.config import PipelineConfig
from torchrg.datasets import SceneDataset, SceneFiles
from torchrg.errors import FormatError
from torchrg.io.files import atomic_path


class Texts(SceneDataset):
    def __init__(self, root):
        self.root, self.scenes = root, []


@dataclass(frozen=True)
class FaultySource(Source):
    """Text files, named ``<points>_<anything>``; the text is a behavior and becomes the result."""

    data: Texts
    settings: PipelineConfig = field(default_factory=PipelineConfig)
    table: str | None = None
    bytes_per_point = 1

    def describe(self):
        return {"kind": "faulty"}

    def list_scans(self, out):
        paths = sorted(self.root.iterdir())
        return [
            SceneFiles(path.stem, path, (path,), num_points=int(path.stem.split("_")[0]))
            for path in paths
        ]

    def convert(self, scan, folder, begin):
        begin("read")
        behavior = scan.files[0].read_text()
        with (self.root.parent / "log").open("a") as log:
            log.write(f"{scan.name} {os.getpid()}\n")
        act(behavior, self.root.parent / f"{scan.name}.once")
        begin("write")
        with atomic_path(folder / "result.txt") as temporary:
            temporary.write_text(behavior)
            if behavior == "kill while writing":
                os.kill(os.getpid(), signal.SIGKILL)
            if behavior == "full":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if behavior == "slow writing":
                time.sleep(60)
        with (self.root.parent / "log").open("a") as log:
            log.write(f"{scan.name} done\n")
        notes, files = (f"was {behavior}",), ("result.txt",)
        return TaskReport(scan.name, "converted", scan.num_points, 1, files, warnings=notes)


def act(behavior, once):
    """Do what a file says, once or always."""
    if behavior == "kill" or (behavior == "kill once" and not once.exists()):
        once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if behavior == "exit":
        os._exit(7)
    if behavior == "corrupt":
        raise FormatError("room.txt: line 7: expected six numbers, got five.")
    if behavior == "bug":
        raise KeyError("what")
    if behavior == "memory":
        raise MemoryError
    if behavior == "torch memory":
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:117] can't allocate memory: 1e18 bytes")
    if behavior == "threads":
        import torch

        assert torch.get_num_threads() == 1
        assert os.environ["OMP_NUM_THREADS"] == "1"
    if behavior.startswith("sleep"):
        time.sleep(float(behavior.split()[1]))


def make_jobs(folder, behaviors):
    """Return jobs for scans by name, with the behavior of each."""
    (folder / "in").mkdir(parents=True, exist_ok=True)
    for name, behavior in behaviors.items():
        (folder / "in" / f"{name}.txt").write_text(behavior)
    source = FaultySource(Texts(folder / "in"))
    return [Job(source, scan, folder / "out") for scan in source.list_scans(folder / "out")]
