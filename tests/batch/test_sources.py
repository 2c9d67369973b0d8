"""What each kind of data set becomes, scan by scan, without any engine."""

import json
import resource
import signal
from functools import partial
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch

from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan, reason_to_convert
from torchrg.batch.sources import CloudSource, RGBDSource
from torchrg.cli.convert import RGBDArguments
from torchrg.config import load_config
from torchrg.datasets import S3DIS, FolderOfClouds, RGBDFrames
from torchrg.datasets.rgbd_layouts import FRAME_LAYOUTS
from torchrg.datasets.s3dis import find_areas
from torchrg.depth import DepthConfig, segment_depth
from torchrg.depth.camera import Pinhole
from torchrg.errors import FormatError
from torchrg.io import Cloud, estimate_points, read_cloud, write_cloud
from torchrg.io.result import read_result
from torchrg.pipeline import make_superpoints, segment_planes

CLASSIC = load_config("classic")

PLY_HEADER = """ply
format ascii 1.0
element vertex %d
property float x
property float y
property float z
end_header
0 0 0
"""
PCD_HEADER = """VERSION .7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
WIDTH %d
HEIGHT 1
POINTS %d
DATA ascii
0 0 0
"""


@pytest.mark.filterwarnings("ignore:.*expected .* rooms")
@pytest.mark.filterwarnings("ignore:.*parts of rooms of S3DIS")
def test_the_command_knows_every_kind_and_layout(tmp_path):
    assert {*get_args(get_type_hints(RGBDArguments)["layout"])} == {"auto", *FRAME_LAYOUTS}
    settings, camera = DepthConfig(), Pinhole(5.0, 5.0, 2.0, 1.0)
    np.save(tmp_path / "1.npy", np.ones((4, 4), np.float32))
    frames = partial(RGBDFrames.from_folder, tmp_path, "images", intrinsics=camera, depth_scale=9.0)
    assert RGBDSource(frames(), settings).describe() == {
        "kind": "rgbd",
        "layout": "images",
        "intrinsics": camera,
        "depth_scale": 9.0,
        "orient": "auto",
    }
    turned = RGBDSource(frames(), settings, orient="up")
    assert turned.describe()["orient"] == "up"
    rays = RGBDSource(frames(depth_kind="ray"), settings)
    assert rays.describe()["depth_kind"] == "ray"
    (tmp_path / "1.npy").unlink()
    options = {"kind": "s3dis", "superpoint": True, "orient": "auto"}
    write_room(tmp_path / "Area_5" / "a", {"floor_1": grid()})
    np.save(tmp_path / "a.npy", grid())
    rooms = S3DIS(tmp_path, (5,))
    assert CloudSource(rooms, CLASSIC, superpoint=True).describe() == options
    options = {"kind": "folder", "superpoint": False, "orient": "none"}
    assert CloudSource(FolderOfClouds(tmp_path), CLASSIC, orient="none").describe() == options
    options |= {"orient": "auto"}
    assert CloudSource(FolderOfClouds(tmp_path), CLASSIC).describe() == options
    named = CloudSource(FolderOfClouds(tmp_path, columns=("x", "y", "z")), CLASSIC)
    assert named.describe() == options | {"columns": ["x", "y", "z"]}


def grid(step=0.05, side=20, height=0.0):
    """A floor and a wall, exactly."""
    ticks = torch.arange(float(side)) * step
    floor = torch.cartesian_prod(ticks, ticks, torch.tensor([height]))
    wall = torch.cartesian_prod(torch.tensor([0.0]), ticks, ticks[1:] + height)
    return torch.cat([floor, wall]).numpy()


def convert_all(source, out):
    """Convert every scan here; return the reports by name."""
    jobs = list_jobs(source, out)
    reports = {job.scan.name: convert_scan(job) for job in jobs}
    assert all(reason_to_convert(job) == "" for job in jobs), reports
    return reports


def load(folder, *names):
    """Return arrays of a result folder."""
    return [np.load(folder / f"{name}.npy") for name in names]


def write_room(room, objects, *, prefix=""):
    """Write a room of S3DIS: points by object, with colors 1, 2, 3."""
    (room / "Annotations").mkdir(parents=True)
    for name, points in objects.items():
        lines = [f"{prefix}{x:.3f} {y:.3f} {z:.3f} 1 2 3\n" for x, y, z in points]
        (room / "Annotations" / f"{name}.txt").write_text("".join(lines))


