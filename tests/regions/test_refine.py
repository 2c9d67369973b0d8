"""Steps after growth: release, absorption, merging."""

import numpy as np
import pytest
import torch

from tests.regions import growing_clouds
from torchrg.config import GrowingConfig
from torchrg.errors import ConfigError
from torchrg.neighbors import canonical_order, search_knn
from torchrg.regions import grow_regions
from torchrg.regions.adjacency import contact_neighbors, count_contacts
from torchrg.regions.edges import GrowingCloud
from torchrg.regions.refine import absorb_points, refine_regions
from torchrg.structures import UNLABELED, Neighbors

OFF = GrowingConfig(seed_rule="curvature", connectivity=None, coplanarity=False, min_size=5)


def with_settings(**settings):
    return GrowingConfig(**{**vars(OFF), **settings})


def flat_cloud(coordinates, k=16, normals=None):
    """A cloud in canonical order, with upward normals, and the order."""
    points = torch.as_tensor(np.asarray(coordinates))
    order = canonical_order(points)
    points = points[order]
    up = torch.tensor([0.0, 0, 1], dtype=points.dtype).expand(len(points), 3)
    normals = up if normals is None else torch.as_tensor(normals)[order]
    valid = torch.ones(len(points), dtype=torch.bool)
    neighbors = search_knn(points, k, canonical=True)
    return GrowingCloud(points, normals, torch.zeros(len(points)), neighbors, valid), order


def sheet(rng, n=1500, noise=0.002):
    points = rng.uniform(0, 1, (n, 3))
    points[:, 2] = noise * rng.normal(size=n)
    return points


def test_nothing_changes_unless_asked():
    cloud, _ = flat_cloud(sheet(np.random.default_rng(0)))
    labels = (cloud.points[:, 0] > 0.5).long()
    assert torch.equal(refine_regions(cloud, labels, OFF), labels)


def test_far_points_are_released():
    rng = np.random.default_rng(1)
    points = sheet(rng)
    points[:40, 2] += 0.05
    cloud, order = flat_cloud(points)
    labels = torch.zeros(len(points), dtype=torch.int64)
    refined = refine_regions(cloud, labels, with_settings(max_plane_residual=6.0))
    assert torch.equal(refined == UNLABELED, order < 40)


def test_unlabelled_points_on_the_plane_are_absorbed_and_others_are_not():
    rng = np.random.default_rng(2)
    points = sheet(rng)
    points[:100, 2] += 0.03
    cloud, order = flat_cloud(points)
    labels = torch.zeros(len(points), dtype=torch.int64)
    labels[cloud.points[:, 0] > 0.8] = UNLABELED
    labels[order < 100] = UNLABELED
    refined = refine_regions(cloud, labels, with_settings(absorb=True))
    assert (refined[order < 100] == UNLABELED).all()
    assert (refined[order >= 100] == 0).float().mean() > 0.99


def test_points_with_another_direction_are_not_absorbed():
    rng = np.random.default_rng(3)
    normals = np.tile([0.0, 0.0, 1.0], (1500, 1))
    normals[:200] = [1.0, 0.0, 0.0]
    cloud, order = flat_cloud(sheet(rng), normals=normals)
    labels = torch.where(order < 200, UNLABELED, 0)
    assert torch.equal(refine_regions(cloud, labels, with_settings(absorb=True)), labels)


def test_invalid_points_are_not_absorbed():
    cloud, order = flat_cloud(sheet(np.random.default_rng(4)))
    labels = torch.where(order < 200, UNLABELED, 0)
    cloud = cloud._replace(valid=order >= 100)
    refined = refine_regions(cloud, labels, with_settings(absorb=True))
    assert (refined[order < 100] == UNLABELED).all()
    assert (refined[(order >= 100) & (order < 200)] == 0).float().mean() > 0.9


def absorbed_one_by_one(points, normals, labels, neighbors, planes, valid, max_angle_deg):
    """The rule of absorption, literally."""
    normal, center, reach = (part.tolist() for part in planes)
    nearest = contact_neighbors(neighbors)[0].tolist()
    labels = labels.tolist()
    least_cosine = np.cos(np.radians(max_angle_deg))
    while True:
        joined = {}
        for i, point in enumerate(points.tolist()):
            if labels[i] >= 0 or not valid[i]:
                continue
            options = []
            for region in {labels[j] for j in nearest[i]} - {UNLABELED}:
                away = np.abs(np.dot(np.subtract(point, center[region]), normal[region]))
                cosine = np.abs(np.dot(normals[i].tolist(), normal[region]))
                if away <= reach[region] and cosine >= least_cosine:
                    options.append((away, region))
            if options:
                joined[i] = min(options)[1]
        if not joined:
            return labels
        for i, region in joined.items():
            labels[i] = region


