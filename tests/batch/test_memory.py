"""The memory model: what processes take is measured, and stays within what is promised for it."""

import subprocess
import sys

import pytest

from torchrg import estimate_normals, search_knn, segment_planes
from torchrg.batch import memory
from torchrg.batch.memory import available_memory, peak_memory, reset_peak_memory, scan_memory
from torchrg.neighbors import canonical_order, measure_sampling
from torchrg.robust import fit_detmcd, fit_fastmcd, fit_mve
from torchrg.scenes import make_room

SITE = """
import numpy as np
import torch
import torchrg
from torchrg.batch.memory import peak_memory, reset_peak_memory, scan_memory
torch.set_num_threads(1)
rng, n = np.random.default_rng(0), 150_000
x, y = rng.uniform(0, 300, (2, n))
terrace = np.floor(x / 37.5)  # Every second one is a ramp.
ground = np.stack([x, y, np.where(terrace % 2 == 0, terrace * 5, x / 7.5)], axis=1)
wall = np.stack([rng.uniform(0, 10, n // 30), np.full(n // 30, 50.0), rng.uniform(0, 3, n // 30)])
points = np.concatenate([ground, wall.T]).astype(np.float32) * UNIT
reset_peak_memory()
torchrg.segment_planes(points, "classic", **{"planes.up": "z"})
print(peak_memory(), scan_memory(len(points)))
"""
MEASURE = """
import sys
import threading
import time
from pathlib import Path
import numpy as np
import torch
from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.config import load_config
torch.set_num_threads(1)
taken = [0]
def watch():  # Pages of files are no such memory: the system can reclaim them.
    while True:
        words = Path("/proc/self/status").read_text().split()
        parts = (int(words[words.index(name) + 1]) for name in ("RssAnon:", "RssShmem:"))
        taken[0] = max(taken[0], 1024 * sum(parts))
        time.sleep(0.01)
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
if "disk" in what:
    threading.Thread(target=watch, daemon=True).start()
reset_peak_memory()
with scratch.on_disk(folder) if "disk" in what else nullcontext():
    seg = segment_planes(points, config, keep_neighbors="superpoints" in what)
    if "superpoints" in what:
        make_superpoints(points, seg)
print(taken[0] or peak_memory())
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
    options = {"num_levels": 4 * ("superpoints" in what), "on_disk": "disk" in what}
    promised = scan_memory(num_points, **options)
    assert 0.5 * promised < int(done.stdout) < promised


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["1", "1000"])
def test_a_wide_site_with_classes_takes_what_the_model_says(unit):
    command = [sys.executable, "-c", SITE.replace("UNIT", unit)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    taken, promised = map(int, done.stdout.split())
    assert taken < promised


def test_more_neighbors_and_levels_take_more():
    usual = scan_memory(1_000_000)
    # Lists of 4 bytes per neighbor, and labels of 8 bytes per level.
    assert scan_memory(1_000_000, k=150) - usual > 100 * 4 * 1_000_000
    assert scan_memory(1_000_000, k=20) == usual
    levels = [scan_memory(1_000_000, num_levels=number) for number in (4, 14)]
    assert levels[1] - levels[0] > 10 * 8 * 1_000_000
    # A cloud has no more neighbors than points.
    assert scan_memory(6000, k=100_000) == scan_memory(6000, k=6000)


@pytest.mark.parametrize(
    "work",
    [
        lambda points: measure_sampling(points, search_knn(points, 600, canonical=True)),
        lambda points: estimate_normals(points[:1200], "consensus", k=600),
        lambda points: segment_planes(points, "classic", **{"normals.k": 600}),
        lambda points: fit_detmcd(points[:300, None] - points[:600]),
        lambda points: fit_fastmcd(points[:100], num_starts=100_000),
        lambda points: fit_mve(points[:600], num_starts=20_000),
    ],
    ids=["sampling", "consensus", "segment", "detmcd", "fastmcd", "mve"],
)
@pytest.mark.slow
def test_wide_neighborhoods_are_fitted_in_parts(work):
    points = make_room(3000, noise=0.003, seed=0).points
    points = points[canonical_order(points)]
    estimate_normals(points, "consensus", k=20)
    reset_peak_memory()
    before = peak_memory()
    work(points)
    assert peak_memory() - before < 1.5e8


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
    monkeypatch.setattr(memory, "_PROCESS_CGROUPS", tmp_path / "own")
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


def test_scan_memory_by_example():
    assert (scan_memory(1_000_000), scan_memory(10_000_000, on_disk=True)) == (
        900000000,
        1400000000,
    )
