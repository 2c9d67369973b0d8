"""Depth frames from the folders of public data sets."""

import json
import math
import pickle
import warnings
from pathlib import Path

import kornia_rs
import numpy as np
import pytest
import torch

from tests.datasets.captures_tree import write_text
from torchrg.batch.scans import Job, convert_scan
from torchrg.batch.sources import RGBDSource
from torchrg.config import DepthConfig
from torchrg.datasets import RGBDFrame, RGBDFrames
from torchrg.datasets.rgbd_files import read_color, read_depth
from torchrg.depth.camera import Pinhole, make_intrinsics
from torchrg.errors import ConfigError, DepthWarning, FormatError, ShapeError
from torchrg.render import write_png
from torchrg.transforms import DepthToCloud

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*using the built-in camera"),
    pytest.mark.filterwarnings("ignore:.*using the depth unit"),
    pytest.mark.filterwarnings("ignore:.*frames have no pose"),
]
HALF = math.sqrt(0.5)
# A quarter turn about z, as x y z w, and as a matrix.
CAMERA = make_intrinsics(5.0, 5.0, 2.5, 1.5)
QUARTER = f"0 0 {HALF} {HALF}"
TURN = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
MATRIX = "577 0 318 0\n0 578 242 0\n0 0 1 0\n0 0 0 1\n"
POSE_ROWS = "0 -1 0 0.5\n1 0 0 0.25\n0 0 1 2\n0 0 0 1\n"


def write_depth(path, value, shape=(4, 6)):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = torch.full(shape, value)
    image[0, 0] = 0
    write_png(path, image)


def write_color(path, value=7):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((4, 6, 3), value, dtype=np.uint8)
    if path.suffix == ".jpg":
        kornia_rs.io.write_image_jpeg(str(path), image, "rgb", 95)
    else:
        write_png(path, image)


def expected_pose():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = TURN, torch.tensor([0.5, 0.25, 2.0])
    return pose


