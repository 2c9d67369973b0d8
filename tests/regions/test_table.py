"""The plane table against shapes whose planes, areas and extents are known."""

import math

import numpy as np
import pytest
import torch

from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import search_knn
from torchrg.regions import summarize_planes
from torchrg.structures.planes import PLANE_COLUMNS


def rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.diag(r))


def rectangle(rng, n, length, width, *, noise=0.0, turn=None, shift=(0.0, 0.0, 0.0)):
    """Random points on a rectangle, with its rotation, as float64 tensors."""
    turn = rotation(rng) if turn is None else turn
    flat = rng.uniform(-0.5, 0.5, (n, 3)) * [length, width, 0]
    flat[:, 2] = noise * rng.normal(size=n)
    return torch.from_numpy(flat @ turn.T + np.asarray(shift)), torch.from_numpy(turn)


def columns_of(planes):
    return [getattr(planes, name) for name in PLANE_COLUMNS]


def one_region(points):
    return torch.zeros(len(points), dtype=torch.int64)


def angle_deg(a, b):
    return torch.rad2deg(torch.asin(torch.linalg.cross(a, b).norm(dim=-1).clamp(max=1)))


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e3])
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (5e6, -4e6, 100.0)])
def test_noisy_rectangle_anywhere_in_any_unit(unit, shift):
    rng = np.random.default_rng(0)
    points, turn = rectangle(rng, 4000, 4.0, 1.5, noise=0.01)
    points = points * unit + torch.tensor(shift, dtype=torch.float64)
    normals = turn[:, 2].expand(len(points), 3)
    planes = summarize_planes(points, normals, one_region(points))
    assert angle_deg(planes.normal[0], turn[:, 2]) < 0.05
    center = torch.tensor(shift, dtype=torch.float64)
    assert torch.allclose(planes.centroid[0], center, atol=0.05 * unit)
    assert torch.allclose((planes.centroid * planes.normal).sum(1), planes.offset, atol=1e-3 * unit)
    assert math.isclose(planes.rms[0], 0.01 * unit, rel_tol=0.05)
    assert math.isclose(planes.area[0], 6.0 * unit**2, rel_tol=0.04)
    assert torch.allclose(planes.extent[0], torch.tensor([4.0, 1.5]).double() * unit, rtol=0.02)
    assert (angle_deg(planes.axes[0], turn[:, :2].T) < 0.5).all()
    assert not planes.curved[0]


def test_an_exact_plane_and_one_place_are_exact():
    grid = torch.cartesian_prod(torch.arange(40.0), torch.arange(25.0), torch.tensor([3.0]))
    planes = summarize_planes(grid, torch.eye(3)[[2] * len(grid)], one_region(grid))
    assert planes.normal.tolist() == [[0.0, 0.0, 1.0]]
    assert planes.offset.tolist() == [3.0]
    assert planes.rms.tolist() == [0.0]
    assert planes.extent.tolist() == [[39.0, 24.0]]
    assert planes.centroid.tolist() == planes.center.tolist() == [[19.5, 12.0, 3.0]]
    assert planes.kind is None
    place = torch.full((30, 3), 0.7)
    planes = summarize_planes(place, torch.eye(3)[[1] * 30], one_region(place))
    assert planes.normal.tolist() == [[0.0, 1.0, 0.0]]
    assert planes.extent.tolist() == [[0.0, 0.0]]
    assert planes.area.tolist() == [0.0]


def test_points_of_another_surface_do_not_tilt_the_plane():
    rng = np.random.default_rng(1)
    floor, turn = rectangle(rng, 2000, 2.0, 2.0, noise=0.003, turn=np.eye(3))
    wall = torch.from_numpy(rng.uniform([0.9, -1, 0], [1.0, 1, 0.4], (300, 3)))
    points = torch.cat([floor, wall])
    planes = summarize_planes(points, turn[:, 2].expand(len(points), 3), one_region(points))
    assert angle_deg(planes.normal[0], turn[:, 2]) < 0.1
    covariance = np.cov(points.numpy().T)
    plain = torch.from_numpy(np.linalg.eigh(covariance)[1][:, 0])
    assert angle_deg(plain, turn[:, 2]) > 2


def test_l_shape_has_its_own_area_not_that_of_its_box():
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 1, (9000, 3)) * [1, 1, 0]
    points = torch.from_numpy(points[(points[:, 0] < 0.3) | (points[:, 1] < 0.3)])
    planes = summarize_planes(points, torch.eye(3).double()[[2] * len(points)], one_region(points))
    assert math.isclose(planes.area[0], 0.51, rel_tol=0.05)
    assert math.isclose(planes.extent[0].prod(), 1.0, rel_tol=0.02)


