"""Signs of normals: orient a place, along an axis, consistent on solids, into rooms."""

import math

import numpy as np
import pytest
import torch

from tests.made import make_shape
from torchrg import segment_planes
from torchrg.errors import ConfigError, ShapeError
from torchrg.normals import estimate_normals, orient_normals


def shuffled_signs(normals):
    signs = torch.rand(len(normals), generator=torch.Generator().manual_seed(5)) < 0.5
    return torch.where(signs[:, None], -normals, normals)


def share_right(oriented, truth):
    """Share of right signs among normals that are about right."""
    dot = (oriented * truth).sum(dim=1)
    return float((dot > 0)[dot.abs() > 0.7].double().mean())


@pytest.fixture(scope="module")
def scanned(room):
    scene = room(30_000, 0.003, 1)
    fit = estimate_normals(scene.points, method="pca", k=20)
    return scene, shuffled_signs(fit.normals)


def box_room(size, at, rng, count=1500, faces=range(6)):
    """Points on the faces of a box, and normals into it."""
    points, normals = [], []
    for face in faces:
        axis, high = face // 2, face % 2
        part = torch.rand(count, 3, generator=rng)
        part[:, axis] = high
        points.append(part * torch.tensor(size) + torch.tensor(at))
        normals.append((1 - 2 * high) * torch.eye(3)[axis].expand(count, 3))
    return torch.cat(points), torch.cat(normals)


def test_normals_look_at_the_viewpoint_of_all_or_of_each_point(rng):
    points, inwards = box_room((4.0, 3.0, 2.5), (0.0, 0.0, 0.0), rng)
    oriented = orient_normals(
        points, shuffled_signs(inwards), orient="viewpoint", viewpoint=torch.tensor([1.0, 2, 1])
    )
    assert torch.equal(oriented, inwards)
    own = orient_normals(points, inwards, orient="viewpoint", viewpoint=points - inwards)
    assert torch.equal(own, -inwards)


@pytest.mark.parametrize("axis", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_normals_lie_along_the_axis(rng, axis):
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=rng), dim=1)
    oriented = orient_normals(torch.rand(50, 3, generator=rng), normals, orient=axis)
    component = oriented[:, "xyz".index(axis[1])]
    assert ((component > 0) if axis[0] == "+" else (component < 0)).all()
    assert torch.equal(oriented.abs(), normals.abs())


def test_right_angles_have_one_answer():
    across = torch.tensor([[-1.0, 0, 0], [0, -1, 0], [0.6, -0.8, 0]])
    for normals in (across, -across):
        oriented = orient_normals(torch.zeros(3, 3), normals, orient="+z")
        assert torch.equal(oriented, torch.tensor([[1.0, 0, 0], [0, 1, 0], [-0.6, 0.8, 0]]))


@pytest.mark.parametrize(
    ("name", "num_points"),
    [
        ("cube", 5000),
        ("dodecahedron", 5000),
        ("stairs", 5000),
        ("bracket", 5000),
        ("torus", 5000),
        ("rounded_box", 5000),
        ("thin_plate", 15_000),
    ],
)
def test_consistent_is_outwards_on_solids(name, num_points):
    scene = make_shape(name, num_points, 0.0)
    oriented = orient_normals(scene.points, shuffled_signs(scene.normals), orient="consistent")
    assert share_right(oriented, scene.normals) > 0.999


def test_consistent_bears_noise_and_smoothed_edges():
    scene = make_shape("bracket", 5000, 0.004)
    fit = estimate_normals(scene.points, method="pca", k=20)
    oriented = orient_normals(scene.points, shuffled_signs(fit.normals), orient="consistent")
    assert share_right(oriented, scene.normals) > 0.995


def test_components_are_turned_each_for_itself():
    scene = make_shape("sphere", 1000)
    points = torch.cat([scene.points, scene.points + 10, scene.points - 10])
    normals = scene.normals.repeat(3, 1)
    oriented = orient_normals(points, shuffled_signs(normals), orient="consistent")
    assert torch.equal(oriented, normals)


def test_open_surface_is_consistent(rng):
    points = torch.rand(500, 3, generator=rng)
    for bend, up in ((0.0, True), (0.3, False), (-0.3, True)):
        points[:, 2] = bend * points[:, 0] ** 2
        fit = estimate_normals(points, method="pca", k=12)
        oriented = orient_normals(points, shuffled_signs(fit.normals), orient="consistent")
        # Flat: upwards; bent: to the convex side.
        assert ((oriented[:, 2] > 0) == up).all()


def test_rooms_are_seen_from_inside(scanned):
    scene, normals = scanned
    oriented = orient_normals(scene.points, normals)
    # Table tops of 4 cm are thinner than the neighbourhoods of this sparse cloud.
    assert share_right(oriented, scene.normals) > 0.97
    kinds = torch.tensor([kind in ("floor", "ceiling", "wall") for kind in scene.kinds])
    shell = kinds[scene.labels] & (scene.labels >= 0)
    assert shell.sum() > 10_000
    assert share_right(oriented[shell], scene.normals[shell]) > 0.998