@pytest.fixture
def tum(tmp_path):
    root = tmp_path / "rgbd_dataset_freiburg3_desk"
    for name, value in (("2.0", 10000), ("1.0", 5000)):
        write_depth(root / "depth" / f"{name}.png", value)
        write_color(root / "rgb" / f"{name}5.png", value // 1000)
    write_text(root / "depth.txt", "# depth\n2.0 depth/2.0.png\n1.0 depth/1.0.png\n")
    write_text(root / "rgb.txt", "# color\n1.015 rgb/1.05.png\n2.03 rgb/2.05.png\n")
    far = f"1.5 9 9 9 {QUARTER}\n1.015 9 9 9 {QUARTER}\n"
    write_text(root / "groundtruth.txt", f"#\n{far}0.99 0.5 0.25 2 {QUARTER}\n")
    return root


def test_tum_frames_are_matched_in_time(tum):
    for root in (tum, tum.parent):
        data = RGBDFrames.from_folder(root, "tum")
        assert [scene.name.split("/")[-1] for scene in data.scenes] == ["1.0", "2.0"]
        first, second = data
        assert first["depth"].shape == (1, 4, 6)
        assert first["depth"].dtype == torch.float32
        assert first["depth"][0, 0, :2].tolist() == [0, 1]
        assert second["depth"][0, 1, 1] == 2
        # The camera is that of 640 x 480 pixels, the images have 6 x 4.
        assert first["intrinsics"].diagonal().tolist() == [535.4 * 6 / 640, 539.2 * 4 / 480, 1]
        assert first["color"][:, 0, 0].tolist() == [5, 5, 5]
        torch.testing.assert_close(first["pose"], expected_pose())
        assert "color" not in second
        assert "pose" not in second
    names = [path.name for path in data.scenes[0].files]
    assert names == ["1.0.png", "1.05.png", "depth.txt", "rgb.txt", "groundtruth.txt"]


def test_the_camera_of_tum_is_not_guessed(tum):
    other = tum.rename(tum.parent / "desk")
    with pytest.raises(ConfigError, match=r"1.0.png: expected intrinsics, which images lack"):
        RGBDFrames.from_folder(other, "tum")
    data = RGBDFrames.from_folder(other, "tum", intrinsics=CAMERA.float(), depth_scale=1000)
    assert data[0]["depth"].max() == 5
    assert data[0]["intrinsics"].dtype == torch.float64


def test_a_scale_of_zero_is_not_that_of_the_layout(tum):
    with pytest.raises(ConfigError, match="expected depth_scale > 0"):
        RGBDFrames.from_folder(tum, "tum", depth_scale=0.0)


def test_scannet_frames_have_files_of_their_own(tmp_path):
    for scene in ("scene0000_00", "scene0000_01"):
        root = tmp_path / scene
        for number in (0, 1):
            write_depth(root / "depth" / f"{number}.png", 1500, (480, 640))
            write_color(root / "color" / f"{number}.jpg")
        write_text(root / "pose" / "0.txt", POSE_ROWS)
        write_text(root / "pose" / "1.txt", "-inf -inf -inf -inf\n" * 4)
        write_text(root / "intrinsic" / "intrinsic_depth.txt", MATRIX)
    data = RGBDFrames.from_folder(tmp_path, "scannet")
    assert len(data) == 4
    assert data.scenes[2].name == "scene0000_01/0"
    assert data[0]["depth"].max() == 1.5
    coarse = RGBDFrames.from_folder(tmp_path, "scannet", depth_scale=500)
    assert coarse[0]["depth"].max() == 3
    torch.testing.assert_close(data[0]["pose"], expected_pose())
    assert "pose" not in data[1]
    assert data[0]["intrinsics"][0].tolist() == [577, 0, 318]
    assert [path.name for path in data.scenes[0].files] == [
        "0.png",
        "0.jpg",
        "intrinsic_depth.txt",
        "0.txt",
    ]


def test_seven_scenes_mark_missing_depth(tmp_path):
    root = tmp_path / "seq-01"
    write_depth(root / "frame-000000.depth.png", 65535)
    write_depth(root / "frame-000001.depth.png", 2500)
    write_color(root / "frame-000001.color.png")
    write_text(root / "frame-000001.pose.txt", POSE_ROWS)
    data = RGBDFrames.from_folder(tmp_path, "7-scenes")
    assert [scene.name for scene in data.scenes] == [
        "seq-01/frame-000000",
        "seq-01/frame-000001",
    ]
    assert not data[0]["depth"].any()
    assert data[1]["depth"].max() == 2.5
    assert data[1]["color"].shape == (3, 4, 6)
    torch.testing.assert_close(data[1]["pose"], expected_pose())


def test_any_folder_of_images_needs_its_camera(tmp_path):
    write_depth(tmp_path / "b" / "10.png", 300)
    np.save(tmp_path / "b" / "9.npy", np.full((4, 6), 1.25, dtype=np.float32))
    for given, missing in (
        ({"intrinsics": CAMERA}, "depth_scale"),
        ({"depth_scale": 1.0}, "intrinsics"),
    ):
        with pytest.raises(ConfigError, match=f"expected {missing}, which images lack"):
            RGBDFrames.from_folder(tmp_path, "images", **given)
    data = RGBDFrames.from_folder(tmp_path, "images", intrinsics=CAMERA, depth_scale=1)
    assert [scene.name for scene in data.scenes] == ["b/9", "b/10"]
    assert data[0]["depth"].unique().tolist() == [1.25]


def test_frames_of_one_size_are_batched_and_transformed(tum):
    data = RGBDFrames.from_folder(tum, "tum", intrinsics=CAMERA, transform=DepthToCloud())
    assert data[0]["coord"].shape == (23, 3)
    plain = [RGBDFrame(frame.depth, CAMERA, 5000.0, frame.name) for frame in data.frames]
    loader = torch.utils.data.DataLoader(RGBDFrames(plain), batch_size=2, num_workers=2)
    batch = next(iter(loader))
    assert batch["depth"].shape == (2, 1, 4, 6)
    assert batch["name"] == [frame.name for frame in data.frames]


def test_wrong_files_are_refused(tmp_path, tum):
    (tmp_path / "empty.npy").touch()
    write_color(tmp_path / "color.png")
    write_text(tmp_path / "text.png", "no image")
    write_text(tmp_path / "text.npy", "no array")
    np.save(tmp_path / "flat.npy", np.zeros(3))
    for name, message in (
        ("color.png", "expected a 16-bit gray PNG, got shape"),
        ("text.png", "expected a PNG image, got: "),
        ("text.npy", "expected an array of numbers, got: "),
        ("flat.npy", r"expected depth of shape \(H, W\), got \(3,\)"),
        ("missing.png", "file not found; check the path"),
        ("empty.npy", "byte 0: the file is empty"),
        ("missing.npy", "file not found; check the path"),
        ("depth.jpg", "expected a depth image that ends in .*, got '.jpg'; convert it to a 16"),
    ):
        with pytest.raises(FormatError, match=f"{name}: {message}"):
            read_depth(tmp_path / name, depth_scale=1000)
    with pytest.raises(ConfigError, match="expected depth_scale > 0"):
        read_depth(tum / "depth" / "1.0.png", depth_scale=0)
    with pytest.raises(FormatError, match=r"text.png: expected a PNG or JPEG image"):
        read_color(tmp_path / "text.png")


def test_wrong_folders_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="expected layout to be one of 3rscan, 7-scenes"):
        RGBDFrames.from_folder(tmp_path, "nyu")
    for layout in ("tum", "scannet", "7-scenes"):
        with pytest.raises(FormatError, match=r"expected recordings that contain .* got none"):
            RGBDFrames.from_folder(tmp_path, layout)
        with pytest.raises(FormatError, match="no such folder"):
            RGBDFrames.from_folder(tmp_path / "missing", layout)
    camera = torch.eye(3)
    with pytest.raises(FormatError, match="expected depth images"):
        RGBDFrames.from_folder(tmp_path, "images", intrinsics=camera, depth_scale=1)
    write_depth(tmp_path / "depth" / "0.png", 1500)
    with pytest.raises(ConfigError, match=r"expected intrinsics, which images lack"):
        RGBDFrames.from_folder(tmp_path, "scannet")
    write_text(tmp_path / "intrinsic" / "intrinsic_depth.txt", "1 2 3\n")
    with pytest.raises(FormatError, match=r"_depth.txt: expected a matrix of .*, got 3 numbers"):
        RGBDFrames.from_folder(tmp_path, "scannet")


