"""Rays, scans and depth frames against brute force."""

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from tests.made import (
    SHAPES,
    Camera,
    build_storey,
    cameras_around,
    cast_rays,
    make_kinect_room,
    make_mapped_room,
    render_depth,
    scan_scene,
)
from tests.made.cameras import KINECT_LAYOUT, fuse_frames
from tests.made.extrusions import Outline, extrude
from tests.made.rays import intersect, solve_quadratic
from tests.made.shapes import Bumpy
from torchrg.errors import ConfigError
from torchrg.scenes import RoomLayout, SceneModel, build_room, make_room
from torchrg.scenes.geometry import Frame, unit
from torchrg.scenes.scene import Part, is_occupied, plane_table
from torchrg.scenes.surfaces import Cone, Flat, Ring
from torchrg.structures import UNLABELED

CURVED = RoomLayout(
    num_tables=3,
    num_windows=1,
    num_columns=2,
    num_round_tables=2,
    num_balls=2,
    num_lamps=2,
    num_bent_walls=1,
    heading_deg=20,
)
TILTED = Frame.spanned(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2, 3]), np.array([0.0, 1, -1]))


@pytest.fixture
def directions():
    return unit(np.random.default_rng(0).standard_normal((40, 25, 3)))


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
        if not surface.triangular:
            yield place + first + second, -first, -second


def test_nearest_hit_is_that_of_brute_force_over_triangles(directions):
    model = build_room(1)
    assert all(isinstance(surface, Flat) for surface in model.surfaces)
    origin = model.viewpoints[0]
    hits = cast_rays(model, origin, directions[:2])
    for row, column in np.ndindex(2, 25):
        found = [
            min(_meet_triangle(origin, directions[row, column], *t) for t in _triangles(surface))
            for surface in model.surfaces
        ]
        assert hits.distances[row, column] == pytest.approx(min(found), rel=1e-9)
        assert hits.faces[row, column] == np.argmin(found)


def test_rays_meet_a_convex_body_between_its_planes():
    surfaces = SHAPES["dodecahedron"]()
    normals, offsets = plane_table(surfaces)
    rng = np.random.default_rng(0)
    origin = np.array([[0.3, -2.0, 0.4]])
    steps = rng.uniform(-0.7, 0.7, (2000, 3)) - origin
    found = np.min([intersect(surface, origin, steps) for surface in surfaces], axis=0)
    slopes = steps @ normals.T
    distances = (offsets - origin @ normals.T) / slopes
    entry = np.where(slopes < 0, distances, -np.inf).max(axis=1)
    leave = np.where(slopes > 0, distances, np.inf).min(axis=1)
    assert 500 < (entry < leave).sum() < 1900
    assert np.allclose(found, np.where(entry < leave, entry, np.inf), rtol=1e-9)


@pytest.mark.parametrize(
    "surface",
    [
        Cone("", TILTED, (0.5, -1), (0.5, 1)),
        Cone("", TILTED, (0.9, -1), (0.2, 1)),
        Cone("", TILTED, (0, -1), (0.7, 0.2), (0.3, 4.0)),
        Cone("", TILTED, (0.2, 0.1), (0.9, 0.1), (-1.0, 2.0)),
        Ring("", TILTED, 0, 0.8),
        Ring("", TILTED, 0, 0.8, (0.2, 1.2), (0.5, 3.0)),
        Ring("", TILTED, 0.6, 0.3, (-np.pi, np.pi)),
        Ring("", TILTED, 0.6, 0.3, (-0.5, 2.0), (1.0, 5.0)),
        extrude(
            "",
            TILTED,
            Outline(
                np.array([[-1.0, -1], [1, -1], [-0.2, -0.2], [-1, 1]]),
                np.full(4, 0.1),
                [(-0.5, 0, 0.2)],
            ),
            0.5,
        )[1],
        Bumpy("", TILTED, 0.7, np.eye(3), np.full(3, 0.06), 5),
    ],
    ids=lambda surface: f"{type(surface).__name__}-{surface.plane is not None}",
)
def test_rays_meet_curved_surfaces_where_their_points_are(surface):
    rng = np.random.default_rng(0)
    origin = np.array([[1.5, -1.0, 0.9]])
    # A ray to a point of the surface meets it there or before, at a point of the surface.
    targets = surface.sample(rng, 1000)
    found = intersect(surface, origin, targets - origin)
    met = found <= 1 + 1e-7
    # A body with bumps is followed in steps, and may be missed where it is only grazed.
    assert met.mean() > (0.995 if isinstance(surface, Bumpy) else 1 - 1e-9)
    targets, found = targets[met], found[met]
    first = origin + found[:, None] * (targets - origin)
    cloud = torch.from_numpy(surface.sample(rng, 60_000))
    gaps = torch.cdist(torch.from_numpy(first[:300]), cloud).min(dim=1).values
    assert gaps.max() < 6 * (surface.area / 60_000) ** 0.5
    # And nowhere before that: places in between are off the surface, seen along the normals.
    assert np.isin(np.isclose(found, 1), [True]).any()
    again = intersect(surface, first + 1e-6 * (targets - origin), targets - origin)
    assert (again[found < 1 - 1e-5] < np.inf).all()


