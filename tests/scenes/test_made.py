"""Shapes against formulas, rays against brute force, depth frames against noise models."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare, kstest

from tests.made import (
    SHAPES,
    Camera,
    CurvedLayout,
    ScannedLayout,
    build_scanned_room,
    build_storey,
    cameras_around,
    cast_rays,
    drawn_from_triangles,
    make_kinect_room,
    make_mapped_room,
    make_shape,
    render_depth,
)
from tests.made.rays import solve_quadratic
from torchrg.neighbors import search_knn
from torchrg.scenes import make_room
from torchrg.scenes.geometry import unit
from torchrg.scenes.scene import is_occupied, plane_equations
from torchrg.structures import UNLABELED

CURVED = CurvedLayout(
    num_tables=3,
    num_windows=1,
    num_columns=2,
    num_round_tables=2,
    num_balls=2,
    num_lamps=2,
    num_bent_walls=1,
    heading_deg=20,
)
GOLDEN = (1 + 5**0.5) / 2

# Area and volume by textbook formulas.
KNOWN = {
    "cube": (6, 1),
    "cuboid": (2 * (0.6 + 0.35 + 0.21), 0.21),
    "thin_plate": (2 * (0.8 + 0.02 + 0.016), 0.016),
    "octahedron": (4 * 3**0.5 * 0.7**2, 4 / 3 * 0.7**3),
    # The edge of a dodecahedron with corners (1, 1, 1) is 2 / golden.
    "dodecahedron": (
        3 * (25 + 10 * 5**0.5) ** 0.5 * (0.7 / GOLDEN) ** 2,
        (15 + 7 * 5**0.5) / 4 * (0.7 / GOLDEN) ** 3,
    ),
    "hexagonal_prism": (2 * 1.5 * 3**0.5 * 0.25 + 6 * 0.5 * 0.7, 1.5 * 3**0.5 * 0.25 * 0.7),
    "stairs": (2 * 0.5 + 0.6 * 3.6, 0.5 * 0.6),
    "rounded_box": (
        2 * (0.8 * 0.5 + 0.5 * 0.3 + 0.3 * 0.8)
        + 2 * np.pi * 0.1 * (0.8 + 0.5 + 0.3)
        + 4 * np.pi * 0.01,
        0.8 * 0.5 * 0.3
        + 0.1 * 2 * (0.8 * 0.5 + 0.5 * 0.3 + 0.3 * 0.8)
        + np.pi * 0.01 * (0.8 + 0.5 + 0.3)
        + 4 / 3 * np.pi * 0.001,
    ),
    "cylinder": (2 * np.pi * 0.09 + 2 * np.pi * 0.3, np.pi * 0.09),
    "sphere": (np.pi, np.pi / 6),
    "torus": (4 * np.pi**2 * 0.35 * 0.15, 2 * np.pi**2 * 0.35 * 0.15**2),
    # Bracket: an L less a rounded heel and toe, plus a fillet. Plate: less corners and holes.
    "bracket": (
        2 * (0.25 + 0.25 * 0.65 - (1 - np.pi / 4) * (0.04 + 0.01 - 0.0144))
        + 0.5 * (3.8 - (2 - np.pi / 2) * (0.2 + 0.1 + 0.12)),
        0.5 * (0.25 + 0.25 * 0.65 - (1 - np.pi / 4) * (0.04 + 0.01 - 0.0144)),
    ),
    "plate": (
        2 * (0.7 - 2 * (1 - np.pi / 4) * 0.15**2 - np.pi * (0.15**2 + 0.01))
        + 0.15 * (3.4 - 2 * (2 - np.pi / 2) * 0.15 + 2 * np.pi * 0.25),
        0.15 * (0.7 - 2 * (1 - np.pi / 4) * 0.15**2 - np.pi * (0.15**2 + 0.01)),
    ),
}
IMPLICIT = {
    "sphere": lambda p: (p**2).sum(dim=1) - 0.25,
    "torus": lambda p: (p[:, :2].norm(dim=1) - 0.35) ** 2 + p[:, 2] ** 2 - 0.15**2,
    "rounded_box": lambda p: (
        ((p.abs() - torch.tensor([0.4, 0.25, 0.15]).double()).clamp(min=0) ** 2).sum(dim=1) - 0.01
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_with_normals_outwards_and_points_by_area(name):
    shape = make_shape(name, 40_000)
    (area, volume), areas = KNOWN[name], shape.face_areas.numpy()
    assert areas.sum() == pytest.approx(area, rel=1e-12)
    counts = shape.labels.bincount(minlength=len(areas)).numpy()
    assert len(areas) == 1 or chisquare(counts, areas / areas.sum() * 40_000).pvalue > 1e-4
    # The flux of a constant field is zero, that of the position three times the volume.
    normals, points = shape.normals.double(), shape.points.double()
    assert normals.mean(dim=0).abs().max() < 5 / 40_000**0.5
    height = (points * normals).sum(dim=1)
    tolerance = 5 * height.std() / 40_000**0.5
    assert (height.mean() - 3 * volume / area).abs() <= tolerance + 1e-7


@pytest.mark.parametrize("name", IMPLICIT)
def test_points_and_normals_are_those_of_the_equation(name):
    shape = make_shape(name, 20_000)
    points = shape.points.double().requires_grad_()
    values = IMPLICIT[name](points)
    [gradient] = torch.autograd.grad(values.sum(), points)
    assert values.abs().max() < 1e-6
    expected = gradient / gradient.norm(dim=1, keepdim=True)
    assert (shape.normals.double() - expected).abs().max() < 1e-5


def test_points_are_spread_evenly_over_curved_and_cut_faces():
    ball = make_shape("sphere", 25_000).points.double().numpy()
    # Archimedes: every coordinate of an even sphere is uniform.
    assert all(kstest(ball[:, axis] + 0.5, "uniform").pvalue > 1e-3 for axis in range(3))
    torus = make_shape("torus", 25_000).points.double().numpy()
    across = np.arctan2(torus[:, 2], np.hypot(torus[:, 0], torus[:, 1]) - 0.35)
    counts, edges = np.histogram(across, bins=16, range=(-np.pi, np.pi))
    weights = 0.35 * np.diff(edges) + 0.15 * np.diff(np.sin(edges))
    assert chisquare(counts, weights / weights.sum() * 25_000).pvalue > 1e-4
    end = make_shape("cylinder", 25_000)
    radii = end.points[end.labels == 0, :2].double().norm(dim=1).numpy()
    assert kstest((radii / 0.3) ** 2, "uniform").pvalue > 1e-3
    plate = make_shape("plate", 25_000)
    top = plate.points[plate.labels == 1].double().numpy()
    inner = (np.abs(top[:, :2] - [0.3, 0.35]) < 0.15).all(axis=1)
    expected = (4 - np.pi) * 0.0225 / plate.face_areas[1].item()
    assert inner.sum() / len(top) == pytest.approx(expected, rel=0.15)


def test_noise_of_a_shape_is_a_share_of_the_diagonal():
    exact, noisy = (make_shape("cuboid", 25_000, noise) for noise in (0, 0.006))
    shifts = (noisy.points - exact.points).double().numpy()
    diagonal = (1 + 0.36 + 0.35**2) ** 0.5
    assert kstest(shifts.ravel() / (0.006 * diagonal), "norm").pvalue > 1e-3


def test_bent_wall_passes_through_its_corners_and_bulges_by_the_bend():
    layout = CurvedLayout(num_bent_walls=1, wall_bend=0.05)
    scene = make_room(60_000, noise=0, seed=0, layout=layout)
    wall = scene.points[scene.labels == 2].double()
    length = layout.size[0]
    # The circle through both corners and the middle, 5 cm into the room.
    radius = (length**2 / 4 + 0.05**2) / (2 * 0.05)
    along = wall[:, 0] - length / 2
    expected = 0.05 - radius + (radius**2 - along**2).sqrt()
    assert (wall[:, 1] - expected).abs().max() < 2e-6
    slopes = -scene.normals[scene.labels == 2, 0] / scene.normals[scene.labels == 2, 1]
    assert (slopes + along / (radius**2 - along**2).sqrt()).abs().max() < 1e-5
    floor = scene.points[scene.labels == 0].double()
    edge = 0.05 - radius + (radius**2 - (floor[:, 0] - length / 2) ** 2).sqrt()
    assert (floor[:, 1] > edge - 1e-5).all()


def test_points_drawn_from_triangles_lie_on_them(room):
    scene = room(2000, 0.0, 3)
    drawn = drawn_from_triangles(scene, 6000)
    # Where all points around are of one plane, so is what is drawn between them.
    around = search_knn(scene.points, 20).indices.long()
    inside = (scene.labels[around] == scene.labels[:, None]).all(dim=1)
    gaps = torch.cdist(drawn.points, scene.points)
    corner = gaps.argmin(dim=1)
    flat = inside[corner] & (drawn.labels == scene.labels[corner])
    assert flat.sum() > 1000
    offset = (drawn.points.double() * scene.face_normals[drawn.labels]).sum(dim=1)
    apart = (offset - scene.face_offsets[drawn.labels])[flat].abs()
    assert (apart < 1e-5).float().mean() > 0.98
    assert gaps.min(dim=1).values.median() > 0.02  # no corner is drawn as it is
    assert len(corner.unique()) > 1500


# Storeys.


@pytest.mark.parametrize("seed", range(4))
def test_every_room_is_reached_from_the_hall_through_its_door(seed):
    model = build_storey(seed)
    thresholds = list(model.surfaces[0].cells[2::2])
    assert len(thresholds) == 8
    for corner, edge, other in thresholds:
        middle = np.array([*(corner + edge / 2 + other / 2), 1.0])
        through = np.array([[[0, 1.0, 0], [0, -1.0, 0]]])
        distances = cast_rays(model, middle, through).distances[0]
        # One way lies the hallway of 2.4 m, the other way a room.
        assert distances.min() > 2
        assert distances.max() > 4


# Rays and scans.


def _meet_triangle(origin, direction, corner, edge, other):
    """Distance along one ray to one triangle, by Cramer's rule; infinite where none."""
    matrix = np.stack([edge, other, -direction], axis=1)
    a, b, distance = np.linalg.solve(matrix, origin - corner)
    return distance if min(a, b, distance) >= 0 and a + b <= 1 else np.inf


