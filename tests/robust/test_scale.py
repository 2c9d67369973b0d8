import itertools
import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernels.clouds import both, needs_library
from tests.robust.oracle_cases import load_oracles
from torchrg.errors import ShapeError
from torchrg.robust import mad, median, qn, qn_exceeds, tau
from torchrg.robust.scale import (
    qn_sample_factor,
    sum_points,
)


def literal_qn(values):
    """The definition: every pair, sorted, the C(h, 2)-th."""
    n = len(values)
    h = n // 2 + 1
    pairs = sorted(abs(a - b) for a, b in itertools.combinations(values, 2))
    return 2.2219 * pairs[math.comb(h, 2) - 1]


def assert_close(found, expected, tolerance):
    expected = np.asarray(expected, dtype=np.float64)
    np.testing.assert_allclose(np.asarray(found, np.float64), expected, rtol=tolerance, atol=0)


def test_qn_agrees_with_other_implementations(oracles_folder):
    patches, _, ours, robustbase = load_oracles(oracles_folder, "ref_numpy", "r_robustbase")
    assert len(patches) == 75
    for name, patch in patches.items():
        columns = torch.from_numpy(patch)
        raw = qn(columns, dim=0) / 2.2219
        theirs = robustbase[name]["Qn"]
        assert_close(raw, ours[name]["qn"]["raw_order_stat"], 1e-12)
        assert_close(qn(columns, dim=0), theirs["const22219_nofinite"], 1e-6)
        assert_close(qn(columns, dim=0, finite_sample=True), theirs["default"], 1e-6)
        assert_close(mad(columns, dim=0), theirs["mad"], 1e-12)
        assert_close(median(columns, dim=0), theirs["median"], 1e-12)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 9, 12, 13, 36, 37, 49, 50, 51, 52, 53, 64])
