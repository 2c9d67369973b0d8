"""Cameras from files of other programs, and cameras of images of another size."""

import json

import numpy as np
import pytest
import torch

from torchrg.datasets.camera_files import read_camera
from torchrg.depth.camera import Pinhole, depth_to_points
from torchrg.errors import ConfigError, DepthWarning, FormatError

CAMERA = Pinhole(525.0, 526.0, 319.5, 239.5, (640, 480))
SIZE = {"width": 640, "height": 480}
ROWS = [[525, 0, 319.5], [0, 526, 239.5], [0, 0, 1]]
FLAT = [value for row in ROWS for value in row]
COLUMNS = np.array(ROWS).T.ravel().tolist()
CALIBRATION = """image_width: 640
image_height: 480
camera_name: depth
camera_matrix:
  rows: 3
  cols: 3
  data: [500., 0., 310., 0., 500., 230., 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
projection_matrix:
  rows: 3
  cols: 4
  data: [525., 0., 319.5, 0., 0., 526., 239.5, 0., 0., 0., 1., 0.]
"""
MESSAGE = """header:
  frame_id: camera_depth_optical_frame
height: 480
width: 640
distortion_model: plumb_bob
d: [0.0, 0.0, 0.0, 0.0, 0.0]
k: [525.0, 0.0, 319.5, 0.0, 526.0, 239.5, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [525.0, 0.0, 319.5, 0.0, 0.0, 526.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
---
"""
NERFSTUDIO = {"fl_x": 525, "fl_y": 526, "cx": 320, "cy": 240, "w": 640, "h": 480, "frames": []}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("open3d.json", {**SIZE, "intrinsic_matrix": COLUMNS}),
        ("parameters.json", {"extrinsic": [], "intrinsic": {**SIZE, "intrinsic_matrix": COLUMNS}}),
        ("rows.json", {**SIZE, "intrinsic_matrix": ROWS}),
        ("transforms.json", NERFSTUDIO),
        ("calibration.yaml", CALIBRATION),
        ("info.YML", MESSAGE),
        ("ros1.yaml", {**SIZE, "K": FLAT}),
    ],
)
def test_every_program_says_the_same_camera(tmp_path, name, content):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    assert read_camera(path) == CAMERA


def test_a_lens_that_bends_lines_is_told(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**NERFSTUDIO, "k1": 0.03, "k2": 0, "p2": -1e-7}))
    with pytest.warns(UserWarning, match=r"lens distortion \(k1, p2\) is not"):
        assert read_camera(path) == CAMERA


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "expected JSON or YAML, got: Expecting property name"),
        ("a.yaml", "a: [", "expected JSON or YAML, got: while parsing a flow"),
        ("a.yaml", "", "expected names with values, got NoneType"),
        ("a.json", "[1, 2]", "expected a matrix of 3 x 3, 3 x 4 or 4 x 4, fx fy cx cy, or width"),
        ("a.json", '["a"]', "expected names with values, got list"),
        ("a.json", '{"fov": 60}', "or a matrix, got only fov; add it, or pass --intrinsics"),
        ("a.json", '{"frames": [{"fl_x": 1}]}', "expected one camera, got one per frame;"),
        ("a.json", '{"intrinsic_matrix": [1, 2]}', "expected intrinsic_matrix to be a matrix, got"),
        ("a.json", '{"intrinsic_matrix": [[1], [2, 3]]}', "to be a matrix, got"),
        ("a.json", f'{{"K": {10**400}}}', "expected K to be a matrix, got 1000"),
        ("a.json", '{"K": [1, 0, 0, 0, 0, 0, 0, 0, 1]}', "expected intrinsics of rows"),
        ("a.json", '{"fx": 1, "fy": NaN, "cx": 0, "cy": 0}', "expected a number for fy, got nan"),
        (
            "a.json",
            '{"fx": 1, "fy": 1, "cx": 0, "cy": 0, "w": 0, "h": 1}',
            "w and h must be positive",
        ),
        ("a.json", '{"fx": 1, "fy": 1, "cx": 0, "cy": 0, "w": 4}', "expected a number for h"),
    ],
)
def test_files_without_a_camera_are_refused(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises((FormatError, ConfigError), match=f"{name}: .*{message}"):
        read_camera(path)


def test_a_pixel_of_a_smaller_image_looks_through_the_middle_of_those_it_stands_for():
    camera = Pinhole(31.0, 29.0, 18.25, 15.5, (40, 30))
    rays = depth_to_points(torch.ones(1, 30, 40).double(), camera.matrix()[None])[0]
    means = rays.view(6, 5, 8, 5, 3).mean(dim=(1, 3))
    smaller = camera.matrix((8, 6))
    found = depth_to_points(torch.ones(1, 6, 8).double(), smaller[None])[0]
    torch.testing.assert_close(found, means)


def test_sizes_may_differ_by_a_rounded_pixel():
    camera = Pinhole(756.0, 756.0, 479.5, 269.5, (960, 540))
    assert camera.matrix((224, 126))[0, 0] == pytest.approx(756 * 224 / 960)
    assert camera.matrix((225, 127)).isfinite().all()
    with pytest.raises(ConfigError, match="got 224 x 172; pass the camera of the depth images"):
        camera.matrix((224, 172))
    assert torch.equal(camera._replace(size=None).matrix((999, 500)), camera.matrix())


NAMED = {"fx": 525, "fy": 526, "cx": 319.5, "cy": 239.5}


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("640 480 525 526 319.5 239.5", (640, 480)),
        ("525 526 319.5 239.5 640 480", (640, 480)),
        ("525 526 319.5 239.5", None),
    ],
)
def test_the_order_of_unnamed_numbers_is_that_of_a_centered_axis(tmp_path, text, size):
    path = tmp_path / "camera.txt"
    path.write_text(text)
    assert read_camera(path) == CAMERA._replace(size=size)