@pytest.mark.parametrize("seed", range(3))
def test_path_to_the_nearest_hit_is_free_and_what_is_behind_is_not(seed, directions):
    model = build_room(seed, layout=CURVED)
    origin, steps = model.viewpoints[0], directions.reshape(-1, 3)
    hits = cast_rays(model, origin, directions)
    distances, faces = hits.distances.ravel(), hits.faces.ravel()
    for share in np.linspace(0.01, 0.9999, 60):
        assert not is_occupied(model.parts, origin + share * distances[:, None] * steps).any()
    bodies = {
        row for row, surface in enumerate(model.surfaces) if model.parts[model.objects[row]].solids
    }
    of_body = np.isin(faces, list(bodies - set(range(6))))
    assert of_body.sum() > 100
    behind = origin + (distances[:, None] + 1e-6) * steps
    assert is_occupied(model.parts, behind[of_body]).all()


@pytest.mark.parametrize(
    "model",
    [build_room(0), build_room(5, layout=CURVED), build_storey(0)],
    ids=["room", "curved", "storey"],
)
def test_no_ray_escapes(model):
    directions = unit(np.random.default_rng(1).standard_normal((60, 100, 3)))
    for viewpoint in model.viewpoints[::3]:
        hits = cast_rays(model, viewpoint, directions)
        assert (hits.faces != UNLABELED).all()
        assert np.isfinite(hits.distances).all()


def test_rays_into_seams_do_not_slip_through():
    model = build_room(0)
    size = np.array([9.0, 7, 2.8])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size
    edges = np.concatenate(
        [corners[0] + np.linspace(0, 1, 50)[:, None] * (corners[4] - corners[0])]
    )
    targets = np.concatenate([corners, edges])
    hits = cast_rays(model, model.viewpoints[0], (targets - model.viewpoints[0])[None])
    assert (hits.distances <= 1 + 1e-9).all()


def test_rays_along_the_sides_of_a_cone_are_solved_without_loss():
    # (1e-20 t^2 - 2 t + 1) has roots near 2e20 and 0.5; the usual formula loses the second.
    roots = solve_quadratic(np.array([1e-20]), np.array([-1.0]), np.array([1.0]))
    assert sorted(root[0] for root in roots) == pytest.approx([0.5, 2e20])


def test_rays_may_be_opposite():
    down_and_up = np.array([[[0, 0, -1.0], [0, 0, 1.0]]])
    distances = cast_rays(build_room(0), np.array([0.3, 0.3, 1.0]), down_and_up).distances
    assert distances.tolist() == [[1.0, pytest.approx(1.8)]]


def test_blocks_of_rays_miss_nothing():
    model = build_room(2, layout=CURVED)
    rays = cameras_around(model, 1, width=96, height=72)[0].rays()
    whole = cast_rays(model, model.viewpoints[0], rays)
    for row, column in np.random.default_rng(0).integers((72, 96), size=(60, 2)):
        single = cast_rays(model, model.viewpoints[0], rays[row, column][None, None])
        assert single.faces[0, 0] == whole.faces[row, column]
        assert single.distances[0, 0] == whole.distances[row, column]


# Scans.


def test_scan_has_equal_steps_and_the_points_asked_for():
    model = build_room(0)
    scan = scan_scene(model, 20_011)
    assert len(scan.points) == 20_011
    lines = scan.points.double() - torch.from_numpy(model.viewpoints[0])
    elevations = torch.rad2deg(torch.asin(lines[:, 2] / lines.norm(dim=1)))
    azimuths = torch.rad2deg(torch.atan2(lines[:, 1], lines[:, 0]))
    steps = elevations.diff()
    usual = steps.median()
    assert ((steps - usual).abs() < 1e-3).double().mean() > 0.97
    assert -65 < elevations.min() < -64
    turns = azimuths.diff().remainder(360)
    new_column = turns.minimum(360 - turns) > 1e-2
    sizes = turns[new_column & (elevations[1:] < 89)]
    assert (sizes - sizes.median()).abs().max() < 1e-2


