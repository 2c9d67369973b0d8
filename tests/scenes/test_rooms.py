"""Rooms against their own geometry: planes, areas, bodies, noise."""

import hashlib
from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from tests.made import HALL_LAYOUT, CurvedLayout, make_shape, make_storey
from torchrg.errors import ConfigError
from torchrg.scenes import RoomLayout, build_room, make_room, sample_scene

CURVED = CurvedLayout(
    num_tables=3,
    num_columns=1,
    num_round_tables=2,
    num_balls=1,
    num_lamps=1,
    num_windows=1,
    num_panels=2,
    num_bent_walls=1,
    heading_deg=20,
)


@pytest.fixture(scope="module")
def exact(room):
    return room(80_000, 0.0, 0)


def test_default_room_has_153_faces_and_35_of_4_cm(exact):
    thin = [kind in ("table edge", "shelf edge") for kind in exact.kinds]
    assert (len(exact.kinds), sum(thin)) == (153, 35)
    surfaces = np.array(build_room().surfaces)[thin]
    assert np.allclose([surface.cells[0][:, 1].sum() for surface in surfaces], 0.04)


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_room(20_000, 0.0, 0),
        lambda: make_room(20_000, 0.0, 0, layout=CURVED),
        lambda: make_room(20_000, 0.0, 0, layout=HALL_LAYOUT),
        lambda: make_storey(30_000, 0.0),
        lambda: make_shape("dodecahedron", 5000),
        lambda: make_shape("bracket", 5000),
    ],
    ids=["room", "curved", "hall", "storey", "dodecahedron", "bracket"],
)
def test_points_lie_on_their_faces_and_normals_are_those_of_the_faces(make):
    scene = make()
    assert torch.allclose(scene.normals.norm(dim=1), torch.tensor(1.0))
    flat = scene.planar[scene.labels]
    points, labels = scene.points[flat].double(), scene.labels[flat]
    heights = (points * scene.face_normals[labels]).sum(dim=1)
    assert (heights - scene.face_offsets[labels]).abs().max() < 3e-6  # float32 of up to 24 m
    assert torch.equal(scene.normals[flat], scene.face_normals[labels].float())


def test_normals_point_into_the_room_and_into_openings(exact):
    middle = torch.tensor([4.5, 3.5, 1.4], dtype=torch.float64)
    assert (exact.face_normals[:6] @ middle - exact.face_offsets[:6] > 1).all()
    model = build_room()
    for part in model.parts[1:6]:
        leaf, *frame = part.surfaces
        assert leaf.kind in ("door", "window")
        middle = np.mean([surface.bounds.mean(axis=0) for surface in frame], axis=0)
        for surface in frame:
            normal, offset = surface.plane
            assert normal @ middle - offset > 0.3
        normal, offset = leaf.plane
        assert 0.02 < normal @ middle - offset < 0.1
        assert normal @ (4.5, 3.5, 1.4) - offset > 0.5


def _inside(block, points, margin):
    """Which points are inside a block shrunk by a margin, by a matrix inverse."""
    local = np.linalg.solve(block.frame.axes.T, (points - block.frame.origin).T).T
    return (np.abs(local) < np.array(block.size) / 2 - margin).all(axis=1)


def test_no_point_is_inside_a_body(exact):
    points = exact.points.double().numpy()
    in_front = points + 1e-4 * exact.normals.double().numpy()
    for block in (block for part in build_room().parts for block in part.solids):
        assert not _inside(block, points, 1e-5).any()
        # Nor is a covered place sampled: the underside of a table above its post, for example.
        assert not _inside(block, in_front, 2e-4).any()


def test_no_face_lies_in_the_plane_of_another(exact):
    planes = torch.cat([exact.face_normals, exact.face_offsets[:, None]], dim=1).numpy()
    for first, second in combinations(planes, 2):
        sign = np.sign(first[:3] @ second[:3])
        if abs(first[:3] @ second[:3]) > 1 - 1e-12:
            assert abs(first[3] - sign * second[3]) > 0.005 - 1e-9


def test_same_seed_gives_the_same_room_whatever_the_number_of_points():
    scene = make_room(2000, noise=0.003, seed=7)
    digest = hashlib.sha256(scene.points.numpy().tobytes() + scene.labels.numpy().tobytes())
    assert digest.hexdigest()[:16] == "70bf90675ea8f6f3"
    more, other = make_room(3000, seed=7), make_room(2000, seed=8)
    assert len(more.points) == 3000
    assert more.face_offsets.equal(scene.face_offsets)
    assert not other.face_offsets.equal(scene.face_offsets)


def test_noise_is_along_the_normal_or_along_each_axis(exact):
    noisy = make_room(80_000, noise=0.004, seed=0)
    assert noisy.labels.equal(exact.labels)
    shifts = (noisy.points - exact.points).double()
    along = (shifts * exact.normals.double()).sum(dim=1)
    assert (shifts - along[:, None] * exact.normals.double()).abs().max() < 2e-6
    assert kstest(along.numpy() / 0.004, "norm").pvalue > 1e-3
    noisy = sample_scene(build_room(), 80_000, noise=0.004, noise_direction="isotropic")
    shifts = (noisy.points - exact.points).double().numpy() / 0.004
    assert all(kstest(shifts[:, axis], "norm").pvalue > 1e-3 for axis in range(3))


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ({"num_doors": -1}, "RoomLayout: expected num_doors >= 0 and .* got -1"),
        ({"num_small_boxes": 9}, "expected num_small_boxes <= 8, got 9"),
        ({"plate_thickness": 0}, "expected plate_thickness > 0, got 0"),
        ({"num_panels": 10**23}, "expected num_panels in "),
        ({"num_tables": 10**6}, "expected num_tables >= 0 and at most 1,000, got 1000000"),
        ({"heading_deg": float("nan")}, "expected heading_deg to be a number, got nan"),
        ({"size": (3, 0.5, 2.5)}, r"of at least 1 x 1 x 2.3 and .* got \(3.0, 0.5, 2.5\)"),
        ({"size": (3, 3, 1e6)}, r"at most 1,000 meters, got \(3.0, 3.0, 1000000.0\)"),
        ({"num_tables": 40}, "expected enough space on the floor"),
        ({"num_windows": 40}, "expected enough space on the walls"),
        ({"min_plane_gap": 0.5}, "expected faces at least min_plane_gap=0.5 from"),
    ],
)
def test_rooms_that_cannot_be_built_are_refused(layout, message):
    with pytest.raises(ConfigError, match=message):
        build_room(layout=RoomLayout(**layout))