def _triangles(surface):
    """Corner and edges in the world of the triangles of a flat surface."""
    for corner, edge, other in surface.cells:
        place = surface.frame.origin + corner @ surface.frame.axes[:2]
        first, second = edge @ surface.frame.axes[:2], other @ surface.frame.axes[:2]
        yield place, first, second
        yield place + first + second, -first, -second


def test_nearest_hit_is_that_of_brute_force_over_triangles():
    model = build_scanned_room(1)
    origin = model.viewpoints[0]
    directions = unit(np.random.default_rng(0).standard_normal((2, 25, 3)))
    hits = cast_rays(model, origin, directions)
    for place in np.ndindex(2, 25):
        found = [
            min(_meet_triangle(origin, directions[place], *t) for t in _triangles(surface))
            for surface in model.surfaces
        ]
        assert hits.distances[place] == pytest.approx(min(found), rel=1e-9)
        assert hits.faces[place] == np.argmin(found)


@pytest.mark.parametrize("seed", range(3))
def test_path_to_the_nearest_hit_is_free_and_what_is_behind_is_not(seed):
    model = build_scanned_room(seed, layout=CURVED)
    origin, steps = model.viewpoints[0], unit(np.random.default_rng(0).standard_normal((1000, 3)))
    distances, faces = (values[0] for values in cast_rays(model, origin, steps[None]))
    for fraction in np.linspace(0.01, 0.9999, 60):
        assert not is_occupied(model.parts, origin + fraction * distances[:, None] * steps).any()
    has_body = np.array([len(model.parts[part].solids) > 0 for part in model.objects])
    has_body[:6] = False
    assert has_body[faces].sum() > 100
    behind = origin + (distances[:, None] + 1e-6) * steps
    assert is_occupied(model.parts, behind[has_body[faces]]).all()


