"""Steps after growth: release, absorption, merging."""

import numpy as np
import pytest
import torch

from tests.regions import growing_clouds
from tests.regions.growing_clouds import papers_growing
from torchrg.linalg.moments import Segments
from torchrg.neighbors import canonical_order, search_knn
from torchrg.regions import grow_regions
from torchrg.regions.adjacency import MIN_CONTACTS, KnnAdjacency
from torchrg.regions.edges import GrowingInput
from torchrg.regions.fit import fit_planes, fit_regions
from torchrg.regions.growth import label_regions
from torchrg.regions.repair import assign_unlabeled, merge_facets, refine_regions
from torchrg.structures import UNLABELED, Neighbors

OFF = papers_growing(seed_rule="curvature", connectivity=None, coplanarity=False, min_size=5)


def with_settings(**settings):
    return papers_growing(**{**vars(OFF), **settings})


def flat_cloud(coordinates, k=16, normals=None):
    """A cloud in canonical order, with upward normals, and the order."""
    points = torch.as_tensor(np.asarray(coordinates))
    order = canonical_order(points)
    points = points[order]
    up = torch.tensor([0.0, 0, 1], dtype=points.dtype).expand(len(points), 3)
    normals = up if normals is None else torch.as_tensor(normals)[order]
    valid = torch.ones(len(points), dtype=torch.bool)
    neighbors = search_knn(points, k, canonical=True)
    return GrowingInput(points, normals, torch.zeros(len(points)), neighbors, valid), order


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


def absorbed_one_by_one(points, normals, labels, neighbors, planes, reach, valid, max_angle_deg):
    """The rule of absorption, literally."""
    normal, center, reach = (part.tolist() for part in (planes.normal, planes.center, reach))
    nearest = neighbors.indices[:, 1:9].tolist()
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
    axes = Segments(torch.arange(3))
    planes = fit_planes(axes, torch.zeros(3, 3).double(), torch.eye(3).double())
    reach = torch.tensor([0.05, 0.02, float("nan")]).double()
    for axis in range(3):
        labels[(points[:, axis].abs() < 0.02).nonzero()[:30, 0]] = axis
    valid = torch.from_numpy(rng.random(len(points)) < 0.9)
    found = assign_unlabeled(
        points,
        labels,
        KnnAdjacency(neighbors).neighbor_rows,
        planes,
        reach,
        valid=valid,
        normals=normals,
        max_angle_deg=30.0,
    )
    expected = absorbed_one_by_one(points, normals, labels, neighbors, planes, reach, valid, 30.0)
    assert found.tolist() == expected
    assert (found >= 0).sum() > (labels >= 0).sum()


def test_entries_that_are_no_neighbours_are_beside_no_point():
    valid = torch.tensor([[True, True], [True, False], [True, False]])
    adjacency = KnnAdjacency(Neighbors(torch.tensor([[0, 1], [1, 2], [2, 0]]), valid))
    assert adjacency.neighbor_rows(torch.tensor([0, 1, 2])).tolist() == [[1], [1], [2]]
    assert adjacency.neighbor_rows(slice(1, 3)).tolist() == [[1], [2]]
    assert adjacency.contacts(torch.tensor([0, 1, 2]))[0].tolist() == [[0, 1]]


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
    assert len(KnnAdjacency(cloud.neighbors).contacts(labels)[0]) == 0
    refined = refine_regions(cloud, labels, with_settings(merge_coplanar=True))
    assert torch.equal(refined, labels)