def test_wall_between_two_rooms_faces_both(rng):
    left, into_left = box_room((4.0, 3.0, 2.5), (0.0, 0.0, 0.0), rng, count=3000)
    right, into_right = box_room((3.0, 3.0, 2.5), (4.2, 0.0, 0.0), rng, count=3000)
    truth = torch.cat([into_left, into_right])
    oriented = orient_normals(torch.cat([left, right]), shuffled_signs(truth))
    assert share_right(oriented, truth) > 0.999


def test_floor_looks_up_without_a_ceiling(rng):
    points, inwards = box_room((4.0, 3.0, 2.5), (0.0, 0.0, 0.0), rng, faces=range(5))
    oriented = orient_normals(points, shuffled_signs(inwards))
    assert share_right(oriented, inwards) > 0.999


def test_box_in_a_room_looks_outwards(rng):
    points, inwards = box_room((5.0, 4.0, 2.5), (0.0, 0.0, 0.0), rng, count=4000)
    box, into_box = box_room(
        (0.8, 0.6, 0.7), (2.0, 1.5, 0.0), rng, count=500, faces=[0, 1, 2, 3, 5]
    )
    truth = torch.cat([inwards, -into_box])
    oriented = orient_normals(torch.cat([points, box]), shuffled_signs(truth))
    assert share_right(oriented[-2500:], truth[-2500:]) > 0.99
    assert share_right(oriented, truth) > 0.995


@pytest.mark.parametrize("tilt_deg", [13, 70])
def test_few_points_that_noise_has_tilted_follow_the_floor_they_are_part_of(rng, tilt_deg):
    # Under a shelf 10 cm high they see less above than below, where another storey lies.
    storeys = [box_room((4.0, 3.0, 2.5), (0.0, 0.0, z), rng, count=3000) for z in (0.0, -2.7)]
    points, inwards = (torch.cat(parts) for parts in zip(*storeys, strict=True))
    shelf = torch.rand(400, 3, generator=rng) * torch.tensor([0.6, 0.6, 0])
    shelf += torch.tensor([1.5, 1.2, 0.1])
    off_middle = (points - torch.tensor([1.8, 1.5, 0])).norm(dim=1)
    few = off_middle.argsort()[:6]
    tilt = math.radians(tilt_deg)
    inwards[few] = torch.tensor([math.sin(tilt), 0, math.cos(tilt)])
    normals = torch.cat([inwards, torch.tensor([0.0, 0, 1]).expand(400, 3)])
    oriented = orient_normals(torch.cat([points, shelf]), shuffled_signs(normals))
    assert torch.equal(oriented[few], inwards[few])


@pytest.mark.parametrize("orient", ["consistent", "interior"])
@pytest.mark.parametrize("rounded", [False, True], ids=["generic", "ties"])
def test_neither_signs_nor_order_matter(scanned, orient, rounded):
    scene, normals = scanned
    points, normals = scene.points[:6000], normals[:6000]
    if rounded:
        # Equal distances everywhere, and normals that agree with nothing.
        points, first = np.unique((points / 0.2).round().numpy(), axis=0, return_index=True)
        points, normals = torch.from_numpy(points), normals[first]
    first = orient_normals(points, normals, orient=orient)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    again = orient_normals(points[order], -normals[order], orient=orient)
    assert torch.equal(again, first[order])


@pytest.mark.parametrize("height", [0.75, 0.8, 0.86])
def test_both_faces_of_a_thin_plate_look_away_from_it(rng, height):
    # Thinner than a cell of the grid of free space.
    points, inwards = box_room((4.0, 4.0, 2.5), (0.0, 0.0, 0.0), rng, count=6000)
    plate, into = box_room((2.0, 1.6, 0.03), (1.0, 1.0, height), rng, count=4000, faces=[4, 5])
    truth = torch.cat([inwards, -into])
    oriented = orient_normals(torch.cat([points, plate]), shuffled_signs(truth))
    assert share_right(oriented, truth) > 0.999


def test_tilted_plane_looks_up_whatever_rounding_says(rng):
    for _ in range(5):
        normal = torch.nn.functional.normalize(torch.randn(3, generator=rng), dim=0)
        across = torch.linalg.svd(normal[None]).Vh[1:]
        points = torch.rand(200, 2, generator=rng) @ across
        oriented = orient_normals(
            points, shuffled_signs(normal.expand(200, 3)), orient="consistent"
        )
        assert torch.equal(oriented, (normal * normal[2].sign()).expand(200, 3))


@pytest.mark.parametrize("orient", ["consistent", "interior"])
@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_unit_and_origin_do_not_matter(rng, orient, unit):
    points, inwards = box_room((4.0, 3.0, 2.5), (0.0, 0.0, 0.0), rng, count=500)
    first = orient_normals(points, shuffled_signs(inwards), orient=orient)
    moved = points.double() * unit + 5e6
    again = orient_normals(moved, shuffled_signs(inwards), orient=orient)
    assert (again != first).any(dim=1).sum() <= 3