def test_wrong_frames_are_refused(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(ShapeError, match=r"RGBDFrame: expected intrinsics of shape \(3, 3\)"):
        RGBDFrame(path, torch.eye(4), 1000.0)
    with pytest.raises(ConfigError, match="expected depth_scale > 0 units per"):
        RGBDFrame(path, torch.eye(3), 0.0)
    with pytest.raises(ConfigError, match="expected distinct frame names, got 'a' twice"):
        RGBDFrames([RGBDFrame(path, torch.eye(3), 1.0, "a")] * 2)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("depth.txt", b"1.0 a b\n", "expected a time and a file name in each row"),
        ("depth.txt", b"one a\n", "expected numbers"),
        ("groundtruth.txt", b"1 2 3\n", "expected time tx ty tz qx qy qz qw in each row"),
        ("depth.txt", b"nan depth/1.0.png\n", "expected finite times, got nan"),
        ("groundtruth.txt", b"inf 0 0 0 0 0 0 1\n", "expected finite times, got inf"),
        ("rgb.txt", b"1.0 rgb/\xe9.png\n", r"byte 8: expected UTF-8, got b'\\xe9'"),
        ("rgb.txt", b"1.0 rgb/\0.png\n", r"byte 8: expected UTF-8, got b'\\x00'"),
    ],
)
def test_lists_that_are_none_are_refused_by_file_and_place(tum, name, content, message):
    (tum / name).write_bytes(content)
    with pytest.raises(FormatError, match=f"{name}: {message}"):
        RGBDFrames.from_folder(tum, "tum")


@pytest.mark.parametrize("value", ["1e300", "nan", "-1e13"])
def test_poses_that_lead_nowhere_are_none(tum, tmp_path, value):
    (tum / "groundtruth.txt").write_text(f"1.01 0.5 {value} 2 {QUARTER}\n")
    assert RGBDFrames.from_folder(tum, "tum").frames[0].pose is None
    root = tmp_path / "scans" / "scene0000_00"
    write_depth(root / "depth" / "0.png", 1500, (480, 640))
    write_text(root / "pose" / "0.txt", POSE_ROWS.replace("0.5", value))
    write_text(root / "intrinsic" / "intrinsic_depth.txt", MATRIX)
    assert RGBDFrames.from_folder(root, "scannet").frames[0].pose is None


@pytest.mark.parametrize("focal", ["0", "nan", "1e300"])
def test_a_camera_matrix_of_none_is_refused_with_its_file(tmp_path, focal):
    root = tmp_path / "scene0000_00"
    write_depth(root / "depth" / "0.png", 1500)
    path = root / "intrinsic" / "intrinsic_depth.txt"
    write_text(path, f"{focal} 0 318 0\n0 578 242 0\n0 0 1 0\n0 0 0 1\n")
    with pytest.raises(ConfigError, match=r"_depth\.txt: expected intrinsics of rows"):
        RGBDFrames.from_folder(tmp_path, "scannet")


