"""Axes of rooms: those that a room was built along come back, whatever way it was turned."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrg import Cloud, align_axes, segment_planes
from torchrg.errors import ConfigError, ShapeError
from torchrg.regions import summarize_planes
from torchrg.regions.axes import transform_cloud, transform_planes
from torchrg.structures import Planes
from torchrg.structures.planes import PLANE_COLUMNS


def tilted(rng, most_tilt=5.0):
    """A turn about z, and then a tilt about a horizontal axis."""
    way = rng.uniform(0, 2 * math.pi)
    tilt = math.radians(rng.uniform(0, most_tilt)) * np.array([math.cos(way), math.sin(way), 0])
    turn = Rotation.from_rotvec(tilt) * Rotation.from_euler("z", rng.uniform(-180, 180), True)
    return torch.from_numpy(turn.as_matrix())


def degrees_off(rotation):
    """How far a rotation is from a quarter turn about z: tilt, and what is left of the turn."""
    tilt = math.degrees(math.acos(min(1.0, float(rotation[2, 2]))))
    angle = math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))
    return tilt, abs(angle - 90 * round(angle / 90))


def test_made_rooms_are_set_upright_along_their_walls(room):
    rng = np.random.default_rng(0)
    scene = room(12_000, 0.005, 0)
    turn = tilted(rng)
    points = scene.points.double() @ turn.T + torch.tensor([1e5, -20, 3.0])
    motion = align_axes(segment_planes(points))
    tilt, off = degrees_off(motion[:3, :3] @ turn)
    assert tilt < 0.2
    assert off < 0.2
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    expected = scene.points[:, 2] - scene.points[:, 2].median()
    assert torch.allclose(moved[:, 2] - moved[:, 2].median(), expected.double(), atol=0.05)
    # Boxes on the floor and the doors' frames are above it, and its noise on both sides.
    assert abs(float(moved[:, 2].quantile(0.02))) < 0.02
    middle = (moved[:, :2].amin(dim=0) + moved[:, :2].amax(dim=0)) / 2
    assert float(middle.abs().max()) < 0.1


def table(normals, areas, centers=None, sides=1.0):
    """A plane table of squares."""
    normals = torch.nn.functional.normalize(torch.tensor(normals, dtype=torch.float64), dim=1)
    count = len(normals)
    helper = torch.eye(3, dtype=torch.float64)[normals.abs().argmin(dim=1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, helper), dim=1)
    axes = torch.stack([first, torch.linalg.cross(normals, first)], dim=1)
    center = torch.zeros(count, 3) if centers is None else torch.tensor(centers)
    columns = {name: torch.zeros(count, *shape) for name, (_, shape) in PLANE_COLUMNS.items()}
    columns |= {
        "normal": normals,
        "offset": (normals * center.double()).sum(dim=1),
        "center": center.double(),
        "area": torch.tensor(areas, dtype=torch.float64),
        "count": torch.full((count,), 100),
        "extent": torch.full((count, 2), sides),
        "axes": axes,
        "curved": torch.zeros(count, dtype=torch.bool),
    }
    return Planes(**columns)


def test_motions_are_rigid_and_turn_least():
    for degrees in (-44, -10, 0, 30, 44):
        turn = Rotation.from_euler("z", degrees, True).as_matrix()
        planes = table((np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]]) @ turn.T).tolist(), [9, 5, 4])
        motion = align_axes(planes)
        assert torch.allclose(motion[:3, :3], torch.from_numpy(turn).T, atol=1e-12)
        assert torch.equal(motion[3], torch.tensor([0.0, 0, 0, 1]).double())


def test_most_area_decides_and_what_leans_does_not_count():
    roof = [0, math.sin(math.radians(4)), math.cos(math.radians(4))]
    skew = [math.cos(math.radians(5)), math.sin(math.radians(5)), 0]
    planes = table([[0, 0, 1], roof, [1, 0, 0], [0, 1, 0], skew], [20.0, 18, 10, 10, 12])
    assert torch.allclose(align_axes(planes)[:3, :3], torch.eye(3).double(), atol=1e-12)


def test_the_lowest_floor_is_at_zero_and_the_room_in_the_middle():
    # The last is a reflection below the floor.
    centers = [[1.0, 2, 5.0], [1, 2, 7.5], [3, 2, 6], [1, 2, 5.7], [1, 2, 4]]
    normals = [[0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, 1], [0, 0, 1]]
    planes = table(normals, [9.0, 9, 5, 1, 0.2], centers, sides=4.0)
    moved = torch.tensor(centers).double() + align_axes(planes)[:3, 3]
    assert moved[0].tolist() == pytest.approx([0, 0, 0])
    assert moved[1, 2] == pytest.approx(2.5)


def test_up_may_be_any_axis():
    planes = table([[0, 1, 0], [1, 0, 0], [0, 0, 1]], [9.0, 5, 4])
    rotation = align_axes(planes, up=(0, -2.0, 0))[:3, :3]
    assert torch.allclose(rotation @ torch.tensor([0, -1.0, 0]).double(), torch.eye(3).double()[2])
    assert float(torch.linalg.det(rotation)) == pytest.approx(1)


def test_a_cloud_without_walls_is_told():
    # What stands askew on the floor is too small for a wall.
    planes = table([[0, 0.05, 1], [0, 0.05, 1], [1, 1, -0.05]], [9.0, 3, 0.1])
    with pytest.warns(UserWarning, match="Only the up axis"):
        rotation = align_axes(planes)[:3, :3]
    assert torch.allclose(rotation @ planes.normal[0], torch.eye(3).double()[2], atol=1e-9)
    assert float(rotation[0, 0]) > 0.99


def test_walls_alone_say_where_up_is():
    tilt = Rotation.from_euler("x", 4, True).as_matrix()
    planes = table((np.array([[1, 0, 0], [0, 1, 0.0]]) @ tilt.T).tolist(), [9.0, 5])
    assert torch.allclose(align_axes(planes)[:3, :3], torch.from_numpy(tilt).T, atol=1e-9)


def test_what_has_no_axes_is_refused():
    for planes in (
        table([[0.0, 1, 0]], [9.0]),
        replace(table([[0.0, 1, 0]], [9.0]), curved=torch.ones(1, dtype=torch.bool)),
        table([[0.0, 1, 0], [1, 0, 0]], [9.0, 0.1]),
        segment_planes(torch.rand(15, 3)),
    ):
        with pytest.raises(ConfigError, match="expected a floor, a ceiling, or walls"):
            align_axes(planes)
    with pytest.raises(ConfigError, match="expected up to be a direction"):
        align_axes(table([[0, 0, 1]], [9.0]), up=(0, 0, 0))


def test_tables_are_moved_as_if_made_of_moved_points(room):
    scene = room(6_000, 0.003, 2)
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix())
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = turn, torch.tensor([3.0, -4, 5])
    points, normals = scene.points.double(), scene.normals.double()
    labels = torch.unique(scene.labels, return_inverse=True)[1]
    given = summarize_planes(points, normals, labels, outline=True)
    moved = transform_planes(given, motion)
    expected = summarize_planes(points @ turn.T + motion[:3, 3], normals @ turn.T, labels)
    for name in ("normal", "offset", "centroid"):
        # Of a few points any of several planes is best.
        found, wanted = (getattr(table, name)[given.count > 5] for table in (moved, expected))
        assert torch.allclose(found, wanted, atol=1e-9), name
    rings = [ring for rings in moved.outline for ring in rings]
    owners = [i for i, rings in enumerate(moved.outline) for _ in rings]
    for owner, ring in zip(owners, rings, strict=True):
        assert torch.allclose(ring @ moved.normal[owner], moved.offset[owner], atol=1e-6)


def test_only_rigid_motions_move_planes_and_clouds():
    floor = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
    planes = segment_planes(floor, "classic").planes
    scaled = torch.diag(torch.tensor([2.0, 2, 2, 1])).double()
    with pytest.raises(ShapeError, match="transform_planes: expected motion to be rigid, got a ro"):
        transform_planes(planes, scaled)
    with pytest.raises(ShapeError, match="transform_cloud: expected motion to be rigid, got a rot"):
        transform_cloud(Cloud(floor.numpy()), scaled)
