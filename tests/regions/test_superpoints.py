"""Superpoints: a literal form of the merging, and what every partition promises."""

import dataclasses
import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tests.made.cameras import KINECT_LAYOUT
from torchrg import make_superpoints, segment_planes
from torchrg.config import SuperpointsConfig
from torchrg.errors import ConfigError, ShapeError
from torchrg.metrics import score_partition
from torchrg.regions import partition_points, superpoints
from torchrg.scenes import make_room
from torchrg.structures import Sampling

CONFIG = SuperpointsConfig(strengths=(0.3, 1.0, 4.0), min_size=4)

SIZE = 3500
"""Points of the room."""

PLACE_SPACINGS = 5
"""So few that places count in a cloud of 100 points."""


@pytest.fixture(scope="module")
def room():
    """Points, true normals, and true faces with every fifth point, and small faces, left out."""
    scene = make_room(SIZE, noise=0.003, seed=2, layout=KINECT_LAYOUT)
    small = torch.bincount(scene.labels)[scene.labels] < 50
    planes = torch.where(small | (torch.arange(SIZE) % 5 == 0), -1, scene.labels)
    return scene.points, scene.normals, planes


@pytest.fixture(scope="module")
def parts(room):
    return partition_points(*room, CONFIG)


def crumpled(rng, count=120, *, crumple=1.0):
    """Points at random in a flat box, their normals spread about z, and a part on two planes."""
    points = torch.rand(count, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.1])
    spread = crumple * torch.randn(count, 3, generator=rng)
    normals = torch.nn.functional.normalize(torch.tensor([0.0, 0, 1]) + spread, dim=1)
    planes = torch.where(points[:, 0] < 0.4, (points[:, 1] < 0.5).long(), -1)
    return points, normals, planes


def literal_leaning(normals, planes):
    """Normals are halfway to the mean direction of their plane, if the normals of this agree."""
    leaning = normals.copy()
    for plane in {int(label) for label in planes if label >= 0}:
        members = [i for i in range(len(planes)) if planes[i] == plane]
        values, axes = np.linalg.eigh(sum(np.outer(normals[i], normals[i]) for i in members))
        if values[-1] / len(members) >= np.cos(np.deg2rad(20)) ** 2:
            for i in members:
                both = normals[i] + np.sign(normals[i] @ axes[:, -1]) * axes[:, -1]
                leaning[i] = both / np.linalg.norm(both)
    return leaning


def literal_merging(points, normals, planes, config):
    """Points, or whole planes, merge, those first that are best partners, all from the points."""
    normals = literal_leaning(normals, planes)
    reach, near = cKDTree(points).query(points, k=9)
    near = near[:, 1:]
    contacts = [(i, int(j)) for i in range(len(points)) for j in near[i]]
    tensors = np.einsum("ni,nj->nij", normals, normals).reshape(len(points), 9)
    spacing = np.quantile(reach[:, -1], 0.5, method="lower") / 1.6
    features = np.hstack([tensors, points / (PLACE_SPACINGS * spacing)])
    groups = {i: {i} for i in range(len(points))}
    of = list(groups)

    def join(a, b):
        a, b = sorted((a, b))
        groups[a] |= groups.pop(b)
        for i in groups[a]:
            of[i] = a

    for i, j in contacts if config.planes == "whole" else ():
        if planes[i] == planes[j] >= 0 and of[i] != of[j]:
            join(of[i], of[j])

    def parted(i, j):
        way = (points[j] - points[i]) / np.linalg.norm(points[j] - points[i])
        step = min((way @ normals[i]) ** 2, (way @ normals[j]) ** 2)
        chord = 2 - 2 * abs(normals[i] @ normals[j])
        return chord + 0.25 * step + 0.25 * float(planes[i] != planes[j])

    def cost(a, b):
        links = [(i, j) for i, j in contacts if {of[i], of[j]} == {a, b}]
        mean_a, mean_b = (features[list(groups[g])].mean(axis=0) for g in (a, b))
        n_a, n_b = len(groups[a]), len(groups[b])
        difference = ((mean_a - mean_b) ** 2).sum() + np.mean([parted(*link) for link in links])
        difference += 0.01
        return n_a * n_b / (n_a + n_b) * difference / np.sqrt(len(links))

    levels = []
    for strength in config.strengths:
        for least in (0, config.min_size):
            while True:
                touching = {tuple(sorted((of[i], of[j]))) for i, j in contacts if of[i] != of[j]}
                found = [
                    (cost(a, b), a, b)
                    for a, b in touching
                    if not least or min(len(groups[a]), len(groups[b])) < least
                ]
                found = [row for row in found if row[0] <= (np.inf if least else strength)]
                best = {}
                for row in sorted(found):
                    for group in row[1:]:
                        best.setdefault(group, row)
                if not best:
                    break
                wanted = {a: sum(row[1:]) - a for a, row in best.items()}
                small = {a for a, b in wanted.items() if len(groups[b]) >= 16 * len(groups[a])}
                joining = [(a, b) for a, b in wanted.items() if a in small and b not in small]
                joining += [
                    (a, b)
                    for a, b in wanted.items()
                    if a > b and best[a] == best[b] and not {a, b} & small
                ]
                for a, b in joining:
                    join(of[a], of[b])
        levels.append(list(of))
    return levels


