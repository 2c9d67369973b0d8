import pytest
import torch

from tests.robust.oracle_cases import ESTIMATORS
from torchrg.robust import fit_detmcd, qn
from torchrg.robust.lanes import smallest_points
from torchrg.robust.scale import sum_points


@pytest.fixture
def patches(rng, dtype):
    """Thin patches with outliers, coordinates on a grid: differences are exact."""
    points = torch.randn(12, 40, 3, generator=rng, dtype=torch.float64)
    points[..., 2] *= 0.1
    points[:, :12, 2] += 1.5
    return ((points * 256).round() / 256).to(dtype)


def assert_equal_fits(found, expected):
    for name, field in found._asdict().items():
        assert torch.equal(field, getattr(expected, name)), name


def test_batch_is_a_loop_of_singles(estimator, patches):
    fit = estimator(patches)
    for row in range(0, 12, 5):
        single = estimator(patches[row])
        assert_equal_fits(single, type(fit)(*(field[row] for field in fit)))


def test_result_does_not_depend_on_chunks_and_batch(estimator, patches):
    fit = estimator(patches)
    for chunk_size in (1, 5):
        assert_equal_fits(estimator(patches, chunk_size=chunk_size), fit)
    assert_equal_fits(
        estimator(patches.flip(0).reshape(2, 3, 2, 40, 3)),
        type(fit)(*(f.flip(0).reshape(2, 3, 2, *f.shape[1:]) for f in fit)),
    )


def test_result_does_not_depend_on_threads(patches, set_threads):
    results = []
    for threads in (1, 3):
        set_threads(threads)
        results.append((fit_detmcd(patches, chunk_size=5), qn(patches.repeat(80, 1, 1))))
    assert torch.get_num_threads() == 3
    assert_equal_fits(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_exact_shifts_change_nothing_but_the_location(estimator, patches):
    shift = torch.tensor([64.0, -128.0, 32.0], dtype=patches.dtype)
    fit, moved = estimator(patches), estimator(patches + shift)
    assert torch.equal(moved.location, fit.location + shift)
    for name in ("covariance", "support", "sq_distances", "raw_covariance", "log_det"):
        assert torch.equal(getattr(moved, name), getattr(fit, name)), name


@pytest.mark.parametrize("power", [-20, 20])
def test_powers_of_two_scale_bit_for_bit(estimator, patches, power):
    unit = 2.0**power
    fit, scaled = estimator(patches), estimator(patches * unit)
    assert torch.equal(scaled.location, fit.location * unit)
    assert torch.equal(scaled.covariance, fit.covariance * unit * unit)
    for name in ("support", "sq_distances", "raw_support"):
        assert torch.equal(getattr(scaled, name), getattr(fit, name)), name


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_other_units_and_far_origins_change_no_inlier(estimator, patches, unit):
    patches = patches.double()
    fit = estimator(patches)
    assert torch.equal(estimator(patches * unit).support, fit.support)
    assert torch.equal(estimator(patches + 4e6).support, fit.support)


@pytest.mark.parametrize("name", ["paper", "dets", "detmm"])
def test_order_of_the_points_changes_nothing(name, patches, rng):
    order = torch.randperm(40, generator=rng)
    fit, shuffled = ESTIMATORS[name](patches), ESTIMATORS[name](patches[:, order])
    close = {"rtol": 1e-4, "atol": 1e-6} if patches.dtype == torch.float32 else {}
    assert torch.equal(shuffled.support, fit.support[:, order])
    if name == "paper":
        assert torch.equal(shuffled.raw_support, fit.raw_support[:, order])
    torch.testing.assert_close(shuffled.location, fit.location, **close)
    torch.testing.assert_close(shuffled.covariance, fit.covariance, **close)


def test_axes_may_be_scaled_apart(patches):
    scale = torch.tensor([4.0, 1.0, 0.5], dtype=patches.dtype)
    fit, scaled = fit_detmcd(patches), fit_detmcd(patches * scale)
    assert torch.equal(scaled.raw_support, fit.raw_support)
    assert torch.equal(scaled.support, fit.support)


def test_subsets_of_tied_distances_have_exactly_h_points(rng):
    distances = torch.randint(0, 4, (50, 300), generator=rng).float()
    for size in (1, 25, 27, 49, 50):
        marked = smallest_points(distances, size)
        assert (marked.sum(dim=0) == size).all()
        kept = torch.where(marked > 0, distances, -1).amax(dim=0)
        left = torch.where(marked > 0, torch.inf, distances).amin(dim=0)
        assert (kept <= left).all()
        if size < 50:
            # Of the points at the limit the first ones are taken.
            indices = torch.arange(50)[:, None]
            tied = distances == kept
            last_in = torch.where(tied & (marked > 0), indices, -1).amax(dim=0)
            first_out = torch.where(tied & (marked == 0), indices, 50).amin(dim=0)
            assert (last_in < first_out).all()


def test_sums_do_not_depend_on_the_place_of_a_lane(dtype, rng):
    values = torch.randn(53, 37, generator=rng, dtype=dtype)
    expected = sum_points(values)
    for start in range(0, 37, 5):
        for stop in (start + 1, start + 2, 37):
            assert torch.equal(sum_points(values[:, start:stop]), expected[start:stop])
    assert torch.equal(sum_points(values.t().contiguous().t()), expected)
