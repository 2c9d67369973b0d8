"""``torchrg depth``: planes of depth images and of organized clouds."""

import json
import struct

import kornia_rs
import numpy as np
import pytest
import torch

from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import RGBDSource
from torchrg.cli.flags import parse_intrinsics
from torchrg.config import DepthConfig
from torchrg.datasets import RGBDFrames
from torchrg.depth import segment_depth
from torchrg.depth.camera import depth_to_points, make_intrinsics
from torchrg.errors import DepthWarning
from torchrg.io import read_cloud, write_cloud
from torchrg.io.result import RECORD
from torchrg.render import write_png
from torchrg.structures import Cloud

CAMERA = ["--intrinsics", "50,50,39.5,29.5", "--depth-scale", "1000", "--threads", "1"]
INTRINSICS = make_intrinsics(50.0, 50.0, 39.5, 29.5)
LARGER = {"width": 160, "height": 120, "fx": 100, "fy": 100, "cx": 79.5, "cy": 59.5}
"""The same camera of images of twice the size: four pixels of them have the middle of one here."""


def points_of(depth, camera=INTRINSICS):
    """Return the points of a depth image, in its type."""
    return depth_to_points(depth[None], camera[None])[0].view(-1, 3)


@pytest.fixture
def depth():
    """A wall with a step and a hole, in meters."""
    depth = torch.full((60, 80), 2.0)
    depth[:, 50:] = 2.5
    depth[:4, :5] = 0
    return depth


@pytest.fixture
def frame(tmp_path, depth):
    path = tmp_path / "frame.png"
    write_png(path, (depth * 1000).round().int())
    return path


def test_a_depth_image_becomes_labels_and_a_picture(tmp_path, frame, depth, run):
    out = tmp_path / "labels.png"
    done = run("depth", frame, *CAMERA, "--out", out)
    labels = kornia_rs.io.read_image_png_u16(str(out), "mono")[..., 0].astype(int) - 1
    expected = segment_depth(depth, INTRINSICS).labels.numpy()
    np.testing.assert_array_equal(labels, expected)
    assert sorted(np.unique(labels)) == [-1, 0, 1]
    picture = kornia_rs.io.read_image_png_u8(str(tmp_path / "labels_planes.png"), "rgb")
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 3
    assert not picture[0, 0].any()
    line = ": 2 planes, 100.0 % labeled; 80 x 60 pixels, 4,780 with depth, in "
    assert line in done.out


def test_a_depth_image_becomes_a_cloud(tmp_path, frame, depth, run):
    for suffix in (".npz", ".pcd"):
        out = tmp_path / f"cloud{suffix}"
        assert run("depth", frame, *CAMERA, "--out", out).code == 0
        cloud = read_cloud(out)
        np.testing.assert_allclose(cloud.coordinates, points_of(depth.double()), rtol=1e-6)
        expected = segment_depth(depth, INTRINSICS).labels.flatten()
        np.testing.assert_array_equal(cloud.fields["labels"], expected)
    assert cloud.grid_shape == (60, 80)
    with np.load(tmp_path / "cloud.npz") as result:
        np.testing.assert_allclose(result["plane_offset"], [2.0, 2.5], rtol=1e-6)
        provenance = json.loads(str(result["provenance"]))
    assert provenance["intrinsics"] == "50,50,39.5,29.5"
    assert provenance["config"]["depth"]["min_size"] == 100


@pytest.mark.parametrize("focal", [50.0, 500.0])
def test_organised_clouds_keep_their_grid(tmp_path, depth, run, focal):
    camera = make_intrinsics(focal, focal, 39.5, 29.5)
    points = points_of(depth, camera)
    source, out = tmp_path / "scan.pcd", tmp_path / "out.pcd"
    write_cloud(source, Cloud(points.numpy(), grid_shape=(60, 80)))
    # A narrow cloud is moved to an origin of its own; its planes stay where they are.
    assert read_cloud(source).origin.any() == (focal == 500)
    assert run("depth", source, "--threads", "1", "--out", out).code == 0
    cloud = read_cloud(out)
    assert cloud.grid_shape == (60, 80)
    np.testing.assert_array_equal(cloud.coordinates, points)
    expected = segment_depth(depth, camera).labels.flatten()
    np.testing.assert_array_equal(cloud.fields["labels"], expected)
    result = tmp_path / "out.npz"
    assert run("depth", source, "--threads", "1", "--out", result).code == 0
    with np.load(result) as arrays:
        np.testing.assert_allclose(arrays["plane_offset"], [2.0, 2.5], rtol=1e-5)