def same_partition(a, b):
    pairs = set(zip(np.asarray(a).tolist(), np.asarray(b).tolist(), strict=True))
    return len(pairs) == len(np.unique(a)) == len(np.unique(b))


@pytest.mark.parametrize("planes_enter", ["borders", "whole"])
@pytest.mark.parametrize("seed", range(2))
def test_merging_is_that_of_literal_loops(seed, planes_enter, monkeypatch):
    monkeypatch.setattr(superpoints, "_POSITION_SPACINGS", PLACE_SPACINGS)
    rng = torch.Generator().manual_seed(seed)
    points, normals, planes = crumpled(rng, 100, crumple=0.1 + 0.3 * seed)
    config = SuperpointsConfig(
        strengths=(0.05 + 0.1 * seed, 0.3 + 0.4 * seed), min_size=3, planes=planes_enter
    )
    order = superpoints.finite_rows(points)
    points, normals, planes = points[order], normals[order], planes[order]
    found = partition_points(points, normals, planes, config)
    expected = literal_merging(points.double().numpy(), normals.double().numpy(), planes, config)
    assert len(set(expected[0])) > len(set(expected[1])) > 1
    for level, literal in zip((found.labels, *found.levels), expected, strict=True):
        assert same_partition(level, literal)


def test_every_point_is_in_one_superpoint_and_levels_are_nested(room, parts):
    sizes = torch.bincount(parts.labels)
    assert (parts.labels >= 0).all()
    assert (sizes >= CONFIG.min_size).all()
    assert (sizes[1:] <= sizes[:-1]).all()
    assert len(parts.plane) == len(sizes)
    finer = parts.labels
    for level in parts.levels:
        pairs = torch.unique(torch.stack([finer, level]), dim=1)
        assert len(finer.unique()) == pairs.shape[1] > len(level.unique()) > 1
        finer = level


def test_kernels_merge_as_their_definitions(room, parts, monkeypatch):
    bounded = dataclasses.replace(CONFIG, max_extent=0.8, counts=(300, 40))
    shade = torch.rand(SIZE, 3, generator=torch.Generator().manual_seed(2))
    expected = partition_points(*room, bounded, shade)
    monkeypatch.setattr(superpoints.kernels, "serve", lambda *_, **__: False)
    for found, level in zip(
        (partition_points(*room, CONFIG), partition_points(*room, bounded, shade)),
        (parts, expected),
        strict=True,
    ):
        assert all(map(torch.equal, (found.labels, *found.levels), (level.labels, *level.levels)))


