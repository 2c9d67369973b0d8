"""The whole command is stopped at any moment: no partial file, and the next run finishes."""

import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from torchrg.batch.convert import convert_scan
from torchrg.batch.run import list_jobs
from torchrg.batch.sources import FolderSource
from torchrg.config import load_config
from torchrg.scenes import make_room

NAMES = ("hall", "lobby", "office", "store")


def save_rooms(folder, num_points):
    """Make rooms of about so many points, and return their folder."""
    for seed, name in enumerate(NAMES):
        points = make_room(num_points=num_points + 500 * seed, seed=seed).points
        np.save(folder / f"{name}.npy", points)
    return folder


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """A folder of small rooms."""
    return save_rooms(tmp_path_factory.mktemp("rooms"), 3000)


@pytest.fixture(scope="module")
def larger_rooms(tmp_path_factory):
    """A folder of rooms that take long enough for a signal to come between them."""
    return save_rooms(tmp_path_factory.mktemp("larger_rooms"), 40_000)


@pytest.fixture(scope="module")
def undisturbed(rooms, tmp_path_factory):
    """The bytes of every result, made here and by nothing but the job function."""
    return convert_here(rooms, tmp_path_factory.mktemp("undisturbed"))


def convert_here(rooms, out):
    """Convert rooms in this process, and return the bytes of every result."""
    for job in list_jobs(FolderSource(rooms, load_config("classic"), out), out):
        assert convert_scan(job).status == "converted"
    assert len(results_of(out)) == 6 * len(NAMES)
    return results_of(out)


def start(rooms, out, workers=1):
    """Start the command in a process group of its own."""
    command = [sys.executable, "-m", "torchrg", "convert", "folder", str(rooms), str(out)]
    return subprocess.Popen(
        [*command, "--preset", "classic", "--workers", str(workers)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=hear_interrupts,
    )


def hear_interrupts():
    """Undo what a shell does to what it runs in the background: SIGINT is ignored there."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def results_of(out):
    """Return the bytes of every file under its final name."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in out.rglob("*")
        if path.is_file() and not path.name.startswith(".") and path.name != "report.json"
    }


def wait_for_files(out, process, count):
    """Wait until so many files, finished or not, are there, or the command has ended."""
    while process.poll() is None and len([p for p in out.rglob("*") if p.is_file()]) < count:
        time.sleep(0.002)


def check_whole(out, undisturbed):
    """Check that every file there is the one of an undisturbed run."""
    for name, content in results_of(out).items():
        assert content == undisturbed[name], name


def check_finishes(rooms, out, undisturbed):
    """Run the command to its end and compare."""
    process = start(rooms, out)
    shown, told = process.communicate()
    assert process.returncode == 0, told
    assert results_of(out) == undisturbed
    assert not list(out.rglob(".*.np?"))
    assert "4 of 4 scans are complete" in shown


def kill_and_go_on(rooms, out, undisturbed, moments, *, whole_group, workers=1):
    """Kill the command when it has written so many files, again and again, then let it finish."""
    for count in moments:
        process = start(rooms, out, workers)
        wait_for_files(out, process, count)
        if whole_group:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.send_signal(signal.SIGKILL)
        process.communicate()
        check_whole(out, undisturbed)
    check_finishes(rooms, out, undisturbed)


def test_a_killed_command_goes_on_where_it_was(rooms, undisturbed, tmp_path):
    # Its workers are left to themselves, as when the kernel picks the process.
    kill_and_go_on(rooms, tmp_path, undisturbed, [9], whole_group=False)


@pytest.mark.slow
@pytest.mark.parametrize("whole_group", [True, False])
def test_ten_kills_at_random_moments_change_nothing(rooms, undisturbed, tmp_path, whole_group):
    moments = random.Random(int(whole_group)).choices(range(2, 26), k=10)
    kill_and_go_on(rooms, tmp_path, undisturbed, moments, whole_group=whole_group, workers=2)
    for seed in range(10):
        out = tmp_path / f"by_time_{seed}"
        process = start(rooms, out, workers=2)
        time.sleep(random.Random(seed).uniform(0, 8))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        check_whole(out, undisturbed)
    check_finishes(rooms, out, undisturbed)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_says_how_to_go_on(larger_rooms, tmp_path, number):
    for attempt in range(5):
        out = tmp_path / str(attempt)
        process = start(larger_rooms, out)
        wait_for_files(out, process, 3)
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # A terminal sends it to the whole group.
        else:
            process.send_signal(number)
        _, told = process.communicate()
        if process.returncode:
            break  # Else all rooms were done before the signal came.
    assert process.returncode == 130, told
    assert told.count("\n") == 1
    assert "of 4 scans are complete. The same command goes on from here." in told
    assert not list(out.rglob(".*.np?"))
    check_whole(out, convert_here(larger_rooms, tmp_path / "undisturbed"))
