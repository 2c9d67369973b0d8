"""Every kernel does what the function of torch does that stands next to it."""

import pytest
import torch

from tests.kernels.clouds import both, clouds, lists, needs_library
from torchrg.linalg import unsigned_angle_deg
from torchrg.normals.consensus.noise import _measure_neighborhoods, _neighbor_quantiles
from torchrg.normals.pca import fit_points_pca
from torchrg.robust.exact import find_flats
from torchrg.robust.lanes import columns_of_points, smallest_points
from torchrg.robust.mcd import _concentrate
from torchrg.robust.scale import _majority_difference
from torchrg.robust.starts import initial_sets

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")

CLOUDS = clouds()


@pytest.fixture(params=CLOUDS)
def name(request):
    return request.param


@pytest.fixture
def points(name):
    return CLOUDS[name]


@pytest.fixture(params=[False, True], ids=["all", "masked"])
def masked(request):
    return request.param


def assert_close(found, expected, unit, tolerance=1e-5):
    """Compare values, infinite ones and all, to a share of a unit for each row."""
    infinite = ~expected.isfinite()
    assert torch.equal(found[infinite], expected[infinite])
    error = torch.where(infinite, 0.0, (found - expected).abs())
    while unit.dim() < error.dim():
        unit = unit[:, None]
    assert (error <= tolerance * unit).all(), (error / unit).max()


def special_rows(n):
    """Sorted rows of n values: random, tied, constant, mixed magnitudes, infinite, with NaN."""
    generator = torch.Generator().manual_seed(n)
    rows = torch.randn(60, n, generator=generator)
    rows[10:20] = rows[10:20].round()
    rows[20:25] = 3.0
    rows[25:30] *= 10.0 ** torch.randint(-30, 30, (5, n), generator=generator)
    rows[30, 0] = torch.inf
    rows[31, -1] = -torch.inf
    rows[32, : n // 2] = torch.inf
    rows[33, 0] = torch.nan
    rows[34] = torch.tensor([-3e38, 3e38]).repeat(n)[:n]
    rows[35:40] *= 1e-42
    return rows.sort(dim=1).values


@pytest.mark.parametrize("n", [2, 3, 4, 7, 8, 9, 15, 16, 17, 50, 51, 300])
def test_differences_are_those_of_the_definition_to_the_bit(n):
    found, expected = both(_majority_difference, special_rows(n))
    assert torch.equal(found.nan_to_num(nan=-1.0), expected.nan_to_num(nan=-1.0))


def special_columns(n):
    """Columns of 70 patches of n points: random, tied, coinciding, flat, thin, tiny differences."""
    patches = torch.randn(70, n, 3, generator=torch.Generator().manual_seed(n))
    patches[10:20] = (2 * patches[10:20]).round()
    patches[20:30, : n * 55 // 100] = patches[20:30, :1]
    patches[30:40, : n * 6 // 10, 0] = 0
    patches[40:50, :, 2] *= 1e-5
    patches[50:60, ::3] *= 1e-30
    patches[60:65] = 0
    return columns_of_points(patches / patches.abs().amax(dim=(1, 2), keepdim=True).clamp(min=1))


SIZES = [2, 3, 4, 7, 8, 31, 50, 70]


@pytest.mark.parametrize("n", SIZES)
def test_smallest_points_are_those_of_the_definition(n):
    distances = special_columns(n)[0].square()
    for size in {1, -(-n // 2), n - 1, n}:
        found, expected = both(smallest_points, distances, size)
        assert torch.equal(found, expected)


@pytest.mark.parametrize("n", SIZES)
def test_flats_are_those_of_the_definition(n):
    tolerance = torch.full((70,), 1e-6)
    found, expected = both(find_flats, special_columns(n), tolerance, n // 2 + 1)
    assert torch.equal(found[0], expected[0])
    assert torch.equal(found[1], expected[1])
    assert n < 4 or 10 < (found[0] < 3).sum() < 60


@pytest.mark.parametrize("starts", ["paper", "robustbase"])
@pytest.mark.parametrize("n", SIZES)
def test_concentrated_starts_are_those_of_the_definition(n, starts):
    columns, size = special_columns(n), n // 2 + 1
    sets, expected_sets = both(initial_sets, columns, size, starts)
    assert torch.equal(sets[0], expected_sets[0])
    for initial in (sets[0], sets[0].repeat(1, 3, 1), sets[0][:, :1]):
        arguments = columns, initial, sets[1], size, torch.full((70,), 1e-12)
        for max_steps in (1, 100):
            found, expected = both(_concentrate, *arguments, max_steps)
            assert torch.equal(found.members, expected.members)
            assert torch.equal(found.determinants, expected.determinants)


def test_planes_of_all_neighbors_are_those_of_the_definition(name, points, masked):
    near = lists(points, 50, masked)
    found, expected = both(fit_points_pca, points, near)
    assert torch.equal(found.valid, expected.valid)
    values = torch.stack([expected.curvature, found.curvature])
    assert (values[0] - values[1]).abs().max() < 1e-5
    radius = (points[near.indices.long()] - points[:, None]).norm(dim=2).amax(dim=1)
    assert_close(found.residual_rms, expected.residual_rms, radius)
    # Where two directions are as thin as one another nothing tells them apart.
    clear = expected.valid & (expected.curvature < 0.2)
    angle = unsigned_angle_deg(found.normals, expected.normals)
    assert not (angle[clear] > 0.05).any()


def test_survey_is_that_of_the_definition(points, masked):
    near = lists(points, 50, masked)
    fit = fit_points_pca(points, near)
    found, expected = both(_measure_neighborhoods, points, near, fit.normals, fit.valid)
    radius = torch.where(expected[1] > 0, expected[1], 1.0)
    for place in (0, 1, 2):
        assert_close(found[place], expected[place], radius)
    for place in (5, 6):
        # Of neighbors spread equally along two directions any plane across them is the thinnest.
        equal = (found[place] - expected[place]).abs() <= 1e-5 * radius
        equal |= found[place].isinf() & expected[place].isinf()
        assert equal.float().mean() > 0.95
    # The deviations from two layers, and where places repeat.
    assert torch.equal(found[3], expected[3])
    assert torch.equal(found[4], expected[4])


def test_quantiles_of_neighbors_are_those_of_the_definition_to_the_bit(points, masked):
    near = lists(points, 50, masked)
    values = torch.randn(len(points), 3, generator=torch.Generator().manual_seed(2))
    values[::3, :2] = values[0, :2]
    values[::7, 1:] = torch.inf
    for quantile in (0.1, 0.35, 1.0):
        found, expected = both(_neighbor_quantiles, values, near, quantile)
        assert torch.equal(found, expected)