@pytest.mark.parametrize("config", [CONFIG, SuperpointsConfig(counts=(300, 40))])
def test_order_unit_and_origin_change_nothing(room, config):
    points, normals, planes = room
    found = partition_points(*room, config)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(3))
    far = points.double() * 2.0**-12 + torch.tensor([2.0**22, -(2.0**21), 0.0])
    moved = partition_points(far[order], normals[order], planes[order], config)
    assert torch.equal(moved.plane, found.plane)
    for level, other in zip(
        (found.labels, *found.levels), (moved.labels, *moved.levels), strict=True
    ):
        assert torch.equal(level[order], other)


def test_threads_and_chunks_change_nothing(room, parts, monkeypatch, set_threads):
    set_threads(2 if torch.get_num_threads() == 1 else 1)
    assert torch.equal(partition_points(*room, CONFIG).levels[1], parts.levels[1])
    monkeypatch.setattr(superpoints, "ROWS_AT_ONCE", 77)
    assert torch.equal(partition_points(*room, CONFIG).labels, parts.labels)


def test_duplicates_stay_together_and_points_that_are_not_finite_stay_out(room):
    points, normals, planes = room
    copies = torch.cat([torch.arange(SIZE), torch.arange(40).repeat(30), torch.tensor([7, 8])])
    cloud = points[copies]
    cloud[-1, 1], cloud[-2, 2] = torch.nan, torch.inf
    found = partition_points(cloud, normals[copies], planes[copies], CONFIG)
    assert found.labels[-2:].tolist() == [-1, -1]
    assert torch.equal(found.labels[SIZE:-2], found.labels[:40].repeat(30))
    alone = partition_points(points, normals, planes, CONFIG)
    assert same_partition(found.labels[:SIZE], alone.labels)
    assert torch.bincount(found.labels[:-2]).diff().le(0).all()


@pytest.mark.parametrize(
    ("counts", "planes"),
    [((5,), "borders"), ((900, 400, 120, 30), "borders"), ((300, 40), "whole")],
)
def test_numbers_of_superpoints_are_met_and_levels_nested(room, counts, planes):
    config = SuperpointsConfig(counts=counts, min_size=2, planes=planes)
    found = partition_points(*room, config)
    levels = [found.labels, *found.levels]
    # A made room has more parts that do not touch than the fewest asked for here.
    fewest = len(partition_points(*room, dataclasses.replace(config, counts=(1,))).plane)
    for count, level in zip(counts, levels, strict=True):
        assert len(level.unique()) == max(count, fewest)
        assert torch.bincount(level).min() >= 2
    for fine, coarse in itertools.pairwise(levels):
        assert len(torch.unique(torch.stack([fine, coarse]), dim=1)[0]) == len(fine.unique())


def test_more_superpoints_than_parts_of_a_size_are_not_made(room):
    found = partition_points(*room, SuperpointsConfig(counts=(1700,), min_size=10))
    assert SIZE / 25 < len(found.plane) <= SIZE / 10
    assert torch.bincount(found.labels).min() >= 10


def test_place_alone_parts_a_flat_wall_into_compact_pieces():
    x, y = torch.cartesian_prod(torch.arange(120.0), torch.arange(30.0)).unbind(1)
    wall = torch.stack([x, 0 * x, y], dim=1)
    normals = torch.tensor([0.0, 1, 0]).expand(len(wall), 3)
    found = partition_points(
        wall, normals, torch.zeros(len(wall), dtype=torch.int64), SuperpointsConfig(counts=(4,))
    )
    sizes = [np.ptp(wall[found.labels == i].numpy(), axis=0) for i in range(4)]
    assert max(size[0] for size in sizes) < 60
    assert torch.bincount(found.labels).min() > 450


