"""``torchrg segment`` of clouds beyond the limit of memory, and of several files as one."""

import re

import numpy as np
import pytest
import torch

from torchrg import scratch
from torchrg.cli import segment
from torchrg.config import load_config
from torchrg.io import read_cloud
from torchrg.neighbors import blocks, sample_voxels
from torchrg.pipeline import segment_planes

LIMIT, WITH_SUPERPOINTS = "0.404", "0.415"
"""Gigabytes: what some thousand points take on a disk, and not in memory."""
ROOM = 40_000


@pytest.fixture(scope="module")
def rooms(room, tmp_path_factory):
    """Two files, with points that are not finite in one."""
    folder, room = tmp_path_factory.mktemp("rooms"), room(ROOM)
    points = room.points.numpy()
    points[8] = np.nan
    np.savez(folder / "a.npz", points=points[::2], labels=room.labels[::2], other=points[::2, 0])
    np.savez(folder / "b.npz", points=points[1::2], labels=room.labels[1::2])
    return folder


@pytest.mark.parametrize("flags", [(), ("--voxel", "0.1"), ("--superpoints", "300,50")])
def test_the_disk_and_memory_write_the_same_bytes(rooms, tmp_path, run, monkeypatch, flags):
    monkeypatch.setattr(scratch, "_MIN_BYTES", 1)
    monkeypatch.setattr(blocks, "BLOCK_SIZE", 10_000)
    files = (rooms / "a.npz", "--preset", "classic", *flags)
    smallest = WITH_SUPERPOINTS if "--superpoints" in flags else LIMIT
    for folder, limit, said in (("whole", "9", False), ("disk", smallest, True)):
        (tmp_path / folder).mkdir()
        done = run(
            "segment", *files, "--out", tmp_path / folder / "out.npz", "--limit-memory", limit
        )
        assert ("moving the largest arrays to disk" in done.out) == said
    whole, disk = (
        {path.relative_to(tmp_path / folder): path.read_bytes() for path in files}
        for folder in ("whole", "disk")
        for files in [[p for p in (tmp_path / folder).rglob("[!.]*") if p.is_file()]]
    )
    assert whole == disk


def test_several_files_are_one_cloud_with_the_fields_of_all(rooms, tmp_path, run):
    files = (rooms / "a.npz", rooms / "b.npz", "--merge", "--preset", "classic")
    assert run("segment", *files, "--out", tmp_path / "both.ply").code == 0
    both = read_cloud(tmp_path / "both.ply")
    parts = [read_cloud(rooms / name) for name in ("a.npz", "b.npz")]
    points = np.concatenate([part.coordinates for part in parts])
    np.testing.assert_array_equal(both.coordinates, points)
    found = segment_planes(torch.from_numpy(points), load_config("classic"))
    np.testing.assert_array_equal(both.fields["labels"], found.labels)
    assert "other" not in both.fields


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ("0.1", r"a.npz: expected --limit-memory of at least 0.402 GB for about 20,000"),
        ("-1", "expected --limit-memory above 0, at most 1,000,000 GB, got -1"),
    ],
)
def test_what_cannot_be_done_is_one_line(rooms, tmp_path, run, limit, message):
    done = run("segment", rooms / "a.npz", "--out", tmp_path / "x.npz", "--limit-memory", limit)
    assert re.search(message, done.error)
    assert not any(tmp_path.iterdir())


def test_settings_that_multiply_memory_are_planned(rooms, tmp_path, run):
    flags = "--normals.k", "100000", "--limit-memory", "1"
    done = run("segment", rooms / "a.npz", "--out", tmp_path / "x.npz", *flags)
    # 20,000 points have 20,000 neighbors each, at 4 bytes on the disk and more in memory.
    assert "GB for about 20,000 points with --normals.k 100000, got 1 GB; raise it" in done.error


def test_a_full_disk_is_said_before_the_work(rooms, tmp_path, run, monkeypatch):
    monkeypatch.setattr("torchrg.io.files.free_space", lambda folder: 1000)
    monkeypatch.setattr(segment, "segment_cloud", None)
    done = run("segment", rooms / "b.npz", "--out", tmp_path / "x.npz", "--limit-memory", LIMIT)
    assert re.search(r"expected [\d.]+ MB of free disk for the work, got 0\.0 MB", done.error)


def test_the_number_of_sites_is_said(rooms, tmp_path, run):
    files = (rooms / "b.npz", "--out", tmp_path / "x.npz", "--preset", "classic")
    done = run("segment", *files, "--voxel", "0.2")
    points = read_cloud(rooms / "b.npz").points
    num_sites = len(sample_voxels(points, 0.2).rows)
    assert f"{num_sites:,} sites, one of the 20,000 points per voxel" in done.out
    done = run("segment", *files, "--limit-memory", LIMIT)
    (voxel,) = re.findall(r"--voxel ([\d.]+) would segment about half of the points", done.out)
    assert 0.4 < len(sample_voxels(points, float(voxel)).rows) / len(points) < 0.55


def test_the_file_is_read_to_the_disk(rooms, tmp_path, run, monkeypatch):
    active, read = [], segment.read_cloud

    def watch(*arguments, **options):
        active.append(scratch.is_active())
        return read(*arguments, **options)

    monkeypatch.setattr(segment, "read_cloud", watch)
    for limit in ("9", LIMIT):
        run("segment", rooms / "b.npz", "--out", tmp_path / "x.npz", "--limit-memory", limit)
    assert active == [False, True]
