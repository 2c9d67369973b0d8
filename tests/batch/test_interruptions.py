"""The whole command is stopped at any moment: no partial file, and the next run finishes."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.datasets.s3dis_tree import write_clean_room
from torchrg.batch.run import LOCK, list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.cli import main
from torchrg.config import load_config
from torchrg.datasets import FolderOfClouds
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
    return save_rooms(tmp_path_factory.mktemp("larger_rooms"), 20_000)


@pytest.fixture(scope="module")
def undisturbed(rooms, tmp_path_factory):
    """The bytes of every result, made here and by nothing but the job function."""
    return convert_here(rooms, tmp_path_factory.mktemp("undisturbed"))


def convert_here(rooms, out):
    """Convert rooms in this process, and return the bytes of every result."""
    for job in list_jobs(
        CloudSource(FolderOfClouds(rooms), load_config("classic", **{"planes.up": "z"})), out
    ):
        assert convert_scan(job).status == "converted"
    assert len(results_of(out)) == 6 * len(NAMES)
    return results_of(out)


def start(rooms, out, workers=1, kind="folder"):
    """Start the command in a process group of its own."""
    command = [sys.executable, "-m", "torchrg", "convert", kind, str(rooms), str(out)]
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
    """Check that every file there is the one of an undisturbed run, or a claim on files."""
    for name, content in results_of(out).items():
        assert content == undisturbed[name] or "claims" in json.loads(content), name


def finish(process):
    """Let a command end, which it does well."""
    shown, message = process.communicate()
    assert process.returncode == 0, message
    assert "4 of 4 scans are complete" in shown


def check_finishes(rooms, out, undisturbed, kind="folder"):
    """Run the command to its end and compare."""
    command = ["convert", kind, str(rooms), str(out), "--preset", "classic", "--workers", "1"]
    assert main(command) == 0
    assert results_of(out) == undisturbed
    assert not list(out.rglob(".*.np?"))


def test_a_killed_command_goes_on_where_it_was(rooms, undisturbed, tmp_path):
    process = start(rooms, tmp_path)
    wait_for_files(tmp_path, process, 9)
    process.kill()
    process.communicate()
    check_whole(tmp_path, undisturbed)
    check_finishes(rooms, tmp_path, undisturbed)


KILLS = 60
"""Kills of the command or one of its workers, for each kind of data set."""


def workers_of(process):
    """Return the running processes that a command has started, which are its workers."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, parent = path.read_text().rpartition(")")[2].split()[:2]
            if int(parent) == process.pid and state != "Z":
                found.append(int(path.parent.name))
    return found


def check_nothing_is_left(out):
    """Check that no temporary file and no empty folder is there."""
    assert [path.name for path in out.rglob(".*")] == [LOCK]
    assert not [path for path in out.rglob("*") if path.is_dir() and not any(path.iterdir())]


@pytest.fixture
def rooms_of_s3dis(tmp_path):
    """An area of small rooms as S3DIS is released."""
    for seed, name in enumerate(NAMES):
        objects = {"wall_1": 900 + 300 * seed, "floor_1": 600, "chair_1": 200}
        write_clean_room(tmp_path / "in" / "Area_1" / f"{name}_1", seed, objects)
    return tmp_path / "in"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["folder", "s3dis"])
def test_kills_at_random_moments_change_no_byte(rooms, rooms_of_s3dis, tmp_path, kind):
    if kind == "s3dis":
        pytest.importorskip("pyarrow")
    root, chance = {"folder": rooms, "s3dis": rooms_of_s3dis}[kind], random.Random(kind)
    begin = time.monotonic()
    finish(start(root, tmp_path / "undisturbed", workers=2, kind=kind))
    seconds = time.monotonic() - begin
    undisturbed, kills, round_number = results_of(tmp_path / "undisturbed"), 0, 0
    num_workers_killed = 0
    while kills < KILLS:
        out = tmp_path / f"round_{round_number}"
        round_number += 1
        is_done = False
        while not is_done and kills < KILLS:
            process = start(root, out, workers=2, kind=kind)
            if chance.random() < 0.5:
                time.sleep(chance.uniform(0, seconds))
            else:
                # A file more or less than now, finished or not, and a moment within its writing.
                count = sum(path.is_file() for path in out.rglob("*"))
                wait_for_files(out, process, count + chance.randint(1, 8))
                time.sleep(chance.choice([0, 0.002, 0.02, 0.1]))
            # A worker alone, the command alone, or both, as the kernel picks them.
            victim = chance.choice(["worker", "command", "all"])
            workers, is_done = workers_of(process), process.poll() is not None
            with contextlib.suppress(ProcessLookupError):
                if victim == "worker" and workers:
                    os.kill(chance.choice(workers), signal.SIGKILL)
                    num_workers_killed += not is_done
                else:
                    (os.kill if victim == "command" else os.killpg)(process.pid, signal.SIGKILL)
            # Without a worker, the command goes on to its end.
            _, message = process.communicate()
            assert process.returncode in (-signal.SIGKILL, 0, 3), message
            kills += not is_done
            is_done |= process.returncode == 0
            check_whole(out, undisturbed)
        check_finishes(root, out, undisturbed, kind=kind)
        check_nothing_is_left(out)
    assert 0 < num_workers_killed < KILLS


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_an_interrupt_says_how_to_go_on(larger_rooms, tmp_path, number):
    for attempt in range(5):
        out = tmp_path / str(attempt)
        process = start(larger_rooms, out)
        wait_for_files(out, process, 3)
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # A terminal sends it to the whole group.
        else:
            process.send_signal(number)
        _, message = process.communicate()
        if process.returncode:
            break  # Else all rooms were done before the signal came.
    assert process.returncode == 130, message
    assert message.count("\n") == 1
    assert "of 4 scans are complete. Rerun the same command to resume." in message
    assert not list(out.rglob(".*.np?"))
