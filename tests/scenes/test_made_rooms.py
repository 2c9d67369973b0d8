"""Rooms against their own geometry: planes, areas, bodies, noise."""

import hashlib
from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.stats import chisquare, kstest

from tests.made import drawn_from_triangles
from torchrg.errors import ConfigError
from torchrg.neighbors import search_knn
from torchrg.scenes import RoomLayout, build_room, make_room, sample_scene
from torchrg.scenes.scene import is_occupied

CURVED = RoomLayout(
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


BARE_WALLS = RoomLayout(num_cabinets=0, num_shelves=0, num_boxes=7)


@pytest.fixture(scope="module")
def exact():
    return make_room(200_000, noise=0, seed=0)


@pytest.fixture(scope="module")
def bare():
    return make_room(200_000, noise=0, seed=2, layout=BARE_WALLS)


def test_default_room_has_about_150_faces_and_more_than_30_of_4_cm(exact):
    assert 140 <= len(exact.kinds) <= 160
    thin = [kind in ("table edge", "shelf edge") for kind in exact.kinds]
    assert 30 <= sum(thin) <= 40
    heights = [
        surface.cells[0][:, 1].sum()
        for surface, edge in zip(build_room().surfaces, thin, strict=True)
        if edge
    ]
    assert np.allclose(heights, 0.04)
    assert exact.planar.all()


def test_points_without_noise_lie_on_their_planes(exact):
    points, labels = exact.points.double(), exact.labels
    residuals = (points * exact.face_normals[labels]).sum(dim=1) - exact.face_offsets[labels]
    assert residuals.abs().max() < 1e-6  # rounding of coordinates up to 9 m to float32


def test_normals_are_those_of_the_faces(exact):
    expected = exact.face_normals[exact.labels].float()
    torch.testing.assert_close(exact.normals, expected, atol=0, rtol=0)
    assert torch.allclose(exact.face_normals.norm(dim=1), torch.ones(len(exact.kinds)).double())


def test_normals_of_the_shell_point_into_the_room(exact):
    middle = torch.tensor([4.5, 3.5, 1.4], dtype=torch.float64)
    inwards = exact.face_normals[:6] @ middle - exact.face_offsets[:6]
    assert (inwards > 1).all()


def test_normals_of_frames_point_into_the_opening(exact):
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
        assert normal @ model.viewpoints[0] - offset > 0.5


def _inside(block, points, margin):
    """Which points are inside a block shrunk by a margin, by a matrix inverse."""
    local = np.linalg.solve(block.frame.axes.T, (points - block.frame.origin).T).T
    low = np.array([-block.size[0] / 2, -block.size[1] / 2, 0]) + margin
    high = np.array([block.size[0] / 2, block.size[1] / 2, block.size[2]]) - margin
    return ((local > low) & (local < high)).all(axis=1)


def test_no_point_is_inside_a_body(exact):
    points = exact.points.double().numpy()
    in_front = points + 1e-4 * exact.normals.double().numpy()
    for block in build_room().solids:
        assert not _inside(block, points, 1e-5).any()
        # Nor is a covered place sampled: the underside of a table above its post, for example.
        assert not _inside(block, in_front, 2e-4).any()


def test_what_is_covered_is_left_out_and_only_that(bare):
    covered = sum(
        solid.size[0] * solid.size[1]
        for solid in build_room(2, layout=BARE_WALLS).solids
        if solid.frame.origin[2] == 0
    )
    counts = bare.labels.bincount(minlength=len(bare.kinds)).double()
    expected = (bare.face_areas[0] - covered) * counts[2:6].sum() / bare.face_areas[2:6].sum()
    assert abs(counts[0] - expected) < 4 * (2 * expected).sqrt()
    # The test would see it if they were sampled too.
    assert covered * counts[0] / bare.face_areas[0] > 5 * (2 * expected).sqrt()


def test_numbers_of_points_are_proportional_to_areas(bare):
    free = ["wall", "door", "window", "door frame", "window frame", "table edge", "pillar"]
    rows = [row for row, kind in enumerate(bare.kinds) if kind in free]
    counts = bare.labels.bincount(minlength=len(bare.kinds))[rows].numpy()
    areas = bare.face_areas[rows].numpy()
    assert chisquare(counts, areas / areas.sum() * counts.sum()).pvalue > 1e-4


def test_points_are_spread_evenly_over_walls_with_holes(bare):
    for face, surface in enumerate(build_room(2, layout=BARE_WALLS).surfaces[2:6], start=2):
        local = surface.frame.to_local(bare.points[bare.labels == face].double().numpy())
        counts = [
            ((local[:, :2] >= corner) & (local[:, :2] < corner + edge + other)).all(axis=1).sum()
            for corner, edge, other in surface.cells
        ]
        areas = np.array([edge[0] * other[1] for _, edge, other in surface.cells])
        assert abs(sum(counts) - len(local)) < 5  # rounding at the edges
        assert chisquare(counts, areas / areas.sum() * sum(counts)).pvalue > 1e-4


def test_points_are_spread_evenly_over_the_ceiling(exact):
    ceiling = exact.points[exact.labels == 1]
    grid = np.histogram2d(ceiling[:, 0], ceiling[:, 1], bins=8, range=[(0, 9), (0, 7)])[0]
    pillars = [solid for solid in build_room().solids if solid.bounds[1, 2] > 2.79]
    assert len(pillars) == 1  # covers part of one cell or a few
    touched = grid < grid.mean() - 6 * np.sqrt(grid.mean())
    assert touched.sum() <= 4
    assert chisquare(grid[~touched]).pvalue > 1e-4


def test_no_face_lies_in_the_plane_of_another(exact):
    planes = torch.cat([exact.face_normals, exact.face_offsets[:, None]], dim=1).numpy()
    for first, second in combinations(planes, 2):
        sign = np.sign(first[:3] @ second[:3])
        if abs(first[:3] @ second[:3]) > 1 - 1e-12:
            assert abs(first[3] - sign * second[3]) > 0.005 - 1e-9


def test_same_seed_gives_the_same_room():
    scene = make_room(2000, noise=0.003, seed=7)
    again = make_room(2000, noise=0.003, seed=7)
    assert scene.points.equal(again.points)
    assert scene.labels.equal(again.labels)
    assert not scene.points.equal(make_room(2000, noise=0.003, seed=8).points)
    digest = hashlib.sha256(scene.points.numpy().tobytes() + scene.labels.numpy().tobytes())
    assert digest.hexdigest()[:16] == "70bf90675ea8f6f3"


def test_every_size_is_a_sample_of_the_same_room():
    small, large = make_room(1000, seed=3), make_room(3000, seed=3)
    assert len(small.points) == 1000
    assert small.face_offsets.equal(large.face_offsets)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("layout", [RoomLayout(), CURVED], ids=["flat", "curved"])
def test_rooms_of_any_seed_have_free_viewpoints(seed, layout):
    model = build_room(seed, layout=layout)
    around = np.random.default_rng(0).uniform(-0.15, 0.15, (500, 3))
    assert not any(
        is_occupied(model.parts, viewpoint + around).any() for viewpoint in model.viewpoints
    )
    assert len(model.surfaces) == len(model.objects)


def test_viewpoints_keep_a_metre_from_bodies_where_there_is_space():
    layout = RoomLayout(num_tables=0, num_small_boxes=0, num_boxes=0, num_pillars=3)
    around = np.random.default_rng(0).uniform(-0.9, 0.9, (2000, 3))
    models = [build_room(seed, layout=layout) for seed in range(6)]
    free = [not is_occupied(model.parts, model.viewpoints[0] + around).any() for model in models]
    assert sum(free) >= 5


# Noise.


def test_noise_is_along_the_normal_with_the_deviation_asked_for(exact):
    noisy = make_room(200_000, noise=0.004, seed=0)
    assert noisy.labels.equal(exact.labels)
    shifts = (noisy.points - exact.points).double()
    along = (shifts * exact.normals.double()).sum(dim=1)
    across = shifts - along[:, None] * exact.normals.double()
    assert across.abs().max() < 2e-6
    assert kstest(along.numpy() / 0.004, "norm").pvalue > 1e-3


def test_isotropic_noise_has_the_deviation_along_each_axis(exact):
    noisy = sample_scene(build_room(), 200_000, noise=0.004, noise_direction="isotropic")
    shifts = (noisy.points - exact.points).double().numpy() / 0.004
    for axis in range(3):
        assert kstest(shifts[:, axis], "norm").pvalue > 1e-3


def test_points_are_in_random_order():
    random = make_room(5000, seed=1).labels
    same = (random[1:] == random[:-1]).double().mean()
    shares = random.bincount().double() / 5000
    assert abs(same - (shares**2).sum()) < 0.02


# Curved parts.


def test_curved_faces_are_marked_and_labelled():
    scene = make_room(20_000, noise=0, seed=0, layout=CURVED)
    curved = {kind for kind, flat in zip(scene.kinds, scene.planar, strict=True) if not flat}
    assert curved == {"wall", "column", "table edge", "table post", "ball", "lamp", "lamp post"}
    assert (scene.labels >= 0).all()
    assert torch.allclose(scene.normals.norm(dim=1), torch.ones(20_000))
    flat = scene.planar[scene.labels]
    points, labels = scene.points[flat].double(), scene.labels[flat]
    residuals = (points * scene.face_normals[labels]).sum(dim=1) - scene.face_offsets[labels]
    assert residuals.abs().max() < 2e-6


def test_bent_wall_passes_through_its_corners_and_bulges_by_the_bend():
    layout = RoomLayout(num_bent_walls=1, wall_bend=0.05)
    scene = make_room(300_000, noise=0, seed=0, layout=layout)
    wall = scene.points[scene.labels == 2].double()
    length = layout.size[0]
    # The circle through both corners and the middle, 5 cm into the room.
    radius = (length**2 / 4 + 0.05**2) / (2 * 0.05)
    along = wall[:, 0] - length / 2
    expected = 0.05 - radius + (radius**2 - along**2).sqrt()
    assert (wall[:, 1] - expected).abs().max() < 2e-6
    assert scene.kinds[2] == "wall"
    slopes = -scene.normals[scene.labels == 2, 0] / scene.normals[scene.labels == 2, 1]
    assert (slopes + along / (radius**2 - along**2).sqrt()).abs().max() < 1e-5
    floor = scene.points[scene.labels == 0].double()
    edge = 0.05 - radius + (radius**2 - (floor[:, 0] - length / 2) ** 2).sqrt()
    assert (floor[:, 1] > edge - 1e-5).all()


# Refusals.


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_points": 0}, "sample_scene: expected num_points >= 1, got 0"),
        ({"noise": -1}, "sample_scene: expected noise >= 0 metres, got -1"),
        ({"noise": float("nan")}, "expected noise >= 0 metres, got nan"),
        ({"seed": -1}, "expected seed >= 0, got -1"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        make_room(**{"num_points": 100, **settings})


def test_unknown_directions_of_noise_are_refused():
    with pytest.raises(ConfigError, match="noise_direction to be one of normal, isotropic, got"):
        sample_scene(build_room(), 100, noise_direction="up")


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ({"num_doors": -1}, "RoomLayout: expected num_doors >= 0, got -1"),
        ({"num_small_boxes": 9}, "expected num_small_boxes <= 8, got 9"),
        ({"num_bent_walls": 5}, "expected num_bent_walls <= 4, got 5"),
        ({"plate_thickness": 0}, "expected plate_thickness > 0, got 0"),
        ({"num_viewpoints": 0}, "expected num_viewpoints > 0, got 0"),
        ({"size": (9, 7, 2)}, "expected size of at least 1 x 1 x 2.3 metres, got"),
    ],
)
def test_impossible_layouts_are_refused(layout, message):
    with pytest.raises(ConfigError, match=message):
        RoomLayout(**layout)


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ({"num_tables": 40}, "expected a place on the floor for each object"),
        ({"num_windows": 40}, "expected a place on the walls for each object"),
        ({"min_plane_gap": 0.5}, "expected no face within min_plane_gap=0.5 of the plane"),
    ],
)
def test_rooms_that_cannot_be_furnished_are_refused(layout, message):
    with pytest.raises(ConfigError, match=message):
        build_room(layout=RoomLayout(**layout))


def test_points_drawn_from_triangles_lie_on_them():
    room = make_room(2000, 0.0, seed=3)
    drawn = drawn_from_triangles(room, 6000)
    # Where all points around are of one plane, so is what is drawn between them.
    around = search_knn(room.points, 20).indices.long()
    inside = (room.labels[around] == room.labels[:, None]).all(dim=1) & room.planar[room.labels]
    corner = torch.cdist(drawn.points, room.points).argmin(dim=1)
    flat = inside[corner] & (drawn.labels == room.labels[corner])
    assert flat.sum() > 1000
    offset = (drawn.points.double() * room.face_normals[drawn.labels]).sum(dim=1)
    apart = (offset - room.face_offsets[drawn.labels])[flat].abs()
    assert (apart < 1e-5).float().mean() > 0.98
    # No corner is drawn twice as it is, and all parts of the room are drawn from.
    assert torch.cdist(drawn.points, room.points).min(dim=1).values.median() > 0.02
    assert len(corner.unique()) > 1500