@pytest.mark.filterwarnings("ignore:.*expected .* rooms")
def test_s3dis_becomes_pointcept_with_planes(tmp_path):
    points = np.round(grid(), 3)
    room = tmp_path / "in" / "Area_2" / "office_1"
    write_room(room, {"floor_1": points[:400], "wall_1": points[400:]})
    wall = room / "Annotations" / "wall_1.txt"
    wall.write_bytes(wall.read_bytes().replace(b"0.000 0.000 0.050 1", b"0.000 0.000 0.05\x10 1"))
    (room / "Annotations" / "wall_1 (1).txt").write_bytes(b"")
    assert find_areas(tmp_path / "in") == (2,)
    source = CloudSource(S3DIS(tmp_path / "in", (2,)), CLASSIC, superpoint=True)
    (scan,) = source.list_scans(tmp_path / "out")
    assert abs(scan.num_points - len(points)) <= 0.02 * len(points)
    report = convert_all(source, tmp_path / "out")["Area_2/office_1"]
    assert report.repairs == (
        "wall_1.txt: line 1, column 17: b'0.000 0.000 0.05\\x10 1 2 3' read as "
        "b'0.000 0.000 0.050 1 2 3'",
    )
    assert "wall_1 (1).txt not read" in report.warnings[0]
    out = tmp_path / "out" / "Area_2" / "office_1"
    coord, color, segment, plane, superpoint = load(
        out, "coord", "color", "segment", "plane", "superpoint"
    )
    assert np.allclose(coord, points)
    assert (color == [1, 2, 3]).all()
    assert segment.ravel().tolist() == [1] * 400 + [2] * 380
    expected = segment_planes(coord, CLASSIC)
    assert np.array_equal(plane, expected.labels)
    parts = make_superpoints(coord, expected, colors=color)
    assert np.array_equal(superpoint, parts.labels)
    assert superpoint.dtype == np.int32
    assert len(json.loads((out / "planes.json").read_text())["planes"]) == report.num_regions


@pytest.mark.filterwarnings("ignore:.*expected .* rooms")
def test_a_bad_line_fails_its_room_and_names_it(tmp_path):
    points = grid()
    write_room(tmp_path / "in" / "Area_1" / "a", {"floor_1": points})
    write_room(tmp_path / "in" / "Area_1" / "b", {"floor_1": points}, prefix="x")
    jobs = list_jobs(CloudSource(S3DIS(tmp_path / "in", (1,)), CLASSIC), tmp_path / "out")
    good, bad = (convert_scan(job) for job in jobs)
    assert good.status == "converted"
    assert "floor_1.txt: line 1" in bad.reason


def test_far_clouds_keep_their_coordinates_and_planes_are_in_them(tmp_path):
    points = grid(height=3.0).astype(np.float64) + np.array([500_000, 4_000_000, 0])
    color = np.full((len(points), 3), 7, dtype=np.uint8)
    (tmp_path / "in").mkdir()
    write_cloud(tmp_path / "in" / "far.npz", Cloud(points, {"color": color}))
    convert_all(CloudSource(FolderOfClouds(tmp_path / "in"), CLASSIC), tmp_path / "out")
    out = tmp_path / "out" / "far"
    coord, written = load(out, "coord", "color")
    assert coord.dtype == np.float64
    assert np.array_equal(coord, points)
    assert np.array_equal(written, color)
    floor = json.loads((out / "planes.json").read_text())["planes"][0]
    assert floor["offset"] == pytest.approx(3.0, abs=1e-4)
    assert floor["centroid"][:2] == pytest.approx([500_000.475, 4_000_000.475], abs=0.2)


@pytest.mark.parametrize(
    ("form", "note"),
    [
        (lambda color: np.float32(color / 255 * (1 + 1e-6)), ""),
        (lambda color: color.astype(np.float32), ""),
        (lambda color: color * np.uint16(257), ""),
        (
            lambda color: color.astype(np.uint16),
            "colors are read as 0..255, judging by their values",
        ),
    ],
)
def test_scenes_have_colors_of_8_bits_whatever_was_in_them(tmp_path, form, note):
    points, scene = grid(), tmp_path / "in" / "scene"
    color = np.random.default_rng(0).integers(0, 256, points.shape, dtype=np.uint8)
    scene.mkdir(parents=True)
    np.save(scene / "coord.npy", points)
    np.save(scene / "color.npy", form(color))
    source = CloudSource(FolderOfClouds(tmp_path / "in"), CLASSIC, superpoint=True)
    (report,) = convert_all(source, tmp_path / "out").values()
    assert report.warnings == ((note,) if note else ())
    written, found = load(tmp_path / "out" / "scene", "color", "superpoint")
    assert written.dtype == np.uint8
    assert np.array_equal(written, color)
    seg = segment_planes(points, CLASSIC)
    assert np.array_equal(found, make_superpoints(points, seg, colors=color).labels)
    result = read_result(scene)
    assert result.fields["color"].tolist() == color.tolist()
    assert result.cloud.notes == report.warnings


def test_a_short_write_of_an_array_has_the_reason_of_the_system(tmp_path):
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "a.npy", grid())
    (job,) = list_jobs(CloudSource(FolderOfClouds(tmp_path / "in"), CLASSIC), tmp_path / "out")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        report = convert_scan(job)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert not report.disk_full
    assert report.reason == f"{job.folder / 'coord.npy'}: cannot be written: File too large."
    assert not job.folder.exists()
    assert convert_scan(job).status == "converted"


