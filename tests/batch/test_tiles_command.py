"""``torchrg segment`` of clouds beyond the limit of memory, and of several files as one."""

import os
import re
import signal
import subprocess
import sys
from collections import Counter
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrg.batch.lock import DirectoryLock
from torchrg.batch.tiles import (
    choose_tile_size,
    choose_workers,
    folder_of_work,
    segmented_in_tiles,
)
from torchrg.cli import main, segment
from torchrg.config import load_config
from torchrg.errors import ConfigError
from torchrg.io import read_cloud, stream_cloud
from torchrg.pipeline import segment_planes
from torchrg.render import color_planes, render_cloud
from torchrg.scenes import make_room

LIMIT = "0.542"
"""Gigabytes: what a few thousand points take in tiles, and not in memory at once."""
ROOM = 40_000


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Two files, with points that are not finite in one."""
    folder = tmp_path_factory.mktemp("rooms")
    room = make_room(num_points=ROOM, noise=0.003, seed=1)
    points = room.points.numpy()
    points[7] = np.nan
    np.savez(folder / "a.npz", points=points[::2], labels=room.labels[::2], other=points[::2, 0])
    np.savez(folder / "b.npz", points=points[1::2], labels=room.labels[1::2])
    return folder


def run(*arguments):
    return main(["segment", *map(str, arguments)])


@pytest.mark.parametrize("flags", [(), ("--voxel", "0.1")])
def test_tiles_and_memory_write_the_same_bytes(rooms, tmp_path, capsys, flags):
    files = (rooms / "a.npz", rooms / "b.npz", "--merge", "--preset", "classic", *flags)
    whole = ("--out", tmp_path / "whole.npz", "--limit-memory", "9", "--orient", "none")
    assert run(*files, *whole) == 0
    assert "in tiles of" not in capsys.readouterr().out
    assert run(*files, "--out", tmp_path / "tiles.npz", "--limit-memory", LIMIT) == 0
    said = capsys.readouterr().out.splitlines()
    assert "about 40,000 points take 0.54 GB of memory, the limit is 0.54: in tiles of" in said[0]
    assert "normals keep their signs, as with --orient none" in said[0]
    assert (tmp_path / "whole.npz").read_bytes() == (tmp_path / "tiles.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiles.npz", "whole.npz"]


@pytest.mark.parametrize(
    ("value", "out", "code", "message"),
    [
        (1.0, "x.npz", 0, "no plane found: all points are equal"),
        (np.nan, "x.npz", 2, "expected finite points, got none in 40,000 points"),
        (None, "x.npz", 0, "1 of 40,000 points are not finite or beyond 1e+12; they stay in "),
        (None, "x.las", 2, "got 1 points that are not (first: 4)"),
    ],
)
def test_tiles_say_what_memory_says_before_the_work(tmp_path, capsys, value, out, code, message):
    if out == "x.las":
        pytest.importorskip("laspy")
    points = np.full((ROOM, 3), 1.0 if value is None else value, np.float32)
    points[4, 0] = np.nan if value is None else points[4, 0]
    np.savez(tmp_path / "points.npz", points=points)
    for limit in ("9", LIMIT):
        flags = ("--preset", "classic", "--limit-memory", limit)
        assert run(tmp_path / "points.npz", "--out", tmp_path / out, *flags) == code
        assert message in capsys.readouterr().err
        assert not (tmp_path / ".x.tiles").exists()


def test_several_files_are_one_cloud_with_the_fields_of_all(rooms, tmp_path):
    files = (rooms / "a.npz", rooms / "b.npz", "--merge", "--preset", "classic")
    assert run(*files, "--out", tmp_path / "both.ply") == 0
    both = read_cloud(tmp_path / "both.ply")
    parts = [read_cloud(rooms / name) for name in ("a.npz", "b.npz")]
    points = np.concatenate([part.coordinates for part in parts])
    np.testing.assert_array_equal(both.coordinates, points)
    found = segment_planes(torch.from_numpy(points), load_config("classic"))
    np.testing.assert_array_equal(both.fields["labels"], found.labels)
    assert "other" not in both.fields


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ("--limit-memory", "0.1"),
            "a.npz: expected --limit-memory of at least 0.54 GB for about 20,000",
        ),
        (
            ("--limit-memory", "-1"),
            "expected --limit-memory above 0 and at most 1,000,000 GB, got -1",
        ),
        (("--limit-memory", "inf"), "at most 1,000,000 GB, got inf"),
        (("--limit-memory", "nan"), "at most 1,000,000 GB, got nan"),
        (("--threads", "100000"), "expected --threads from 1 to 1,024, got 100000"),
        (
            ("--limit-memory", LIMIT, "--merge", "--superpoints"),
            "expected no --superpoints for a cloud .* no tile tells it; raise --limit-memory",
        ),
        (
            ("--limit-memory", LIMIT, "--merge", "--picture", "x.png"),
            r"expected --limit-memory of at least 0\.71 GB for --picture, got 0\.54 GB; raise it",
        ),
        (
            ("--limit-memory", LIMIT, "--merge", "--orient", "interior"),
            "expected no --orient interior for a cloud .* no tile tells its side; raise --limit",
        ),
        (("--ray-address", "auto"), "expected --ray-address together with --engine ray"),
    ],
)
def test_what_cannot_be_done_is_one_line(rooms, tmp_path, capsys, flags, message):
    files = sorted(rooms.iterdir())[: 1 + ("--merge" in flags)]
    assert run(*files, "--out", tmp_path / "x.npz", *flags) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_folder_of_work_is_of_one_command(rooms, tmp_path, capsys):
    files = (rooms / "a.npz", rooms / "b.npz", "--merge", "--out", tmp_path / "x.npz")
    work = folder_of_work(tmp_path / "x.npz", tmp_path / "work")
    work.mkdir(parents=True)
    with DirectoryLock(work):
        assert run(*files, "--workdir", tmp_path / "work", "--limit-memory", LIMIT) == 2
    assert "another torchrg" in capsys.readouterr().err


def test_a_directory_for_work_may_hold_what_it_likes(tmp_path, capsys):
    shared = tmp_path / "shared"
    shared.mkdir()
    np.save(shared / "scan.npy", make_room(num_points=ROOM, seed=1).points)
    names = ("model.pt", "sensor.raw", "points.npy", "normals.npy", ".x.01234567.y", "tiles.json")
    for name in names:
        (shared / name).write_text(f"the user's {name}")
    before = {path: path.read_bytes() for path in shared.iterdir()}
    work = ("--preset", "classic", "--limit-memory", LIMIT, "--workdir", shared)
    assert run(shared / "scan.npy", "--out", shared / "result.npy", *work) == 0
    assert f"in {shared}{os.sep}result.npy." in capsys.readouterr().out
    assert np.load(shared / "result.npy").shape[0] == ROOM
    (shared / "result.npy").unlink()
    assert {path: path.read_bytes() for path in shared.iterdir()} == before


@pytest.mark.parametrize("flags", [(), ("--workdir", "work")])
def test_what_is_in_the_way_of_the_work_is_named_and_stays(tmp_path, capsys, monkeypatch, flags):
    monkeypatch.chdir(tmp_path)
    np.save("scan.npy", make_room(num_points=ROOM, seed=1).points)
    folder = folder_of_work(Path("x.npz"), Path("work") if flags else None)
    folder.mkdir(parents=True)
    scan = Path("scan.npy").rename(folder / "scan.npy")
    said = {
        scan: f"{scan}: expected a file outside of {folder}",
        Path("scan.npy"): f"{folder}: expected an empty directory or the work of an earlier call",
    }
    for source, message in said.items():
        if source != scan:
            source.write_bytes(scan.read_bytes())
        assert run(source, "--out", "x.npz", "--limit-memory", LIMIT, *flags) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert [path.name for path in folder.iterdir()] == ["scan.npy"]


def draw_in_both_ways(monkeypatch, files, folder, picture, most):
    """Segment and draw in memory and in tiles; return the results that were drawn."""
    drawn = []

    def draw(arguments, path, result):
        drawn.append(result)
        draw_result(arguments, path, result)

    draw_result = segment._draw
    monkeypatch.setattr(segment, "_draw", draw)
    monkeypatch.setattr(segment, "MAX_POINTS", most)
    monkeypatch.setattr("torchrg.render.gallery.render_cloud", partial(render_cloud, width=80))
    for name, least in (("whole", 0), ("tiles", 3e9)):
        monkeypatch.setattr(segment, "memory_of_scan", lambda num_points, least=least: least)
        (folder / name).mkdir()
        flags = ("--merge", "--preset", "classic", "--limit-memory", "2")
        out = ("--out", folder / name / "x.npz", "--picture", folder / name / picture)
        assert run(*files, *flags, *out) == 0
    return drawn


@pytest.mark.slow
@pytest.mark.parametrize("picture", ["x.png", "x.html"])
def test_tiles_and_memory_draw_the_same_bytes(rooms, tmp_path, monkeypatch, picture):
    if picture == "x.html":
        pytest.importorskip("pydeck")
    files = (rooms / "a.npz", rooms / "b.npz")
    draw_in_both_ways(monkeypatch, files, tmp_path, picture, ROOM)
    whole, tiles = ((tmp_path / name / picture).read_bytes() for name in ("whole", "tiles"))
    assert whole == tiles


def test_a_sample_shows_the_planes_that_memory_finds(rooms, tmp_path, monkeypatch):
    files, most = (rooms / "a.npz", rooms / "b.npz"), 4_000
    whole, sample = draw_in_both_ways(monkeypatch, files, tmp_path, "x.png", most)
    assert most <= len(sample.cloud) <= most + 6
    label_of = dict(zip(map(bytes, whole.cloud.coordinates), whole.labels.tolist(), strict=True))
    labels = [label_of[bytes(point)] for point in sample.cloud.coordinates]
    assert sample.labels.tolist() == labels
    assert len(set(labels)) == len(whole.planes.count) + 1
    for one, other in zip(sample.planes[:10], whole.planes[:10], strict=True):
        assert torch.equal(one, other)
    colors = color_planes(sample.labels, sample.cloud.points).tolist()
    assert len({(label, *color) for label, color in zip(labels, colors, strict=True)}) == len(
        set(labels)
    )
    np.testing.assert_array_equal(sample.cloud.origin, whole.cloud.origin)
    assert sample.whole[:2] == (ROOM, ROOM - 1)


def test_tiles_are_as_large_as_memory_allows():
    assert choose_tile_size(10**5, 10**9) > choose_tile_size(10**5, 8 * 10**8)
    assert choose_tile_size(10**7, 10**12) == choose_tile_size(1, 10**12)
    with pytest.raises(ConfigError, match=r"expected --limit-memory of at least 100\.88 GB"):
        choose_tile_size(10**9, 3 * 10**9)


def test_workers_are_as_many_as_memory_and_points_are_worth():
    before = torch.get_num_threads()
    torch.set_num_threads(8)
    try:
        assert choose_workers(10**8, 300_000, 10**11) == 8
        assert choose_workers(10**7, 300_000, 10**11) == 5
        # Half a gigabyte for this process, 1.1 for each of the others.
        assert choose_workers(10**8, 300_000, 3 * 10**9) == 2
        assert choose_workers(10**8, 300_000, 10**9) == 1
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_processes_give_the_labels_of_one(tmp_path):
    points = make_room(num_points=3000, noise=0.003, seed=2).points
    np.save(tmp_path / "room.npy", points)
    config = load_config("paper")
    with segmented_in_tiles(
        [tmp_path / "room.npy"],
        stream_cloud(tmp_path / "room.npy"),
        tmp_path / "work",
        config,
        tile_size=500,
        workers=2,
    ) as found:
        expected = segment_planes(points, config)
        np.testing.assert_array_equal(found.labels, expected.labels)
        np.testing.assert_array_equal(found.normals, expected.normals)
    assert not (tmp_path / "work").exists()


def python(*arguments):
    """Run Python with the modules of this folder at hand."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])
    }
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


