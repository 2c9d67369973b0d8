"""Density and directions of surfaces that are known."""

import pytest
import torch

from torchrg.render.surface import sample_rows, sample_surface


def plane_grid(step, count=60):
    line = torch.arange(count) * step
    return torch.cartesian_prod(line, line, torch.zeros(1))


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e3])
def test_spacing_of_a_regular_grid_is_its_step(scale):
    spacing = sample_surface(plane_grid(0.02 * scale)).spacing
    assert 0.7 < float(spacing.median()) / (0.02 * scale) < 1.3
    assert float(spacing.amax()) < 0.04 * scale


def test_spacing_follows_the_local_density():
    dense, sparse = plane_grid(0.01), plane_grid(0.1) + torch.tensor([20.0, 0, 0])
    surface = sample_surface(torch.cat([dense, sparse]))
    is_dense = surface.rows < len(dense)
    assert 0.7 < float(surface.spacing[is_dense].median()) / 0.01 < 1.3
    assert 0.7 < float(surface.spacing[~is_dense].median()) / 0.1 < 1.3


def test_spacing_along_a_line_is_its_step():
    line = torch.arange(200.0)[:, None] * torch.tensor([0.6, 0.8, 0.0])
    assert 0.8 < float(sample_surface(line).spacing.median()) < 1.3


def test_only_discs_in_planes_grow_where_points_are_sparse(rng):
    dense, sparse = plane_grid(0.01), plane_grid(0.03) + torch.tensor([5.0, 0, 0])
    stray = 3 * torch.rand(40, 3, generator=rng) + torch.tensor([0.0, 3, 1])
    surface = sample_surface(torch.cat([dense, sparse, stray]))
    usual, kind = (
        surface.spacing.median(),
        torch.bucketize(
            surface.rows, torch.tensor([len(dense), len(dense) + len(sparse)]), right=True
        ),
    )
    assert surface.spacing[kind == 2].median() > 4 * usual
    for labels in (kind, torch.where(kind == 2, -1, kind)):
        found = surface.disc_spacing(labels)
        assert torch.equal(found[kind < 2], surface.spacing[kind < 2].clamp(max=4 * usual))
        assert (found[kind == 2] <= usual).double().mean() > 0.8
    assert (surface.disc_spacing(torch.where(kind == 2, -1, kind))[kind == 2] <= usual).all()


def test_duplicates_count_once(rng):
    points = torch.rand(3000, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.0])
    once, many = sample_surface(points), sample_surface(points.repeat(5, 1))
    assert torch.equal(once.spacing.repeat_interleave(5), many.spacing)
    assert torch.equal(once.centers, many.centers)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_spacing_of_one_place_is_zero(count):
    surface = sample_surface(torch.ones(count, 3))
    assert surface.spacing.tolist() == [0] * count
    assert not surface.normals.any()


def test_nothing_depends_on_the_order_of_the_points(rng):
    points = torch.randn(5000, 3, generator=rng)
    order = torch.randperm(5000, generator=rng)
    one, other = sample_surface(points), sample_surface(points[order])
    assert torch.equal(order[other.rows], one.rows)
    for name in ("points", "spacing", "voxel_of", "first", "centers", "normals"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_voxels_are_the_means_of_their_points(rng):
    surface = sample_surface(torch.rand(4000, 3, generator=rng))
    counts = torch.bincount(surface.voxel_of)
    assert 2 <= float(counts.double().mean()) < 16
    means = torch.zeros(len(counts), 3).index_add_(0, surface.voxel_of, surface.points)
    torch.testing.assert_close(surface.centers, means / counts[:, None], atol=2e-6, rtol=0)
    assert torch.equal(surface.voxel_of[surface.first], torch.arange(len(counts)))
    away = (surface.points - surface.centers[surface.voxel_of]).abs()
    assert float(away.amax()) < surface.size


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_voxels_of_a_tilted_plane_have_its_normal(rng, offset):
    flat = torch.rand(20_000, 2, generator=rng, dtype=torch.float64)
    basis = torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float64))[0]
    noise = 0.001 * torch.randn(20_000, 1, generator=rng, dtype=torch.float64)
    surface = sample_surface(torch.cat([flat, noise], dim=1) @ basis.T + offset)
    cosine = (surface.normals.double() @ basis[:, 2]).abs()
    assert float(cosine.median()) > 0.999
    assert float((cosine > 0.99).double().mean()) > 0.95


def test_a_sample_is_even_whatever_the_density_and_the_order(monkeypatch):
    monkeypatch.setattr("torchrg.render.surface.MAX_DISCS", 2**10)
    rng = torch.Generator().manual_seed(3)
    dense = torch.rand(20_000, 3, generator=rng) * torch.tensor([1.0, 1, 0])
    sparse = torch.rand(2000, 3, generator=rng) * torch.tensor([1.0, 1, 0]) + torch.tensor(
        [1.0, 0, 0]
    )
    far = torch.tensor([[50.0, 50, 50], [torch.nan, 0, 0]])
    points = torch.cat([dense, sparse, far])
    rows = sample_rows(points)
    assert 2**9 <= len(rows) <= 2**10
    assert bool(points[rows].isfinite().all())
    left = float((points[rows][:, 0] < 1).float().mean())
    assert 0.4 < left < 0.65
    order = torch.randperm(len(points), generator=rng)
    again = points[order][sample_rows(points[order])]
    assert {tuple(p) for p in again.tolist()} == {tuple(p) for p in points[rows].tolist()}