@pytest.mark.parametrize(
    ("gap", "step", "merged"), [(0.03, 0.0, True), (0.2, 0.0, False), (0.03, 0.01, False)]
)
def test_halves_of_a_rim_are_merged_though_other_faces_are_nearer(gap, step, merged):
    """The rim of a plate of 4 cm, two or three rows of points, broken in the middle."""
    rng = np.random.default_rng(12)
    top, bottom = (sheet(rng, 3000, 0.001) * (1.2, 0.4, 1) for _ in range(2))
    rim = (sheet(rng, 300, 0.001) * (1.2, -0.04, 1))[:, [0, 2, 1]]
    rim[:, 1] -= step * (rim[:, 0] > 0.6)
    bottom[:, 2] -= 0.04
    parts = np.where(abs(rim[:, 0] - 0.6) < gap / 2, UNLABELED, rim[:, 0] > 0.6)
    faces = np.concatenate([np.full(3000, 2), np.full(3000, 3), parts])
    normals = np.repeat(np.eye(3)[[2, 2, 1]], [3000, 3000, 300], axis=0)
    cloud, order = flat_cloud(np.concatenate([top, bottom, rim]), k=50, normals=normals)
    labels = torch.from_numpy(faces)[order]
    pairs, counts = KnnAdjacency(cloud.neighbors).contacts(labels)
    assert counts[(pairs == torch.tensor([0, 1])).all(dim=1)].sum() < MIN_CONTACTS
    refined = refine_regions(cloud, labels, with_settings(merge_coplanar=True))
    assert bool((refined == torch.where(labels == 1, 0, labels)).all()) == merged
    assert merged or torch.equal(refined, labels)


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_a_step_or_a_bend_is_not_merged(noise):
    rng = np.random.default_rng(8)
    step, bend = sheet(rng, 3000, noise), sheet(rng, 3000, noise)
    step[:, 2] += 0.01 * (step[:, 0] > 0.5)
    bend[:, 2] += 0.2 * np.maximum(bend[:, 0] - 0.5, 0)
    for points in (step, bend):
        cloud, _ = flat_cloud(points)
        labels = (cloud.points[:, 0] > 0.5).long()
        assert len(KnnAdjacency(cloud.neighbors).contacts(labels)[0]) == 1
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


def faceted_face(rng, height, bend):
    """Points exactly on the facets of a mesh of a face that bends, and the number of their facet.

    The corners of the facets, 20 cm apart, are off by some height.
    """
    corners = np.stack(np.meshgrid(np.arange(11.0), np.arange(11.0), indexing="ij"), axis=2) * 0.2
    heights = rng.uniform(-height, height, (11, 11)) + bend * corners[:, :, 0] ** 2
    cell, (u, v) = rng.integers(0, 10, (20_000, 2)), rng.uniform(0, 1, (2, 20_000))
    lower = u + v < 1
    x, y = cell.T
    across = heights[x + 1, y], heights[x, y + 1]
    base = np.where(lower, heights[x, y], heights[x + 1, y + 1])
    first, second = np.where(lower, u, 1 - v), np.where(lower, v, 1 - u)
    z = base + first * (across[0] - base) + second * (across[1] - base)
    points = np.stack([0.2 * (x + u), 0.2 * (y + v), z], axis=1)
    return points, (10 * x + y) * 2 + lower


@pytest.mark.parametrize("height", [0.005, 0.012])
def test_facets_of_a_flat_face_become_one_and_those_of_a_bend_do_not(height):
    rng = np.random.default_rng(17)
    config = with_settings(min_size=100, facet_tolerance=0.009)
    for bend, fewest, most in ((0.0, 1, 1), (0.2, 3, 25)):
        points, facet = faceted_face(rng, height, bend)
        cloud, order = flat_cloud(points)
        grown = torch.from_numpy(facet)[order]
        assert label_regions(cloud, grown, with_settings(), 4096).max() == 199
        found = label_regions(cloud, grown, config, 4096)
        assert fewest <= int(found.max()) + 1 <= most
        planes = fit_regions(cloud, found, config)
        assert planes.rms.max() < 0.009


def test_a_thin_side_is_no_facet_of_the_face_beside_it():
    rng = np.random.default_rng(18)
    front, side = sheet(rng, 3000, 0.0), sheet(rng, 300, 0.0)
    side = np.stack([1 + side[:, 2], side[:, 1], -0.01 * side[:, 0]], axis=1)
    points = np.concatenate([front, side])
    cloud, order = flat_cloud(points)
    labels = (order >= 3000).long()
    contacts = KnnAdjacency(cloud.neighbors).contacts(labels)
    planes = fit_regions(cloud, labels, OFF)
    config = with_settings(facet_tolerance=0.009, faceted=True)
    assert len(merge_facets(labels, contacts, planes, config).unique()) == 2


@pytest.mark.parametrize(
    ("step", "faceted", "faces"),
    [(0.012, True, 1), (0.035, True, 2), (0.035, False, 1), (0.06, False, 2)],
)
def test_a_plane_across_a_step_does_not_explain_the_boards_beside_it(step, faceted, faces):
    rng = np.random.default_rng(19)
    upper, lower = (rng.uniform(0, 1, (3000, 3)) * (1.74, 0.29, 0) for _ in range(2))
    points = np.concatenate([upper + np.array([0, 0.295, step]), lower])
    cloud, order = flat_cloud(points)
    labels = (order >= 3000).long()
    contacts = KnnAdjacency(cloud.neighbors).contacts(labels)
    planes = fit_regions(cloud, labels, OFF)
    both = points - points.mean(axis=0)
    across = both @ np.linalg.svd(both, full_matrices=False)[2][2]
    is_near = np.sqrt(np.mean(across**2)) < 0.009
    assert is_near == (step < 0.06)
    found = merge_facets(
        labels, contacts, planes, with_settings(facet_tolerance=0.009, faceted=faceted)
    )
    assert len(found.unique()) == faces