def test_scan_sees_only_what_is_in_sight():
    model = build_room(3)
    scan = scan_scene(model, 3000)
    lines = scan.points.double().numpy() - model.viewpoints[0]
    hits = cast_rays(model, model.viewpoints[0], lines[None])
    assert np.abs(hits.distances - 1).max() < 1e-5
    facing = (scan.normals.double().numpy() * lines).sum(axis=1)
    assert (facing < 0).all()
    residuals = (scan.points.double() * scan.face_normals[scan.labels]).sum(dim=1)
    assert (residuals - scan.face_offsets[scan.labels]).abs().max() < 2e-6


def test_scans_from_several_places_share_the_points():
    model = build_room(0, layout=RoomLayout(num_viewpoints=3))
    scan = scan_scene(model, 10_000)
    assert len(scan.points) == 10_000
    starts = [0, 3333, 6666]
    for start, viewpoint in zip(starts, model.viewpoints, strict=True):
        lines = scan.points[start : start + 300].double().numpy() - viewpoint
        assert np.abs(cast_rays(model, viewpoint, lines[None]).distances - 1).max() < 1e-5


def test_scan_of_nothing_is_refused():
    away = SceneModel((Part(build_room().surfaces[:1]),), np.array([[0.0, 0, 5000]]))
    with pytest.raises(ConfigError, match="expected a scene around its viewpoints, got no hit"):
        scan_scene(away, 100)


# Cameras and depth frames.


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
    rays = torch.from_numpy(camera.rays())
    pixels = rays @ camera.intrinsics.T
    assert torch.allclose(pixels[17, 230], torch.tensor([230, 17, 1.0]).double())


def test_vertical_view_is_refused():
    with pytest.raises(ConfigError, match="expected a target not above or below the position"):
        Camera.looking((1, 1, 1), (1, 1, 0))


def test_depth_frame_lies_on_the_faces_it_names():
    model = build_room(4)
    planes, offsets = (torch.from_numpy(values) for values in plane_table(model.surfaces))
    frame = render_depth(model, cameras_around(model, 1, width=160, height=120)[0])
    rays = torch.from_numpy(frame.camera.rays())
    local = rays * frame.depth.double()[..., None]
    pose = frame.camera.pose
    world = local @ pose[:3, :3].T + pose[:3, 3]
    residuals = (world * planes[frame.labels]).sum(dim=-1) - offsets[frame.labels]
    assert residuals.abs().max() < 2e-6
    assert torch.allclose(frame.normals.double() @ pose[:3, :3].T, planes[frame.labels], atol=1e-6)
    assert ((frame.normals * rays).sum(dim=-1) < 0).all()
    assert frame.planar.all()


def test_rays_that_meet_nothing_have_no_depth():
    model = SceneModel((Part(build_room().surfaces[:1]),), np.array([[1.0, 1, 1]]))
    frame = render_depth(model, Camera.looking((1, 1, 1), (3, 3, 1), width=64, height=48))
    nothing = frame.depth == 0
    assert nothing.any()
    assert not nothing.all()
    assert torch.equal(nothing, frame.labels == UNLABELED)
    assert (frame.normals[nothing] == 0).all()


def test_kinect_noise_grows_with_the_square_of_depth_and_has_steps_of_an_eighth_pixel():
    model = build_room(0)
    camera = cameras_around(model, 1)[0]
    exact, noisy = render_depth(model, camera), render_depth(model, camera, sensor="kinect")
    valid = noisy.depth > 0
    assert torch.equal(noisy.labels[valid], exact.labels[valid])
    assert (noisy.labels[~valid] == UNLABELED).all()
    disparity = 525 * 0.075 / noisy.depth[valid].double() * 8
    assert (disparity - disparity.round()).abs().max() < 1e-4
    depth = exact.depth[valid].double()
    error = noisy.depth[valid].double() - depth
    for low, high in depth[::50].quantile(torch.linspace(0.05, 0.95, 7).double()).unfold(0, 2, 1):
        there = (depth > low) & (depth < high)
        sigma = 0.0012 + 0.0019 * (depth[there] - 0.4) ** 2
        step = depth[there] ** 2 / (525 * 0.075) / 8
        expected = (sigma**2 + step**2 / 12).mean().sqrt()
        assert error[there].std().item() == pytest.approx(expected.item(), rel=0.05)
        assert abs(error[there].mean()) < 0.1 * expected


def test_kinect_2_has_little_noise_and_no_steps():
    model = build_room(0)
    camera = cameras_around(model, 1)[0]
    exact, noisy = render_depth(model, camera), render_depth(model, camera, sensor="kinect2")
    valid = noisy.depth > 0
    assert 0.5 <= noisy.depth[valid].min() <= noisy.depth.max() <= 4.5
    depth = exact.depth[valid].double()
    error = noisy.depth[valid].double() - depth
    for low, high in ((1.0, 2.0), (3.0, 4.0)):
        there = (depth > low) & (depth < high)
        expected = (0.0015 - 0.0005 * depth[there] + 0.0003 * depth[there] ** 2).square().mean()
        assert error[there].std().item() == pytest.approx(expected.sqrt().item(), rel=0.05)
    assert len(noisy.depth[valid].unique()) > 0.9 * int(valid.sum())