def test_qn_is_its_definition(n, dtype, rng):
    rows = torch.randn(7, n, generator=rng, dtype=dtype)
    rows[1] = rows[1].round()
    rows[2, : n // 2 + 1] = 3.0
    rows[3] *= 10.0 ** torch.arange(n, dtype=dtype).clamp(max=12)
    expected = [literal_qn(row.tolist()) for row in rows]
    assert_close(qn(rows), expected, 4 * torch.finfo(dtype).eps)


@given(
    st.lists(
        st.one_of(st.sampled_from([0.0, 1.0, 1.5, -2.0]), st.floats(-1e6, 1e6, width=32)),
        min_size=2,
        max_size=53,
    )
)
@settings(max_examples=60, deadline=None)
def test_qn_is_its_definition_with_ties_and_mixed_magnitudes(values):
    row = torch.tensor(values, dtype=torch.float64)
    assert_close(qn(row), literal_qn(values), 1e-12)


def rows_of_all_kinds(n, dtype, rng):
    """Return rows with ties, several magnitudes, infinities, NaN and negative zeros."""
    rows = torch.randn(11, n, generator=rng, dtype=dtype)
    rows[1] = rows[1].mul(3).round()
    rows[2, : n // 2 + 1] = 3.0
    rows[3] *= 10.0 ** (torch.arange(n, dtype=dtype) % 12)
    rows[4, ::3], rows[4, 1::5] = torch.inf, -torch.inf
    rows[5, ::2] = torch.inf
    rows[6, n // 2] = torch.nan
    rows[7] = rows[7].mul(40).round() * torch.finfo(dtype).smallest_normal / 4
    rows[8] = rows[8].sign() * 0.0
    rows[9] = 0.9 * torch.finfo(dtype).max * rows[9].sign()
    rows[10] *= 1e-42
    return rows


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("n", [2, 3, 4, 7, 8, 9, 15, 16, 17, 50, 51, 300])
def test_kernels_find_qn_of_the_definition_to_the_bit(n, rng):
    found, expected = both(qn, rows_of_all_kinds(n, torch.float32, rng))
    assert torch.equal(found.nan_to_num(nan=-1.0), expected.nan_to_num(nan=-1.0))


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("n", [50, 200, 512])
def test_kernels_find_qn_where_windows_miss_it_or_overflow(n, rng):
    normal = torch.randn(8, n, generator=rng)
    clusters, half_tied = 50 * normal + 100, normal.clone()
    clusters[:, : n * 6 // 10], half_tied[:, : n * 45 // 100] = normal[:, : n * 6 // 10], 0
    heavy = normal * 10 ** (4 * torch.randn(8, n, generator=rng))
    tied = torch.cat([normal.mul(steps).round() for steps in (0.5, 3, 20, 100)])
    # Rows of one kind first, then rows of all kinds side by side.
    rows = torch.cat([clusters, half_tied, heavy, (3 * normal).exp(), tied])
    rows = torch.cat([rows, rows.view(8, 8, n).transpose(0, 1).reshape(-1, n)])
    found, expected = both(qn, rows)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 8, 9, 31, 32, 33, 100, 401, 402, 1200])
def test_qn_by_counting_pairs_is_that_by_listing_them(n, dtype, rng, monkeypatch):
    rows = rows_of_all_kinds(n, dtype, rng).requires_grad_()
    mask = torch.rand(rows.shape, generator=rng) < torch.linspace(0.5, 1, 11)[:, None]
    found = []
    for longest in (1, 1200):
        monkeypatch.setattr("torchrg.robust.scale._MAX_LISTED_VALUES", longest)
        values = qn(rows), qn(rows, mask=mask)
        batched = torch.vmap(lambda row, used: qn(row, mask=used))(rows.detach(), mask)
        assert torch.equal(batched.nan_to_num(), values[1].nan_to_num())
        known = torch.where(values[1].isfinite(), values[1], 0)
        found.append((*values, *torch.autograd.grad(known.sum(), rows)))
    for counted, listed in zip(*found, strict=True):
        torch.testing.assert_close(counted, listed, rtol=0, atol=0, equal_nan=True)


def test_qn_of_a_hundred_thousand_values(dtype):
    # The integers below n have n - d pairs with the difference d.
    n = 100_000
    pairs = np.cumsum(np.arange(n - 1, 0, -1))
    expected = 1 + np.searchsorted(pairs, math.comb(n // 2 + 1, 2))
    integers = torch.arange(n, dtype=dtype)[torch.randperm(n)]
    assert_close(qn(integers), 2.2219 * expected, 1e-7)


@given(
    st.lists(st.sampled_from([0.0, 0.25, 1.0, 1.5, 7.0]), min_size=1, max_size=52),
    st.sampled_from([0.0, 0.5, 2.2219 * 0.25, 2.2219, 5.0, math.inf]),
    st.sampled_from([torch.float32, torch.float64]),
)
@settings(max_examples=80, deadline=None)
def test_qn_exceeds_is_qn_greater_than_the_threshold(values, threshold, dtype):
    row = torch.tensor(values, dtype=dtype)
    assert qn_exceeds(row, threshold).item() == (qn(row) > threshold).item()


def test_qn_exceeds_next_to_the_threshold(dtype, rng):
    kind = np.float32 if dtype == torch.float32 else np.float64
    for threshold in torch.rand(100, generator=rng).tolist():
        step = kind(kind(threshold) / kind(2.2219))
        for length in (np.nextafter(step, kind(0)), step, np.nextafter(step, kind(9))):
            row = torch.tensor([0.0, float(length)], dtype=dtype)
            assert qn_exceeds(row, threshold).item() == (qn(row) > threshold).item()


@pytest.mark.parametrize("n", [2, 9, 16, 51, 300])
def test_values_left_by_a_mask_are_used_alone(n, dtype, rng):
    rows = rows_of_all_kinds(n, dtype, rng).repeat(3, 1)
    mask = torch.rand(rows.shape, generator=rng) < torch.linspace(0, 1.2, 33)[:, None]
    finite = torch.where(rows.isfinite(), rows, 1.0).requires_grad_()
    for function in (median, mad, qn, partial(qn, finite_sample=True), tau):
        found = function(rows, mask=mask)
        alone = torch.stack([function(r[m]) for r, m in zip(rows, mask, strict=True)])
        torch.testing.assert_close(found, alone, rtol=0, atol=0, equal_nan=True)
        total = function(finite, mask=mask)[mask.any(dim=1)].sum()
        (gradient,) = torch.autograd.grad(total, finite)
        assert gradient[~mask].eq(0).all()


def test_masked_values_do_not_count(dtype, rng):
    rows = torch.randn(12, 50, generator=rng, dtype=dtype)
    mask = torch.rand(12, 50, generator=rng) < torch.linspace(0, 1, 12)[:, None]
    spoiled = torch.where(mask, rows, torch.nan)
    for function in (median, mad, tau, qn, lambda x, **k: qn(x, finite_sample=True, **k)):
        found = function(spoiled, mask=mask)
        singles = torch.stack([function(r[m]) for r, m in zip(rows, mask, strict=True)])
        torch.testing.assert_close(found, singles, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(qn_exceeds(spoiled, 1.0, mask=mask), qn(spoiled, mask=mask) > 1.0)


def test_scales_of_few_values():
    empty, one = torch.zeros(3, 0), torch.tensor([[4.0]])
    assert qn(empty).isnan().all()
    assert median(empty).isnan().all()
    assert not qn_exceeds(empty, 1.0).any()
    assert qn(one).item() == 0
    assert mad(one).item() == 0
    assert tau(one).item() == 0
    assert tau(empty).isnan().all()


def test_nan_stays_in_its_row():
    rows = torch.arange(100.0).reshape(2, 50)
    rows[1, 3] = torch.nan
    for function in (median, mad, tau, qn):
        result = function(rows)
        assert result[0].isfinite()
        assert result[1].isnan()
    assert not qn_exceeds(rows, 0.0)[1]


def test_qn_of_a_row_does_not_depend_on_its_batch(dtype, rng):
    rows = torch.randn(300, 50, generator=rng, dtype=dtype)
    assert torch.equal(qn(rows), torch.stack([qn(row) for row in rows]))
    assert torch.equal(qn(rows.t(), dim=0), qn(rows))
    assert torch.equal(qn(rows.reshape(2, 150, 50)), qn(rows).reshape(2, 150))


def test_tau_agrees_with_statsmodels():
    # statsmodels.robust.scale.scale_tau(np.array(row))[1]
    rows = {
        1.744097372590729: [1.0, 2.0, 3.0, 4.0, 1000.0],
        1.3164607533630004: [0.3, -1.2, 5.0, 2.2, 0.1, 0.9, -0.4],
    }
    for expected, row in rows.items():
        assert_close(tau(torch.tensor(row, dtype=torch.float64)), expected, 1e-14)


def test_finite_sample_factor_tends_to_one():
    assert qn_sample_factor(1) == 1
    assert qn_sample_factor(2) == 0.399356
    assert 0.999 < qn_sample_factor(10_001) < qn_sample_factor(100_001) < 1


def test_refusals():
    with pytest.raises(ShapeError, match="qn: expected x of float32 or float64, got int64"):
        qn(torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ShapeError, match=r"median: expected x with an axis 2, got shape \(3,\)"):
        median(torch.zeros(3), dim=2)
    with pytest.raises(ShapeError, match=r"mad: expected mask of shape \(\*\) with \*=\(3,\)"):
        mad(torch.zeros(3), mask=torch.ones(4, dtype=torch.bool))


def test_sums_do_not_depend_on_the_place_of_a_lane(dtype, rng):
    values = torch.randn(53, 37, generator=rng, dtype=dtype)
    expected = sum_points(values)
    for start in range(0, 37, 5):
        for stop in (start + 1, start + 2, 37):
            assert torch.equal(sum_points(values[:, start:stop]), expected[start:stop])
    assert torch.equal(sum_points(values.t().contiguous().t()), expected)
