"""Cameras that do not belong to their images are refused or doubted; those of data sets pass."""

import warnings

import pytest
import torch

from torchrg.datasets import RGBDFrames
from torchrg.depth import depth_to_points, segment_depth
from torchrg.depth.camera import Pinhole, describe_improbable_view, make_intrinsics
from torchrg.errors import ConfigError, DepthWarning
from torchrg.render import write_png
from torchrg.transforms import DepthToCloud, SegmentDepth, fuse_depth

REAL = {
    "TUM freiburg1": ((517.3, 516.5, 318.6, 255.3), (640, 480)),
    "ICL-NUIM, y upwards": ((481.2, -480.0, 319.5, 239.5), (640, 480)),
    "ScanNet": ((577.87, 577.87, 319.5, 239.5), (640, 480)),
    "ARKitScenes": ((212.0, 212.0, 127.9, 95.6), (256, 192)),
    "3RScan": ((176.6, 177.1, 112.8, 87.4), (224, 172)),
    "Replica": ((600.0, 600.0, 599.5, 339.5), (1200, 680)),
    "Kinect v2": ((365.5, 365.5, 257.0, 205.2), (512, 424)),
    "Azure Kinect, narrow": ((504.1, 504.1, 322.5, 337.3), (640, 576)),
    "Azure Kinect, wide": ((252.4, 252.4, 251.9, 257.5), (512, 512)),
    "ETH3D": ((726.3, 726.3, 354.6, 186.5), (739, 458)),
    "RealSense": ((386.4, 386.4, 321.7, 238.3), (640, 480)),
    "a quarter of a degree of a side": ((58.3, 57.9, 40.5, 30.1), (80, 60)),
}
DOUBTED = {
    "a wide lens": ((42.0, 42.0, 160.0, 120.0), "with pixels 75.3 degrees off the optical axis"),
    "a long lens": ((4e3, 4e3, 160.0, 120.0), "with a field of view of 4.6 degrees"),
    "fx, cx, fy, cy": ((300.0, 160.0, 300.0, 120.0), "with non-square pixels"),
    "half as high": ((300.0, 150.0, 160.0, 60.0), "with non-square pixels"),
    "cx and cy": ((300.0, 300.0, 120.0, 160.0), "with an optical axis off the center"),
    "of smaller images": ((150.0, 150.0, 80.0, 60.0), "with an optical axis off the center"),
}
IMPOSSIBLE = {
    "fractions of the image": (0.94, 1.25, 0.5, 0.5),
    "millimeters": (3.6, 3.6, 2.4, 1.8),
    "a focal length of 1e9": (1e9, 1e9, 160.0, 120.0),
    "an axis far away": (300.0, 300.0, 1e5, 120.0),
}
OUTSIDE = {
    "of larger images": (600.0, 600.0, 320.0, 240.0),
    "of color images": (577.0, 578.0, 318.0, 242.0),
    "focal lengths last": (160.0, 120.0, 300.0, 300.0),
    "negative": (300.0, 300.0, -160.0, 120.0),
}
SIZE = (320, 240)


def doors(numbers, size=SIZE):
    """Yield the functions that take a camera for an image."""
    camera, depth = make_intrinsics(*numbers), torch.full(size[::-1], 2.0)
    sample = {"depth": depth[None], "intrinsics": camera, "pose": torch.eye(4).double()}
    yield "segment_depth", lambda: segment_depth(depth, camera)
    yield "depth_to_points", lambda: depth_to_points(depth[None], camera[None])
    yield "segment_depth", lambda: SegmentDepth()(sample)
    yield "depth_to_points", lambda: DepthToCloud()(sample)
    yield "depth_to_points", lambda: fuse_depth([sample])


@pytest.mark.parametrize("name", REAL)
def test_cameras_of_data_sets_raise_no_doubt(name):
    numbers, size = REAL[name]
    for _, call in [*doors(numbers, size)][1::2]:
        call()
    assert torch.equal(Pinhole(*numbers).matrix(size), make_intrinsics(*numbers))