@pytest.mark.slow
def test_killed_in_every_stage_it_goes_on_and_does_no_tile_twice(tmp_path):
    np.save(tmp_path / "room.npy", make_room(num_points=3000, noise=0.003, seed=2).points)
    script, deaths = Path(__file__).with_name("killed_tiles.py"), 0
    while (done := python(script, tmp_path / "room.npy", tmp_path / "work", 7)).returncode:
        assert done.returncode == -signal.SIGKILL, done.stderr
        deaths += 1
    assert deaths > 5
    python(script, tmp_path / "room.npy", tmp_path / "other", 0)
    for name in ("labels", "normals", "area"):
        found, expected = (np.load(tmp_path / f"{run}.npz")[name] for run in ("work", "other"))
        np.testing.assert_array_equal(found, expected)
    assert set(Counter((tmp_path / "work.log").read_text().splitlines()).values()) == {1}


@pytest.mark.slow
def test_a_hundred_kills_at_random_moments_change_nothing(tmp_path):
    np.save(tmp_path / "room.npy", make_room(num_points=3000, noise=0.003, seed=2).points)
    (tmp_path / "out").mkdir()
    script = Path(__file__).with_name("killed_at_random.py")
    done = python(script, tmp_path / "room.npy", tmp_path / "out", 100, 1)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 10


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_ray_gives_the_bytes_of_one_process(rooms, tmp_path):
    files = (rooms / "a.npz", rooms / "b.npz", "--merge", "--preset", "classic")
    assert run(*files, "--out", tmp_path / "here.npz", "--limit-memory", LIMIT) == 0
    options = ("--out", tmp_path / "ray.npz", "--limit-memory", LIMIT, "--engine", "ray")
    done = python("-m", "torchrg", "segment", *files, *options)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "ray.npz").read_bytes() == (tmp_path / "here.npz").read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_a_lost_node_changes_no_byte(tmp_path):
    points = make_room(num_points=15_000, noise=0.003, seed=3).points
    np.save(tmp_path / "room.npy", points)
    script = Path(__file__).with_name("lose_tiles.py")
    done = python(script, tmp_path / "room.npy", tmp_path / "found.npz")
    assert done.returncode == 0, done.stderr
    whole = segment_planes(points, load_config("paper"))
    with np.load(tmp_path / "found.npz") as found:
        np.testing.assert_array_equal(found["labels"], whole.labels)
        np.testing.assert_array_equal(found["normals"], whole.normals)
    assert not (tmp_path / "found.work").exists()