def test_a_picture_flush_with_a_wall_is_cut_out_by_its_colours():
    x, y = torch.cartesian_prod(torch.arange(60.0), torch.arange(60.0)).unbind(1)
    wall = torch.stack([x, 0 * x, y], dim=1)
    picture = (x > 20.5) & (x < 41) & (y > 13.5) & (y < 29)
    colors = torch.where(picture, 0.2, 0.7)[:, None].expand(-1, 3)
    normals = torch.tensor([0.0, 1, 0]).expand(len(wall), 3)
    planes = torch.zeros(len(wall), dtype=torch.int64)
    config = SuperpointsConfig(counts=(200, 12))
    found = partition_points(wall, normals, planes, config, colors)
    for level in (found.labels, *found.levels):
        assert score_partition(level, picture.long()).asa == 1


@pytest.mark.parametrize("count", [0, 1, 2, 5, 30])
@pytest.mark.filterwarnings("ignore:expected finite points")
def test_few_or_equal_points_are_one_superpoint(count):
    for points in (torch.ones(count, 3), torch.arange(3.0 * count).reshape(count, 3)):
        found = make_superpoints(points)
        assert found.labels.tolist() == [0] * count
        assert len(found.plane) == min(count, 1)
        assert all(level.tolist() == [0] * count for level in found.levels)
    assert make_superpoints(torch.full((4, 3), torch.nan)).labels.tolist() == [-1] * 4


def test_equal_points_of_a_grid_are_one_superpoint_without_kernels(monkeypatch):
    monkeypatch.setattr(superpoints.kernels, "serve", lambda *_, **__: False)
    floor = torch.cartesian_prod(torch.arange(12.0), torch.arange(12.0), torch.arange(1.0))
    parts = make_superpoints(floor, segment_planes(floor, "classic"))
    assert all(level.tolist() == [0] * len(floor) for level in (parts.labels, *parts.levels))


def test_an_island_without_neighbours_stays_small(rng):
    points, normals, planes = crumpled(rng)
    points[:9] += 50.0
    config = dataclasses.replace(CONFIG, min_size=40)
    found = partition_points(points, normals, planes, config)
    assert len(found.labels[:9].unique()) == 1
    assert torch.bincount(found.labels).min() == 9


def test_a_floor_takes_in_its_specks_together(rng, monkeypatch):
    points = torch.rand(3000, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.0])
    normals = torch.tensor([0.0, 0, 1]).expand(3000, 3)
    planes = torch.where(torch.rand(3000, generator=rng) < 0.1, -1, 0)
    merge, turns = superpoints._merge, []
    monkeypatch.setattr(superpoints, "_merge", lambda *args: turns.append(1) or merge(*args))
    config = dataclasses.replace(CONFIG, planes="whole")
    assert len(partition_points(points, normals, planes, config).plane) == 1
    assert len(turns) < 10


def test_whole_planes_are_not_cut_and_extents_are_bounded(room):
    points, _, planes = room
    bounded = dataclasses.replace(CONFIG, max_extent=0.8)
    whole = partition_points(*room, dataclasses.replace(bounded, planes="whole"))
    cut = partition_points(*room, bounded)
    largest = torch.bincount(planes[planes >= 0]).argmax()
    most = [torch.bincount(found.labels[planes == largest]).max() for found in (whole, cut)]
    assert most[0] > 0.95 * (planes == largest).sum() > 2 * most[1]
    for level in (cut.labels, *cut.levels):
        for number in level.unique():
            assert np.ptp(points[level == number].numpy(), axis=0).max() <= 0.8


