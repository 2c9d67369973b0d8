"""The power may go at any moment: the same command goes on, and its result is the same."""

import os
import random
import shutil
from functools import partial

import numpy as np
import pytest

from tests.batch.power import Disk, PowerCutError
from torchrg.batch.run import list_jobs, lock_folder, make_plan
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.config import load_config
from torchrg.datasets import FolderOfClouds
from torchrg.scenes import make_room

SYSTEM_CALLS = ("fsync", "unlink", "replace", "mkdir", "rmdir")
"""Calls that change a folder, or flush it."""


def convert(root):
    """Convert a folder of rooms, as the command does."""
    out = root / "out"
    out.mkdir(exist_ok=True)
    jobs = list_jobs(CloudSource(FolderOfClouds(root / "rooms"), load_config("classic")), out)
    with lock_folder(out):
        for job in make_plan(jobs).to_convert:
            assert convert_scan(job).status == "converted"
    (out / ".torchrg.lock").unlink()


def make_rooms(root):
    """Make two rooms to convert."""
    (root / "rooms").mkdir(parents=True)
    for seed in (2, 3):
        np.save(root / "rooms" / f"{seed}.npy", make_room(num_points=600, seed=seed).points)


def contents(root):
    """Return the bytes of every file."""
    files = (path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


class Moments:
    """Moments at which the power can go: before each change of a file or a folder."""

    def __init__(self, monkeypatch, disk):
        self.left, self.number, self.on_cut = -1, 0, None
        for name in SYSTEM_CALLS:
            call = disk.fsync if name == "fsync" else getattr(os, name)
            monkeypatch.setattr(os, name, partial(self.pass_by, call))

    def pass_by(self, call, *given, **options):
        """Do what was asked for, or end if this is the moment."""
        self.number += 1
        self.left -= 1
        if self.left == 0:
            self.on_cut()
            raise PowerCutError
        return call(*given, **options)


@pytest.mark.parametrize(
    "seed", [pytest.param(n, marks=pytest.mark.slow if n > 1 else ()) for n in range(20)]
)
def test_after_a_power_cut_the_same_command_goes_on(seed, tmp_path, monkeypatch):
    root, after, rng = tmp_path / "disk", tmp_path / "after", random.Random(seed)
    make_rooms(root)
    disk = Disk(root, tmp_path / "flushed")
    disk.settle()
    with monkeypatch.context() as patch:
        moments = Moments(patch, disk)
        convert(root)
        number = moments.number
    expected = contents(root)
    assert len(expected) > 3
    shutil.rmtree(root)
    make_rooms(root)
    disk.settle()
    for moment in (1 + seed * number // 20, rng.randrange(1, number), rng.randrange(1, number)):
        with monkeypatch.context() as patch:
            moments = Moments(patch, disk)
            moments.left = moment
            moments.on_cut = partial(disk.cut, after, rng)
            try:
                convert(root)
            except PowerCutError:
                disk.restore(after)
    with monkeypatch.context() as patch:
        Moments(patch, disk)
        convert(root)
    assert contents(root) == expected
    # What a command that has ended well has written stays, whatever comes then.
    disk.cut(after, rng)
    disk.restore(after)
    assert contents(root).items() >= expected.items()
