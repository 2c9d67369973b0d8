"""``torchrg align``: what it writes leads where the matrix says, and is set along the axes."""

import functools

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrg import read_cloud, read_result, segment_planes, write_cloud
from torchrg.structures import Cloud

TURN = (Rotation.from_euler("x", 3, True) * Rotation.from_euler("z", 25, True)).as_matrix()
PLACE = np.array([500_000.0, 4_000_000.0, 120.0])


@pytest.fixture(scope="module")
def turned(room, tmp_path_factory):
    """A room, turned and far away, with a point that is missing and a viewpoint."""
    room = room(noise=0.004, seed=4)
    coordinates = room.points.double().numpy() @ TURN.T + PLACE
    coordinates[5] = np.nan
    normals = (room.normals.double().numpy() @ TURN.T).astype(np.float32)
    header = {"viewpoint": (1.0, 2, 3, 1, 0, 0, 0)}
    cloud = Cloud(coordinates, {"normals": normals}, header=header)
    path = tmp_path_factory.mktemp("align") / "room.pcd"
    write_cloud(path, cloud)
    return path


@pytest.fixture
def align(run):
    """``align(...)``: the command."""
    return functools.partial(run, "align")


def test_points_and_normals_are_where_the_matrix_leads(turned, tmp_path, align):
    out, matrix, line = (tmp_path / name for name in ("out.pcd", "m.npy", "m.txt"))
    done = align(turned, "--out", out, "--matrix", matrix)
    tilt = float(done.out.split("tilted by ")[1].split()[0])
    assert tilt == pytest.approx(3, abs=0.1)
    motion, before, after = np.load(matrix), read_cloud(turned), read_cloud(out)
    expected = before.coordinates @ motion[:3, :3].T + motion[:3, 3]
    assert np.allclose(after.coordinates, expected, atol=2e-6, equal_nan=True)
    assert np.isnan(after.coordinates[5]).all()
    normals = before.fields["normals"] @ motion[:3, :3].T
    assert np.allclose(after.fields["normals"], normals, atol=1e-6)
    # Back along the axes that the room was built on, with its floor at 0.
    assert np.allclose(motion[:3, :3] @ TURN, np.eye(3), atol=0.003)
    assert np.nanquantile(after.coordinates[:, 2], 0.02) == pytest.approx(0, abs=0.01)
    assert np.allclose(after.header.get("viewpoint", (0, 0, 0))[:3], 0)
    assert align(turned, "--out", out, "--matrix", line).code == 0
    name, numbers = line.read_text().split("=")
    assert name == "axisAlignment "
    assert np.allclose(np.array(numbers.split(), float).reshape(4, 4), motion, atol=1e-8)


def test_planes_are_those_of_the_input_moved(turned, tmp_path, align):
    out = tmp_path / "out.npz"
    assert align(turned, "--out", out, "--segment").code == 0
    found, given = read_result(out), segment_planes(read_cloud(turned).points)
    assert np.array_equal(found.labels, given.labels)
    planes = found.planes
    again = segment_planes(found.cloud.points)
    on_plane = found.labels >= 0
    points = found.cloud.coordinates[on_plane]
    rows = found.labels[on_plane]
    distances = (points * planes.normal.numpy()[rows]).sum(axis=1) - planes.offset.numpy()[rows]
    assert np.abs(distances).max() < 0.1
    largest = int(planes.count.argmax())
    assert torch.allclose(planes.normal[largest].abs(), torch.tensor([0.0, 0, 1]), atol=0.002)
    assert again.planes.area[0] == pytest.approx(float(planes.area[0]), rel=0.02)
    assert np.allclose(
        np.linalg.norm(found.cloud.fields["normals"], axis=1)[on_plane], 1, atol=1e-5
    )


def test_several_inputs_go_to_a_directory(turned, tmp_path, align):
    other = tmp_path / "other.ply"
    write_cloud(other, Cloud(read_cloud(turned).coordinates[::2]))
    assert align(turned, other, "--out", tmp_path / "out", "--preset", "classic").code == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["other.npz", "room.npz"]
    done = align(turned, other, "--out", tmp_path / "out", "--matrix", tmp_path / "m.npy")
    assert "expected one input with --matrix" in done.error


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--matrix", "m.csv"], "expected --matrix to end in .npy or .txt"),
        (["--up", "w"], "up"),
        (["--up", "1"], "up"),
    ],
)
def test_mistakes_are_one_line(turned, tmp_path, flags, words, align):
    done = align(turned, "--out", tmp_path / "out.npz", "--preset", "classic", *flags)
    assert words in done.error


def test_a_cloud_without_a_floor_or_walls_is_told(tmp_path, align):
    path = tmp_path / "blob.npy"
    np.save(path, np.random.default_rng(0).normal(size=(400, 3)))
    error = align(path, "--out", tmp_path / "out.npz").error
    assert f"{path}: align_axes: expected a floor" in error


def test_a_floor_alone_is_turned_upright_with_a_warning(tmp_path, align):
    path = tmp_path / "floor.npy"
    x, y = np.random.default_rng(0).uniform(0, 4, (2, 3000))
    np.save(path, np.stack([x, y, 0.1 * x], axis=1))
    assert "expected vertical planes" in align(path, "--out", tmp_path / "out.ply").err
    assert np.ptp(read_cloud(tmp_path / "out.ply").coordinates[:, 2]) < 1e-3
