"""To which side the normals point that commands write: rooms as points, meshes, scans, frames."""

import json
import re
import shutil
import struct

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay
from torch.utils.data import DataLoader

from tests.datasets.scannet_tree import write_mesh, write_scan
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan, reason_to_convert
from torchrg.batch.sources import CloudSource, RGBDSource
from torchrg.config import DepthConfig, load_config
from torchrg.datasets import FolderOfClouds, RGBDFrames, ScanNet, collate_offset
from torchrg.depth.camera import Pinhole
from torchrg.io import read_cloud, write_cloud
from torchrg.pipeline import segment_planes
from torchrg.render import write_png
from torchrg.structures import Cloud
from torchrg.transforms import SegmentPlanes

CLASSIC = load_config("classic")
CAMERA = ("--intrinsics", "50,50,19.5,14.5", "--depth-scale", "1000")


@pytest.fixture(scope="module")
def mesh(room):
    """Points of a made room, normals into it, and triangles of each face, wound to be seen."""
    scene = room(noise=0.002, seed=2)
    labels = scene.labels.numpy()
    kept = np.isin(labels, np.flatnonzero(np.bincount(labels[labels >= 0]) >= 50))
    points, normals = (part[kept].float().numpy() for part in (scene.points, scene.normals))
    labels = labels[kept]
    faces = []
    for label in np.unique(labels):
        own = np.flatnonzero(labels == label)
        across = np.linalg.svd(normals[own[:1]])[2][1:]
        corners = own[Delaunay(points[own] @ across.T).simplices]
        a, b, c = (points[corners[:, i]] for i in range(3))
        away = (np.cross(b - a, c - a) * normals[own[0]]).sum(axis=1) < 0
        corners[away] = corners[away][:, ::-1]
        faces.append(corners)
    return points, normals, np.concatenate(faces)


@pytest.fixture(scope="module")
def files(mesh, tmp_path_factory):
    """The room as points, as two meshes, and as a mesh of two faces."""
    points, _, faces = mesh
    folder = tmp_path_factory.mktemp("rooms")
    write_cloud(folder / "points.ply", Cloud(points))
    write_mesh(folder / "inwards.ply", points, faces=faces)
    write_mesh(folder / "outwards.ply", points, faces=faces[:, ::-1])
    write_mesh(folder / "two.ply", points, faces=faces[:2])
    return folder


def write_stations(path, points, normals):
    """What two scanners see of a room, each in its own frame; return the truth in that order."""
    pye57 = pytest.importorskip("pye57")
    middle = points.mean(axis=0)
    places = [middle + step for step in (np.array([0.5, 0.4, 0.1]), np.array([-0.5, -0.4, -0.1]))]
    seen = [(normals * (place - points)).sum(axis=1) > 0 for place in places]
    first = seen[0] & (~seen[1] | (np.arange(len(points)) % 2 == 0))
    far, truth = np.array([5e5, 4.5e6, 210.0]), []
    with pye57.E57(str(path), "w") as file:
        for place, rows in zip(places, (first, seen[1] & ~first), strict=True):
            x, y, z = (points[rows].astype(float) - place).T
            columns = {"cartesianX": y, "cartesianY": -x, "cartesianZ": z}
            turn = np.array([0.5**0.5, 0, 0, 0.5**0.5])
            file.write_scan_raw(columns, rotation=turn, translation=far + place)
            truth.append(normals[rows])
    return np.concatenate(truth)


def fraction(normals, truth):
    """Share of normals that point to the true side."""
    return ((normals * truth).sum(axis=1) > 0).mean()


def convert(source, out):
    """Convert all scans here; return their normals by name."""
    for job in list_jobs(source, out):
        report = convert_scan(job)
        assert report.status == "converted", report.reason
        assert reason_to_convert(job) == ""
    return {path.parent.name: np.load(path) for path in out.rglob("normal.npy")}


def folder_source(tmp_path, orient="auto"):
    return CloudSource(FolderOfClouds(tmp_path / "in"), CLASSIC, orient=orient)