@pytest.mark.parametrize("lens", ["0.1 -0.2 0 0", "0.1 -0.2 0 0 0", "0.1 -0.2 0 0 0.3"])
def test_unnamed_numbers_of_a_lens_are_told(tmp_path, lens):
    path = tmp_path / "calibration.txt"
    path.write_text(f"525 526 319.5 239.5 {lens}\n")
    with pytest.warns(DepthWarning, match=r"lens distortion \(k1, k2(, k3)?\) is not corrected"):
        assert read_camera(path) == CAMERA._replace(size=None)


@pytest.mark.parametrize(
    ("name", "value", "scale"),
    [
        ("depth_scale", 1000.0, 1000),
        ("depth_scale", 0.001, 1000),
        ("depth_scale", 1, 1),
        ("depth_unit_scale_factor", 0.0002, 5000),
        ("DepthMapFactor", 5000.0, 5000),
        ("png_depth_scale", 6553.5, 6553.5),
    ],
)
def test_depth_units_are_units_per_meter_or_meters_per_unit(tmp_path, name, value, scale):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**NAMED, name: value}))
    assert read_camera(path).depth_scale == pytest.approx(scale, rel=1e-15)


@pytest.mark.parametrize(
    "more",
    [
        {"is_fisheye": True},
        {"camera_model": "OPENCV_FISHEYE"},
        {"distortion_model": "equidistant"},
        {"Camera.type": "KannalaBrandt8"},
    ],
)
def test_cameras_that_are_no_pinhole_are_refused(tmp_path, more):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**NAMED, **more}))
    with pytest.raises(FormatError, match=r"expected a pinhole camera, got .*; undistort"):
        read_camera(path)
    (name,) = more
    path.write_text(json.dumps({**NAMED, name: False}))
    assert read_camera(path)[:4] == CAMERA[:4]


@pytest.mark.parametrize("name", ["fx", "cy", "width", "depth_scale", "K"])
def test_a_boolean_is_no_number(tmp_path, name):
    path = tmp_path / "camera.json"
    record = {"K": [525, 0, 320, 0, 525, True, 0, 0, 1]}
    if name != "K":
        record = {**NAMED, **SIZE, name: True}
    path.write_text(json.dumps(record))
    with pytest.raises(FormatError, match=f"expected (a number for )?{name}.*, got .*True"):
        read_camera(path)


def test_a_damaged_line_is_named_with_the_way_out(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("%YAML:1.0\nfx: 525\nfy: 526\ncx: 'open\ncy: 239.5\n")
    with pytest.raises(FormatError) as raised:
        read_camera(path)
    (line,) = str(raised.value).splitlines()
    assert line.startswith(f"{path}: expected JSON or YAML, got: ")
    assert "line 4" in line
    assert "cx: 'open" in line
    assert line.endswith("; correct it, or pass --intrinsics fx,fy,cx,cy.")


def test_names_without_a_blank_are_read_as_opencv_reads_them(tmp_path):
    path = tmp_path / "camera.yaml"
    lines = [f"Camera1.{name}:{value}" for name, value in NAMED.items()]
    path.write_text("\n".join(["%YAML:1.0", *lines, "Viewer.PointSize:2", "Window:-.5"]))
    assert read_camera(path)[:4] == CAMERA[:4]


@pytest.mark.parametrize(
    ("model", "parameters", "focal"),
    [
        ("SIMPLE_PINHOLE", "525 320 240", (525, 525)),
        ("SIMPLE_RADIAL", "525 320 240 0.01", (525, 525)),
        ("RADIAL", "525 320 240 0.01 0.02", (525, 525)),
        ("PINHOLE", "525 526 320 240", (525, 526)),
        ("OPENCV", "525 526 320 240 0.01 0 0 0", (525, 526)),
    ],
)
@pytest.mark.filterwarnings("ignore:.*lens distortion")
def test_models_of_colmap_have_one_focal_length_or_two(tmp_path, model, parameters, focal):
    path = tmp_path / "cameras.txt"
    path.write_text(
        f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {model} 640 480 {parameters}\n"
    )
    assert read_camera(path)[:5] == (*focal, 319.5, 239.5, (640, 480))
