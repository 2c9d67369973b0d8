"""The sparse grid: codes, density, cells."""

import pytest
import torch

from torchrg.render.grid import (
    build_grid,
    gather_bits,
    local_spacing,
    spread_bits,
    surface_cells,
)


def plane_grid(step, count=60):
    line = torch.arange(count) * step
    return torch.cartesian_prod(line, line, torch.zeros(1))


def test_morton_codes_hold_the_bits_of_three_numbers(rng):
    numbers = torch.randint(0, 2**16, (500, 3), generator=rng)
    codes = sum(spread_bits(numbers[:, axis]) << axis for axis in range(3))
    for code, triple in zip(codes.tolist(), numbers.tolist(), strict=True):
        bits = "".join(
            str(triple[axis] >> bit & 1) for bit in reversed(range(16)) for axis in (2, 1, 0)
        )
        assert code == int(bits, 2)
    assert torch.equal(torch.stack([gather_bits(codes >> a) for a in range(3)], 1), numbers)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e3])
def test_spacing_of_a_regular_grid_is_its_step(scale):
    spacing = local_spacing(build_grid(plane_grid(0.02 * scale)))
    assert 0.7 < float(spacing.median()) / (0.02 * scale) < 1.3
    assert float(spacing.amax()) < 0.04 * scale


def test_spacing_follows_the_local_density(rng):
    dense, sparse = plane_grid(0.01, 100), plane_grid(0.1, 100) + torch.tensor([20.0, 0, 0])
    grid = build_grid(torch.cat([dense, sparse]))
    spacing = local_spacing(grid)
    is_dense = grid.rows < len(dense)
    assert 0.7 < float(spacing[is_dense].median()) / 0.01 < 1.3
    assert 0.7 < float(spacing[~is_dense].median()) / 0.1 < 1.3


def test_spacing_along_a_line_is_its_step():
    line = torch.arange(200.0)[:, None] * torch.tensor([0.6, 0.8, 0.0])
    assert 0.8 < float(local_spacing(build_grid(line)).median()) < 1.3


def test_duplicates_count_once(rng):
    points = torch.rand(3000, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.0])
    grid, doubled = build_grid(points), build_grid(points.repeat(5, 1))
    for once, many in zip(grid.levels, doubled.levels, strict=True):
        assert torch.equal(once.moments, many.moments)
    assert torch.equal(local_spacing(grid).repeat_interleave(5), local_spacing(doubled))


def test_spacing_of_one_place_is_zero():
    assert local_spacing(build_grid(torch.ones(7, 3))).tolist() == [0] * 7
    assert local_spacing(build_grid(torch.ones(0, 3))).tolist() == []


def test_levels_do_not_depend_on_the_order_of_the_points(rng):
    points = torch.randn(5000, 3, generator=rng)
    first, second = build_grid(points), build_grid(points[torch.randperm(5000, generator=rng)])
    assert len(first.levels) == len(second.levels)
    for one, other in zip(first.levels, second.levels, strict=True):
        assert torch.equal(one.codes, other.codes)
        assert torch.equal(one.moments, other.moments)


def test_first_level_has_the_moments_of_its_voxels(rng):
    points = torch.rand(4000, 3, generator=rng)
    grid = build_grid(points)
    level = grid.levels[0]
    sums = torch.zeros(len(level.codes), 3).double()
    sums.index_add_(0, grid.cell_of, grid.points.double() / grid.voxel_size - 0.5)
    counts = torch.bincount(grid.cell_of)
    assert torch.equal(counts, level.counts)
    means = level.moments[:3].double() / level.counts
    torch.testing.assert_close(means.T, sums / counts[:, None], atol=0.51, rtol=0)
    second = level.moments[6].double()
    x, y = ((grid.points[:, a] / grid.voxel_size).long().clamp(max=65535) for a in (0, 1))
    expected = torch.zeros_like(second).index_add_(0, grid.cell_of, (x * y).double())
    torch.testing.assert_close(second, expected)


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_cells_of_a_tilted_plane_have_its_normal(rng, offset):
    flat = torch.rand(40_000, 2, generator=rng, dtype=torch.float64)
    basis = torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float64))[0]
    noise = 0.001 * torch.randn(40_000, 1, generator=rng, dtype=torch.float64)
    points = torch.cat([flat, noise], dim=1) @ basis.T + offset
    grid = build_grid(points)
    cells = surface_cells(grid)
    known = (cells.normals != 0).any(dim=1)
    assert float(known[cells.cell_of].double().mean()) > 0.8
    cosine = (cells.normals[known].double() @ basis[:, 2]).abs()
    assert float(cosine.median()) > 0.999
    middles = torch.zeros(len(cells.centers), 3).index_add_(0, cells.cell_of, grid.points)
    counts = torch.bincount(cells.cell_of, minlength=len(middles))
    torch.testing.assert_close(
        cells.centers, middles / counts[:, None], atol=float(grid.voxel_size), rtol=0
    )


def test_noise_makes_cells_larger(rng):
    flat = torch.rand(60_000, 2, generator=rng)
    sizes = []
    for noise in (0.0, 0.01):
        height = noise * torch.randn(60_000, 1, generator=rng)
        sizes.append(surface_cells(build_grid(torch.cat([flat, height], dim=1))).size)
    assert sizes[1] > sizes[0]