@pytest.mark.parametrize("name", DOUBTED)
def test_improbable_cameras_are_doubted_at_every_door(name, tmp_path, run):
    numbers, message = DOUBTED[name]
    for caller, call in doors(numbers):
        with pytest.warns(DepthWarning, match=f"^{caller}: expected intrinsics fx,fy.*{message}"):
            call()
    root, labels = tmp_path / "in", tmp_path / "labels.png"
    root.mkdir()
    write_png(root / "0.png", torch.full(SIZE[::-1], 2000))
    flags = ["--intrinsics", ",".join(map(str, numbers)), "--depth-scale", "1000"]
    reported = "0.png: expected --intrinsics fx,fy,cx,cy of images of 320 x 240 pixels, got "
    for command in (
        ("depth", root / "0.png", "--out", labels),
        ("convert", "rgbd", root, tmp_path / "out", "--dry-run"),
    ):
        done = run(*command, *flags)
        assert done.code == 0
        (line,) = done.err.splitlines()
        assert reported in line
        assert message in line
    camera = make_intrinsics(*numbers)
    with pytest.warns(DepthWarning, match=message):
        RGBDFrames.from_folder(root, "images", intrinsics=camera, depth_scale=1000.0)


@pytest.mark.parametrize("name", {**IMPOSSIBLE, **OUTSIDE})
def test_impossible_cameras_are_refused(name, tmp_path, run):
    numbers = {**IMPOSSIBLE, **OUTSIDE}[name]
    for caller, call in doors(numbers) if name in IMPOSSIBLE else ():
        with pytest.raises(ConfigError, match=f"^{caller}: expected intrinsics fx,fy"):
            call()
    root, labels = tmp_path / "in", tmp_path / "labels.png"
    root.mkdir()
    write_png(root / "0.png", torch.full(SIZE[::-1], 2000))
    flags = ["--intrinsics", ",".join(map(str, numbers)), "--depth-scale", "1000"]
    for command in (
        ("depth", root / "0.png", "--out", labels),
        ("convert", "rgbd", root, tmp_path / "out", "--dry-run"),
    ):
        error = run(*command, *flags).error
        assert "0.png: expected " in error
        assert "320 x 240 pixels, got " in error
    assert not labels.exists()


def test_the_axis_of_a_crop_may_be_outside_of_it():
    with pytest.warns(DepthWarning, match="with an optical axis off the center"):
        segment_depth(torch.full((60, 80), 2.0), make_intrinsics(300.0, 300.0, -20.0, 30.0))


def test_cx_and_cy_in_the_wrong_order_are_told_from_an_axis_off_the_center():
    # Kinect v2: the axis is off by a tenth of a side alone, and fits in the other order.
    with pytest.warns(DepthWarning, match="which fit better with cx and cy exchanged"):
        segment_depth(torch.full((424, 512), 2.0), make_intrinsics(365.5, 365.5, 205.2, 257.0))


def test_a_batch_is_doubted_once():
    depth = torch.full((3, 24, 32), 2.0)
    cameras = torch.stack([make_intrinsics(30.0, 30.0, 15.5, cy) for cy in (11.5, 3.0, 3.0)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        depth_to_points(depth, cameras)
    assert len(caught) == 1
    assert caught[0].category is DepthWarning


def test_turned_images_are_told():
    with pytest.raises(ConfigError, match=r"got 240 x 320; rotate the images back, or pass the c"):
        Pinhole(600.0, 600.0, 319.5, 239.5, (640, 480)).matrix((240, 320))


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_images_without_rows_or_columns_have_no_planes(shape):
    camera, batch = make_intrinsics(5.0, 5.0, 2.0, 2.0), torch.zeros(2, 1, *shape)
    found = segment_depth(torch.zeros(shape), camera, pose=torch.eye(4))
    images = found.labels, found.normals, found.curvature, found.sharp, found.valid
    for image, dtype in zip(
        images, (torch.int64, *[torch.float32] * 2, *[torch.bool] * 2), strict=True
    ):
        assert image.shape[:2] == shape
        assert image.dtype == dtype
    assert len(found.planes) == 0
    sample = {"depth": batch, "intrinsics": camera, "color": torch.zeros(2, 3, *shape)}
    assert SegmentDepth()(sample)["plane"].shape == (2, *shape)
    assert DepthToCloud()(sample)["color"].shape == (0, 3)
    assert depth_to_points(batch[:, 0], camera.expand(2, 3, 3)).shape == (2, *shape, 3)


@pytest.mark.parametrize("shift", [-6.6, -6.4, 6.4, 6.6])
def test_an_axis_is_off_the_center_equally_on_both_sides(shift):
    """0.15 of 40 pixels and half a pixel, from the center at 19.5."""
    camera = Pinhole(30.0, 30.0, 19.5 + shift, 19.5)
    assert bool(describe_improbable_view("f", camera, (40, 40))) == (abs(shift) > 6.5)
