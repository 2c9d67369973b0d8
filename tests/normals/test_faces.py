"""Faces: the double cover, sides of plates, thick planes."""

import math

import pytest
import torch

from tests.kernels.clouds import definitions, needs_library
from torchrg import scratch
from torchrg.neighbors import search_knn
from torchrg.neighbors.order import finite_rows
from torchrg.normals import orient_normals
from torchrg.normals.faces import _find_links, _split_plates, find_faces, find_surfaces
from torchrg.normals.orient import turn_faces
from torchrg.scenes import make_room


def draw(rng, count, low, high, axis=2, side=1.0):
    """Draw points of an axis-aligned rectangle, in canonical order later, and their normals."""
    low, high = torch.tensor(low), torch.tensor(high)
    points = low + torch.rand(count, 3, generator=rng) * (high - low)
    return points, side * torch.eye(3)[axis].expand(count, 3)


def sorted_cloud(parts, noise=0.0, rng=None):
    """Join parts of points and normals in canonical order; return the part of each point, too."""
    points, normals = (torch.cat(column) for column in zip(*parts, strict=True))
    part = torch.repeat_interleave(torch.tensor([len(part[0]) for part in parts]))
    if noise:
        points = points + noise * normals * torch.randn(len(points), 1, generator=rng)
    rows = finite_rows(points)
    return points[rows], normals[rows], part[rows]


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
def test_kernel_of_links_equals_the_definition(rng):
    points = make_room(3000, noise=0.003, seed=0).points
    points[:9] = points[0]
    normals = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=rng), dim=1)
    rows = torch.arange(0, len(points), 2)
    groups = torch.randint(-1, 3, (len(points),), generator=rng, dtype=torch.int32)
    for more in ([], [groups], [groups, 0.4]):
        arguments = points, normals, search_knn(points, 7).indices, rows, [2, 4, 6], *more
        found = _find_links(*arguments)
        with definitions():
            expected = _find_links(*arguments)
        assert len(found[0]) > 100
        for values, others in zip(found, expected, strict=True):
            assert torch.equal(values, others)


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("thickness", [0.0, 0.02, 1.0])
def test_kernel_of_plates_equals_the_definition(rng, thickness):
    points = make_room(3000, noise=0.003, seed=0).points
    rows = torch.arange(0, len(points), 2)
    faces = torch.randint(0, 7, (len(rows),), generator=rng)
    axes = torch.nn.functional.normalize(torch.randn(9, 3, generator=rng), dim=1)
    points[rows] -= (points[rows] * axes[faces]).sum(dim=1, keepdim=True) * axes[faces] * 0.99
    found = _split_plates(points, rows, faces, axes, thickness)
    with definitions():
        expected = _split_plates(points, rows, faces, axes, thickness)
    for values, others in zip(found, expected, strict=True):
        assert torch.equal(values, others)


@pytest.mark.parametrize("labeled", [True, False])
def test_both_sides_of_a_plate_are_faces(rng, labeled):
    # Farther apart than a neighbor is high: sides are reported apart by heights alone.
    top = draw(rng, 300, (0.0, 0, 0.04), (1.5, 1, 0.04))
    bottom = draw(rng, 260, (0.0, 0, 0), (1.5, 1, 0), side=1.0)
    stray = draw(rng, 20, (0.0, 0, -0.2), (1.5, 1, -0.1))
    points, normals, part = sorted_cloud([top, bottom, stray], 0.003, rng)
    near = search_knn(points, 20).indices
    labels = torch.full((len(points),), 0 if labeled else -1)
    axes = torch.tensor([[0.0, 0, 1]])[: int(labeled)]
    faces, signs = find_faces(points, normals, near, labels, axes, 0.07)
    for side in (0, 1):
        assert (faces[part == side] == faces[part == side].mode().values).double().mean() > 0.99
    assert faces[part == 0].mode().values != faces[part == 1].mode().values
    assert (signs == signs[0]).all()


@pytest.mark.parametrize(("kind", "sides"), [("noise", 1), ("slab", 2), ("plate", 2)])
def test_noise_is_one_face(rng, kind, sides):
    points, normals = draw(rng, 4000, (0.0, 0, 0), (4.0, 3, 0))
    heights = {
        "noise": torch.randn(4000, generator=rng),
        "slab": 4 * torch.rand(4000, generator=rng) - 2,
        "plate": torch.randn(4000, generator=rng).sign() + 0.3 * torch.randn(4000, generator=rng),
    }
    points[:, 2] = 0.02 * heights[kind]
    rows = finite_rows(points)
    points, normals = points[rows], normals[rows]
    near, labels = search_knn(points, 20).indices, torch.zeros(4000, dtype=torch.int64)
    faces, _ = find_faces(points, normals, near, labels, normals[:1], 0.1)
    assert len(faces.unique()) == sides


def test_a_region_of_two_walls_is_no_face(rng):
    # Growth joined both sides of a wall, farther apart than points are.
    walls = [draw(rng, 2000, (x, 0.0, 0), (x, 4, 2.5), axis=0) for x in (0.0, 0.4)]
    points, normals, part = sorted_cloud(walls, 0.002, rng)
    near = search_knn(points, 20).indices
    labels = torch.zeros(len(points), dtype=torch.int64)
    tilted = torch.nn.functional.normalize(torch.tensor([[1.0, 0.1, 0.05]]), dim=1)
    faces, _ = find_faces(points, normals, near, labels, tilted, 0.05)
    majority = [faces[part == wall].mode().values for wall in (0, 1)]
    assert majority[0] != majority[1]
    for wall in (0, 1):
        assert (faces[part == wall] == majority[wall]).double().mean() > 0.99