def test_points_that_are_not_finite_stay_and_are_told(tmp_path):
    points = grid()
    points[5] = np.nan
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "holes.npy", points)
    source = CloudSource(FolderOfClouds(tmp_path / "in"), CLASSIC)
    report = convert_all(source, tmp_path / "out")["holes"]
    assert "1 of 780 points are not finite" in report.warnings[0]
    coord, plane = load(tmp_path / "out" / "holes", "coord", "plane")
    assert np.array_equal(coord, points, equal_nan=True)
    assert plane[5] == -1
    np.save(tmp_path / "in" / "holes.npy", np.full((9, 3), np.inf))
    (job,) = list_jobs(source, tmp_path / "out")
    assert "expected finite points, got none" in convert_scan(job).reason


def test_folders_of_pointcept_are_completed_in_place(tmp_path):
    scene = tmp_path / "Area_1" / "hall"
    scene.mkdir(parents=True)
    points = grid()
    np.save(scene / "coord.npy", points)
    np.save(scene / "normal.npy", np.ones_like(points))
    before = {path.name: path.read_bytes() for path in scene.iterdir()}
    source = CloudSource(FolderOfClouds(tmp_path), CLASSIC)
    report = convert_all(source, tmp_path)["Area_1/hall"]
    assert report.num_points == len(points)
    assert all((scene / name).read_bytes() == content for name, content in before.items())
    names = {path.name for path in scene.iterdir()}
    assert names == {*before, "plane.npy", "curvature.npy", "planes.json", "provenance.json"}
    # What was added is no input, so a second run finds all done.
    assert convert_all(source, tmp_path)["Area_1/hall"].status == "converted"


def test_folders_of_pointcept_go_elsewhere_with_their_labels(tmp_path):
    scene = tmp_path / "in" / "hall"
    scene.mkdir(parents=True)
    points = grid()
    np.save(scene / "coord.npy", points)
    np.save(scene / "segment.npy", np.ones((len(points), 1), dtype=np.int16))
    np.save(scene / "normal.npy", np.ones_like(points))
    convert_all(CloudSource(FolderOfClouds(tmp_path / "in"), CLASSIC), tmp_path / "out")
    segment, normal = load(tmp_path / "out" / "hall", "segment", "normal")
    assert segment.tolist() == [[1]] * len(points)
    assert np.array_equal(normal, segment_planes(points, CLASSIC).normals)


def test_depth_frames_become_images(tmp_path):
    depth = np.full((30, 40), 2000, dtype=np.uint16)
    depth[:, 20:] = 3000
    depth[0] = 0
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "1.npy", depth)
    np.save(tmp_path / "in" / "2.npy", np.zeros_like(depth))
    camera = Pinhole(50.0, 50.0, 20.0, 15.0)
    settings = DepthConfig(noise=(0.001, 0.0))
    frames = partial(RGBDFrames.from_folder, tmp_path / "in", intrinsics=camera)
    source = RGBDSource(frames(depth_scale=1000), settings)
    jobs = list_jobs(source, tmp_path / "out")
    good, bad = (convert_scan(job) for job in jobs)
    assert "expected pixels with depth" in bad.reason
    assert (good.num_points, good.num_regions) == (1200, 2)
    coord, normal, plane = load(tmp_path / "out" / "1", "coord", "normal", "plane")
    matrix = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    found = segment_depth(torch.from_numpy(depth / 1000.0).float(), matrix, settings)
    assert np.array_equal(plane, found.labels)
    assert np.array_equal(normal, found.normals)
    assert (plane[0] == -1).all()
    assert (coord[0] == 0).all()
    assert coord[15, 20].tolist() == [0, 0, 3]
    assert reason_to_convert(jobs[0]) == ""
    other = RGBDSource(frames(depth_scale=500), settings)
    assert reason_to_convert(list_jobs(other, tmp_path / "out")[0]) == "options changed"


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".ply", ".pcd", ".xyz", ".las"])
def test_points_are_counted_without_reading_them(tmp_path, suffix):
    pytest.importorskip("laspy") if suffix == ".las" else None
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, Cloud(grid()))
    assert estimate_points(path) == pytest.approx(780, rel=0 if suffix != ".xyz" else 0.02)
    path.write_bytes(path.read_bytes()[:20] if suffix != ".xyz" else b"")
    assert estimate_points(path) == 0


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.las", np.random.default_rng(0).bytes(5000)),
        ("b.laz", b"LASF" + bytes(20) + b"\1\2" + bytes(81) + b"\xff" * 4 + bytes(140)),
        ("c.ply", PLY_HEADER % 10**15),
        ("d.pcd", PCD_HEADER % (10**15, 10**15)),
    ],
)
def test_a_file_too_small_for_its_number_of_points_is_corrupt(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert estimate_points(path) == 0
    with pytest.raises(FormatError, match=f"{name}: "):
        read_cloud(path)