def test_a_frame_that_is_missing_fails_alone(tum, tmp_path):
    (tum / "depth" / "1.0.png").unlink()
    long = "x" * 300
    (tum / "depth.txt").write_text(f"1.0 depth/1.0.png\n2.0 depth/2.0.png\n3.0 {long}.png\n")
    source = RGBDSource(RGBDFrames.from_folder(tum, "tum"), DepthConfig(noise=(0.001, 0.0)))
    out = tmp_path / "out"
    reports = [convert_scan(Job(source, scan, out)) for scan in source.list_scans(out)]
    assert [report.status for report in reports] == ["failed", "converted", "failed"]
    assert reports[0].reason.startswith(f"{tum / 'depth' / '1.0.png'}: ")
    assert reports[2].reason.startswith(f"{tum / long}.png: ")
    assert [report.details for report in reports] == [""] * 3


@pytest.mark.parametrize("given", ["folder", Path("folder"), ["a.png"]])
def test_a_folder_in_place_of_frames_is_refused_with_the_right_call(given):
    message = "RGBDFrames: expected a list of RGBDFrame, got .*; use RGBDFrames.from_folder"
    with pytest.raises(ConfigError, match=message):
        RGBDFrames(given)
    assert len(RGBDFrames([])) == 0


def test_numpy_cameras_are_cameras(tum):
    given = RGBDFrames.from_folder(tum, intrinsics=CAMERA.numpy())[0]["intrinsics"]
    assert torch.equal(given, CAMERA)


def test_names_listed_on_windows_are_found(tum):
    for name in ("depth.txt", "rgb.txt"):
        text = (tum / name).read_text()
        write_text(tum / name, text.replace("/", "\\"))
    data = RGBDFrames.from_folder(tum, "tum", intrinsics=CAMERA)
    assert [frame.name.split("/")[-1] for frame in data.frames] == ["1.0", "2.0"]
    assert data[0]["color"].shape == (3, 4, 6)


def test_distances_along_the_ray_are_read_as_depth(tmp_path):
    rows, columns = np.mgrid[:4, :6]
    lengths = np.sqrt(((columns - 2.5) / 5) ** 2 + ((rows - 1.5) / 5) ** 2 + 1)
    np.save(tmp_path / "a.npy", 2 * lengths)
    options = {"intrinsics": CAMERA, "depth_scale": 1.0}
    data = RGBDFrames.from_folder(tmp_path, "images", **options, depth_kind="ray")
    torch.testing.assert_close(data[0]["depth"], torch.full((1, 4, 6), 2.0))
    with pytest.raises(ConfigError, match="RGBDFrame: expected depth_kind to be one of z, ray"):
        RGBDFrames.from_folder(tmp_path, "images", **options, depth_kind="euclid")


