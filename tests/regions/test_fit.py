"""Planes fitted to regions, and whether regions are curved."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.regions.test_repair import OFF, flat_cloud, scattered, sheet, with_settings
from tests.regions.test_splits import CONFIG, bumpy
from torchrg import segment_planes
from torchrg.linalg.moments import Segments
from torchrg.regions.fit import RegionFits, canonicalize_sign, fit_planes, fit_regions


def test_planes_are_fitted_again_only_when_labels_have_changed():
    cloud, _ = flat_cloud(sheet(np.random.default_rng(0)))
    fits = RegionFits(cloud, OFF)
    labels = (cloud.points[:, 0] > 0.5).long()
    planes = fits.get(labels)
    assert fits.get(labels.clone()) is planes
    other = (cloud.points[:, 0] > 0.6).long()
    assert torch.equal(fits.get(other).center, fit_regions(cloud, other, OFF).center)


def test_an_arc_without_width_is_curved_although_it_lies_in_a_plane():
    turn = torch.linspace(0, 1.5, 200, dtype=torch.float64)
    normals = torch.stack([turn.sin(), 0 * turn, turn.cos()], dim=1)
    fit = fit_planes(Segments(torch.zeros(200, dtype=torch.int64)), 2 * normals, normals)
    assert fit.normal.abs()[0].tolist() == pytest.approx([0, 1, 0])
    assert fit.thickness.item() < 1e-9
    assert fit.curved.tolist() == [True]


@pytest.mark.parametrize("rounding", [-1e-9, 0.0, 1e-9])
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_last_of_the_largest_components_is_positive_within_rounding(rounding, sign):
    normals = torch.tensor([[1, -1, 0], [-1, 0.5, 1], [1, 1, -1], [-1, 0.9, 0.9]]).double()
    expected = torch.tensor([-1.0, 1, -1, -1])
    moved = sign * (normals + torch.tensor([rounding, 0, 0]).double())
    assert torch.equal(canonicalize_sign(moved), expected[:, None] * sign * moved)


def test_planes_of_large_regions_are_those_of_all_their_points():
    points = sheet(np.random.default_rng(11), 20_000)
    points[::2] = points[::2, [2, 1, 0]]
    cloud, order = flat_cloud(points)
    labels = order % 2
    normals = torch.eye(3, dtype=torch.float64)[torch.where(labels == 0, 0, 2)]
    cloud = cloud._replace(normals=normals)
    found = fit_regions(cloud, labels, OFF)
    full = fit_planes(Segments(labels), cloud.points, cloud.normals)
    assert found.num_points.tolist() == [10_000, 10_000]
    torch.testing.assert_close(found.thickness, full.thickness, rtol=0.03, atol=0)
    assert (found.normal * full.normal).sum(dim=1).min() > np.cos(np.radians(0.02))
    heights = [planes.signed_distances(cloud.points, labels).abs() for planes in (found, full)]
    assert (heights[0] - heights[1]).abs().max() < 1e-3


def test_faces_of_facets_are_at_least_as_thick_as_these_may_lie_apart():
    rng = np.random.default_rng(20)
    cloud, _ = flat_cloud(sheet(rng, 3000, 0.0))
    labels = torch.zeros(3000, dtype=torch.long)
    assert fit_regions(cloud, labels, with_settings()).thickness < 1e-3
    found = fit_regions(cloud, labels, with_settings(facet_tolerance=0.009))
    torch.testing.assert_close(found.thickness, torch.tensor([0.006], dtype=torch.float64))


def test_scattered_normals_make_a_region_curved_only_where_noise_does_not_explain_its_thickness():
    rng = np.random.default_rng(12)
    strip = sheet(rng, 400) * [1, 0.04, 1]
    cloud, _ = flat_cloud(strip, normals=scattered(rng, 400, 10.0))
    whole = torch.zeros(400, dtype=torch.int64)
    reach = torch.full((400,), 4 * 0.002)
    assert fit_regions(cloud, whole, OFF).curved.tolist() == [True]
    found = fit_regions(cloud._replace(reach=reach), whole, OFF)
    assert (found.curved.tolist(), found.bent.tolist()) == ([False], [False])
    assert found.noise.item() == pytest.approx(0.002, rel=0.2)
    for unknown in (reach / 4, torch.full_like(reach, torch.inf)):
        found = fit_regions(cloud._replace(reach=unknown), whole, OFF)
        assert (found.curved.tolist(), found.noise.tolist()) == ([True], [0.0])


@pytest.mark.parametrize("width", [0.2, 1.0])
def test_a_bend_is_thick_for_its_width_and_scatter_is_not(width):
    rng = np.random.default_rng(16)
    turn, along = rng.uniform(-0.3, 0.3, 2000), rng.uniform(0, 1, 2000)
    radius = width / 0.6
    arc = np.stack([radius * np.sin(turn), along, radius * np.cos(turn)], axis=1)
    normals = np.stack([np.sin(turn), 0 * turn, np.cos(turn)], axis=1)
    flat = sheet(rng, 2000) * [width, 1, 1]
    for points, own, curved in ((arc, normals, True), (flat, scattered(rng, 2000, 8.0), False)):
        segments = Segments(torch.zeros(2000, dtype=torch.int64))
        fit = fit_planes(segments, torch.tensor(points), torch.tensor(own))
        assert fit.curved.tolist() == [curved]


@pytest.mark.parametrize(("radius", "curved"), [(1e9, False), (0.5, True)])
def test_points_decide_whether_a_faceted_region_is_flat(radius, curved):
    points, normals = bumpy(np.random.default_rng(8), radius)
    cloud, _ = flat_cloud(points, normals=normals)
    labels = torch.zeros(len(points), dtype=torch.int64)
    for faceted, expected in ((True, curved), (False, True), ("auto", True)):
        config = dataclasses.replace(CONFIG, faceted=faceted)
        assert fit_regions(cloud, labels, config).curved.tolist() == [expected]


@pytest.mark.parametrize("num_points", [10, 30, 90])
def test_random_points_in_a_cube_are_no_flat_plane(num_points):
    for seed in range(4):
        points = torch.rand(num_points, 3, generator=torch.Generator().manual_seed(seed))
        assert segment_planes(points).planes.curved.all()


@pytest.mark.parametrize("size", [(1, 1, 0.0), (1, 1, 0.05), (1, 0.05, 0.01)])
def test_flat_and_long_points_stay_planes(size):
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(size)
    assert len(segment_planes(points, {"growing.min_size": 10}).planes) == 1
