"""To which side the normals point that commands write: rooms as points, meshes, scans, frames."""

import json
import re
import shutil
import struct

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from tests.datasets.scannet_tree import write_mesh, write_scan
from torchrg.cli import main
from torchrg.io import read_cloud, write_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud

CAMERA = ("--intrinsics", "50,50,19.5,14.5", "--depth-scale", "1000")


@pytest.fixture(scope="module")
def room():
    """Points of a made room, normals into it, and triangles of each face, wound to be seen."""
    scene = make_room(8000, noise=0.002, seed=2)
    points, normals = scene.points.float().numpy(), scene.normals.float().numpy()
    faces = []
    for label in scene.labels.unique():
        own = np.flatnonzero(scene.labels.numpy() == int(label))
        if label < 0 or len(own) < 50:
            continue
        across = np.linalg.svd(normals[own[:1]])[2][1:]
        corners = own[Delaunay(points[own] @ across.T).simplices]
        a, b, c = (points[corners[:, i]] for i in range(3))
        away = (np.cross(b - a, c - a) * normals[own[0]]).sum(axis=1) < 0
        corners[away] = corners[away][:, ::-1]
        faces.append(corners)
    return points, normals, np.concatenate(faces)


@pytest.fixture(scope="module")
def files(room, tmp_path_factory):
    """The room as points, as two meshes, and as a mesh of two faces."""
    points, _, faces = room
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
    places = [middle + [0.5, 0.4, 0.1], middle - [0.5, 0.4, 0.1]]
    seen = [(normals * (place - points)).sum(axis=1) > 0 for place in places]
    far, truth = np.array([5e5, 4.5e6, 210.0]), []
    with pye57.E57(str(path), "w") as file:
        for place, rows in zip(places, (seen[0], seen[1] & ~seen[0]), strict=True):
            x, y, z = (points[rows].astype(float) - place).T
            columns = {"cartesianX": y, "cartesianY": -x, "cartesianZ": z}
            turn = np.array([0.5**0.5, 0, 0, 0.5**0.5])
            file.write_scan_raw(columns, rotation=turn, translation=far + place)
            truth.append(normals[rows])
    return np.concatenate(truth)


def share(normals, truth):
    """Share of normals that point to the true side."""
    return ((normals * truth).sum(axis=1) > 0).mean()


def convert(*arguments):
    return main(["convert", *map(str, arguments), "--workers", "1"])


def test_convert_points_normals_into_rooms_to_faces_and_to_scanners(room, files, tmp_path, capsys):
    _, truth, _ = room
    shutil.copytree(files, tmp_path / "in")
    of_scan = write_stations(tmp_path / "in" / "stations.e57", *room[:2])
    command = ("folder", tmp_path / "in", tmp_path / "out", "--preset", "classic")
    assert convert(*command) == 0
    shares = {
        path.parent.name: share(np.load(path), of_scan if path.parent.name == "stations" else truth)
        for path in (tmp_path / "out").glob("*/normal.npy")
    }
    assert shares.pop("outwards") < 0.05
    assert min(shares.values()) > 0.95, shares
    record = json.loads((tmp_path / "out" / "points" / "provenance.json").read_text())
    assert record["source"]["orient"] == "auto"
    # What had other signs is made again, and what is the same is kept.
    assert convert(*command, "--dry-run") == 0
    assert "5 done" in capsys.readouterr().out
    assert convert(*command, "--dry-run", "--orient", "none") == 0
    assert "5 scans to convert" in capsys.readouterr().out


def test_other_sides_can_be_asked_for(room, files, tmp_path, capsys):
    _, truth, _ = room
    (tmp_path / "in").mkdir()
    shutil.copy(files / "outwards.ply", tmp_path / "in")
    found = {}
    for orient in ("interior", "up", "none"):
        options = ("--preset", "classic", "--orient", orient)
        assert convert("folder", tmp_path / "in", tmp_path / orient, *options) == 0
        found[orient] = np.load(tmp_path / orient / "outwards" / "normal.npy")
    assert share(found["interior"], truth) > 0.95
    assert (found["up"][:, 2] >= 0).all()
    assert share(found["none"], truth) < 0.7
    for kind in ("folder", "s3dis"):
        assert convert(kind, tmp_path / "in", tmp_path / "x", "--orient", "viewpoint") != 0
        error = capsys.readouterr().err
        assert re.search("got (none|viewpoint); use (--orient interior|auto)", error)


