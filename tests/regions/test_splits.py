"""Levels: regions that hold two parallel surfaces are split, points between them are assigned."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.regions.test_repair import flat_cloud, scattered, with_settings
from torchrg import load_config, segment_planes
from torchrg.regions import summarize_planes
from torchrg.regions.adjacency import KnnAdjacency
from torchrg.regions.fit import RegionPlanes, fit_regions
from torchrg.regions.repair import assign_levels, merge_coplanar, refine_regions
from torchrg.regions.splits import _have_valleys, split_levels
from torchrg.structures import Neighbors

CONFIG = with_settings(min_size=50, facet_tolerance=0.005)
NOISE = 0.003
"""Standard deviation of the points from their surface, in meters."""


def wall_with_board(rng, step, noise=NOISE, count=6000):
    """A wall of 2 x 1 m with a board of 0.6 x 0.5 m in front of it; whether points are on that."""
    points = rng.uniform(0, 1, (count, 3)) * [2, 1, 0]
    on_board = (np.abs(points[:, 0] - 1) < 0.3) & (np.abs(points[:, 1] - 0.5) < 0.25)
    points[:, 2] = step * on_board + noise * rng.normal(size=count)
    return points, on_board


def split(points, config=CONFIG):
    """Labels of the points as one region, after the split, in the order of the points."""
    cloud, order = flat_cloud(points)
    labels = torch.zeros(len(points), dtype=torch.int64)
    found = split_levels(cloud, labels, fit_regions(cloud, labels, config), config)
    assert (found is labels) == (found.max() == 0)
    return torch.empty_like(found).index_copy_(0, order, found).numpy()


def iou(first, second):
    return (first & second).sum() / (first | second).sum()


@pytest.mark.parametrize("step", [0.015, -0.015, 0.04, -0.1])
def test_a_board_in_front_of_a_wall_is_a_region(step):
    points, on_board = wall_with_board(np.random.default_rng(0), step)
    labels = split(points)
    assert labels.max() == 1
    assert iou(labels == 1, on_board) > 0.95


def test_each_board_of_a_wall_is_a_region():
    rng = np.random.default_rng(1)
    points, on_board = wall_with_board(rng, 0.02)
    niche, on_niche = wall_with_board(rng, -0.03)
    labels = split(np.concatenate([points, niche + np.array([2, 0, 0])]))
    assert labels.max() == 2
    truth = np.concatenate([on_board, 2 * on_niche.astype(int)])
    ious = [max(iou(labels == label, truth == kind) for label in (1, 2)) for kind in (1, 2)]
    assert min(ious) > 0.95


BENT = {
    "noise": lambda x, y: 0 * x,
    "a slope": lambda x, y: 0.03 * x,
    "a bend": lambda x, y: 0.03 * (x - 1) ** 2,
    "a wave": lambda x, y: 0.01 * np.sin(4 * x),
    "a ramp between two levels": lambda x, y: 0.02 * (np.abs(x - 1) / 0.5).clip(0, 1),
    "a step within the noise": lambda x, y: 0.004 * (np.abs(x - 1) < 0.3),
    "a specks of five points": lambda x, y: 0.03 * ((x - 1) ** 2 + (y - 0.5) ** 2 < 0.0005),
}


@pytest.mark.parametrize("height", BENT.values(), ids=BENT)
@pytest.mark.parametrize("seed", [2, 3])
def test_a_surface_without_a_valley_stays_whole(height, seed):
    rng = np.random.default_rng(seed)
    points, _ = wall_with_board(rng, 0.0)
    points[:, 2] += height(points[:, 0], points[:, 1])
    assert split(points).max() == 0


def test_the_plane_of_a_region_may_lie_between_its_levels():
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 1, (6000, 3)) * [2, 1, 0]
    upper = np.abs(points[:, 1] - 0.5) < 0.22
    points[:, 2] = 0.02 * upper + 0.002 * rng.normal(size=6000)
    labels = split(points)
    assert labels.max() == 1
    assert iou(labels == 1, upper) > 0.95


@pytest.mark.parametrize("step", [0.02, 0.04])
def test_points_between_parallel_regions_go_to_the_nearer_plane(step):
    rng = np.random.default_rng(6)
    points, on_board = wall_with_board(rng, step)
    cloud, order = flat_cloud(points)
    truth = torch.from_numpy(on_board)[order].long()
    wrong = truth.clone()
    # A rim of the board, 4 cm wide, has the label of the wall.
    x, y = cloud.points[:, 0] - 1, cloud.points[:, 1] - 0.5
    wrong[(truth == 1) & ((x.abs() > 0.26) | (y.abs() > 0.21))] = 0
    found = assign_levels(cloud, wrong, fit_regions(cloud, wrong, CONFIG))
    assert (wrong != truth).sum() > 200
    assert (found != truth).sum() < 10


def test_pieces_of_one_face_keep_their_points():
    points, _ = wall_with_board(np.random.default_rng(7), 0.0)
    cloud, _ = flat_cloud(points)
    labels = (cloud.points[:, 0] > 1).long()
    assert torch.equal(assign_levels(cloud, labels, fit_regions(cloud, labels, CONFIG)), labels)


def test_thick_regions_across_a_step_do_not_join_its_sides():
    # A wall and a board 24 mm in front of it, each with a thick region of 200 points between them.
    height = torch.tensor([0.0, 0.024, 0.006, 0.018], dtype=torch.float64)
    rms = torch.tensor([0.003, 0.003, 0.011, 0.011], dtype=torch.float64)
    count = torch.tensor([10_000, 10_000, 200, 200])
    no, zero = torch.zeros(4, dtype=torch.bool), torch.zeros(4, dtype=torch.float64)
    planes = RegionPlanes(
        normal=torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(4, 3),
        center=torch.stack([zero, zero, height], dim=1),
        covariance=torch.diag_embed(torch.stack([zero + 0.1, zero + 0.1, rms**2], dim=1)),
        thickness=rms,
        rms=rms,
        num_points=count,
        curved=no,
        floor=zero,
        reach=zero + torch.inf,
        bent=no,
        radius=zero,
    )
    contacts = torch.tensor([[0, 1], [0, 2], [1, 3]]), torch.tensor([50, 50, 50])
    found = merge_coplanar(torch.arange(4), contacts, planes, tolerance=1.2)
    assert found.tolist() == [0, 1, 0, 1]


def bumpy(rng, radius, count=4000):
    """A face 30 cm wide on a cylinder of some radius, and its bumpy normals, 20 degrees off."""
    points = rng.uniform(-0.15, 0.15, (count, 3))
    points[:, 2] = points[:, 0] ** 2 / (2 * radius) + 0.006 * rng.normal(size=count)
    return points, scattered(rng, count, 15.0)


@pytest.mark.parametrize(("tolerance", "curved"), [(None, True), (0.005, False)])
def test_the_table_calls_a_faceted_face_a_plane(tolerance, curved):
    points, normals = (torch.from_numpy(each) for each in bumpy(np.random.default_rng(8), 1e9))
    labels = torch.zeros(len(points), dtype=torch.int64)
    table = summarize_planes(points, normals, labels, up="z", facet_tolerance=tolerance)
    assert table.curved.tolist() == [curved]
    assert table.rms.item() == pytest.approx(0.006, rel=0.1)


def test_distance_decides_what_a_faceted_face_absorbs():
    points, normals = bumpy(np.random.default_rng(9), 1e9)
    normals[:500] = [1.0, 0, 0]
    points[:50, 2] = 0.05
    cloud, order = flat_cloud(points, normals=normals)
    labels = torch.where(order < 500, -1, 0)
    found = {}
    for faceted in (True, False):
        config = dataclasses.replace(CONFIG, faceted=faceted, absorb=True)
        found[faceted] = refine_regions(cloud, labels, config)
    assert not (found[False][order < 500] == 0).any()
    assert not (found[True][order < 50] == 0).any()
    assert (found[True][(order >= 50) & (order < 500)] == 0).float().mean() > 0.95


def test_levels_do_not_depend_on_the_order_of_points_or_on_threads(set_threads):
    points, _ = wall_with_board(np.random.default_rng(10), 0.02)
    points = torch.from_numpy(points.astype(np.float32))
    labels = segment_planes(points).labels
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    set_threads(3)
    config = load_config(chunk_size=1000)
    assert torch.equal(segment_planes(points[order], config).labels, labels[order])


def board_of(height, seed):
    """A wall and a board whose height depends on x, from -0.3 to 0.3, and a number from 0 to 1."""
    rng = np.random.default_rng(seed)
    points, on_board = wall_with_board(rng, 0.0)
    points[on_board, 2] += height(points[on_board, 0] - 1, rng.uniform(size=on_board.sum()))
    return points


@pytest.mark.parametrize(
    ("height", "num_levels"),
    [
        (lambda x, u: 0.15 + 0.2 * x, 2),  # 11 degrees to the wall
        (lambda x, u: 0.25 + 0.4 * x, 1),  # 22 degrees: no second level
        (lambda x, u: 0.02 + 0.01 * u, 2),
        (lambda x, u: 0.02 + 0.12 * (u - 0.5).clip(0), 1),  # clutter, from 2 to 8 cm
    ],
    ids=["parallel", "oblique", "thin", "thick"],
)
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_level_is_parallel_and_thinner_than_its_step(height, num_levels, seed):
    assert split(board_of(height, seed)).max() == num_levels - 1


def test_a_point_between_two_levels_counts_for_the_first():
    # The middle is halfway to the left level, which has no valley then, and far below the right.
    average = torch.tensor([1.0, 0.5, 3.0])
    near = Neighbors(torch.tensor([[0, 1], [1, 0], [2, 1]], dtype=torch.int32))
    level, step, region = torch.tensor([0, -1, 1]), torch.tensor([1.0, 3.0]), torch.zeros(3).long()
    for order in ([0, 1, 2], [2, 1, 0]):
        rows = torch.tensor(order)
        place = rows.argsort().to(torch.int32)
        lists = KnnAdjacency(Neighbors(place[near.indices.long()[rows]]))
        found = _have_valleys(level[rows], step, average[rows], region, lists)
        assert found.tolist() == [False, True]


def test_a_level_on_a_level_is_found_in_the_second_search():
    points, on_board = wall_with_board(np.random.default_rng(14), 0.02, count=12_000)
    on_frame = (np.abs(points[:, 0] - 1) < 0.12) & (np.abs(points[:, 1] - 0.5) < 0.12)
    points[on_frame, 2] += 0.03
    labels = split(points)
    assert labels.max() == 2
    kinds = on_board.astype(int) + on_frame
    assert min(max(iou(labels == n, kinds == kind) for n in range(3)) for kind in range(3)) > 0.9