def test_specks_on_both_sides_do_not_exceed_an_extent():
    points = torch.cat([torch.linspace(0, 1, 101), torch.tensor([-0.02, 1.02])])[:, None]
    points = torch.cat([points, torch.zeros(103, 2)], dim=1)
    normals = torch.tensor([0.0, 0, 1]).expand(103, 3)
    planes = torch.where((points[:, 0] < 0) | (points[:, 0] > 1), -1, 0)
    config = SuperpointsConfig((50.0,), min_size=1, planes="whole", max_extent=1.03)
    found = partition_points(points, normals, planes, config)
    sizes = [np.ptp(points[found.labels == i, 0].numpy()) for i in found.labels.unique()]
    assert max(sizes) == pytest.approx(1.02, abs=1e-6)


def test_colours_tell_flat_things_apart():
    x, y = torch.cartesian_prod(torch.arange(30.0), torch.arange(30.0)).unbind(1)
    floor = torch.stack([x, y, 0 * x], dim=1)
    seg = segment_planes(floor)
    shade = torch.where(x < 13, 250, 20)[:, None].expand(-1, 3).to(torch.uint8)
    config = SuperpointsConfig(strengths=(12.0,))
    plain = make_superpoints(floor, seg, config)
    colored = make_superpoints(floor, seg, config, colors=shade)
    assert len(plain.plane) == 1
    assert score_partition(colored.labels, (x < 13).long()).asa > 0.9
    assert 1 < len(colored.plane) < 8
    for same in (shade.double() / 255 * (1 + 1e-9), shade.half()):
        found = make_superpoints(floor, seg, config, colors=same)
        assert torch.equal(colored.labels, found.labels)
    with pytest.warns(UserWarning, match="^make_superpoints: colors are read as 0..65535"):
        found = make_superpoints(floor, seg, config, colors=shade.long() * 257)
    assert torch.equal(colored.labels, found.labels)
    with pytest.raises(ConfigError, match=r"^make_superpoints: expected color in 0\.\.255, got -"):
        make_superpoints(floor, seg, config, colors=shade / 127.5 - 1)


def test_arguments_are_checked(room):
    points = room[0]
    with pytest.raises(ShapeError, match="expected points of shape"):
        make_superpoints(points[:, :2])
    with pytest.raises(ShapeError, match="expected colors of shape"):
        make_superpoints(points, colors=points[:5])
    with pytest.raises(ConfigError, match=r"expected color of shape \(N, 3\), got"):
        make_superpoints(points, colors=points.to(torch.complex64))
    seg = segment_planes(points[:100])
    with pytest.raises(ShapeError, match="expected seg of 3,500 points, got 100"):
        make_superpoints(points, seg)
    for wrong in (
        {"strengths": ()},
        {"strengths": (2.0, 1.0)},
        {"counts": ()},
        {"counts": (0,)},
        {"counts": (300, 300)},
        {"max_extent": 0.0},
    ):
        with pytest.raises(ConfigError, match="SuperpointsConfig: expected"):
            SuperpointsConfig(**wrong)


def test_a_made_room_is_parted_at_its_objects():
    scene = make_room(20_000, noise=0.003, seed=5, layout=KINECT_LAYOUT)
    found = make_superpoints(scene.points, config=SuperpointsConfig(strengths=(0.1,)))
    score = score_partition(found.labels, scene.objects[scene.labels], scene.points)
    assert score.count < 400
    assert score.asa > 0.98
    assert score.oracle_miou > 0.85
    assert score.boundary_recall > 0.9


def test_a_superpoint_is_on_the_plane_of_more_than_half_of_its_points():
    parts = torch.tensor([0, 0, 1, 1, 1, 2, 2, -1])
    planes = torch.tensor([3, -1, 3, 4, 4, -1, -1, 5])
    assert superpoints.majority_planes(parts, planes).tolist() == [-1, 4, -1]
    large = torch.where(planes >= 0, planes * 10**18, -1)
    assert superpoints.majority_planes(parts, large).tolist() == [-1, 4 * 10**18, -1]