def test_uneven_density_leaves_no_holes_in_the_area():
    rng = np.random.default_rng(3)
    radius = 0.1 * 80 ** rng.uniform(0, 1, 20000)
    angle = rng.uniform(0, 2 * np.pi, 20000)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    points = torch.from_numpy(points[np.abs(points[:, :2]).max(axis=1) < 4])
    planes = summarize_planes(points, torch.eye(3).double()[[2] * len(points)], one_region(points))
    assert math.isclose(planes.area[0], 64.0, rel_tol=0.08)


def test_thin_strip_keeps_its_area():
    rng = np.random.default_rng(4)
    points, turn = rectangle(rng, 200, 2.0, 0.04)
    normals = turn[:, 2].expand(len(points), 3)
    planes = summarize_planes(points, normals, one_region(points))
    assert math.isclose(planes.area[0], 0.08, rel_tol=0.1)
    assert math.isclose(planes.extent[0, 1], 0.04, rel_tol=0.1)


@pytest.mark.parametrize("num_points", [1, 2, 3, 5])
def test_few_and_collinear_points_take_the_normals_they_have(num_points, dtype):
    along = torch.tensor([1.0, 0.0, 0.0], dtype=dtype)
    points = torch.arange(num_points, dtype=dtype)[:, None] * along + 2
    normals = torch.tensor([[0.2, 0.6, 0.8], [-0.2, -0.6, -0.8]], dtype=dtype)
    normals = torch.nn.functional.normalize(normals, dim=1)[torch.arange(num_points) % 2]
    planes = summarize_planes(points, normals, one_region(points))
    expected = [0.0, 0.6, 0.8] if num_points > 1 else (-normals[0] * -1).tolist()
    assert torch.allclose(planes.normal[0], torch.tensor(expected, dtype=dtype), atol=1e-6)
    assert planes.area.tolist() == [0.0]
    assert planes.rms[0] < 1e-6
    assert planes.extent[0, 0] == num_points - 1
    assert all(part.isfinite().all() for part in columns_of(planes)[:9])


def test_table_of_no_region_is_empty():
    points = torch.rand(5, 3)
    planes = summarize_planes(
        points, points, torch.full((5,), -1), neighbors=search_knn(points, 3), up=(0, 0, 1)
    )
    assert len(planes) == len(planes.normal) == len(planes.adjacency.pairs) == 0
    nothing = summarize_planes(points[:0], points[:0], torch.zeros(0, dtype=torch.int64))
    assert len(nothing.count) == 0


def test_rows_do_not_depend_on_the_order_of_the_points(rng):
    generator = np.random.default_rng(5)
    parts = [rectangle(generator, 500, 2.0, 1.0, noise=0.01)[0] for _ in range(3)]
    points, labels = torch.cat(parts), torch.arange(3).repeat_interleave(500)
    normals = torch.nn.functional.normalize(points, dim=1)
    first = summarize_planes(points, normals, labels)
    order = torch.randperm(1500, generator=rng)
    again = summarize_planes(points[order], normals[order], labels[order])
    for a, b in zip(*(columns_of(planes)[:9] for planes in (first, again)), strict=True):
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("bend_deg", "curved"), [(26.0, False), (30.0, True)])
def test_a_bend_is_curved_from_three_to_four_times_the_spread_on(bend_deg, curved):
    angle = torch.deg2rad(torch.linspace(0, bend_deg, 500))
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=1)
    normals[::3] *= -1
    assert summarize_planes(normals, normals, one_region(normals)).curved.tolist() == [curved]


def box_of_points(rng, size=(4.0, 3.0, 2.5), n=3000, noise=0.002):
    """The six faces of a room, seen from inside: floor and ceiling first."""
    points, labels = [], []
    for label, (axis, side) in enumerate([(2, 0), (2, 1), (0, 0), (0, 1), (1, 0), (1, 1)]):
        face = rng.uniform(0, 1, (n, 3))
        face[:, axis] = side
        face = face * size
        face[:, axis] += noise * rng.normal(size=n)
        points.append(face)
        labels += [label] * n
    normals = np.eye(3)[[2, 2, 0, 0, 1, 1]].repeat(n, axis=0)
    return torch.from_numpy(np.concatenate(points)), torch.from_numpy(normals), torch.tensor(labels)