def test_segment_says_that_a_cloud_is_a_depth_image(tmp_path, run, depth):
    points = points_of(depth).numpy()
    turned = points[:, [2, 0, 1]]
    for name, coordinates, grid in (
        ("image", points, (60, 80)),
        ("list", points, None),
        ("turned", turned, (60, 80)),
    ):
        source = tmp_path / f"{name}.pcd"
        write_cloud(source, Cloud(coordinates, grid_shape=grid))
        done = run("segment", source, "--preset", "classic", "--out", tmp_path / "out.npz")
        better = f"Run torchrg depth {source} --out {tmp_path / 'out.npz'}"
        assert (better in done.err.replace("\n", " ")) == (name == "image")


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_several_images_go_into_a_folder_and_a_damaged_one_stops_no_other(tmp_path, frame, run):
    folder, out = tmp_path / "images", tmp_path / "out"
    folder.mkdir()
    for name in ("1.png", "3.png"):
        (folder / name).write_bytes(frame.read_bytes())
    (folder / "2.png").write_bytes(frame.read_bytes()[:90])
    inputs = [folder / f"{number}.png" for number in (1, 2, 3)]
    reported = run("depth", *inputs, *CAMERA, "--out", out)
    assert reported.code == 3
    damaged, sums = reported.err.splitlines()
    assert damaged.startswith(f"torchrg: {inputs[1]}: ")
    assert damaged.count("2.png") == 1
    assert sums == "torchrg: 1 of 3 inputs failed, the remaining ones are written."
    assert reported.out.count(" 2 planes, ") == 2
    assert sorted(path.name for path in out.iterdir()) == ["1", "3"]
    assert contents(out / "1") == contents(out / "3")
    assert len(contents(out / "1")) == 6


def test_images_in_a_directory_write_what_convert_writes(tmp_path, frame, depth, run):
    folder, out = tmp_path / "images", tmp_path / "out"
    folder.mkdir()
    frame.rename(folder / "0.png")
    write_png(folder / "1.png", (depth.flip(1) * 1200).round().int())
    assert run("depth", *sorted(folder.iterdir()), *CAMERA, "--out", out).code == 0
    assert run("convert", "rgbd", folder, tmp_path / "all", *CAMERA[:4], "--workers", "1").code == 0
    for name in ("0", "1"):
        written, expected = contents(out / name), contents(tmp_path / "all" / name)
        assert json.loads(written.pop(RECORD))["claims"].keys() == written.keys()
        assert written == {key: expected[key] for key in expected if key != RECORD}
    table = (folder / "0.png", *CAMERA, "--out", tmp_path / "labels.png", "--table")
    assert run("depth", *table, tmp_path / "labels.csv").code == 0
    assert (tmp_path / "labels.json").is_file()
    before = contents(out / "0")
    tables = ("--out", out, "--table", tmp_path / "tables", "--picture", tmp_path / "pictures")
    assert run("depth", *sorted(folder.iterdir()), *CAMERA, *tables).code == 0
    assert contents(out / "0") == before
    written = contents(tmp_path / "tables")
    assert written.keys() == {"0.csv", "1.csv"}
    assert written["0.csv"] == (tmp_path / "labels.csv").read_bytes()
    picture = contents(tmp_path / "pictures")["0.png"]
    assert picture == (tmp_path / "labels_planes.png").read_bytes()


def test_a_folder_is_refused_with_the_command_for_it(tmp_path, frame, run):
    error = run("depth", tmp_path, *CAMERA, "--out", tmp_path / "out").error
    assert f"depth images, got a folder; use torchrg convert rgbd {tmp_path} OUT" in error
    assert [path.name for path in tmp_path.iterdir()] == ["frame.png"]


@pytest.mark.parametrize("suffix", [".bag", ".mkv", ".r3d"])
def test_recordings_are_refused_with_what_converts_them(tmp_path, suffix, run):
    source, tools = tmp_path / f"walk{suffix}", {".r3d": "export it as EXR + JPG"}
    source.write_bytes(b"no frames")
    for command in (["depth", source, "--out"], ["convert", "rgbd", source]):
        error = run(*command, tmp_path / "out").error
        assert f"walk{suffix}: expected depth images, got {suffix}; " in error
        assert tools.get(suffix, "Open3D's ") in error
    assert [path.name for path in tmp_path.iterdir()] == [source.name]


