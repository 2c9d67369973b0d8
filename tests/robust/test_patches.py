"""Robust fits of many patches at a time."""

import pytest
import torch

from torchrg.robust import fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve, qn


def assert_equal_fits(found, expected):
    for name, field in found._asdict().items():
        assert torch.equal(field, getattr(expected, name)), name


def test_result_does_not_depend_on_chunks_and_batch(estimator, patches):
    fit = estimator(patches)
    assert_equal_fits(estimator(patches, chunk_size=4), fit)
    assert_equal_fits(estimator(patches[1]), type(fit)(*(field[1] for field in fit)))
    assert_equal_fits(
        estimator(patches.flip(0).reshape(1, 3, 2, 40, 3)),
        type(fit)(*(f.flip(0).reshape(1, 3, 2, *f.shape[1:]) for f in fit)),
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
    far = 1.0 if patches.dtype == torch.float32 else 2.0**16
    shift = far * torch.tensor([64.0, -128.0, 32.0], dtype=patches.dtype)
    fit, moved = estimator(patches), estimator(patches + shift)
    assert torch.equal(moved.location, fit.location + shift)
    for name in ("covariance", "support", "sq_distances", "raw_covariance", "log_det"):
        assert torch.equal(getattr(moved, name), getattr(fit, name)), name


def test_powers_of_two_scale_bit_for_bit(estimator, patches):
    unit = 2.0 ** (20 if patches.dtype == torch.float32 else -20)
    fit, scaled = estimator(patches), estimator(patches * unit)
    assert torch.equal(scaled.location, fit.location * unit)
    assert torch.equal(scaled.covariance, fit.covariance * unit * unit)
    for name in ("support", "sq_distances", "raw_support"):
        assert torch.equal(getattr(scaled, name), getattr(fit, name)), name


@pytest.mark.parametrize("fit", [fit_detmcd, fit_fastmcd, fit_mve, fit_dets, fit_detmm])
def test_few_points_warn_and_columns_are_named(fit, rng):
    match = f"{fit.__name__}: expected at least 10 points per patch for 5 coordinates, got 9"
    with pytest.warns(UserWarning, match=match):
        fit(torch.randn(2, 9, 5, generator=rng))
    with pytest.warns(UserWarning, match=r"got 3: .*; pass patches.mT if points are columns"):
        fit(torch.randn(3, 8, generator=rng))
    # Enough points, planes alone, and no patches.
    fit(torch.randn(2, 10, 5, generator=rng))
    fit(torch.randn(2, 5, 3, generator=rng), min_dimension=2)
    fit(torch.empty(0, 4, 3))


def test_few_points_warn_under_vmap_and_compilers(rng):
    patches = torch.randn(2, 9, 5, generator=rng)
    compiled = torch.compile(lambda x: fit_detmcd(x).covariance, fullgraph=True, backend="eager")
    for transformed in (torch.vmap(lambda x: fit_detmcd(x).covariance), compiled):
        with pytest.warns(UserWarning, match="too few to trust the covariance"):
            transformed(patches)


def test_a_covariance_beyond_the_largest_number_is_not_valid(estimator, dtype, rng):
    patches = torch.randn(2, 30, 3, generator=rng, dtype=dtype)
    patches[1] *= 0.1 * torch.finfo(dtype).max
    fit = estimator(patches)
    assert fit.valid.tolist() == [True, False]
    assert fit.covariance.isfinite().all()
    assert not fit.support[1].any()
    assert torch.equal(fit.location[0], estimator(patches[0]).location)


def test_a_fit_is_shown_in_one_line(rng):
    fit = fit_detmcd(torch.randn(2, 4, 30, 3, generator=rng))
    assert repr(fit) == "RobustFit((2, 4) patches, 30 points, 3 coordinates)"


def test_a_raw_covariance_beyond_the_largest_number_is_not_valid(dtype, rng):
    patches = torch.randn(40, 12, 3, generator=rng, dtype=dtype)
    fit = fit_detmcd(patches)
    raw, final = (m.abs().amax(dim=(1, 2)).double() for m in (fit.raw_covariance, fit.covariance))
    row = int((raw / final).argmax())
    assert raw[row] > 1.5 * final[row]
    # Between both: the final covariance alone would fit.
    scale = (torch.finfo(dtype).max / (raw[row] * final[row]).sqrt()).sqrt()
    assert not fit_detmcd(patches[row] * float(scale)).valid
    assert fit_detmcd(patches[row] * float(scale) / 2).valid