def test_faces_of_a_room_meet_along_its_edges():
    points, normals, labels = box_of_points(np.random.default_rng(7))
    neighbors = search_knn(points, 20)
    found = summarize_planes(points, normals, labels, neighbors=neighbors).adjacency
    lengths = {(0, 2): 3, (0, 3): 3, (0, 4): 4, (0, 5): 4, (1, 2): 3, (1, 3): 3}
    lengths |= {(1, 4): 4, (1, 5): 4, (2, 4): 2.5, (2, 5): 2.5, (3, 4): 2.5, (3, 5): 2.5}
    assert list(map(tuple, found.pairs.tolist())) == sorted(lengths)
    for pair, length in zip(found.pairs.tolist(), found.boundary_length, strict=True):
        assert math.isclose(length, lengths[tuple(pair)], rel_tol=0.05)
    assert (found.dihedral_deg > 89.5).all()


def test_boundary_within_one_plane_has_the_length_of_the_curve():
    rng = np.random.default_rng(8)
    points = torch.from_numpy(rng.uniform(0, 4, (30000, 3)) * [1, 1, 0])
    inside = ((points[:, :2] - 2).norm(dim=1) < 1).long()
    normals = torch.eye(3).double()[[2] * len(points)]
    neighbors = search_knn(points, 12)
    found = summarize_planes(points, normals, inside, neighbors=neighbors).adjacency
    assert math.isclose(found.boundary_length[0], 2 * math.pi, rel_tol=0.05)
    assert found.dihedral_deg[0] < 1e-3


def test_parallel_faces_do_not_meet():
    rng = np.random.default_rng(9)
    points = torch.from_numpy(rng.uniform(0, 1, (4000, 3)) * [1, 1, 0])
    points[2000:, 2] = 0.02
    labels = torch.arange(2).repeat_interleave(2000)
    normals = torch.eye(3).double()[[2] * len(points)]
    neighbors = search_knn(points, 20)
    assert len(summarize_planes(points, normals, labels, neighbors=neighbors).adjacency.pairs) == 0


def test_wrong_arguments_are_refused():
    points = torch.rand(5, 3)
    with pytest.raises(ShapeError, match=r"summarize_planes: expected labels of shape \(N\)"):
        summarize_planes(points, points, torch.zeros(4, dtype=torch.int64))
    with pytest.raises(ConfigError, match=r"an axis\), got 'xz'"):
        summarize_planes(points, points, one_region(points), up="xz")
    with pytest.raises(ConfigError, match="expected up to be a direction"):
        summarize_planes(points, points, one_region(points), up=(0, 0, 0))


def test_copies_count_in_the_number_of_points_alone():
    points, turn = rectangle(np.random.default_rng(14), 300, 4.0, 1.5, noise=0.01)
    normals = turn[:, 2].expand(300, 3)
    once = summarize_planes(points, normals, one_region(points))
    crowd = torch.cat([points, points[:1].expand(200, 3)])
    copied = summarize_planes(crowd, turn[:, 2].expand(500, 3), one_region(crowd))
    assert (once.count.tolist(), copied.count.tolist()) == ([300], [500])
    for name in PLANE_COLUMNS:
        if name != "count":
            assert torch.equal(getattr(copied, name), getattr(once, name)), name


@pytest.mark.parametrize("canonical", [True, False])
def test_regions_that_share_positions_have_all_of_them(canonical):
    # Two objects at the same positions: each has the whole grid.
    grid = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.zeros(1))
    points = grid.repeat_interleave(2, dim=0)
    labels, normals = torch.arange(40) % 2, torch.eye(3)[[2] * 40]
    planes = summarize_planes(points, normals, labels, canonical=canonical)
    assert planes.extent.tolist() == [[4.0, 3.0]] * 2
    assert planes.centroid.tolist() == [[2.0, 1.5, 0.0]] * 2


def test_the_centroid_is_the_mean_of_all_points_of_the_region():
    points, turn = rectangle(np.random.default_rng(15), 500, 4.0, 1.5, noise=0.01)
    # The fit ignores the points off the plane.
    points[:60] += turn[:, 2] * 0.5 + turn[:, 0] * 2
    planes = summarize_planes(points, turn[:, 2].expand(500, 3), one_region(points))
    torch.testing.assert_close(planes.centroid[0], points.mean(dim=0))
    others = summarize_planes(points[60:], turn[:, 2].expand(440, 3), one_region(points[60:]))
    assert angle_deg(planes.normal[0], others.normal[0]) < 0.02