def test_meshes_of_scannet_say_which_side_is_seen(room, tmp_path):
    points, truth, faces = room
    color = np.zeros((len(points), 3), np.uint8)
    write_scan(tmp_path / "in" / "scans", "scene0000_00", points, color, None, None)
    name = "scene0000_00/scene0000_00_vh_clean_2.ply"
    # A room from outside, which only its faces can tell.
    write_mesh(tmp_path / "in" / "scans" / name, points, color, faces=faces[:, ::-1])
    options = ("--preset", "classic")
    assert convert("scannet", tmp_path / "in", tmp_path / "out", *options) == 0
    folder = tmp_path / "out" / "test" / "scene0000_00"
    assert share(np.load(folder / "normal.npy"), -truth) > 0.95
    assert not (folder / "front.npy").exists()


@pytest.mark.parametrize("flags", [(), ("--voxel", "0.05"), ("--merge",)])
def test_segment_writes_what_convert_writes(room, files, tmp_path, flags):
    _, truth, _ = room
    inputs = [files / "outwards.ply", *[files / "points.ply"] * ("--merge" in flags)]
    out = tmp_path / "a.npz"
    command = ["segment", *inputs, "--out", out, "--preset", "classic", *flags]
    assert main([*map(str, command)]) == 0
    with np.load(out) as result:
        normals, provenance = result["normals"], json.loads(str(result["provenance"]))
        assert (result["plane_normal"][:, 2] >= 0).all()
    assert share(normals[: len(truth)], -truth) > 0.93
    assert (
        share(normals[len(truth) :], np.tile(truth, (len(inputs) - 1, 1))) > 0.93 or not flags[1:]
    )
    assert provenance["orient"] == "auto"


def test_normals_by_viewpoint_look_to_the_scanners_of_the_file(room, tmp_path):
    truth = write_stations(tmp_path / "a.e57", *room[:2])
    command = ["normals", tmp_path / "a.e57", "--out", tmp_path / "a.npz", "--orient", "viewpoint"]
    assert main([*map(str, command), "--method", "pca"]) == 0
    assert share(np.load(tmp_path / "a.npz")["normals"], truth) > 0.97
    assert main(["segment", *map(str, command[1:]), "--preset", "classic"]) == 0
    assert share(np.load(tmp_path / "a.npz")["normals"], truth) > 0.97


def corner(path):
    """A depth image of a floor and a wall behind it, in millimetres."""
    v = np.arange(30.0)[:, None] - 14.5
    depth = np.minimum(np.where(v > 0, 1.0 / np.maximum(v / 50, 1e-6), 9), 3.0)
    np.save(path, (1000 * np.broadcast_to(depth, (30, 40))).astype(np.uint16))


def test_normals_of_frames_look_at_the_camera_unless_told_otherwise(tmp_path):
    corner(tmp_path / "a.npy")
    for orient, turned in (("auto", False), ("viewpoint", False), ("none", False), ("up", True)):
        out = tmp_path / f"{orient}.npz"
        command = ["depth", str(tmp_path / "a.npy"), *CAMERA, "--out", str(out), "--orient", orient]
        assert main(command) == 0
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
    corner(tmp_path / "a.npy")
    depth = torch.from_numpy(np.load(tmp_path / "a.npy").astype(np.int32))
    from torchrg.render import write_png

    write_png(tmp_path / "in" / "seq-01" / "frame-000000.depth.png", depth)
    pose = np.array([[0, 0, 1, 5.0], [-1, 0, 0, 6], [0, -1, 0, 7], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "in" / "seq-01" / "frame-000000.pose.txt", pose)
    options = ("--layout", "7-scenes", *CAMERA)
    for orient in ("auto", "up"):
        out = tmp_path / orient
        assert convert("rgbd", tmp_path / "in", out, *options, "--orient", orient) == 0
        (folder,) = [path.parent for path in out.rglob("normal.npy")]
        normals, points = np.load(folder / "normal.npy"), np.load(folder / "coord.npy")
        arms = pose[:3, 3] - points
        known = normals.any(axis=-1)
        assert known.mean() > 0.9
        if orient == "auto":
            assert ((normals * arms).sum(axis=-1)[known] > 0).all()
            assert normals[..., 2].max() > 0.9
        else:
            assert (normals[..., 2] >= 0).all()


def test_damaged_faces_are_noted_and_the_room_decides(room, files, tmp_path, capsys):
    _, truth, _ = room
    data = (files / "inwards.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:-8] + struct.pack("<ii", 9_000_000, 1))
    command = ["segment", tmp_path / "a.ply", "--out", tmp_path / "a.npz", "--preset", "classic"]
    assert main([*map(str, command)]) == 0
    assert "its faces left out, as they are damaged: vertex 9,000,000 of 8,000" in (
        capsys.readouterr().err
    )
    assert share(np.load(tmp_path / "a.npz")["normals"], truth) > 0.95
    assert read_cloud(tmp_path / "a.ply").front is None
