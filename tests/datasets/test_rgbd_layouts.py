"""Captures of phones and of data sets: read, they show the room that they were made in."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch

from tests.datasets.captures_tree import (
    COLOR,
    CV,
    ENLARGED,
    FRAMES,
    FX,
    HEIGHT,
    SIZE,
    UNSURE,
    WIDTH,
    WRITERS,
    write_depth,
    write_nerfstudio,
    write_polycam,
    write_record3d,
    write_rtabmap,
    write_stray,
    write_text,
)
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import RGBDSource
from torchrg.config import DepthConfig
from torchrg.datasets import RGBDFrames
from torchrg.datasets.rgbd_layouts import find_layout
from torchrg.depth import segment_depth
from torchrg.depth.camera import unproject_image
from torchrg.errors import ConfigError, DepthWarning, FormatError, MissingDependencyError
from torchrg.pipeline import segment_planes

NAMES = {
    "nerfstudio": ["capture/depth/frame_00000", "capture/depth/frame_00001"],
    "arkitscenes": [f"Training/40753679/40753679_6791.{tenth}00" for tenth in (2, 3)],
    "replica": ["room0/000000", "room0/000001"],
    "scannetpp": [f"data/0a5c013435/iphone/frame_0000{tens}" for tens in ("00", "10")],
    "3rscan": ["0988ea72/sequence/frame-000000", "0988ea72/sequence/frame-000001"],
    "stray": ["capture/000000", "capture/000005"],
    "polycam": ["capture/62910452125", "capture/62910485458"],
    "record3d": ["EXR_RGBD/0", "EXR_RGBD/1"],
    "rtabmap": ["capture/2", "capture/3"],
}
APPS = ["stray", "polycam", "record3d", "rtabmap"]


def points_of(sample):
    """Return the points of a sample in the world, float64."""
    points = unproject_image(sample["depth"][0], sample["intrinsics"], sample["pose"])
    return points.numpy()


@pytest.mark.parametrize("layout", WRITERS)
def test_frames_lie_on_the_walls_that_they_were_taken_of(tmp_path, layout):
    root = WRITERS[layout](tmp_path / "capture")
    assert find_layout(root) == layout
    data = RGBDFrames.from_folder(root)
    assert [scene.name for scene in data.scenes] == NAMES[layout]
    frames = reversed(FRAMES) if layout == "rtabmap" else FRAMES
    for sample, frame in zip(data, frames, strict=True):
        unsure = sample["depth"][0].numpy() == 0
        has_confidence = layout in ("arkitscenes", "stray", "polycam")
        assert np.array_equal(unsure, UNSURE if has_confidence else 0 * UNSURE)
        # Half a millimeter of rounding, and what a ray of it moves sideways.
        np.testing.assert_allclose(points_of(sample)[~unsure], frame.points[~unsure], atol=1e-3)
    assert all(root in path.parents for path in data.scenes[0].files)


@pytest.mark.parametrize(("suffix", "unit"), [(".png", None), (".npy", 1.0), (".pgm", 0.0005)])
def test_a_capture_in_opengl_axes_has_the_planes_of_its_cloud(tmp_path, suffix, unit):
    given = {} if unit is None else {"depth_unit_scale_factor": unit}
    root = write_nerfstudio(tmp_path / "capture", suffix, 1 / (unit or 0.001), **given)
    data = RGBDFrames.from_folder(root, "nerfstudio")
    jobs = list_jobs(RGBDSource(data, DepthConfig()), tmp_path / "out")
    assert [convert_scan(job).status for job in jobs] == ["converted"] * 2
    for number, frame in enumerate(FRAMES):
        cloud = segment_planes(torch.from_numpy(frame.points.reshape(-1, 3)).float(), "classic")
        folder = tmp_path / "out" / "capture" / "depth" / f"frame_{number:05d}"
        planes = json.loads((folder / "planes.json").read_text())["planes"]
        assert len(planes) == 3
        for plane in planes:
            cosines = cloud.planes.normal.double() @ torch.tensor(plane["normal"]).double()
            best = int(cosines.abs().argmax())
            assert cosines[best].abs() > np.cos(np.radians(0.1))
            offset = float(cloud.planes.offset[best] * cosines[best].sign())
            assert offset == pytest.approx(plane["offset"], abs=1e-3)
            # And those of the room that it was made in.
            axis = int(np.abs(plane["normal"]).argmax())
            assert abs(plane["normal"][axis]) > np.cos(np.radians(0.1))
            wall = plane["offset"] * np.sign(plane["normal"][axis])
            assert min(abs(wall), abs(wall - SIZE[axis])) < 1e-3


def write_variant(name, root):
    """Write a capture as another version or another option of its program does."""
    return {
        "stray": lambda: write_stray(root, per_frame=True),
        "record3d": lambda: write_record3d(root, ".png", per_frame=True),
        "rtabmap": lambda: write_rtabmap(root, is_by_id=False),
        "polycam": lambda: without_corrected(write_polycam(root)),
        "exr": lambda: write_record3d(root, ".exr"),
    }[name]()


def without_corrected(root):
    """Keep the poses before optimization, which are in another world."""
    shutil.rmtree(root / "keyframes" / "corrected_cameras")
    return root


@pytest.mark.parametrize("name", [*APPS, "exr"])
def test_other_versions_of_apps_are_read(tmp_path, name):
    if name == "exr":
        pytest.importorskip("OpenEXR")
    data = RGBDFrames.from_folder(write_variant(name, tmp_path / "capture"))
    turn = np.eye(3)[[1, 2, 0]] if name == "polycam" else np.eye(3)
    for sample, frame in zip(data, FRAMES, strict=True):
        seen = sample["depth"][0].numpy() > 0
        assert np.array_equal(seen, ~UNSURE if name in ("stray", "polycam") else seen | True)
        np.testing.assert_allclose(points_of(sample)[seen], frame.points[seen] @ turn.T, atol=1e-3)


@pytest.mark.parametrize("name", APPS)
def test_planes_of_apps_are_those_of_the_room_in_every_frame(tmp_path, name):
    data = RGBDFrames.from_folder(WRITERS[name](tmp_path / "capture"))
    walls = [set(), set()]
    for number, sample in enumerate(data):
        options = {"pose": sample["pose"], "noise": (0.0005, 0.0)}
        planes = segment_depth(sample["depth"], sample["intrinsics"], **options).planes
        for normal, offset in zip(planes.normal.double(), planes.offset.tolist(), strict=True):
            axis = int(normal.abs().argmax())
            assert np.degrees(np.arccos(min(float(normal[axis].abs()), 1))) < 0.05
            place = offset * float(normal[axis].sign())
            assert min(abs(place), abs(place - SIZE[axis])) < 1e-3
            walls[number].add((axis, round(place, 1)))
    assert min(map(len, walls)) == 3
    assert walls[0] & walls[1]


@pytest.mark.parametrize("name", APPS)
def test_poses_of_apps_are_exact_and_in_the_axes_of_torchrg(tmp_path, name):
    frames = RGBDFrames.from_folder(WRITERS[name](tmp_path / "capture")).frames
    for frame, made in zip(frames, FRAMES[:: -1 if name == "rtabmap" else 1], strict=True):
        np.testing.assert_allclose(frame.pose, made.pose(*CV), rtol=0, atol=1e-14)


def test_frames_without_an_optimized_pose_have_none(tmp_path):
    root = write_polycam(tmp_path / "capture")
    next((root / "keyframes" / "corrected_cameras").iterdir()).unlink()
    with pytest.warns(DepthWarning, match="1 of 2 frames have no pose"):
        frames = RGBDFrames.from_folder(root).frames
    assert sum(frame.pose is None for frame in frames) == 1


def test_numbers_of_other_images_are_no_poses(tmp_path):
    root = write_rtabmap(tmp_path / "capture")
    path = root / "map_camera_poses.txt"
    path.write_text(path.read_text().replace(" 3\n", " 7\n"))
    with pytest.warns(DepthWarning, match="1 of 2 frames have no pose"):
        RGBDFrames.from_folder(root)
    path.write_text("# none\n9.5 0 0 0 0 0 0 1 9\n")
    with pytest.warns(DepthWarning, match="2 of 2 frames have no pose"):
        RGBDFrames.from_folder(root)


@pytest.mark.parametrize(
    ("name", "file", "old", "new", "message"),
    [
        ("stray", "odometry.csv", "frame", "image", "expected a table with a column frame, got: "),
        ("stray", "odometry.csv", " qw", " qv", "expected a number for qw, got None"),
        ("stray", "odometry.csv", " 000000,", "", "expected a table with a column frame, got: "),
        ("stray", "camera_matrix.csv", "0.0", "", "expected a matrix of 3 x 3"),
        (
            "polycam",
            "keyframes/corrected_cameras/62910452125.json",
            "t_12",
            "t",
            "expected a number for t_12",
        ),
        ("record3d", "EXR_RGBD/metadata.json", "]], ", ", 0]], ", "expected {'poses': 'qx qy"),
        ("rtabmap", "map_camera_poses.txt", " 3\n", "\n", "expected stamp x y z qx qy qz qw id"),
        ("rtabmap", "map_calib/3.yaml", "matrix:", "m:", "expected a camera, as fl_x"),
    ],
)
def test_spoilt_captures_of_apps_are_refused_with_their_file(
    tmp_path, name, file, old, new, message
):
    path = WRITERS[name](tmp_path / "capture") / file
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FormatError) as caught:
        RGBDFrames.from_folder(tmp_path / "capture")
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_confidence_of_another_size_is_refused_and_determines_results(tmp_path):
    root = write_stray(tmp_path / "capture")
    source, out = RGBDSource(RGBDFrames.from_folder(root), DepthConfig()), tmp_path / "out"
    path = root / "confidence" / "000000.png"
    assert path in source.list_scans(out)[0].files
    write_depth(path, np.ones((4, 6)))
    with pytest.raises(
        FormatError, match=r"000000.png: expected a gray image of shape \(96, 128\)"
    ):
        source.data[0]
    path.unlink()
    assert not np.array_equal(RGBDFrames.from_folder(root)[0]["depth"][0] == 0, UNSURE)


def test_openexr_is_asked_for_by_name(tmp_path, monkeypatch):
    root = write_record3d(tmp_path / "capture")
    header = (
        b"v/1\x01\x02\0\0\0dataWindow\0box2i\0\x10\0\0\0"
        + np.array([0, 0, WIDTH - 1, HEIGHT - 1], "<i4").tobytes()
    )
    for path in (root / "EXR_RGBD" / "depth").iterdir():
        path.with_suffix(".exr").write_bytes(header)
        path.unlink()
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    data = RGBDFrames.from_folder(root)
    assert data.frames[0].depth_scale == 1.0
    assert data.frames[0].intrinsics[0, 0] == FX / ENLARGED
    with pytest.raises(
        MissingDependencyError, match=r"OpenEXR is needed to read .exr depth im.*exr"
    ):
        data[0]


def test_frames_may_have_cameras_of_their_own(tmp_path):
    root = write_nerfstudio(tmp_path, k1=0.1)
    shared = json.loads((root / "transforms.json").read_text())
    own = {key: shared.pop(key) for key in ("fl_x", "cx", "w")}
    for frame in shared["frames"]:
        frame |= own
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    shared["frames"].reverse()
    write_text(root / "transforms.json", {**shared, "fl_x": 1})
    with pytest.warns(UserWarning, match=r"lens distortion \(k1\) is not corrected"):
        data = RGBDFrames.from_folder(root)
    for sample, frame in zip(data, FRAMES, strict=True):
        np.testing.assert_allclose(points_of(sample), frame.points, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fl_x": ...}, "expected a camera, as fl_x, fl_y, cx, cy or a matrix, got only fl_y"),
        (
            {"camera_model": "OPENCV_FISHEYE"},
            "expected a pinhole camera, got OPENCV_FISHEYE; undistort",
        ),
        ({"frames": {"0": 1}}, "expected a list of frames"),
        ({"w": 2 * COLOR[0]}, "as its camera's, or in their ratio, got 128 x 96; pass the camera"),
        ({"fl_y": 0}, "expected nonzero fl_x and fl_y"),
        ({"cx": 10**400}, "expected a number for cx, got 10000"),
        (
            {"depth_file_path": ...},
            "expected a list of frames, each with depth_file_path; add the depth",
        ),
        ({"transform_matrix": [[1, 0, 0, "far"]] * 4}, "transform_matrix to be a matrix, got [["),
        ({"transform_matrix": [[1, 0, 0]] * 3}, "transform_matrix to be a matrix, got [["),
    ],
)
def test_a_spoilt_capture_is_refused_in_one_line(tmp_path, run, change, message):
    path = write_nerfstudio(tmp_path / "capture") / "transforms.json"
    shared = json.loads(path.read_text())
    place = shared["frames"][1] if {*change} & {*shared["frames"][1]} else shared
    place |= change
    for name in [name for name, value in change.items() if value is ...]:
        del place[name]
    write_text(path, shared)
    error = run("convert", "rgbd", path.parent, tmp_path / "out").error
    assert error.startswith("torchrg: ")
    assert message in error
    assert not (tmp_path / "out").exists()


def test_depth_that_is_missing_fails_its_frame_and_leaves_nothing(tmp_path, run):
    root, out = write_nerfstudio(tmp_path / "capture"), tmp_path / "out"
    (root / "depth" / "frame_00001.png").unlink()
    done = run("convert", "rgbd", root, out, "--workers", "1")
    assert done.code == 3
    (reported,) = [line for line in done.err.splitlines() if "frame_00001" in line]
    assert reported.endswith(f"{root / 'depth' / 'frame_00001.png'}: No such file or directory.")
    assert [path.name for path in (out / "capture" / "depth").iterdir()] == ["frame_00000"]


def test_an_image_of_replica_beyond_its_poses_has_none(tmp_path):
    root = WRITERS["replica"](tmp_path / "capture")
    images = root / "room0" / "results"
    shutil.copy(images / "depth000001.png", images / "depth000002.png")
    with pytest.warns(DepthWarning, match=f"{root}: 1 of 3 frames have no pose; their results"):
        data = RGBDFrames.from_folder(root)
    assert [sample["name"] for sample in data] == [f"room0/{i:06d}" for i in range(3)]
    assert ["pose" in sample for sample in data] == [True, True, False]
    assert torch.equal(data[2]["depth"], data[1]["depth"])


def test_the_unit_of_floating_point_is_not_guessed(tmp_path, run):
    root = write_nerfstudio(tmp_path / "capture", ".npy", 1.0)
    error = run("convert", "rgbd", root, tmp_path / "out").error
    assert (
        "frame_00000.npy: expected depth_scale, which images lack; pass it (--depth-scale)" in error
    )
    data = RGBDFrames.from_folder(root, depth_scale=1.0)
    np.testing.assert_allclose(points_of(data[1]), FRAMES[1].points, atol=1e-5)


def test_other_captures_say_what_they_lack(tmp_path):
    roots = {name: write(tmp_path / name) for name, write in WRITERS.items()}
    scan = roots["arkitscenes"] / "Training" / "40753679"
    (scan / "lowres_wide_intrinsics" / "40753679_6791.200.pincam").write_text("256 192 212\n")
    (scan / "lowres_wide.traj").write_text("6791.2 0 0\n")
    iphone = roots["scannetpp"] / "data" / "0a5c013435" / "iphone"
    records = json.loads((iphone / "pose_intrinsic_imu.json").read_text())
    write_text(iphone / "pose_intrinsic_imu.json", {"frame_000000": records["frame_000000"]})
    (roots["replica"] / "cam_params.json").unlink()
    info = roots["3rscan"] / "0988ea72" / "sequence" / "_info.txt"
    info.write_text(info.read_text().replace("m_calibrationDepth", "m_calibration"))
    for name, message in (
        ("arkitscenes", "lowres_wide.traj: expected time rx ry rz tx ty tz in each row"),
        (
            "scannetpp",
            "pose_intrinsic_imu.json: expected an entry for frame_000010, got none",
        ),
        ("replica", "cam_params.json: cannot be read: No such file"),
        ("3rscan", "000000.depth.pgm: expected intrinsics, which images lack; pass"),
    ):
        with pytest.raises((FormatError, ConfigError), match=message):
            RGBDFrames.from_folder(roots[name])
    (scan / "lowres_wide.traj").unlink()
    with pytest.raises(FormatError, match=r"pincam: expected a matrix of .* got 3 numbers; pass"):
        RGBDFrames.from_folder(roots["arkitscenes"])
    (iphone / "depth").rename(iphone / "depth.bin")
    with pytest.raises(
        FormatError, match=r"extract them from depth\.bin with iphone/prepare_iphone"
    ):
        RGBDFrames.from_folder(roots["scannetpp"])


def test_layouts_are_found_by_what_is_there(tmp_path):
    roots = [write(tmp_path / name) for name, write in WRITERS.items()]
    assert [find_layout(root) for root in roots] == [*WRITERS]
    write_depth(tmp_path / "plain" / "depth" / "0.png", FRAMES[0].depth)
    write_text(tmp_path / "plain" / "metadata.json", {"camera": "kinect"})
    assert find_layout(tmp_path / "plain") == "images"
    assert find_layout(tmp_path / "missing") == "images"
    with pytest.raises(FormatError, match="expected a folder of frames, got a file; pass its fol"):
        RGBDFrames.from_folder(roots[0] / "transforms.json")
    (tmp_path / "capture").mkdir()
    with pytest.raises(
        FormatError, match=r"expected depth images \(.png .npy .pgm .exr\), got none"
    ):
        RGBDFrames.from_folder(tmp_path / "capture")


def test_paths_of_windows_and_units_per_frame_are_read(tmp_path):
    root = write_nerfstudio(tmp_path / "capture", scale=4000.0, depth_unit_scale_factor=0.00025)
    shared = json.loads((root / "transforms.json").read_text())
    for frame in shared["frames"]:
        frame["depth_file_path"] = frame["depth_file_path"].replace("/", "\\")
    write_text(root / "transforms.json", shared)
    data = RGBDFrames.from_folder(root)
    assert [scene.name for scene in data.scenes] == NAMES["nerfstudio"]
    for sample, frame in zip(data, FRAMES, strict=True):
        np.testing.assert_allclose(points_of(sample), frame.points, atol=1e-3)