def test_results_that_would_replace_an_image_are_refused(tmp_path, frame, run):
    other = tmp_path / "frame_planes.png"
    other.write_bytes(frame.read_bytes())
    before = contents(tmp_path)
    for inputs, out, message in (
        ([frame], frame, "frame.png: would overwrite an input or a result"),
        ([other], frame, "frame_planes.png: would overwrite an input or a result"),
    ):
        assert message in run("depth", *inputs, *CAMERA, "--out", out).error
    assert contents(tmp_path) == before


def test_wrong_use_is_one_line(tmp_path, frame, depth, run):
    points = points_of(depth).numpy()
    write_cloud(tmp_path / "list.pcd", Cloud(points))
    write_cloud(tmp_path / "turned.pcd", Cloud(points + 1, grid_shape=(60, 80)))
    np.save(tmp_path / "bad.npy", depth.numpy())
    content = (tmp_path / "bad.npy").read_bytes()
    assert content.count(b"}") == 1
    (tmp_path / "bad.npy").write_bytes(content.replace(b"}", b"("))
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 300_000, 300_000)
    (tmp_path / "huge.png").write_bytes(head + b"\x10\0\0\0\0")
    (tmp_path / "more").mkdir()
    twin = tmp_path / "more" / frame.name
    twin.write_bytes(frame.read_bytes())
    for arguments, message in (
        ([frame], "frame.png: missing --intrinsics fx,fy,cx,cy, required"),
        ([frame, *CAMERA[:2]], "frame.png: missing --depth-scale, required"),
        ([frame, "--intrinsics", "1,2,3", *CAMERA[2:]], "fx,fy,cx,cy (no spaces)"),
        ([frame, frame, *CAMERA], "expected a directory for 2 inputs"),
        ([frame, *CAMERA[:4], "--threads", "0"], "expected --threads from 1 to 1,024, got 0"),
        ([tmp_path / "list.pcd"], "not an organized cloud"),
        ([tmp_path / "turned.pcd"], "expected points of a pinhole camera"),
        ([tmp_path / "bad.npy", *CAMERA], "bad.npy: expected an array of numbers, got: "),
        ([tmp_path / "huge.png", *CAMERA], "huge.png: not enough memory for 90,000,000,000 pix"),
        ([frame, twin, *CAMERA, "--out", tmp_path / "out"], "has the same name as"),
    ):
        assert message in run("depth", "--out", tmp_path / "a.png", *arguments).error
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("K.txt", "50 0 39.5\n0 50 29.5\n0 0 1\n"),
        ("intrinsic_depth.txt", "50,0,39.5,0\n0,50,29.5,0\n0,0,1,0\n0,0,0,1\n"),
        ("cam.K", "[[50. 0. 39.5]\n [0. 50. 29.5]\n [0. 0. 1.]]"),
        ("camera", "50 50 39.5 29.5"),
        ("frame.pincam", "80 60 50 50 39.5 29.5"),
        ("info.txt", "m_depthShift=1000\nm_calibrationDepthIntrinsic=50 0 39.5 0 50 29.5 0 0 1"),
        ("cameras.txt", "1 SIMPLE_PINHOLE 160 120 100 80 60\n"),
        ("camera.json", json.dumps(LARGER)),
    ],
)
def test_a_matrix_file_is_a_camera(tmp_path, frame, run, name, content):
    (tmp_path / name).write_text(content)
    assert run("depth", frame, *CAMERA, "--out", tmp_path / "expected.png").code == 0
    flags = ["--intrinsics", tmp_path / name]
    flags += [] if "Shift" in content else CAMERA[2:4]
    done = run("depth", frame, *flags, "--out", tmp_path / "labels.png")
    assert (done.code, done.err) == (0, "")
    for suffix in (".png", ".json"):
        expected = (tmp_path / f"expected{suffix}").read_bytes()
        assert (tmp_path / f"labels{suffix}").read_bytes() == expected