@pytest.mark.parametrize("orient", ["+z", "consistent", "interior"])
@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_points_and_missing_normals_are_no_trouble(orient, count):
    points, normals = torch.rand(count, 3), torch.zeros(count, 3)
    assert torch.equal(orient_normals(points, normals, orient=orient), normals)
    normals = torch.eye(3)[:1].expand(count, 3)
    assert torch.equal(orient_normals(points, normals, orient=orient).abs(), normals)


@pytest.mark.parametrize("orient", ["consistent", "interior"])
def test_duplicates_and_bad_points_are_no_trouble(rng, orient):
    points, inwards = box_room((4.0, 3.0, 2.5), (0.0, 0.0, 0.0), rng, count=200)
    points = torch.cat([points, points[:300], torch.full((2, 3), torch.nan)])
    normals = torch.cat([inwards, inwards[:300], torch.zeros(2, 3)])
    oriented = orient_normals(points, normals, orient=orient)
    assert oriented.isfinite().all()
    assert torch.equal(oriented.abs(), normals.abs())
    same_place = torch.full((30, 3), 0.5)
    assert orient_normals(same_place, torch.eye(3)[:1].expand(30, 3)).isfinite().all()


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"orient": "inwards"}, ConfigError, "orient to be one of auto, .*, got 'inwards'"),
        ({"orient": "viewpoint"}, ConfigError, "a viewpoint, or scanner poses .* got"),
        (
            {"orient": "+z", "viewpoint": torch.zeros(3)},
            ConfigError,
            r"no viewpoint with orient='\+z'",
        ),
        (
            {"orient": "viewpoint", "viewpoint": torch.zeros(2, 3)},
            ShapeError,
            "viewpoint of shape",
        ),
        ({"normals": torch.rand(3, 3)}, ShapeError, "normals of shape"),
    ],
)
def test_wrong_arguments_are_refused(settings, error, message):
    with pytest.raises(error, match=f"expected {message}"):
        orient_normals(**{"points": torch.rand(4, 3), "normals": torch.rand(4, 3), **settings})


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_viewpoint_and_front_are_finite_where_points_are(wrong):
    points, normals = np.random.default_rng(0).random((9, 3)), np.eye(3)[[2] * 9]
    with pytest.raises(ConfigError, match=r"finite viewpoint, got (nan|inf); pass the sc"):
        orient_normals(points, normals, orient="viewpoint", viewpoint=[0, wrong, 0])
    front = np.ones((9, 3))
    front[4, 1] = wrong
    with pytest.raises(ConfigError, match=r"expected finite front, got (nan|inf); pass zeros"):
        orient_normals(points, normals, front=front)
    with pytest.raises(ConfigError, match="expected finite viewpoint"):
        segment_planes(points, "classic", orient="viewpoint", viewpoint=front)
    points[4] = np.nan  # A missing point has no front.
    assert orient_normals(points, normals, front=front).isfinite().all()


def test_what_lies_apart_decides_for_itself_however_small_it_is(rng):
    points, inwards = box_room((4.0, 3.0, 2.5), (0.0, 0.0, 0.0), rng, count=1500)
    # Fewer points than a face that decides, farther from the walls than any neighbor.
    lamp = torch.tensor([2.0, 1.5, 2.2]) + 0.01 * torch.rand(6, 3, generator=rng)
    lamp[:, 2] = 2.2
    normals = torch.cat([inwards, torch.tensor([[0.0, 0, 1]]).expand(6, 3)])
    oriented = orient_normals(torch.cat([points, lamp]), normals)
    assert torch.equal(oriented[:-6], inwards)
    assert (oriented[-6:, 2] < 0).all()


def test_rounding_of_an_open_surface_decides_nothing(rng):
    # A wall, whose normals lean down by less than they are known to.
    points = torch.rand(400, 3, generator=rng) * torch.tensor([4.0, 0, 2.5])
    normals = torch.nn.functional.normalize(torch.tensor([[0.0, 1, -1e-5]]), dim=1)
    oriented = orient_normals(points, shuffled_signs(normals.expand(400, 3)), orient="consistent")
    assert torch.equal(oriented, normals.expand(400, 3))


def test_duplicates_of_a_seen_point_count_once():
    # The last point was not seen; two of its neighbors look up, one down, equally near but for
    # rounding.
    far = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) + 50
    around = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1 + 2e-7, 0, 0]])
    lost = torch.zeros(1, 3)
    up = torch.tensor([[0.0, 0, 1]])
    for copies in (1, 4):
        points = torch.cat([far, around, around[2:].repeat(copies, 1), lost])
        front = up.repeat(len(points), 1)
        front[302:-1] *= -1
        front[-1] = 0
        oriented = orient_normals(points, -up.expand(len(points), 3), front=front)
        assert torch.equal(oriented[-1], up[0])
        assert torch.equal(oriented[:-1], front[:-1])
