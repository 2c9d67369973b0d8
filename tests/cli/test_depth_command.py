"""``torchrg depth``: planes of depth images and of organised clouds."""

import contextlib
import hashlib
import json
import os
import random
import re
import signal
import struct
import subprocess
import sys
import time

import kornia_rs
import numpy as np
import pytest
import torch

from torchrg import _compile
from torchrg.batch.lock import DirectoryLock
from torchrg.batch.scans import Scan
from torchrg.cli import main
from torchrg.cli.depth import FrameJob
from torchrg.depth import segment_depth
from torchrg.depth.camera import depth_to_points, make_intrinsics
from torchrg.io import read_cloud, write_cloud
from torchrg.render import write_png
from torchrg.structures import Cloud

CAMERA = ["--intrinsics", "50,50,39.5,29.5", "--depth-scale", "1000", "--threads", "1"]
INTRINSICS = make_intrinsics(50.0, 50.0, 39.5, 29.5)


@pytest.fixture
def depth():
    """A wall with a step and a hole, in metres."""
    depth = torch.full((60, 80), 2.0)
    depth[:, 50:] = 2.5
    depth[:4, :5] = 0
    return depth


@pytest.fixture
def frame(tmp_path, depth):
    path = tmp_path / "frame.png"
    write_png(path, (depth * 1000).round().int())
    return path


def test_a_depth_image_becomes_labels_and_a_picture(tmp_path, frame, depth, capsys):
    out = tmp_path / "labels.png"
    assert main(["depth", str(frame), *CAMERA, "--out", str(out)]) == 0
    labels = kornia_rs.io.read_image_png_u16(str(out), "mono")[..., 0].astype(int) - 1
    expected = segment_depth(depth, INTRINSICS).labels.numpy()
    np.testing.assert_array_equal(labels, expected)
    assert sorted(np.unique(labels)) == [-1, 0, 1]
    picture = kornia_rs.io.read_image_png_u8(str(tmp_path / "labels_planes.png"), "rgb")
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 3
    assert not picture[0, 0].any()
    assert "80 x 60 pixels, 4,780 with depth, 2 planes, 100.0 %" in capsys.readouterr().out


def test_a_depth_image_becomes_a_cloud(tmp_path, frame, depth):
    for suffix in (".npz", ".pcd"):
        out = tmp_path / f"cloud{suffix}"
        assert main(["depth", str(frame), *CAMERA, "--out", str(out)]) == 0
        cloud = read_cloud(out)
        points = depth_to_points(depth[None].double(), INTRINSICS[None])[0].view(-1, 3)
        np.testing.assert_allclose(cloud.coordinates, points.float(), rtol=1e-6)
        expected = segment_depth(depth, INTRINSICS).labels.flatten()
        np.testing.assert_array_equal(cloud.fields["labels"], expected)
    assert cloud.grid_shape == (60, 80)
    with np.load(tmp_path / "cloud.npz") as result:
        np.testing.assert_allclose(result["plane_offset"], [2.0, 2.5], rtol=1e-6)
        provenance = json.loads(str(result["provenance"]))
    assert provenance["intrinsics"] == "50,50,39.5,29.5"
    assert provenance["config"]["depth"]["min_size"] == 100


