"""Camera files next to depth images, cameras without a file, and cameras of other images."""

import json

import numpy as np
import pytest
import torch

from tests.datasets.captures_tree import FRAMES, write_3rscan, write_depth, write_text
from torchrg.batch.run import list_jobs, make_plan
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import RGBDSource
from torchrg.config import DepthConfig
from torchrg.datasets import RGBDFrames
from torchrg.datasets.rgbd_layouts import find_layout
from torchrg.depth.camera import make_intrinsics
from torchrg.errors import ConfigError, DepthWarning, FormatError

pytestmark = pytest.mark.filterwarnings("ignore:.*using the depth unit of")
WIDTH, HEIGHT = 32, 24
FX, FY, CX, CY = 30.0, 31.0, 16.25, 11.5
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
K4 = np.eye(4)
K4[:3, :3] = K
POSE = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, 0.25], [0, 0, 1, 2], [0, 0, 0, 1]])
FLAT = " ".join(map(str, K4.ravel()))


def rows(matrix, blank=" "):
    """Return a matrix as np.savetxt writes it."""
    return "\n".join(blank.join(f"{value:.18e}" for value in row) for row in matrix)


INFO = f"""m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 640
m_depthWidth = {WIDTH}
m_depthHeight = {HEIGHT}
m_depthShift = 2000
m_calibrationColorIntrinsic = 582 0 320 0 0 582 240 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = {FLAT}
m_frames.size = 1
"""
SCENE = f"""axisAlignment = {FLAT}
depthHeight = {HEIGHT}
depthWidth = {WIDTH}
fx_color = 60
fx_depth = {FX}
fy_depth = {FY}
mx_depth = {CX}
my_depth = {CY}
sceneType = Office
"""
ORB_SLAM = f"""%YAML:1.0

# The camera of the depth images
Camera.fx: {FX}
Camera.fy: {FY}
Camera.cx: {CX}
Camera.cy: {CY}
Camera.k1: 0.0
Camera.width: {WIDTH}
Camera.height: {HEIGHT}
Camera.type: "PinHole"
DepthMapFactor:\t2000.0
Viewer.PointSize:2
Viewer.ViewpointY:-0.7
"""
OPENCV = f"""%YAML:1.0
---
image_width: {WIDTH}
image_height: {HEIGHT}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {FX}, 0., {CX}, 0., {FY}, {CY}, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
"""
NICE_SLAM = f"""cam: # of all scenes
  H: {HEIGHT}
  W: {WIDTH}
  fx: {FX}
  fy: {FY}
  cx: {CX}
  cy: {CY}
  png_depth_scale: 2000.0
"""
OPEN3D = {"intrinsic_matrix": K.T.ravel().tolist(), "depth_scale": 2000.0}
COLMAP = f"# Camera list\n1 PINHOLE {WIDTH} {HEIGHT} {FX} {FY} {CX + 0.5} {CY + 0.5}\n"
LARGER = [2 * FX, 0, 0, 0, 2 * FY, 0, 2 * CX + 0.5, 2 * CY + 0.5, 1]
SIZES = {"w": 2 * WIDTH, "h": 2 * HEIGHT}
REALSENSE = {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "width": WIDTH, "height": HEIGHT}
NERFSTUDIO = {"fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5, "frames": []}
FILES = {
    "camera-intrinsics.txt": rows(K),
    "camera_intrinsics.txt": rows(K4, ","),
    "intrinsics.txt": " ".join(map(str, K.ravel())),
    "K.txt": str(K),
    "calibration.txt": f"{FX} {FY} {CX} {CY}",
    "camera.txt": f"{WIDTH} {HEIGHT} {FX} {FY} {CX} {CY}",
    "cameras.txt": COLMAP,
    "camera_matrix.csv": rows(K, ", "),
    "info.txt": INFO,
    "scene.txt": SCENE,
    "intrinsics_depth.txt": rows(K4),
    "intrinsic/intrinsic_depth.txt": rows(K4),
    "camera.json": {"intrinsic_matrix": K.T.ravel().tolist()},
    "intrinsic.json": K.tolist(),
    "depth_intrinsics.json": {"depth": REALSENSE, "color": {"fx": 99}},
    "metadata": {"K": LARGER, **SIZES, "poses": [[0, 0, 0, 1, 0, 0, 0]]},
    "transforms.json": NERFSTUDIO,
    "camera.yaml": ORB_SLAM,
    "calibration.yml": OPENCV,
    "cam.yaml": NICE_SLAM,
    "cam.json": OPEN3D,
    "cam_info.json": {**REALSENSE, "depth_scale": 0.0005, "model": "Azure NFOV"},
    "cam-params.json": {**NERFSTUDIO, "depth_unit_scale_factor": 0.0005, "is_fisheye": False},
    "camera-params.txt": f"{FX} {FY} {CX} {CY} {WIDTH} {HEIGHT}",
    "calib.txt": f"{FX} {FY} {CX} {CY} 0 0 0 0 0",
}
"""Camera files of other programs, all of one camera, by names that they have."""
SCALES = dict.fromkeys(
    ["info.txt", "camera.yaml", "cam.yaml", "cam.json", "cam_info.json", "cam-params.json"], 2000
)
"""Stored values of one meter that files name; it is 1000 in others."""


@pytest.fixture
def scene(tmp_path):
    """A scene with a sequence of one frame, in the folders and names of 7-Scenes."""
    write_depth(tmp_path / "root/scene/seq-01/frame-0.depth.png", np.full((HEIGHT, WIDTH), 1.5))
    return tmp_path / "root" / "scene"


def only_frame(root, layout="auto", **given):
    (frame,) = RGBDFrames.from_folder(root, layout, **given).frames
    return frame


@pytest.mark.parametrize("name", FILES)
def test_a_camera_file_next_to_the_frames_wins(scene, name):
    write_text(scene / name, FILES[name])
    frame = only_frame(scene)
    expected = make_intrinsics(FX, FY, CX, CY)
    torch.testing.assert_close(frame.intrinsics, expected, rtol=1e-12, atol=1e-12)
    assert frame.depth_scale == SCALES.get(name, 1000)
    assert frame.sources == (scene / name,)
    assert frame.origin == (scene / name).name
    assert only_frame(scene, depth_scale=500.0).depth_scale == 500


BUILT_IN = (
    "using the built-in camera of 7-scenes, 585,585,320,240, for frames without a camera file; pass"
)


@pytest.mark.parametrize(("place", "up"), [("scene/seq-01", 0), ("scene", 1), ("", 2)])
@pytest.mark.parametrize(("start", "down"), [("scene/seq-01", 0), ("scene", 1), ("", 2)])
def test_the_nearest_camera_file_counts(scene, place, up, start, down):
    root = scene.parent
    np.savetxt(root / place / "camera-intrinsics.txt", K)
    for folder in [root / place, *(root / place).parents][1 : 1 + 2 - up]:
        np.savetxt(folder / "intrinsics.txt", np.diag([50.0, 50, 1]))
    if up > down + 1:  # Two folders above what was named: it may be of anything.
        with pytest.warns(DepthWarning, match=BUILT_IN):
            frame = only_frame(root / start)
        assert frame.origin == "built in, 7-scenes"
        return
    if up > down:
        with pytest.warns(DepthWarning, match=r"camera-intrinsics.txt, outside this folder"):
            frame = only_frame(root / start)
    else:
        frame = only_frame(root / start)
    assert frame.intrinsics[0].tolist() == [FX, 0, CX]


@pytest.mark.parametrize("layout", ["tum", "images", "scannet"])
def test_every_layout_without_cameras_of_frames_looks_for_a_file(tmp_path, layout):
    root = tmp_path / "rgbd_freiburg1_desk"
    write_depth(root / "depth" / "0.png", np.full((HEIGHT, WIDTH), 1.5))
    (root / "depth.txt").write_text("0.5 depth/0.png\n")
    (root / "calibration.txt").write_text(f"{FX} {FY} {CX} {CY}\n")
    frame = only_frame(root, layout, depth_scale=1000.0)
    assert frame.intrinsics[0].tolist() == [FX, 0, CX]


def test_a_camera_without_a_file_is_named_once(scene, tmp_path, run):
    write_depth(scene / "seq-02" / "frame-0.depth.png", np.full((HEIGHT, WIDTH), 1.5))
    done = run("convert", "rgbd", scene, tmp_path / "out", "--dry-run")
    assert done.err.count("torchrg: ") == 1
    assert f"{scene}: {BUILT_IN} --intrinsics" in done.err


@pytest.mark.filterwarnings("ignore:.*using the built-in camera")
def test_the_record_names_the_camera_and_a_new_file_changes_the_input(scene, tmp_path):
    data = RGBDFrames.from_folder(scene, "7-scenes")
    (job,) = list_jobs(RGBDSource(data, DepthConfig()), tmp_path / "out")
    assert convert_scan(job).status == "converted"
    record = json.loads((job.folder / "provenance.json").read_text())
    # The camera is that of 640 x 480 pixels; the centers of pixels are scaled.
    camera = {"intrinsics": "29.25,29.25,15.525,11.525", "camera": "built in, 7-scenes"}
    assert record["measured"] == {**camera, "depth_scale": 1000.0, "pose": "camera"}
    np.savetxt(scene / "camera-intrinsics.txt", K)
    data = RGBDFrames.from_folder(scene, "7-scenes")
    jobs = list_jobs(RGBDSource(data, DepthConfig()), tmp_path / "out")
    assert [*make_plan(jobs).reasons.values()] == ["input changed"]
    assert convert_scan(jobs[0]).status == "converted"
    record = json.loads((job.folder / "provenance.json").read_text())
    assert record["measured"]["camera"] == "camera-intrinsics.txt"
    assert not make_plan(jobs).reasons


def test_images_of_several_cameras_have_the_nearest(tmp_path):
    for name, focal in (("a", 30.0), ("b", 40.0)):
        write_depth(tmp_path / name / "depth" / "0.png", np.full((HEIGHT, WIDTH), 1.5))
        write_text(tmp_path / name / "camera.json", {**REALSENSE, "fx": focal, "fy": focal})
    frames = RGBDFrames.from_folder(tmp_path, depth_scale=1000.0).frames
    assert [float(frame.intrinsics[0, 0]) for frame in frames] == [30, 40]
    assert frames[1].files == (tmp_path / "b/depth/0.png", tmp_path / "b/camera.json")
    (tmp_path / "b" / "camera.json").unlink()
    with pytest.raises(ConfigError, match=r"b/depth/0.png: expected intrinsics, which images"):
        RGBDFrames.from_folder(tmp_path, depth_scale=1000.0)


def test_two_camera_files_that_differ_are_told_apart(scene):
    np.savetxt(scene / "camera-intrinsics.txt", K)
    (scene / "info.txt").write_text(INFO)
    assert only_frame(scene).origin == "camera-intrinsics.txt"
    (scene / "camera.json").write_text('{"fx": 20, "fy": 20, "cx": 15, "cy": 12}')
    with pytest.warns(DepthWarning, match=r"camera-intrinsics.txt: used .* camera.json diff"):
        assert only_frame(scene).intrinsics[0].tolist() == [FX, 0, CX]
    np.savetxt(scene / "depth_intrinsics.txt", 2 * K - np.diag([0, 0, 1]))
    with pytest.raises(ConfigError, match=r"depth_intrinsics.txt: expected an optical axis within"):
        only_frame(scene)


def test_files_that_only_sometimes_hold_a_camera_are_passed_over(scene):
    (scene / "info.txt").write_text("recorded on a Monday = true\n")
    (scene / "metadata.json").write_text('{"frames": 3}')
    (scene / "intrinsics_color.txt").write_text(rows(2 * K))
    (scene / "camera_poses.txt").write_text("0 0 0")
    with pytest.warns(DepthWarning, match=BUILT_IN):
        only_frame(scene)
    (scene / "camera.txt").write_text("525 525 oops")
    with pytest.raises(FormatError, match=r"camera.txt: expected names with values, got '525 52"):
        only_frame(scene)


@pytest.fixture
def tasks(tmp_path):
    """ScanNet's scannet_frames_25k: images of labels and objects next to those of depth."""
    scan = tmp_path / "tasks" / "scannet_frames_25k" / "scene0000_00"
    for name, value in (("depth", 2.0), ("instance", 1.001), ("label", 0.005)):
        write_depth(scan / name / "000000.png", np.full((HEIGHT, WIDTH), value))
    np.savetxt(scan / "intrinsics_depth.txt", K4)
    np.savetxt(scan / "intrinsics_color.txt", 2 * K4)
    (scan / "pose").mkdir()
    np.savetxt(scan / "pose" / "000000.txt", POSE)
    return scan


@pytest.mark.parametrize("layout", ["auto", "scannet"])
@pytest.mark.parametrize("up", [0, 1, 2])
def test_labels_and_objects_of_scannets_frames_are_not_depth(tasks, layout, up):
    frame = only_frame((tasks, *tasks.parents)[up], layout)
    assert frame.depth == tasks / "depth" / "000000.png"
    assert frame.intrinsics[0].tolist() == [FX, 0, CX]
    assert frame.pose.tolist() == POSE.tolist()
    assert frame.depth_scale == 1000


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["depth/0.png", "instance/0.png", "label-filt/0.png", "x/0.png"], ["depth/0"]),
        (["a/0_depth.png", "a/0_seg.png", "a/depth_labels.png"], ["a/0_depth"]),
        (["0.png", "labels.png", "rgb/0.png", "intrinsics.npy"], ["0"]),
        (["a/0.npy", "a/1.npy"], ["a/0", "a/1"]),
    ],
)
def test_images_that_are_not_depth_by_their_names_are_left_out(tmp_path, names, expected):
    for name in names:
        write_depth(tmp_path / name, np.full((HEIGHT, WIDTH), 1.5))
    given = {"intrinsics": make_intrinsics(FX, FY, CX, CY), "depth_scale": 1000.0}
    if (left := len(names) - len(expected)) == 0:
        assert len(RGBDFrames.from_folder(tmp_path, **given)) == len(expected)
        return
    with pytest.warns(DepthWarning, match=f"skipped {left} of {len(names)} images that are not"):
        data = RGBDFrames.from_folder(tmp_path, **given)
    assert [frame.name for frame in data.frames] == expected


def test_exports_of_sens_files_may_be_png(tmp_path):
    root = write_3rscan(tmp_path)
    for path in [*root.rglob("*.depth.pgm")]:
        path.unlink()
        write_depth(path.with_suffix(".png"), FRAMES[0].depth)
    assert find_layout(root) == "3rscan"
    names = [frame.name.rpartition("/")[2] for frame in RGBDFrames.from_folder(root).frames]
    assert names == ["frame-000000", "frame-000001"]
