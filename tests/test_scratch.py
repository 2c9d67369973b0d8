"""Large arrays on a disk: the result is that of memory to the last bit, and nothing is left."""

import dataclasses
import errno
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from torchrg import scratch
from torchrg.config import load_config
from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.neighbors import blocks
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.scenes import make_room
from torchrg.structures import Cloud

PRESETS = ("classic", "paper", "algorithm2", "consensus")


@pytest.fixture
def small(monkeypatch):
    """Let blocks be small, and all arrays be on the disk."""
    monkeypatch.setattr(blocks, "BLOCK_SIZE", 700)
    monkeypatch.setattr(scratch, "_MIN_BYTES", 1)
    monkeypatch.setattr(scratch, "_RELEASE_SECONDS", 0.001)


def settings(preset, k=16):
    """A preset with few neighbors, so that a block of a small cloud is not all of it."""
    config = load_config(preset)
    return dataclasses.replace(
        config,
        normals=dataclasses.replace(config.normals, k=k),
        growing=dataclasses.replace(config.growing, min_size=12),
        planes=dataclasses.replace(config.planes, up="z"),
    )


def difficult_room(num_points):
    """A room with duplicates, a dense cluster in sparse surroundings, far points, and NaN."""
    rng = np.random.default_rng(3)
    room = make_room(num_points=num_points, noise=0.003, seed=1).points.double().numpy()
    cluster = rng.uniform(0, 0.05, (num_points // 4, 3)) * [1, 1, 0] + [1.0, 1.0, 0.5]
    sparse = rng.uniform(-20, 20, (num_points // 20, 3)) * [1, 1, 0]
    far = np.array([[4e3, 0, 0], [-3e3, 5, 5], [-3e3, 5, 5]])
    parts = [room, room[: num_points // 5], np.repeat(room[:2], 150, axis=0), cluster, sparse, far]
    points = np.concatenate(parts)
    rng.shuffle(points)
    points[::97] = np.nan
    points[5, 1] = np.inf
    return points.astype(np.float32)


def wall(num_points):
    """One noisy wall in a national grid, far from the origin, in double precision."""
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 1, (num_points, 3)) * [10, 0, 3] + [5e6, 4e5, 100]
    points[:, 1] += 0.003 * rng.normal(size=num_points)
    return points


def assert_same(found, expected):
    """Check that two segmentations are equal to the last bit."""
    for name in ("labels", "normals", "curvature", "sharp", "valid"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    for name, values in vars(expected.planes).items():
        same = getattr(found.planes, name)
        if name == "adjacency":
            assert all(torch.equal(a, b) for a, b in zip(same, values, strict=True))
        elif isinstance(values, torch.Tensor):
            assert torch.equal(same, values), name


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("make", [difficult_room, wall])
def test_the_disk_gives_the_result_of_memory(make, preset, tmp_path, small):
    points, config = Cloud(make(2500)).points, settings(preset)
    whole = segment_planes(points, config)
    assert len(whole.planes) > 0
    with scratch.on_disk(tmp_path):
        found = segment_planes(points, config)
    assert_same(found, whole)


@pytest.mark.parametrize("method", ["jet", "detmcd", "detmm"])
def test_other_estimators_read_neighbors_on_the_disk(method, tmp_path, small):
    config = settings("classic")
    config = dataclasses.replace(config, normals=dataclasses.replace(config.normals, method=method))
    points = Cloud(difficult_room(200)).points
    with scratch.on_disk(tmp_path):
        found = segment_planes(points, config)
    assert_same(found, segment_planes(points, config))


def test_voxels_and_superpoints_are_those_of_memory(tmp_path, small):
    points = Cloud(difficult_room(2500)).points
    with scratch.on_disk(tmp_path):
        seg = segment_planes(points, settings("classic"), voxel=0.2)
        parts = make_superpoints(points, seg)
    assert_same(seg, segment_planes(points, settings("classic"), voxel=0.2))
    assert torch.equal(parts.labels, make_superpoints(points, seg).labels)


@pytest.mark.parametrize("num_points", [0, 1, 2, 7])
@pytest.mark.filterwarnings("ignore:expected finite points")
def test_few_points_are_a_cloud_too(num_points, tmp_path, small):
    points = torch.full((num_points + 1, 3), torch.nan)
    points[1:] = torch.arange(3.0 * num_points).view(-1, 3) ** 2
    with scratch.on_disk(tmp_path):
        found = segment_planes(points, settings("consensus"))
    assert_same(found, segment_planes(points, settings("consensus")))


def test_released_pages_hold_what_was_written(tmp_path, small):
    values = np.random.default_rng(0).integers(0, 99, (300, 4096), dtype=np.int32)
    with scratch.on_disk(tmp_path):
        kept = scratch.empty(values.shape, np.int32)
        for row, one in enumerate(values):
            kept[row] = one
            time.sleep(0.0001)
        np.testing.assert_array_equal(kept, values)
        assert not list(tmp_path.iterdir())
    np.testing.assert_array_equal(kept, values)


@pytest.mark.parametrize("kind", [torch.float32, torch.int64, torch.bool])
def test_stored_tensors_keep_values_and_layout(tmp_path, small, kind):
    values = (torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 9).to(kind)
    for tensor in (values, values.T.contiguous().T, values[::2]):
        assert scratch.store(tensor) is tensor
        with scratch.on_disk(tmp_path):
            stored, maps = scratch.store(tensor), [np.frombuffer(m, "u1") for m in scratch._maps]
        assert stored.untyped_storage().data_ptr() in {each.ctypes.data for each in maps}
        assert stored.dtype == kind
        assert torch.equal(stored, tensor)
        assert stored.is_contiguous() or tensor.T.is_contiguous()


def test_a_cloud_read_within_is_on_the_disk(tmp_path, small):
    points = difficult_room(100).astype(np.float64) + 1e5
    color = np.full(points.shape, 7, "u1")
    write_cloud(tmp_path / "room.ply", Cloud(points, {"color": color}))
    with scratch.on_disk(tmp_path):
        cloud = read_cloud(tmp_path / "room.ply")
        arrays = cloud.coordinates, cloud.fields["color"], cloud.points.numpy()
        starts = {np.frombuffer(m, "u1").ctypes.data for m in scratch._maps}
        assert all(array.ctypes.data in starts for array in arrays)
    np.testing.assert_array_equal(cloud.coordinates, points)
    torch.testing.assert_close(cloud.points, Cloud(points).points, rtol=0, atol=0, equal_nan=True)


def test_a_full_disk_is_one_line(tmp_path, small, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(scratch.os, "posix_fallocate", refuse)
    message = r"expected 0\.00 GB of free disk space, got: No space left on device; free space, or"
    with scratch.on_disk(tmp_path), pytest.raises(FormatError, match=message):
        segment_planes(torch.rand(30, 3), "classic")
    assert not list(tmp_path.iterdir())


def test_without_the_call_that_reserves_it_the_disk_is_filled(tmp_path, small, monkeypatch):
    monkeypatch.delattr(scratch.os, "posix_fallocate")
    with scratch.on_disk(tmp_path):
        assert (scratch.empty((3, 700_000), np.int32) == 0).all()


KILLED = """
import os, signal, sys, torchrg
from torchrg import scratch
scratch._MIN_BYTES = 1
def end(stage):
    if stage == sys.argv[2]:
        os.kill(os.getpid(), signal.SIGKILL)
with scratch.on_disk(sys.argv[1]):
    torchrg.segment_planes(torchrg.scenes.make_room(3000, seed=0).points, "classic", on_stage=end)
"""


def test_a_killed_process_leaves_nothing(tmp_path):
    command = [sys.executable, "-c", KILLED, str(tmp_path), "planes"]
    assert subprocess.run(command, check=False).returncode == -9
    assert not list(tmp_path.iterdir())


def end_after_work():
    """Take an array from the disk in a forked process, which ends, or hangs and is ended."""
    signal.alarm(10)
    found = scratch.empty((3, 5), np.int32)
    scratch.release()
    os._exit(found.shape != (3, 5))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_a_forked_process_waits_for_no_thread_that_it_does_not_have(tmp_path, small):
    with scratch.on_disk(tmp_path):
        lock = scratch._lock
        with lock:  # As the thread that releases pages has it now and then.
            process = os.fork()
            if process == 0:
                end_after_work()
        assert os.waitpid(process, 0)[1] == 0