def messages_of(caught):
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("camera", ["flag", "file", "built in", "file with a unit", "flags"])
def test_a_unit_of_the_layout_with_another_camera_is_said_once(tum, camera):
    text = {"file": "", "file with a unit": "DepthMapFactor: 1000\n"}.get(camera)
    if text is not None:
        write_text(tum / "camera.yaml", f"fx: 5\nfy: 5\ncx: 2.5\ncy: 1.5\n{text}")
    options = {"intrinsics": CAMERA} if camera.startswith("flag") else {}
    options |= {"depth_scale": 1000.0} if camera == "flags" else {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        RGBDFrames.from_folder(tum, **options)
    said = [text for text in messages_of(caught) if "depth unit" in text]
    assert len(said) == (camera in ("flag", "file"))
    for text in said:
        origin = "given" if camera == "flag" else "camera.yaml"
        assert text.startswith(f"{tum}: using the depth unit of tum, 5000 units per meter, with a ")
        assert f"({origin}); pass --depth-scale (depth_scale), 1000 for millimeters" in text


def test_the_unit_of_scannet_goes_with_its_own_camera_file(tmp_path):
    root = tmp_path / "scene0000_00"
    write_depth(root / "depth" / "0.png", 1500, (480, 640))
    np.savetxt(root / "intrinsics_depth.txt", np.diag([577.0, 577, 1]) + np.eye(3, k=2) * 320)
    for given, count in (({}, 0), ({"intrinsics": make_intrinsics(577, 577, 320, 240)}, 1)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            RGBDFrames.from_folder(root, "scannet", **given)
        assert sum("depth unit of scannet" in text for text in messages_of(caught)) == count


@pytest.mark.parametrize("pose", ["-inf", "nan", "missing"])
def test_frames_without_the_poses_of_others_are_counted(tmp_path, pose):
    root = tmp_path / "seq-01"
    for number in range(3):
        write_depth(root / f"frame-{number:06d}.depth.png", 2500)
        write_text(root / f"frame-{number:06d}.pose.txt", POSE_ROWS)
    path = root / "frame-000001.pose.txt"
    path.unlink() if pose == "missing" else path.write_text(f"{pose} {pose} 1 1\n" * 4)
    with pytest.warns(DepthWarning, match=f"{tmp_path}: 1 of 3 frames have no pose; their results"):
        frames = RGBDFrames.from_folder(tmp_path, "7-scenes").frames
    assert [frame.pose is None for frame in frames] == [False, True, False]
    for path in root.glob("*.pose.txt"):
        path.unlink()
    with warnings.catch_warnings(record=True) as caught:
        RGBDFrames.from_folder(tmp_path, "7-scenes")
    assert not any("no pose" in text for text in messages_of(caught))


def test_a_pose_that_is_no_motion_is_refused_with_its_file(tmp_path):
    root = tmp_path / "seq-01"
    write_depth(root / "frame-000000.depth.png", 2500)
    write_text(root / "frame-000000.pose.txt", "5 0 0 1\n0 5 0 1\n0 0 5 1\n0 0 0 1\n")
    message = (
        r"000000\.pose\.txt: frame-000000: expected pose to be rigid, got a rotation scaled by 5"
    )
    with pytest.raises(FormatError, match=message):
        RGBDFrames.from_folder(tmp_path, "7-scenes")


@pytest.mark.parametrize("posed", [True, False])
def test_the_record_says_in_which_frame_results_are(tmp_path, posed):
    root = tmp_path / "seq-01"
    write_depth(root / "frame-000000.depth.png", 2500, (24, 36))
    if posed:
        write_text(root / "frame-000000.pose.txt", POSE_ROWS)
    camera = Pinhole(30, 30, 17.5, 11.5)
    data = RGBDFrames.from_folder(tmp_path, "7-scenes", intrinsics=camera)
    source = RGBDSource(data, DepthConfig())
    (scan,) = source.list_scans(tmp_path / "out")
    report = convert_scan(Job(source, scan, tmp_path / "out"))
    record = json.loads((tmp_path / "out" / scan.name / "provenance.json").read_text())
    expected = "world" if posed else "camera"
    assert record["measured"]["pose"] == report.measured["pose"] == expected


@pytest.mark.parametrize("posed", [True, False])
def test_a_frame_is_read_as_a_cloud_as_other_scenes_are(tmp_path, posed):
    root = tmp_path / "seq-01"
    write_depth(root / "frame-000000.depth.png", 2500, (24, 36))
    image = torch.full((24, 36), 2500)
    image[3, 5] = 0
    write_png(root / "frame-000000.depth.png", image)
    if posed:
        write_text(root / "frame-000000.pose.txt", POSE_ROWS)
    camera = Pinhole(30, 30, 17.5, 11.5)
    data = RGBDFrames.from_folder(tmp_path, "7-scenes", intrinsics=camera)
    cloud, sample = data.read_cloud(0), data[0]
    pose = sample.get("pose", torch.eye(4).double())
    pixel = torch.tensor([(35 - 17.5) / 30 * 2.5, (23 - 11.5) / 30 * 2.5, 2.5]).double()
    assert cloud.grid_shape == (24, 36)
    np.testing.assert_allclose(cloud.coordinates[-1], pose[:3, :3] @ pixel + pose[:3, 3], atol=1e-6)
    assert np.flatnonzero(~cloud.finite).tolist() == [3 * 36 + 5]
    np.testing.assert_allclose(
        (cloud.coordinates + cloud.front)[cloud.finite], pose[:3, 3].expand(863, 3), atol=1e-6
    )
    assert data.count_points(data.scenes[0]) == len(cloud) == 24 * 36
    copy = pickle.loads(pickle.dumps(data.scenes[0].item))
    assert torch.equal(copy.intrinsics, data.frames[0].intrinsics)
    assert (copy.pose is None) == (not posed)