@pytest.mark.parametrize(("scale", "median"), [("1", "2,000 m"), ("1e6", "0.002 m")])
def test_a_scale_of_another_unit_is_doubted_at_every_door(tmp_path, frame, run, scale, median):
    root = tmp_path / "in"
    root.mkdir()
    frame.rename(root / frame.name)
    flags = [*CAMERA[:3], scale]
    reported = (
        f"frame.png: expected a median depth of 0.05 to 20 m, got {median} with --depth-scale "
    )
    for command in (
        ("depth", root / frame.name, "--out", tmp_path / "labels.png"),
        ("convert", "rgbd", root, tmp_path / "out", "--dry-run"),
    ):
        (line,) = run(*command, *flags).err.splitlines()
        assert reported in line
        assert "pass 1000 for millimeters" in line
    camera = parse_intrinsics(CAMERA[1])
    data = RGBDFrames.from_folder(root, intrinsics=camera, depth_scale=float(scale))
    source = RGBDSource(data, DepthConfig())
    with pytest.warns(DepthWarning, match="expected a median depth"):
        jobs = list_jobs(source, tmp_path / "out")
    (note,) = convert_scan(jobs[0]).warnings
    assert reported in note
    with pytest.warns(DepthWarning, match=reported):
        _ = data[0]


def test_a_cloud_is_checked_against_a_camera_that_is_given(tmp_path, depth, run):
    source, out = tmp_path / "scan.pcd", ["--out", tmp_path / "out.png"]
    write_cloud(source, Cloud(points_of(depth).numpy(), grid_shape=(60, 80)))
    (tmp_path / "camera.json").write_text(json.dumps(LARGER))
    for camera in (CAMERA[1], tmp_path / "camera.json"):
        assert run("depth", source, "--intrinsics", camera, *out).err == ""
    for camera in ("55,55,39.5,29.5", "50,50,36,29.5", "50,-50,39.5,29.5"):
        error = run("depth", source, "--intrinsics", camera, *out).err.splitlines()[-1]
        assert "scan.pcd: --intrinsics do not match the points" in error
    done = run("depth", source, "--depth-scale", "1000", *out)
    assert "--depth-scale and --depth-kind are ignored for point clouds" in done.err


def test_segment_says_where_depth_images_went(tmp_path, frame, run):
    cloud, out = tmp_path / "scan.pcd", ["--out", tmp_path / "out.npz"]
    unknown = "unrecognized option {}: torchrg depth segments depth images."
    for arguments, message in (
        ([frame, *out], "an image; pass images of depth to torchrg depth"),
        ([cloud, *CAMERA, *out], unknown.format("--intrinsics")),
        ([cloud, "--depth-scale=1000", *out], unknown.format("--depth-scale")),
    ):
        assert message in run("segment", *arguments).error
    # Pictures of segment are no images.
    for picture in (["--picture", "a.png"], ["--picture=a.png"]):
        error = run("segment", tmp_path / "no.pcd", "--out", tmp_path, *picture).error
        assert "no.pcd: file not found" in error


@pytest.mark.parametrize("kind", ["z", "ray"])
def test_missing_pixels_and_rays_are_converted_at_every_door(tmp_path, depth, run, kind):
    stored = (depth.double() * 1000).round()
    rays = points_of(torch.ones_like(depth).double()).norm(dim=-1).view(60, 80)
    stored = stored * rays if kind == "ray" else stored
    stored[depth == 0] = 65535
    root, flags = tmp_path / "in", [*CAMERA[:4], "--depth-kind", kind]
    root.mkdir()
    np.save(root / "0.npy", stored.numpy())
    assert run("depth", root / "0.npy", *flags, "--out", tmp_path / "a.npz").err == ""
    assert run("convert", "rgbd", root, tmp_path / "c", *flags, "--workers", "1").err == ""
    expected = segment_depth(depth, INTRINSICS).labels
    with np.load(tmp_path / "a.npz") as found:
        np.testing.assert_array_equal(found["labels"], expected.flatten())
        np.testing.assert_allclose(found["plane_offset"], [2.0, 2.5], rtol=1e-6)
        assert json.loads(str(found["provenance"]))["pose"] == "camera"
    np.testing.assert_array_equal(np.load(tmp_path / "c/0/plane.npy"), expected)
    record = json.loads((tmp_path / "c/0/provenance.json").read_text())
    assert record["measured"]["pose"] == "camera"


def test_a_panorama_is_doubted(tmp_path, run):
    np.save(tmp_path / "a.npy", np.full((40, 80), 2.0))
    flags = ["--intrinsics", "40,40,39.5,19.5", "--depth-scale", "1", "--out", tmp_path / "a.png"]
    error = run("depth", tmp_path / "a.npy", *flags).err
    assert "of a panorama, by its ratio of 2:1; project it to perspective images" in error


def test_labels_of_another_image_format_are_refused(frame, tmp_path, run):
    error = run("depth", frame, *CAMERA, "--out", tmp_path / "labels.jpg").error
    assert "expected a file ending in one of .png .npz .npy" in error