def test_neighbors_that_are_known_are_not_searched_again(monkeypatch):
    points = make_room(num_points=3000, noise=0.003, seed=2).points
    seg = segment_planes(points, "classic", keep_neighbors=True)
    expected = make_superpoints(points, replace(seg, neighbors=None))
    twice = torch.cat([points, points[:7]])
    found_twice = make_superpoints(twice, segment_planes(twice, "classic", keep_neighbors=True))
    assert torch.equal(found_twice.labels[3000:], found_twice.labels[:7])
    other = make_superpoints(
        points.flip(0), replace(seg, labels=seg.labels.flip(0), normals=seg.normals.flip(0))
    )
    assert torch.equal(other.labels.flip(0), expected.labels)
    monkeypatch.setattr("torchrg.regions.superpoints.search_knn", None)
    assert torch.equal(make_superpoints(points, seg).labels, expected.labels)


def board(step, size=60):
    """A board tilted by 14 degrees, its noisy coordinates along z rounded to ``step``."""
    rng = torch.Generator().manual_seed(3)
    x, y = torch.cartesian_prod(torch.arange(float(size)), torch.arange(float(size))).unbind(1)
    z = x / 4 + 0.1 * torch.randn(len(x), generator=rng)
    points = torch.stack([x, y, step * (z / step).round()], dim=1)
    return points, torch.tensor([0.0, 0.0, 1.0]).expand(len(x), 3), torch.zeros(len(x)).long()


@pytest.mark.parametrize("step", [1.0, 2.0])
def test_terraces_of_a_plane_are_no_stripes(step):
    points, normals, planes = board(step)
    config = SuperpointsConfig(counts=(20,))
    found = partition_points(points, normals, planes, config).labels
    extents = [np.ptp(points[found == part, :2].numpy(), axis=0) for part in range(20)]
    assert np.median([extent.max() / extent.min() for extent in extents]) < 2
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(4))
    shuffled = partition_points(points[order], normals[order], planes[order], config).labels
    assert torch.equal(shuffled, found[order])


def test_points_far_from_the_terraces_of_their_plane_stay_apart():
    points, normals, planes = board(2.0)
    is_far = (points[:, :2] < 8).all(dim=1)
    points[:, 2] += 15 * is_far
    found = partition_points(points, normals, planes, SuperpointsConfig(counts=(20,))).labels
    assert not set(found[is_far].tolist()) & set(found[~is_far].tolist())


def test_a_step_inside_a_plane_separates_without_quantized_coordinates():
    rng = torch.Generator().manual_seed(5)
    points = torch.rand(3000, 3, generator=rng) * torch.tensor([60.0, 60.0, 0.1])
    is_raised = points[:, 0] > 30
    points[:, 2] += 3 * is_raised
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(3000, 3)
    found = partition_points(
        points, normals, torch.zeros(3000).long(), SuperpointsConfig(counts=(2,))
    )
    assert torch.equal(found.labels == found.labels[is_raised][0], is_raised)


@pytest.mark.parametrize(
    ("measures", "expected"),
    [
        ((0.72, 0.27, 0.08, 307_000.0, 0.26, 0.0008), True),  # A desk seen by a Kinect.
        ((0.0, 0.19, 0.83, 35_800.0, 1.2, 0.0043), True),  # Terraces wider than a neighborhood.
        ((0.06, 0.53, 0.6, 4510.0, 2.8, 0.0001), False),  # Points sampled from a mesh.
        ((0.06, 0.53, 0.6, 4510.0, 2.8, 0.005), False),  # Facets that deviate as much.
        ((1.0, 0.1, 1.0, 4000.0, 2.8, 0.0), False),  # An exact grid.
        ((0.9, 0.9, 0.6, 4000.0, 2.8, 0.005), False),  # Scan lines.
        ((0.32, 0.55, 0.0, 7880.0, 2.3, 0.0028), False),  # A fused scan of an office.
    ],
)
def test_terraces_are_told_by_the_sampling(measures, expected):
    assert superpoints.is_terraced(Sampling(*measures)) is expected