def test_kinect_drops_what_is_out_of_its_range():
    model = build_room(0, layout=RoomLayout(size=(16.0, 7.0, 2.8)))
    camera = Camera.looking((0.5, 3.5, 1.6), (15, 3.5, 1.5), width=160, height=120)
    exact, noisy = render_depth(model, camera), render_depth(model, camera, sensor="kinect")
    assert (noisy.depth[exact.depth > 9.5] == 0).all()
    assert (noisy.depth <= 8).all()
    dropped = noisy.depth == 0
    assert dropped.any()
    assert not dropped.all()
    assert torch.equal(noisy.labels == UNLABELED, dropped)
    assert (noisy.normals[dropped] == 0).all()


def test_unknown_sensor_is_refused():
    with pytest.raises(
        ConfigError, match="expected sensor to be one of exact, kinect, kinect2, got 'lidar'"
    ):
        render_depth(build_room(), sensor="lidar")


# Fused frames.


def test_exact_frames_fuse_to_points_on_their_faces():
    scene = make_kinect_room(5000, seed=1, num_frames=1, sensor="exact")
    points, labels = scene.points.double(), scene.labels
    residuals = (points * scene.face_normals[labels]).sum(dim=1) - scene.face_offsets[labels]
    assert residuals.abs().max() < 3e-6
    assert torch.allclose(scene.normals.double(), scene.face_normals[labels], atol=1e-6)


def test_fused_frames_come_in_random_order_without_doubles():
    model = build_room(1, layout=KINECT_LAYOUT)
    cameras = cameras_around(model, 3, width=64, height=48)
    frames = [render_depth(model, camera) for camera in cameras]
    scene, again = (fuse_frames(model, frames, 5000) for _ in range(2))
    assert torch.equal(scene.points, again.points)
    assert len(scene.points.unique(dim=0)) == 5000
    places = scene.points[:, 0].double().numpy()
    assert kstest(places[:2500], places[2500:]).pvalue > 1e-3


def test_a_map_lies_on_its_faces_within_noise_and_drift():
    def residuals(drift):
        scene = make_mapped_room(3000, seed=1, num_frames=2, voxel=0.05, drift=drift)
        heights = (scene.points.double() * scene.face_normals[scene.labels]).sum(dim=1)
        return scene, (heights - scene.face_offsets[scene.labels]).abs()

    scene, exact = residuals((0.0, 0.0))
    # Voxels of 5 cm at edges hold the mean of two faces.
    assert exact.median() < 0.0015
    assert exact.max() < 0.1
    assert 2 * exact.median() < residuals((0.01, 0.0))[1].median() < 0.02
    assert 2 * exact.median() < residuals((0.0, 0.5))[1].median() < 0.05
    cells = torch.floor((scene.points - scene.points.min(dim=0).values) / 0.05)
    assert len(cells.unique(dim=0)) > 2500
    with pytest.raises(ConfigError, match=r"expected num_points <= .*, the voxels that were seen"):
        make_mapped_room(10**6, seed=1, num_frames=1, voxel=0.5)


def test_too_few_pixels_are_refused():
    model = build_room(0, layout=KINECT_LAYOUT)
    frame = render_depth(model, cameras_around(model, 1, width=64, height=48)[0])
    with pytest.raises(ConfigError, match=r"expected num_points in \[1, 3072\], .* got 4000"):
        fuse_frames(model, [frame], 4000)


def test_bent_walls_of_a_frame_are_gentle():
    layout = RoomLayout(num_bent_walls=4, num_doors=0, num_windows=0, num_cabinets=0, num_shelves=0)
    scene = make_room(20_000, noise=0, seed=0, layout=layout)
    curved = ~scene.planar[scene.labels]
    assert {scene.kinds[row] for row in scene.labels[curved].unique()} == {"wall"}
    model = build_room(0, layout=layout)
    frame = render_depth(model, cameras_around(model, 1, width=160, height=120)[0])
    walls = ~frame.planar[frame.labels]
    assert walls.any()
    inwards = frame.normals[walls].double() @ frame.camera.pose[:3, :3].T
    aligned = inwards[:, :2].abs().max(dim=1).values
    # The ends of a wall of 9 m bent by 4 cm are tilted by 4 * 0.04 / 9 radians, of 7 m by more.
    assert torch.rad2deg(torch.acos(aligned.clamp(max=1))).max() < 1.4