@pytest.mark.parametrize(
    "model", [build_scanned_room(0), build_scanned_room(5, layout=CURVED)], ids=["room", "curved"]
)
def test_no_ray_escapes_not_even_into_seams(model):
    origin = model.viewpoints[0]
    directions = unit(np.random.default_rng(1).standard_normal((60, 100, 3)))
    assert np.isfinite(cast_rays(model, origin, directions).distances).all()
    seam = model.surfaces[0].frame.to_world(np.linspace((0.0, 0, 0), (9, 0, 0), 50))
    assert (cast_rays(model, origin, (seam - origin)[None]).distances <= 1 + 1e-9).all()


def test_rays_along_the_sides_of_a_cone_are_solved_without_loss():
    # (1e-20 t^2 - 2 t + 1) has roots near 2e20 and 0.5; the usual formula loses the second.
    roots = solve_quadratic(np.array([1e-20]), np.array([-1.0]), np.array([1.0]))
    assert sorted(root[0] for root in roots) == pytest.approx([0.5, 2e20])


@pytest.mark.parametrize("layout", [ScannedLayout(), CURVED], ids=["flat", "curved"])
def test_rooms_of_any_seed_have_free_viewpoints(layout):
    around = np.random.default_rng(0).uniform(-0.15, 0.15, (500, 3))
    for seed in range(5):
        model = build_scanned_room(seed, layout=layout)
        assert not is_occupied(model.parts, model.viewpoints[0] + around).any()
        assert len(model.surfaces) == len(model.objects)


def test_viewpoints_keep_a_metre_from_bodies_where_there_is_space():
    layout = ScannedLayout(num_tables=0, num_small_boxes=0, num_boxes=0, num_pillars=3)
    around = np.random.default_rng(0).uniform(-0.9, 0.9, (2000, 3))
    models = [build_scanned_room(seed, layout=layout) for seed in range(6)]
    free = [not is_occupied(model.parts, model.viewpoints[0] + around).any() for model in models]
    assert sum(free) >= 5


# Depth frames.