@pytest.mark.parametrize("preset", ["classic", "consensus"])
@pytest.mark.parametrize(("name", "side"), [("points", 1), ("outwards", -1)])
def test_all_doors_give_one_answer(room, mesh, files, tmp_path, run, preset, name, side):
    if name == "points":
        scene = room(noise=0.002, seed=2, num_points=20_000)
        points, truth = scene.points.float().numpy(), scene.normals.numpy()
    else:
        points, truth, faces = mesh
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / f"{name}.ply"
    write_cloud(path, Cloud(points))
    if name != "points":
        write_mesh(path, points, faces=faces[:, ::-1])
    expected = segment_planes(path, preset)
    assert fraction(expected.normals.numpy(), side * truth) >= 0.97
    cloud = read_cloud(path)
    seg = segment_planes(cloud, preset)
    assert torch.equal(seg.labels, expected.labels)
    assert torch.equal(seg.normals, expected.normals)
    data = FolderOfClouds(tmp_path / "in", transform=SegmentPlanes(preset))
    (batch,) = DataLoader(data, collate_fn=collate_offset)
    assert torch.equal(batch["plane"], expected.labels)
    assert torch.equal(batch["normal"], expected.normals)
    assert run("segment", path, "--out", tmp_path / "a.npz", "--preset", preset).code == 0
    with np.load(tmp_path / "a.npz") as result:
        assert np.array_equal(result["labels"], expected.labels)
        assert np.array_equal(result["normals"], expected.normals)
    source = CloudSource(FolderOfClouds(tmp_path / "in"), load_config(preset))
    (normals,) = convert(source, tmp_path / "out").values()
    assert np.array_equal(normals, expected.normals)
    assert np.array_equal(np.load(tmp_path / "out" / name / "plane.npy"), expected.labels)
    settings = load_config(preset).normals
    flags = ("--method", settings.method, "--normals.k", settings.k)
    assert run("normals", path, "--out", tmp_path / "b.npz", *flags).code == 0
    with np.load(tmp_path / "b.npz") as result:
        assert fraction(result["normals"], side * truth) >= 0.97


def test_normals_point_into_rooms_to_the_front_of_faces_and_to_scanners(mesh, files, tmp_path):
    _, truth, _ = mesh
    shutil.copytree(files, tmp_path / "in")
    truths = {"stations": write_stations(tmp_path / "in" / "stations.e57", *mesh[:2])}
    found = convert(folder_source(tmp_path), tmp_path / "out")
    fractions = {
        name: fraction(normals, truths.get(name, truth)) for name, normals in found.items()
    }
    assert fractions.pop("outwards") < 0.05
    assert len(fractions) == 4
    assert min(fractions.values()) > 0.95, fractions
    record = json.loads((tmp_path / "out" / "points" / "provenance.json").read_text())
    assert record["source"]["orient"] == "auto"


def test_other_sides_are_other_results(mesh, files, tmp_path):
    _, truth, _ = mesh
    (tmp_path / "in").mkdir()
    shutil.copy(files / "outwards.ply", tmp_path / "in")
    found = {}
    for orient in ("interior", "up", "none"):
        source = folder_source(tmp_path, orient)
        (job,) = list_jobs(source, tmp_path / "out")
        assert reason_to_convert(job) != ""
        found[orient] = convert(source, tmp_path / "out")["outwards"]
    assert fraction(found["interior"], truth) > 0.95
    assert (found["up"][:, 2] >= 0).all()
    assert fraction(found["none"], truth) < 0.7
    (job,) = list_jobs(folder_source(tmp_path, "viewpoint"), tmp_path / "out")
    assert re.search(
        "outwards.ply: expected a viewpoint, .* or use interior", convert_scan(job).reason
    )


@pytest.mark.parametrize("kind", ["s3dis", "scannet"])
def test_data_sets_without_scanners_refuse_to_look_at_them(tmp_path, run, kind):
    error = run("convert", kind, tmp_path, tmp_path / "x", "--orient", "viewpoint").error
    assert "expected --orient auto, interior, up or none" in error


def test_meshes_of_scannet_say_which_side_is_seen(mesh, tmp_path):
    points, truth, faces = mesh
    color = np.zeros((len(points), 3), np.uint8)
    write_scan(tmp_path / "in" / "scans", "scene0000_00", points, color, None, None)
    name = "scene0000_00/scene0000_00_vh_clean_2.ply"
    # A room from outside, which only its faces can tell.
    write_mesh(tmp_path / "in" / "scans" / name, points, color, faces=faces[:, ::-1])
    found = convert(CloudSource(ScanNet(tmp_path / "in"), CLASSIC), tmp_path / "out")
    assert fraction(found["scene0000_00"], -truth) > 0.95
    assert not [*tmp_path.rglob("front.npy")]


