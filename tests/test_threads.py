"""Calls leave torch's threads as they found them, and none of torch's own threads is ever used."""

import subprocess
import sys
from pathlib import Path
from threading import Event, Thread

import pytest
import torch

import torchrg

ALL_WORK = """
import os, time, torch, torchrg

def count_threads():
    # A thread that has ended is listed a little longer.
    time.sleep(0.5)
    return len(os.listdir("/proc/self/task"))

def work(room, side):
    for preset in ("classic", "paper", "consensus"):
        torchrg.segment_planes(room.points, torchrg.load_config(preset))
    torchrg.normals.orient_normals(room.points, room.normals)
    depth = torch.tensor(2.0).expand(side, side)
    camera = torch.tensor([[300.0, 0, side / 2], [0, 300, side / 2], [0, 0, 1]])
    torchrg.depth.segment_depth(depth, camera)

torch.set_num_threads(1)
small, large = (torchrg.scenes.make_room(num_points=n, noise=0.003, seed=0) for n in (500, 4_000))
work(small, 20)  # Libraries that are loaded bring threads of their own, which sleep.
torch.set_num_threads(2)
before = count_threads()
work(large, 200)
assert count_threads() == before, "a team of OpenMP threads was started"
torch.rand(1_000_000).sin()
assert count_threads() > before, "this would not have been seen"
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc")
def test_no_operation_is_shared_between_threads_of_openmp():
    run = subprocess.run([sys.executable, "-c", ALL_WORK], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_calls_in_two_threads_change_nothing_for_others(make_threads):
    room = torchrg.scenes.make_room(num_points=5_000, noise=0.003, seed=0)
    config = torchrg.load_config("classic")
    expected = torchrg.segment_planes(room.points, config).labels
    default, done, seen, results = torch.get_num_threads(), Event(), [], []

    def segment():
        before = torch.get_num_threads()
        results.extend(torchrg.segment_planes(room.points, config).labels for _ in range(2))
        seen.append(torch.get_num_threads() - before)

    def train():
        weights = torch.zeros(100, 10, requires_grad=True)
        while not done.wait(0.02):
            (weights.sum() ** 2).backward()
            seen.append(torch.get_num_threads() - default)
            make_threads(lambda: seen.append(torch.get_num_threads() - default))

    training = Thread(target=train)
    training.start()
    make_threads(segment, segment)
    done.set()
    training.join()
    assert len(results) == 4
    assert all(labels.equal(expected) for labels in results)
    assert set(seen) == {0}
    assert torch.get_num_threads() == default


@pytest.fixture
def make_threads(set_threads):
    """Run functions side by side and wait for them, with a setting of two threads."""
    set_threads(2)

    def start(*functions):
        threads = [Thread(target=function) for function in functions]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    return start
