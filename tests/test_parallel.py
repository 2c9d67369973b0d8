"""Calls leave torch's threads as they found them, and none of torch's own threads is ever used."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from threading import Barrier, Event, Thread, current_thread
from time import sleep

import pytest
import torch

import torchrg
from torchrg._parallel import (
    limit_rows,
    map_chunks,
    map_tasks,
    nonzero_rows,
    sequential_operations,
    split_rows,
)
from torchrg.robust import fit_detmcd

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


def results_of(number):
    """Bytes of what kernels of clouds, superpoints and images find, of one of two rooms."""
    points = torchrg.scenes.make_room(num_points=2_000, noise=0.003, seed=number % 2).points
    seg = torchrg.segment_planes(points)
    parts = torchrg.make_superpoints(points, seg, counts=40).labels
    normals = torchrg.estimate_normals(points[:300], method="paper", k=30).normals
    depth = torch.full((30, 40), 2.0, dtype=torch.float64)
    depth[:, 20 * (number % 2) :] = 2.5
    camera = torch.tensor([[30.0, 0, 19.5], [0, 30, 14.5], [0, 0, 1]])
    image = torchrg.depth.segment_depth(depth, camera)
    found = seg.labels, seg.normals, parts, normals, image.labels, image.normals
    return b"".join(values.numpy().tobytes() for values in found)


@pytest.fixture(scope="module")
def expected_results():
    return [results_of(number) for number in range(2)]


def test_threads_that_segment_at_once_find_what_one_finds(expected_results, set_threads):
    set_threads(2)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(results_of, range(4)))
    assert found == expected_results * 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_processes_that_are_forked_find_what_their_parent_finds(expected_results, set_threads):
    set_threads(2)
    torch.rand(1_000_000).sin()  # Starts a team of threads, which a forked process does not have.
    with get_context("fork").Pool(2) as pool:
        found = pool.map_async(results_of, range(2)).get(timeout=120)
    assert found == expected_results


def test_inference_mode_holds_in_all_threads(set_threads):
    set_threads(2)
    patches = torch.rand(3000, 12, 3, generator=torch.Generator().manual_seed(0))
    expected = fit_detmcd(patches)
    with torch.inference_mode():
        fit = fit_detmcd(patches)
    assert torch.equal(fit.location, expected.location)


def thread_states(look, number=2):
    """Call ``look`` once in each of several threads at the same time."""
    together = Barrier(number)

    def work(_):
        together.wait(timeout=60)
        return look()

    return map_tasks(work, range(number), torch.device("cpu"))


@pytest.mark.parametrize("enabled", [True, False])
def test_tasks_have_the_gradient_mode_of_their_caller(enabled, set_threads):
    set_threads(2)
    with torch.set_grad_enabled(enabled):
        assert thread_states(torch.is_grad_enabled) == [enabled] * 2
    with torch.inference_mode(enabled):
        assert thread_states(torch.is_inference_mode_enabled) == [enabled] * 2


def test_threads_start_once_in_a_call_and_end_with_it(set_threads):
    set_threads(2)
    with sequential_operations():
        first, second = ({*thread_states(current_thread)} for _ in range(2))
    assert first == second
    assert len(first) == 2
    assert [thread for thread in first if thread.is_alive()] == [current_thread()]


def test_an_error_waits_for_the_tasks_of_other_threads(set_threads):
    set_threads(2)
    caller, ended = current_thread(), []

    def look():
        if current_thread() is caller:
            raise ValueError("here")
        sleep(0.2)
        ended.append(True)

    with sequential_operations():
        with pytest.raises(ValueError, match="here"):
            thread_states(look)
        assert ended == [True]


@pytest.mark.parametrize("startable", [0, 1])
def test_tasks_run_at_a_limit_of_threads(startable, set_threads, monkeypatch):
    """As in a container, and while the interpreter exits."""
    set_threads(4)
    start, started = Thread.start, []

    def start_few(thread):
        if len(started) == startable:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    def work(number):
        sleep(0.01)
        return number

    monkeypatch.setattr(Thread, "start", start_few)
    for _ in range(2):
        assert map_tasks(work, range(20), torch.device("cpu")) == [*range(20)]
        started.clear()
    assert not [thread for thread in started if thread.is_alive()]


def test_a_thread_segments_at_the_end_of_a_script():
    script = """
import threading, time, torch, torchrg
torch.set_num_threads(2)
points = torchrg.scenes.make_room(20_000, noise=0.003, seed=0).points
def segment():
    time.sleep(0.3)  # The main thread has ended.
    print(len(torchrg.segment_planes(points, "classic").labels))
threading.Thread(target=segment).start()
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.stdout == "20000\n", run.stderr


def test_split_rows_by_example():
    assert repr(split_rows(5, 2)) == "[slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]"


def test_limit_rows_by_example():
    assert (limit_rows(16384, 50), limit_rows(16384, 640)) == (16384, 1638)


def test_map_chunks_by_example():
    assert map_chunks(lambda rows: rows.stop, 5, 3, torch.device("cpu")) == [3, 5]
    assert repr(map_chunks(lambda rows: rows, 0, 3, torch.device("cpu"))) == "[slice(0, 0, None)]"


def test_nonzero_rows_by_example():
    assert repr(nonzero_rows(torch.tensor([[True, False], [False, True]]))) == "tensor([0, 3])"