def test_patches_that_noise_cuts_from_one_wall_join(rng):
    points, normals = draw(rng, 6000, (0.0, 0, 0), (4.0, 3, 0))
    normals = normals + 0.25 * torch.randn(6000, 3, generator=rng)
    normals = torch.nn.functional.normalize(normals, dim=1)
    rows = finite_rows(points)
    points, normals = points[rows], normals[rows]
    near, none = search_knn(points, 20).indices, torch.full((6000,), -1)
    faces, signs = find_faces(points, normals, near, none, torch.zeros(0, 3), 0.05)
    sizes = faces.bincount()
    assert sizes[sizes > 0].min() >= 10
    assert (sizes > 0).sum() < 60
    for face in faces.unique():
        assert ((normals[:, 2] * signs)[faces == face] > 0).double().mean() in (0.0, 1.0)


def test_surfaces_are_connected_over_edges(rng):
    cube = [
        draw(rng, 400, *((*[0.0] * a, s, *[0.0] * (2 - a)), (*[1.0] * a, s, *[1.0] * (2 - a))), a)
        for a in range(3)
        for s in (0.0, 1.0)
    ]
    points, normals, _ = sorted_cloud([*cube, draw(rng, 400, (5.0, 0, 0), (6.0, 1, 0))])
    surfaces, signs = find_surfaces(points, normals, search_knn(points, 12).indices)
    assert surfaces.bincount().tolist() == [2400, 400]
    outwards = ((points - 0.5) * normals).sum(dim=1)[surfaces == 0] * signs[surfaces == 0]
    assert (outwards > 0).double().mean() in (0.0, 1.0)


@pytest.fixture(scope="module")
def furnished():
    room = make_room(8_000, 0.003, 4)
    rows = finite_rows(room.points)
    return room.points[rows].float(), room.normals[rows].float()


def test_a_stray_point_far_off_changes_little(furnished):
    points, normals = furnished
    whole = orient_normals(points, normals)
    far = torch.tensor([[3e4, -2e4, 1e4]])
    strayed = orient_normals(torch.cat([points, far]), torch.cat([normals, normals[:1]]))
    assert strayed.isfinite().all()
    assert ((strayed[:-1] * whole).sum(dim=1) > 0).double().mean() > 0.9


@pytest.mark.parametrize("side", ["interior", "consistent"])
def test_threads_and_disks_and_longer_lists_change_nothing(
    furnished, tmp_path, monkeypatch, set_threads, side
):
    points, normals = furnished
    results = []
    for threads in (3, 1):
        set_threads(threads)
        results.append(orient_normals(points, normals, orient=side))
    monkeypatch.setattr(scratch, "_MIN_BYTES", 0)
    with scratch.on_disk(tmp_path):
        results.append(orient_normals(points, normals, orient=side))
        longer = search_knn(points, 50)
        results.append(orient_normals(points, normals, orient=side, neighbors=longer))
    results.append(turn_faces(points, -normals, side, search_knn(points, 5)))
    assert all(torch.equal(result, results[0]) for result in results)


def test_points_across_a_plane_are_not_of_its_face(rng):
    # A ledge 8 cm high, which growth gave to the floor it stands on.
    floor = draw(rng, 3000, (0.0, 0, 0), (3.0, 2, 0))
    ledge = draw(rng, 500, (1.5, 0.0, 0), (1.5, 2, 0.08), axis=0)
    points, normals, part = sorted_cloud([floor, ledge])
    near = search_knn(points, 20).indices
    labels = torch.zeros(len(points), dtype=torch.int64)
    faces, _ = find_faces(points, normals, near, labels, torch.tensor([[0.0, 0, 1]]), 0.05)
    assert (faces[part == 0] == faces[part == 0][0]).all()
    assert not (faces[part == 1] == faces[part == 0][0]).any()


@pytest.mark.parametrize(("turn_deg", "num_faces"), [(5, 1), (12, 2)])
def test_smooth_patches_end_where_exact_normals_turn_by_eight_degrees(rng, turn_deg, num_faces):
    turn = math.radians(turn_deg)
    left, right = (draw(rng, 2000, (x, 0.0, 0), (x + 1, 1, 0)) for x in (-1.0, 0.0))
    slope = torch.tensor([math.cos(turn), 1, 0]), torch.tensor([math.sin(turn), 0, 0])
    points = right[0] * slope[0]
    points[:, 2] = (right[0] * slope[1]).sum(dim=1)
    normals = torch.tensor([-math.sin(turn), 0, math.cos(turn)]).expand(2000, 3)
    points, normals, part = sorted_cloud([left, (points, normals)])
    near, none = search_knn(points, 20).indices, torch.full((len(points),), -1)
    faces, _ = find_faces(points, normals, near, none, torch.zeros(0, 3), 0.01)
    sides = [faces[part == side].mode().values for side in (0, 1)]
    assert len(set(map(int, sides))) == num_faces