def test_absorption_follows_its_rule_literally():
    rng = np.random.default_rng(5)
    cloud = growing_clouds.prepare(growing_clouds.room(rng, 300, 0.01), 12)
    points, normals, _, neighbors = cloud
    labels = torch.full((len(points),), UNLABELED)
    planes = (
        torch.eye(3).double(),
        torch.zeros(3, 3).double(),
        torch.tensor([0.05, 0.02, float("nan")]).double(),
    )
    for axis in range(3):
        labels[(points[:, axis].abs() < 0.02).nonzero()[:30, 0]] = axis
    valid = torch.from_numpy(rng.random(len(points)) < 0.9)
    found = absorb_points(
        points, normals, labels, neighbors, planes, valid=valid, max_angle_deg=30.0
    )
    expected = absorbed_one_by_one(points, normals, labels, neighbors, planes, valid, 30.0)
    assert found.tolist() == expected
    assert (found >= 0).sum() > (labels >= 0).sum()


def test_contacts_of_touching_regions_are_counted():
    neighbors = Neighbors(torch.tensor([[0, 1], [1, 0], [2, 1]]))
    pairs, counts = count_contacts(torch.tensor([0, 1, 1]), neighbors)
    assert (pairs.tolist(), counts.tolist()) == ([[0, 1]], [2])
    assert contact_neighbors(neighbors)[0].tolist() == [[1], [0], [1]]


def test_touching_pieces_of_one_plane_are_merged():
    cloud, _ = flat_cloud(sheet(np.random.default_rng(6), 3000))
    labels = (cloud.points[:, 0] * 4).long() + 4 * (cloud.points[:, 1] * 3).long()
    refined = refine_regions(cloud, labels, with_settings(merge_coplanar=True))
    assert (refined == 0).all()


def test_pieces_across_a_gap_are_not_merged():
    points = sheet(np.random.default_rng(7), 3000)
    points[points[:, 0] > 0.5, 0] += 0.07
    cloud, _ = flat_cloud(points, k=50)
    labels = (cloud.points[:, 0] > 0.5).long()
    assert len(count_contacts(labels, cloud.neighbors)[0]) == 0
    refined = refine_regions(cloud, labels, with_settings(merge_coplanar=True))
    assert torch.equal(refined, labels)


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_a_step_or_a_bend_is_not_merged(noise):
    rng = np.random.default_rng(8)
    step, bend = sheet(rng, 3000, noise), sheet(rng, 3000, noise)
    step[:, 2] += 0.01 * (step[:, 0] > 0.5)
    bend[:, 2] += 0.2 * np.maximum(bend[:, 0] - 0.5, 0)
    for points in (step, bend):
        cloud, _ = flat_cloud(points)
        labels = (cloud.points[:, 0] > 0.5).long()
        assert len(count_contacts(labels, cloud.neighbors)[0]) == 1
        refined = refine_regions(cloud, labels, with_settings(merge_coplanar=True))
        assert torch.equal(refined, labels)


def test_curved_regions_are_neither_merged_nor_fed():
    rng = np.random.default_rng(9)
    angle, height = rng.uniform(0, np.pi, 3000), rng.uniform(0, 8, 3000)
    points = np.stack([np.cos(angle), np.sin(angle), height], axis=1)
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    cloud, _ = flat_cloud(points, normals=normals)
    labels = (cloud.points[:, 2] > 3.5).long()
    labels[cloud.points[:, 2] > 7.2] = UNLABELED
    config = with_settings(absorb=True, merge_coplanar=True)
    assert torch.equal(refine_regions(cloud, labels, config), labels)


@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_grown_and_refined_labels_do_not_depend_on_order_or_unit(unit, rng):
    generator = np.random.default_rng(10)
    coordinates = growing_clouds.room(generator, 900, 0.005)
    points, normals, curvature, neighbors = growing_clouds.prepare(coordinates, 14)
    config = with_settings(
        max_angle_deg=6.0, max_plane_residual=5.0, absorb=True, merge_coplanar=True
    )
    labels = grow_regions(points, normals, curvature, neighbors, config)
    assert labels.max() >= 2
    plain = grow_regions(points, normals, curvature, neighbors, with_settings(max_angle_deg=6.0))
    assert not torch.equal(labels, plain)
    order = torch.randperm(len(points), generator=rng)
    moved = points[order] * unit
    again = grow_regions(
        moved, normals[order], curvature[order], search_knn(moved, 14), config, chunk_size=100
    )
    assert torch.equal(again, labels[order])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_plane_residual", 0.0),
        ("absorb_reach", -1.0),
        ("absorb_angle_deg", 91.0),
        ("merge_tolerance", 0.9),
        ("max_distance", -1.0),
    ],
)
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(ConfigError, match=f"GrowingConfig: expected {name} "):
        GrowingConfig(**{name: value})