@pytest.mark.parametrize("flags", [(), ("--voxel", "0.05"), ("--merge",)])
def test_segment_writes_what_convert_writes(mesh, files, tmp_path, run, flags):
    _, truth, _ = mesh
    inputs = [files / "outwards.ply", *[files / "points.ply"] * ("--merge" in flags)]
    out = tmp_path / "a.npz"
    assert run("segment", *inputs, "--out", out, "--preset", "classic", *flags).code == 0
    with np.load(out) as result:
        normals, provenance = result["normals"], json.loads(str(result["provenance"]))
    assert fraction(normals[: len(truth)], -truth) > 0.93
    if "--merge" in flags:
        assert fraction(normals[len(truth) :], truth) > 0.93
    assert provenance["orient"] == "auto"


def test_normals_by_viewpoint_look_to_the_scanners_of_the_file(mesh, tmp_path, run):
    truth = write_stations(tmp_path / "a.e57", *mesh[:2])
    for command in (("normals", "--method", "pca"), ("segment", "--preset", "classic")):
        places = (tmp_path / "a.e57", "--out", tmp_path / "a.npz")
        assert run(*command, *places, "--orient", "viewpoint").code == 0
        assert fraction(np.load(tmp_path / "a.npz")["normals"], truth) > 0.97


def corner(path):
    """A depth image of a floor and a wall behind it, in millimeters."""
    v = np.arange(30.0)[:, None] - 14.5
    depth = np.minimum(np.where(v > 0, 0.5 / np.maximum(v / 50, 1e-6), 9), 3.0)
    stored = (1000 * np.broadcast_to(depth, (30, 40))).astype(np.uint16)
    np.save(path, stored)
    return stored


def test_normals_of_frames_look_at_the_camera_unless_told_otherwise(tmp_path, run):
    corner(tmp_path / "a.npy")
    for orient, turned in (("auto", False), ("viewpoint", False), ("none", False), ("up", True)):
        out = tmp_path / f"{orient}.npz"
        places = (tmp_path / "a.npy", "--out", out)
        assert run("depth", *places, *CAMERA, "--orient", orient).code == 0
        with np.load(out) as result:
            normals, points = result["normals"], result["points"]
            known = normals.any(axis=1)
            assert known.mean() > 0.9
            towards = ((normals * points).sum(axis=1) <= 0)[known]
            assert json.loads(str(result["provenance"]))["orient"] == orient
        assert towards.all() != turned
        assert not turned or (normals[:, 2] >= 0).all()


def test_converted_frames_look_at_the_camera_in_the_world(tmp_path):
    (tmp_path / "in" / "seq-01").mkdir(parents=True)
    depth = torch.from_numpy(corner(tmp_path / "a.npy").astype(np.int32))
    write_png(tmp_path / "in" / "seq-01" / "frame-000000.depth.png", depth)
    pose = np.array([[0, 0, 1, 5.0], [-1, 0, 0, 6], [0, -1, 0, 7], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "in" / "seq-01" / "frame-000000.pose.txt", pose)
    camera = Pinhole(50.0, 50.0, 19.5, 14.5)
    data = RGBDFrames.from_folder(tmp_path / "in", "7-scenes", intrinsics=camera, depth_scale=1000)
    (normals,) = convert(RGBDSource(data, DepthConfig()), tmp_path / "out").values()
    points = np.load(next((tmp_path / "out").rglob("coord.npy")))
    known = normals.any(axis=-1)
    assert known.mean() > 0.9
    assert ((normals * (pose[:3, 3] - points)).sum(axis=-1)[known] > 0).all()
    assert normals[..., 2].max() > 0.99
    for orient, least in (("up", 0), ("interior", -0.1)):
        source = RGBDSource(data, DepthConfig(), orient=orient)
        (turned,) = convert(source, tmp_path / orient).values()
        np.testing.assert_allclose(abs(turned), abs(normals), atol=1e-6)
        assert (turned[..., 2] >= least).all()


def test_damaged_faces_are_noted_and_the_room_decides(mesh, files, tmp_path, run):
    _, truth, _ = mesh
    data = (files / "inwards.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:-8] + struct.pack("<ii", 9_000_000, 1))
    places = (tmp_path / "a.ply", "--out", tmp_path / "a.npz")
    done = run("segment", *places, "--preset", "classic")
    assert re.search(r"faces skipped: expected vertex indices in .* got 9,000,000", done.err)
    assert fraction(np.load(tmp_path / "a.npz")["normals"], truth) > 0.95
    assert read_cloud(tmp_path / "a.ply").front is None