def test_camera_projects_by_its_intrinsics_and_pose():
    camera = Camera.looking((1, 2, 1.5), (4, 6, 1.0), width=320, height=240)
    pose = camera.pose
    assert torch.allclose(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3).double(), atol=1e-12)
    assert torch.linalg.det(pose[:3, :3]) > 0
    assert pose[2, 0] == 0  # upright: rows of the picture are level
    assert pose[2, 1] < 0  # down
    target = torch.linalg.solve(pose, torch.tensor([4, 6, 1, 1.0]).double())[:3]
    pixel = camera.intrinsics @ target
    assert torch.allclose(pixel[:2] / pixel[2], torch.tensor([159.5, 119.5]).double())
    pixels = torch.from_numpy(camera.rays()) @ camera.intrinsics.T
    assert torch.allclose(pixels[17, 230], torch.tensor([230, 17, 1.0]).double())


def test_depth_frame_lies_on_the_faces_it_names():
    model = build_scanned_room(4)
    planes, offsets = (torch.from_numpy(values) for values in plane_equations(model.surfaces))
    frame = render_depth(model, cameras_around(model, 1, width=160, height=120)[0])
    rays, pose = torch.from_numpy(frame.camera.rays()), frame.camera.pose
    world = (rays * frame.depth.double()[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    residuals = (world * planes[frame.labels]).sum(dim=-1) - offsets[frame.labels]
    assert residuals.abs().max() < 2e-6
    assert torch.allclose(frame.normals.double() @ pose[:3, :3].T, planes[frame.labels], atol=1e-6)
    assert ((frame.normals * rays).sum(dim=-1) < 0).all()


# Standard deviation and step of the depth, and its range, by sensor.
SENSORS = {
    "kinect": (
        lambda z: 0.0012 + 0.0019 * (z - 0.4) ** 2,
        lambda z: z**2 / (525 * 0.075) / 8,
        (0.4, 8.0),
    ),
    "kinect2": (lambda z: 0.0015 - 0.0005 * z + 0.0003 * z**2, torch.zeros_like, (0.5, 4.5)),
}


@pytest.mark.parametrize("sensor", SENSORS)
def test_noise_of_a_sensor_is_that_of_its_model(sensor):
    model = build_scanned_room(0)
    camera = cameras_around(model, 1)[0]
    exact, noisy = render_depth(model, camera), render_depth(model, camera, sensor=sensor)
    (deviation, step, _), valid = SENSORS[sensor], noisy.depth > 0
    assert torch.equal(noisy.labels[valid], exact.labels[valid])
    depth = exact.depth[valid].double()
    error = noisy.depth[valid].double() - depth
    for low, high in ((1.0, 2.0), (2.0, 3.0), (3.0, 4.0)):
        there = (depth > low) & (depth < high)
        variance = deviation(depth[there]) ** 2 + step(depth[there]) ** 2 / 12
        expected = variance.mean().sqrt()
        assert error[there].std().item() == pytest.approx(expected.item(), rel=0.05)
        assert abs(error[there].mean()) < 0.1 * expected
    if sensor == "kinect":
        disparity = 525 * 0.075 / noisy.depth[valid].double() * 8
        assert (disparity - disparity.round()).abs().max() < 1e-4


@pytest.mark.parametrize("sensor", SENSORS)
def test_sensors_drop_what_is_out_of_range(sensor):
    model = build_scanned_room(0, layout=ScannedLayout(size=(16.0, 7.0, 2.8)))
    camera = Camera.looking((0.5, 3.5, 1.6), (15, 3.5, 1.5), width=160, height=120)
    exact, noisy = render_depth(model, camera), render_depth(model, camera, sensor=sensor)
    nearest, furthest = SENSORS[sensor][2]
    dropped = noisy.depth == 0
    assert dropped[exact.depth > 1.2 * furthest].all()
    assert nearest <= noisy.depth[~dropped].min() <= noisy.depth.max() <= furthest
    assert torch.equal(noisy.labels == UNLABELED, dropped)
    assert (noisy.normals[dropped] == 0).all()


@pytest.mark.parametrize(
    ("make", "median", "most"),
    [
        (lambda: make_kinect_room(5000, seed=1, num_frames=1, sensor="exact"), 1e-6, 3e-6),
        # Voxels of 5 cm at edges hold the mean of two faces.
        (lambda: make_mapped_room(3000, seed=1, num_frames=2, voxel=0.05), 0.0015, 0.1),
    ],
    ids=["frames", "map"],
)
def test_fused_points_lie_on_their_faces(make, median, most):
    scene = make()
    heights = (scene.points.double() * scene.face_normals[scene.labels]).sum(dim=1)
    apart = (heights - scene.face_offsets[scene.labels]).abs()
    assert apart.median() < median
    assert apart.max() < most
    assert torch.allclose(scene.normals.double(), scene.face_normals[scene.labels], atol=1e-6)