@pytest.mark.parametrize(
    ("thickness", "warp", "reach", "faces"),
    [(0.04, 0.0, 0.006, 2), (0.04, 0.0, 0.012, 1), (0.0, 0.02, 0.006, 1)],
)
def test_a_warp_bends_a_face_and_the_two_sides_of_a_plate_stay_two(thickness, warp, reach, faces):
    rng = np.random.default_rng(20)
    points = sheet(rng, 3000)
    left = points[:, 0] < 0.5
    # The halves of a wave are bent the other way, and side by side; the sides of a plate overlap.
    points[:, 2] += warp * np.sin(2 * np.pi * points[:, 0])
    points += np.outer(left, [0.5 * (thickness > 0), 0, thickness])
    cloud, order = flat_cloud(points)
    labels = torch.from_numpy(left)[order].long()
    planes = fit_regions(cloud._replace(reach=torch.full((3000,), reach)), labels, OFF)
    contacts = torch.tensor([[0, 1]]), torch.tensor([MIN_CONTACTS])
    config = with_settings(facet_tolerance=0.03, faceted=True)
    assert len(merge_facets(labels, contacts, planes, config).unique()) == faces


def scattered(rng, count, angle_deg):
    """Upward normals that are off by some degrees along both axes."""
    slopes = np.tan(np.radians(angle_deg)) * rng.normal(size=(count, 2))
    normals = np.concatenate([slopes, np.ones((count, 1))], axis=1)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("scatter_deg", [0.0, 12.0])
def test_what_lies_within_the_noise_of_a_larger_face_is_part_of_it(scatter_deg):
    rng = np.random.default_rng(13)
    points = sheet(rng, 4000, 0.003)
    patch = (np.abs(points[:, :2] - 0.5) < 0.1).all(axis=1)
    points[patch, 2] = points[patch, 2] / 10 + 0.03 * (points[patch, 0] - 0.5)
    lifted = points + np.outer(patch, [0, 0, 0.009])
    normals = np.tile([0.0, 0.0, 1.0], (4000, 1))
    normals[patch] = scattered(rng, int(patch.sum()), scatter_deg)
    config = with_settings(merge_coplanar=True, plane_reach=4.0)
    reach = torch.full((4000,), 4 * 0.003)
    for coordinates, noise, regions in (
        (points, reach, 1),
        (lifted, reach, 2),
        (points, reach / 4, 2),
    ):
        cloud, order = flat_cloud(coordinates, normals=normals)
        labels = torch.from_numpy(patch)[order].long()
        refined = refine_regions(cloud._replace(reach=noise), labels, config)
        assert len(refined.unique()) == regions


@pytest.mark.parametrize(("scatter_deg", "kept"), [(1.0, True), (4.0, False)])
def test_a_face_that_is_large_enough_with_its_border_counts_if_its_normals_agree(scatter_deg, kept):
    rng = np.random.default_rng(14)
    points = sheet(rng, 60)
    inner = np.abs(points[:, 0] - 0.5) < 0.3
    assert 30 < inner.sum() < 50
    cloud, order = flat_cloud(points, normals=scattered(rng, 60, scatter_deg))
    labels = torch.where(torch.from_numpy(inner)[order], 0, UNLABELED)
    refined = refine_regions(cloud, labels, with_settings(absorb=True, min_size=50))
    assert int((refined == 0).sum()) >= 50 if kept else bool((refined == UNLABELED).all())


def test_a_region_grows_large_enough_by_what_it_absorbs():
    points = sheet(np.random.default_rng(15), 60)
    border = np.abs(points[:, 0] - 0.5) > 0.3
    normals = np.where(border[:, None], [0.5, 0, 0.75**0.5], [0.0, 0, 1.0])
    points, normals = torch.tensor(points), torch.tensor(normals)
    curvature, neighbors = torch.from_numpy(border).double(), search_knn(points, 16)
    plain, absorbing = with_settings(min_size=50), with_settings(min_size=50, absorb=True)
    assert (grow_regions(points, normals, curvature, neighbors, plain) == UNLABELED).all()
    assert (grow_regions(points, normals, curvature, neighbors, absorbing) == 0).sum() >= 50


@pytest.mark.parametrize("unit", [1e3])
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
