"""The memory model: what processes take is measured, and stays within what is promised for it."""

import subprocess
import sys

import pytest

from torchrg.batch import memory
from torchrg.batch.memory import available_memory, peak_memory, scan_memory

MEASURE = """
import sys
import numpy as np
import torch
from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.config import load_config
torch.set_num_threads(1)
what, preset, num_points, folder = *sys.argv[1:3], int(sys.argv[3]), sys.argv[4]
if what == "frame":
    from torchrg.depth import make_intrinsics, segment_depth
    noise = torch.randn(num_points // 640, 640, generator=torch.Generator().manual_seed(0))
    depth = 2 + torch.arange(640) / 640 + 0.003 * noise
    reset_peak_memory()
    segment_depth(depth, make_intrinsics(525.0, 525.0, 319.5, 239.5))
    print(peak_memory())
    sys.exit()
from torchrg.scenes import make_room
from torchrg.structures import Cloud
points = make_room(num_points, noise=0.003, seed=0).points
config = load_config(preset)
from torchrg.pipeline import make_superpoints, segment_planes
from contextlib import nullcontext
from torchrg import scratch
reset_peak_memory()
with scratch.on_disk(folder) if "disk" in what else nullcontext():
    seg = segment_planes(points, config, keep_neighbors="superpoints" in what)
    if "superpoints" in what:
        make_superpoints(points, seg)
print(peak_memory())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "preset", "num_points"),
    [
        ("frame", "classic", 640 * 480),
        *(("scan", preset, 300_000) for preset in ("classic", "paper", "consensus")),
        *(("disk", preset, 1_000_000) for preset in ("classic", "paper", "consensus")),
        ("superpoints", "consensus", 300_000),
        ("disk superpoints", "consensus", 1_000_000),
    ],
)
def test_what_a_cloud_or_an_image_takes_is_what_the_model_says(tmp_path, what, preset, num_points):
    command = [sys.executable, "-c", MEASURE, what, preset, str(num_points), str(tmp_path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    options = {"superpoints": "superpoints" in what, "on_disk": "disk" in what}
    promised = scan_memory(num_points, **options)
    assert 0.5 * promised < int(done.stdout) < promised


def test_memory_is_measured():
    assert 1e7 < peak_memory() < 1e12
    assert 1e7 < available_memory() < 1e14


@pytest.mark.parametrize(
    ("own", "tree", "limit", "used", "cache"),
    [
        ("0::/slurm/job_7/step_0", "", "memory.max", "memory.current", "inactive_file"),
        (
            "4:cpu,memory:/slurm/job_7/step_0\n1:pids:/\n0::/",
            "memory",
            "memory.limit_in_bytes",
            "memory.usage_in_bytes",
            "total_inactive_file",
        ),
    ],
)
def test_the_least_limit_of_nested_groups_counts(
    monkeypatch, tmp_path, own, tree, limit, used, cache
):
    monkeypatch.setattr(memory, "_CGROUP", tmp_path / "cgroup")
    monkeypatch.setattr(memory, "_OWN_CGROUPS", tmp_path / "own")
    machine = available_memory()  # No groups, as on other systems.
    (tmp_path / "own").write_text(own)
    assert machine / 2 < available_memory() < 2 * machine

    def restrict(group, most, taken, reclaimable=None):
        folder = tmp_path / "cgroup" / tree / group
        folder.mkdir(parents=True, exist_ok=True)
        (folder / limit).write_text(f"{most}\n")
        (folder / used).write_text(f"{taken}\n")
        if reclaimable is not None:
            (folder / "memory.stat").write_text(f"anon 5\n{cache} {reclaimable}\nfile 3\n")

    restrict("", 900_000, 1000)  # A container, in whose tree the path of its host is missing.
    assert available_memory() == 899_000
    restrict("slurm/job_7/step_0", "max", 100)
    restrict("slurm/job_7", 300_000, 50_000, 20_000)
    assert available_memory() == 270_000
    restrict("slurm", 200_000, 50_000)
    assert available_memory() == 150_000
    restrict("slurm/job_7/step_0", 1000, 3000, 0)
    assert available_memory() == 0
    restrict("other", 10, 0)
    restrict("slurm/job_7/step_0", 100_000, 40_000, 5000)
    assert available_memory() == 65_000