def test_without_a_place_for_kernels_a_line_says_so_and_all_runs_as_written(
    tmp_path, frame, monkeypatch, capsys
):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TORCHRG_CACHE_DIR", str(tmp_path / "file" / "below"))
    monkeypatch.setattr(_compile, "_prepared", {})
    out = tmp_path / "planes.npz"
    assert main(["depth", str(frame), *CAMERA, "--compile", "--out", str(out)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "kernels are not compiled" in line
    with np.load(out) as result:
        assert json.loads(str(result["provenance"]))["compile"] is False


@pytest.mark.parametrize("focal", [50.0, 500.0])
def test_organised_clouds_keep_their_grid(tmp_path, depth, focal):
    camera = make_intrinsics(focal, focal, 39.5, 29.5)
    points = depth_to_points(depth[None], camera[None])[0].view(-1, 3)
    source, out = tmp_path / "scan.pcd", tmp_path / "out.pcd"
    write_cloud(source, Cloud(points.numpy(), grid_shape=(60, 80)))
    # A narrow cloud is moved to an origin of its own; its planes stay where they are.
    assert read_cloud(source).origin.any() == (focal == 500)
    assert main(["depth", str(source), "--threads", "1", "--out", str(out)]) == 0
    cloud = read_cloud(out)
    assert cloud.grid_shape == (60, 80)
    np.testing.assert_array_equal(cloud.coordinates, points)
    expected = segment_depth(depth, camera).labels.flatten()
    np.testing.assert_array_equal(cloud.fields["labels"], expected)
    result = tmp_path / "out.npz"
    assert main(["depth", str(source), "--threads", "1", "--out", str(result)]) == 0
    with np.load(result) as arrays:
        np.testing.assert_allclose(arrays["plane_offset"], [2.0, 2.5], rtol=1e-5)


def test_segment_says_that_a_cloud_is_a_depth_image(tmp_path, capsys, depth):
    points = depth_to_points(depth[None], INTRINSICS[None])[0].view(-1, 3).numpy()
    turned = points[:, [2, 0, 1]]
    for name, coordinates, grid in (
        ("image", points, (60, 80)),
        ("list", points, None),
        ("turned", turned, (60, 80)),
    ):
        source = tmp_path / f"{name}.pcd"
        write_cloud(source, Cloud(coordinates, grid_shape=grid))
        flags = ["--preset", "classic", "--out", str(tmp_path / "out.npz")]
        assert main(["segment", str(source), *flags]) == 0
        assert ("taken by a depth camera; torchrg depth" in capsys.readouterr().err) == (
            name == "image"
        )


def test_several_images_go_into_a_folder(tmp_path, frame):
    other, out = tmp_path / "other.png", tmp_path / "out"
    other.write_bytes(frame.read_bytes())
    inputs = [str(frame), str(other)]
    assert main(["depth", *inputs, *CAMERA, "--out", str(out)]) == 0
    names = ["frame.png", "frame_planes.png", "other.png", "other_planes.png"]
    assert sorted(path.name for path in out.iterdir()) == names


@pytest.fixture
def sequence(tmp_path, depth):
    """A folder of four frames that differ, the third of them damaged, and a file that is none."""
    folder = tmp_path / "sequence"
    folder.mkdir()
    for number in (1, 2, 3, 10):
        write_png(folder / f"{number}.png", (depth * (1000 + number)).round().int())
    damaged = (folder / "3.png").read_bytes()
    (folder / "3.png").write_bytes(damaged[: len(damaged) // 2])
    (folder / "notes.txt").write_text("a desk")
    return folder


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_damaged_frame_of_a_sequence_stops_no_other(tmp_path, sequence, capsys):
    out = tmp_path / "out"
    assert main(["depth", str(sequence), *CAMERA, "--out", str(out)]) == 3
    told = capsys.readouterr()
    damaged, sums = told.err.splitlines()
    assert damaged.startswith(f"torchrg: {sequence / '3.png'}: ")
    assert damaged.count("3.png") == 1
    assert sums == "torchrg: 1 of 4 inputs failed, the others are written."
    speed = r"[\d.]+ s, [\d.]+ frames a second"
    assert re.fullmatch(rf"3 of 4 frames, 6 planes, {speed} -> {out}\n", told.out)
    for number in (1, 2, 10):
        alone = tmp_path / "alone.png"
        assert main(["depth", str(sequence / f"{number}.png"), *CAMERA, "--out", str(alone)]) == 0
        assert contents(out)[f"{number}.png"] == alone.read_bytes()
    assert len(contents(out)) == 6


@pytest.mark.slow
def test_processes_side_by_side_write_the_same_bytes(tmp_path, sequence):
    results = []
    for workers in ("1", "2", "3"):
        out = tmp_path / workers
        command = [sys.executable, "-m", "torchrg", "depth", str(sequence), *CAMERA, "--out", out]
        ended = subprocess.run([*command, "--workers", workers], check=False, capture_output=True)
        assert ended.returncode == 3
        assert ended.stderr.count(b"\n") == 2
        results.append(contents(out))
    assert len(results[0]) == 6
    assert results[0] == results[1] == results[2]


def written(folder):
    """Return when each file was written."""
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()}


def test_frames_that_are_done_are_not_done_again(tmp_path, sequence, frame, capsys):
    out = tmp_path / "out"
    command = ["depth", str(sequence), *CAMERA, "--out", str(out)]
    assert main(command) == 3
    before = written(out)
    (sequence / "3.png").write_bytes(frame.read_bytes())
    assert main(command) == 0
    assert "4 of 4 frames, 8 planes" in capsys.readouterr().out
    after = written(out)
    assert after.keys() - before.keys() == {"3.png", "3_planes.png"}
    assert before.items() <= after.items()
    # An input, a result, a picture and a setting that are others than the labels say.
    first = contents(out)
    (sequence / "1.png").write_bytes(frame.read_bytes())
    pixels = kornia_rs.io.read_image_png_u16(str(out / "2.png"), "mono")
    kornia_rs.io.write_image_png_u16(str(out / "2.png"), pixels, "mono")
    (out / "10_planes.png").unlink()
    before = written(out)
    assert main(command) == 0
    changed = dict(written(out).items() - before.items())
    assert {name.partition(".")[0].removesuffix("_planes") for name in changed} == {"1", "2", "10"}
    assert contents(out).items() - first.items() == {("1.png", contents(out)["1.png"])}
    assert main([*command, "--depth.min-size", "99"]) == 0
    assert not written(out).items() & before.items()


def test_labels_hold_what_they_were_made_from_and_stay_an_image(tmp_path, frame, depth):
    images = pytest.importorskip("PIL.Image")
    out = tmp_path / "labels.png"
    assert main(["depth", str(frame), *CAMERA, "--out", str(out)]) == 0
    with images.open(out) as image:
        image.load()
        record = json.loads(image.text["torchrg"])
        labels = np.asarray(image).astype(int) - 1
    np.testing.assert_array_equal(labels, segment_depth(depth, INTRINSICS).labels)
    assert record["inputs"][0]["name"] == "frame.png"
    assert record["inputs"][0]["sha256"] == hashlib.sha256(frame.read_bytes()).hexdigest()
    assert record["config"]["min_size"] == 100
    assert record["source"]["intrinsics"] == [50, 50, 39.5, 29.5]
    assert str(tmp_path) not in json.dumps(record)


@pytest.mark.slow
def test_a_killed_sequence_goes_on_and_leaves_nothing_unfinished(tmp_path, depth):
    folder, out, chance = tmp_path / "in", tmp_path / "out", random.Random(0)
    folder.mkdir()
    for number in range(40):
        write_png(folder / f"{number}.png", (depth * (1000 + number)).round().int())
    command = [sys.executable, "-m", "torchrg", "depth", str(folder), *CAMERA, "--workers", "2"]
    begin = time.monotonic()
    subprocess.run([*command, "--out", str(tmp_path / "whole")], check=True)
    seconds, expected = time.monotonic() - begin, contents(tmp_path / "whole")
    for _ in range(3):
        process = subprocess.Popen([*command, "--out", str(out)], start_new_session=True)
        time.sleep(chance.uniform(0.3, 1) * seconds)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if out.is_dir():
            found = {name: what for name, what in contents(out).items() if name[0] != "."}
            assert {name: expected[name] for name in found}.keys() == found.keys()
    subprocess.run([*command, "--out", str(out)], check=True)
    assert contents(out) == expected


def test_results_that_would_replace_an_image_are_refused(tmp_path, sequence, frame, capsys):
    write_png(sequence / "1_planes.png", torch.ones(4, 4).int())
    before = contents(sequence)
    empty = tmp_path / "empty"
    empty.mkdir()
    for inputs, out, message in (
        (sequence, sequence, "expected a place of its own for each result"),
        (sequence, tmp_path / "out", "1_planes.png: expected a place of its own"),
        (frame, frame, "frame.png: expected a place of its own"),
        (empty, tmp_path / "out", "expected images (.png .npy .pcd) in the folder, got none"),
    ):
        assert main(["depth", str(inputs), *CAMERA, "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert contents(sequence) == before


def test_what_a_killed_process_was_writing_goes_and_nothing_else(tmp_path):
    scan = Scan("1", (tmp_path / "1.npy",), 0)
    place = {"target": tmp_path / "1.png", "picture": tmp_path / "1_planes.png"}
    frame = FrameJob(None, scan, tmp_path, **place)
    theirs = (".1.0123abcd.png", ".1.0123456789abcdef01234567.png", "1.png", "1_planes.png")
    for name in (*theirs, f".1.{frame.mark}01234567.png", f".1_planes.{frame.mark}01234567.png"):
        (tmp_path / name).touch()
    frame.clean()
    assert sorted(contents(tmp_path)) == sorted(theirs)


def test_what_a_killed_sequence_was_writing_goes_when_it_goes_on(tmp_path, sequence):
    out = tmp_path / "out"
    out.mkdir()
    with DirectoryLock(out) as lock:
        left = out / f".10_planes.{lock.mark_of('10.png')}01234567.png"
    for path in (left, out / ".10_planes.0123abcd.png"):
        path.touch()
    assert main(["depth", str(sequence), *CAMERA, "--out", str(out)]) == 3
    assert [name for name in contents(out) if name[0] == "."] == [".10_planes.0123abcd.png"]


def test_wrong_use_is_one_line(tmp_path, frame, depth, capsys):
    points = depth_to_points(depth[None], INTRINSICS[None])[0]
    write_cloud(tmp_path / "list.pcd", Cloud(points.view(-1, 3).numpy()))
    turned = (points + 1).view(-1, 3).numpy()
    write_cloud(tmp_path / "turned.pcd", Cloud(turned, grid_shape=(60, 80)))
    out = ["--out", str(tmp_path / "a.png")]
    for arguments, message in (
        ([str(frame), *out], "frame.png: expected --intrinsics fx,fy,cx,cy, which depth images"),
        ([str(frame), *CAMERA[:2], *out], "frame.png: expected --depth-scale, which depth images"),
        ([str(frame), "--intrinsics", "1,2,3", *CAMERA[2:], *out], "four numbers without blanks"),
        ([str(frame), str(frame), *CAMERA, *out], "expected a directory for 2 inputs"),
        (
            [str(frame), *CAMERA[:4], "--threads", "0", *out],
            "expected --threads from 1 to 1,024, got 0",
        ),
        ([str(frame), *CAMERA, "--workers", "0", *out], "expected --workers >= 1, got 0"),
        ([str(tmp_path / "list.pcd"), *out], "expected an organised cloud"),
        ([str(tmp_path / "turned.pcd"), *out], "expected points of a pinhole camera"),
    ):
        assert main(["depth", *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (tmp_path / "a.png").exists()


def test_two_files_of_one_name_are_refused(tmp_path, frame, capsys):
    (tmp_path / "more").mkdir()
    twin = tmp_path / "more" / frame.name
    twin.write_bytes(frame.read_bytes())
    assert main(["depth", str(frame), str(twin), *CAMERA, "--out", str(tmp_path / "out")]) == 2
    assert "another input has the same name" in capsys.readouterr().err


def test_segment_says_where_depth_images_went(tmp_path, frame, capsys):
    cloud, out = str(tmp_path / "scan.pcd"), ["--out", str(tmp_path / "out.npz")]
    depth = "--intrinsics FX,FY,CX,CY --depth-scale S --out PATH."
    image = f"got the image {frame}; use: torchrg depth {frame} {depth}"
    for arguments, message in (
        ([str(frame), *out], image),
        ([cloud, str(frame), *CAMERA, *out], image),
        ([*out, "--preset=classic", str(frame)], image),
        ([cloud, "--image", *out], f"got --image; use: torchrg depth IMAGES... {depth}"),
        ([cloud, *CAMERA, *out], f"got --intrinsics; use: torchrg depth IMAGES... {depth}"),
        ([cloud, "--depth-scale=1000", *out], "got --depth-scale=1000; use: torchrg depth IMAGES"),
    ):
        assert main(["segment", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("torchrg: segment: expected point clouds, got ")
        assert message in error
        assert error.count("\n") == 1


def test_pictures_of_segment_are_no_images(tmp_path, capsys):
    for picture in (["--picture", "a.png"], ["--picture=a.png"]):
        assert main(["segment", str(tmp_path / "no.pcd"), "--out", str(tmp_path), *picture]) == 2
        assert "no.pcd: no such file" in capsys.readouterr().err


def test_an_image_that_memory_has_no_room_for_is_refused_before_it_is_read(tmp_path, capsys):
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 300_000, 300_000)
    (tmp_path / "huge.png").write_bytes(head + b"\x10\0\0\0\0")
    out = ["--out", str(tmp_path / "labels.png")]
    assert main(["depth", str(tmp_path / "huge.png"), *CAMERA, *out]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "huge.png: expected an image that memory has room for, got 90,000,000,000 pix" in line


def test_an_array_whose_header_does_not_end_is_one_line(tmp_path, depth, capsys):
    np.save(tmp_path / "bad.npy", depth.numpy())
    content = (tmp_path / "bad.npy").read_bytes()
    assert content.count(b"}") == 1
    (tmp_path / "bad.npy").write_bytes(content.replace(b"}", b"("))
    out = ["--out", str(tmp_path / "labels.png")]
    assert main(["depth", str(tmp_path / "bad.npy"), *CAMERA, *out]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "bad.npy: expected an array of numbers, got: " in line
