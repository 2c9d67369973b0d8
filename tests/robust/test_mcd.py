import numpy as np
import pytest
import torch
from scipy.stats import chi2

from tests.robust.oracle_cases import (
    FLAT_IN_FLOAT32,
    FRACTIONS,
    LIBRA,
    angle_deg,
    fit_all,
    load_oracles,
    local_float32,
    normal_of,
    points_of,
)
from torchrg.errors import ConfigError, ShapeError
from torchrg.robust import fit_detmcd, fit_fastmcd
from torchrg.robust.mcd import _Concentrated, _distinct_best
from torchrg.robust.weights import consistency_factor, small_sample_factor

# The cases include patches of fewer than six points.
pytestmark = pytest.mark.filterwarnings("ignore:.*too few to trust the covariance")

CUTOFF = 9.348403604496148
"""Quantile 0.975 of the chi-square distribution of 3 degrees."""


def regular_fits(patches, cases, answers, key, **settings):
    """Yield fits of the cases in general position that the reference has an answer for."""
    for level, fraction in FRACTIONS.items():
        known = {}
        for name, points in patches.items():
            answer = answers[name].get(key.format(level), {})
            if "best" in answer and not cases[name][f"exact_fit_{level}"]:
                known[name] = points
        fits = fit_all(
            known, lambda batch, a=fraction: fit_detmcd(batch, support_fraction=a, **settings)
        )
        for name, fit in fits.items():
            yield name, fraction, fit, answers[name][key.format(level)]


def assert_close(found, expected, tolerance, name):
    expected = np.reshape(expected, (3, 3))
    assert np.abs(found - expected).max() < tolerance * np.abs(expected).max(), name


@pytest.mark.parametrize("starts", ["robustbase", "paper"])
def test_subset_weights_and_scatter_are_those_of_the_reference(oracles_folder, starts):
    patches, cases, ours = load_oracles(oracles_folder, "ref_numpy")
    seen = 0
    key = f"detmcd_{starts}_{{}}"
    for name, _, fit, answer in regular_fits(patches, cases, ours, key, starts=starts):
        assert points_of(fit.raw_support) == set(answer["best"]), name
        tolerance = 1e-6 if name.endswith("utm") else 1e-8
        assert abs(fit.log_det.item() - answer["logdet"]) < tolerance, name
        assert points_of(fit.support) == set(np.flatnonzero(answer["weights"])), name
        raw = fit.raw_covariance.numpy() / answer["raw_consistency"]
        factor = 1 if fit.support.all() else consistency_factor(0.975, 3)
        assert_close(raw, answer["raw_cov_uncorrected"], 1e-8, name)
        assert_close(fit.covariance.numpy() / factor, answer["cov_uncorrected"], 1e-8, name)
        seen += 1
    assert seen > 115


def final_factor(fraction):
    """c(q) of the guide to estimators, for P = 3."""
    return fraction / chi2.cdf(chi2.ppf(fraction, 3), 5) if fraction < 1 else 1.0


def test_robustbase_variant_agrees_with_robustbase(oracles_folder):
    patches, cases, robustbase = load_oracles(oracles_folder, "r_robustbase")
    seen = rescaled = 0
    settings = {"starts": "robustbase", "small_sample": True}
    for name, fraction, fit, answer in regular_fits(
        patches, cases, robustbase, "detmcd_{}", **settings
    ):
        assert points_of(fit.raw_support) == set(answer["best"]), name
        tolerance = 1e-6 if name.endswith("utm") else 1e-8
        assert abs(fit.log_det.item() - answer["crit"]) < tolerance, name
        n, m = len(fit.support), int(fit.support.sum())
        if n <= 6:
            continue  # its factor for few points is negative or above a hundred
        # The published factor has six digits.
        assert_close(fit.raw_covariance.numpy(), answer["raw_cov"], 1e-6, name)
        assert points_of(fit.support) == set(np.flatnonzero(answer["raw_weights"])), name
        factor = 1
        if m < n:
            factor = consistency_factor(0.975, 3)
            factor *= small_sample_factor(n, 3, fraction, reweighted=True)
        expected = np.asarray(answer["cov"]) / np.prod(answer["cnp2"])
        assert_close(fit.covariance.numpy() / factor, expected, 1e-8, name)
        # The answers are those of 0.95-0, whose final factor is that of the kept fraction.
        factor = final_factor(m / n) / final_factor(0.975) if m < n else 1.0
        assert_close(fit.covariance.numpy() * factor, answer["cov"], 1e-5, name)
        seen, rescaled = seen + 1, rescaled + (abs(factor - 1) > 0.02)
    assert seen > 110
    assert rescaled > 60


def test_final_flags_and_distances_are_those_of_robustbase(oracles_folder):
    patches, cases, robustbase = load_oracles(oracles_folder, "r_robustbase")
    seen = 0
    settings = {"starts": "robustbase", "small_sample": True, "inliers": "reweighted"}
    for name, fraction, fit, answer in regular_fits(
        patches, cases, robustbase, "detmcd_{}", **settings
    ):
        if len(fit.support) <= 6:
            continue  # its factor for few points is negative or above a hundred
        factor = 1
        if not all(answer["raw_weights"]):
            factor = consistency_factor(0.975, 3)
            factor *= small_sample_factor(len(fit.support), 3, fraction, reweighted=True)
        # Its covariance has another factor since that version; without factors they agree.
        expected = np.asarray(answer["mah"]) * np.prod(answer["cnp2"]) / factor
        # They invert matrices: those of thin patches and far origins lose digits.
        tolerance = 1e-4 if name.endswith("utm") else 1e-6
        np.testing.assert_allclose(fit.sq_distances, expected, rtol=tolerance, err_msg=name)
        assert points_of(fit.support) == set(np.flatnonzero(expected < CUTOFF)), name
        seen += 1
    assert seen > 110


@pytest.mark.parametrize(
    ("name", "trusted"),
    [
        ("planar_noisy", 0.5),
        ("curved_saddle", 0.5),
        ("edge120_60", 0.5),
        ("out30_uniform", 0.5),
        ("sphere", 0.9),
    ],
)
def test_covariances_of_scikit_learn_are_those_of_the_table_in_the_guide(
    oracles_folder, name, trusted, rng
):
    pytest.importorskip("sklearn", minversion="1.9")
    from sklearn.covariance import MinCovDet

    (patches, _) = load_oracles(oracles_folder)
    directions = torch.randn(24, 3, generator=rng, dtype=torch.float64)
    patches["sphere"] = torch.nn.functional.normalize(directions, dim=1).numpy()
    points = patches[name]
    fit = fit_fastmcd(torch.from_numpy(points), support_fraction=trusted)
    n, h, m = len(points), int(fit.raw_support.sum()), int(fit.support.sum())
    theirs = MinCovDet(random_state=0, support_fraction=(h + 0.5) / n).fit(points)
    assert np.array_equal(theirs.raw_support_, fit.raw_support.numpy())
    assert np.array_equal(theirs.support_, fit.support.numpy())
    assert (m == n) == (name == "sphere")
    raw = fit.raw_covariance.numpy() * (h - 1) / h / final_factor(h / n)
    assert_close(theirs.raw_covariance_, raw, 1e-8, name)
    final = fit.covariance.numpy() * (m - 1) / m * (final_factor(0.975) if m == n else 1)
    assert_close(theirs.covariance_, final, 1e-8, name)


def libra(points, best):
    """DetMCD.m of LIBRA from its best set on: raw scatter, and location, scatter, flags, rd^2."""
    n, h = len(points), len(best)

    def squared(center, scatter):
        offset = points - center
        return np.einsum("ij,jk,ik->i", offset, np.linalg.inv(scatter), offset)

    center, scatter = points[best].mean(axis=0), np.cov(points[best].T)
    raw = scatter * np.sort(squared(center, scatter))[h - 1] / chi2.ppf(h / n, 3)
    weights = squared(center, raw) <= chi2.ppf(0.975, 3)
    center, scatter = points[weights].mean(axis=0), np.cov(points[weights].T)
    distances = squared(center, scatter)
    return raw, center, scatter, distances <= chi2.ppf(0.975, 3), distances


def test_libra_variant_is_what_its_formulas_give(oracles_folder):
    patches, cases, ours = load_oracles(oracles_folder, "ref_numpy")
    seen = 0
    for name, _, fit, answer in regular_fits(patches, cases, ours, "detmcd_paper_{}", **LIBRA):
        if name.endswith("aniso_units") or cases[name]["n"] < 10:
            continue
        points = patches[name] - patches[name][0]
        raw, center, scatter, flags, distances = libra(points, answer["best"])
        assert_close(fit.raw_covariance.numpy(), raw, 1e-6, name)
        assert_close(fit.covariance.numpy(), scatter, 1e-8, name)
        np.testing.assert_allclose(
            fit.location.numpy() - patches[name][0], center, atol=1e-8, err_msg=name
        )
        np.testing.assert_allclose(fit.sq_distances, distances, rtol=1e-4, err_msg=name)
        assert points_of(fit.support) == set(np.flatnonzero(flags)), name
        seen += 1
    assert seen > 100


@pytest.mark.parametrize("starts", ["robustbase", "paper"])
def test_float32_finds_the_same_subset(oracles_folder, starts):
    patches, cases, ours = load_oracles(oracles_folder, "ref_numpy")
    local = {
        name: local_float32(points)
        for name, points in patches.items()
        if name not in FLAT_IN_FLOAT32
    }
    key, seen = f"detmcd_{starts}_{{}}", 0
    for name, _, fit, answer in regular_fits(local, cases, ours, key, starts=starts):
        assert points_of(fit.raw_support) == set(answer["best"]), name
        seen += 1
        if name in ("planar_very_fine", "line_noisy"):
            continue  # thinner than a matrix of float32 can hold
        assert abs(fit.log_det.item() - answer["logdet"]) < 1e-3, name
        assert angle_deg(normal_of(fit.covariance), normal_of(answer["cov"])) < 0.01, name
    assert seen == {"robustbase": 123, "paper": 119}[starts]


@pytest.mark.parametrize("num_coordinates", [1, 2, 4, 5])
@pytest.mark.parametrize("starts", ["paper", "robustbase", "planes", "more"])
def test_any_number_of_coordinates(num_coordinates, starts, rng):
    patches = torch.randn(20, 60, num_coordinates, generator=rng, dtype=torch.float64)
    patches[..., -1] *= 0.05
    patches[:, :15, -1] += 3
    fit = fit_detmcd(patches, starts=starts)
    assert fit.valid.all()
    assert not fit.exact_fit.any()
    assert not fit.support[:, :15].any()
    assert fit.support[:, 15:].double().mean() > 0.8
    assert fit.covariance.shape == (20, num_coordinates, num_coordinates)


def test_long_patches_use_tau(rng):
    patch = torch.randn(1100, 3, generator=rng, dtype=torch.float64)
    patch[:400, 2] += 20
    fit = fit_detmcd(patch)
    assert not fit.support[:400].any()
    assert fit.support[400:].double().mean() > 0.95


def test_numpy_arrays_are_accepted(rng):
    patch = torch.randn(30, 3, generator=rng)
    assert torch.equal(fit_detmcd(patch.numpy()).location, fit_detmcd(patch).location)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"support_fraction": 0.4}, "support_fraction from 0.5 to 1, got 0.4"),
        ({"chunk_size": 0}, "chunk_size of at least 1, got 0"),
        ({"starts": "six"}, "starts to be one of paper, robustbase"),
        ({"quantile": 1}, "quantile above 0 and below 1, got 1"),
        ({"scaling": "median"}, "scaling to be one of consistency, quantile"),
        ({"inliers": "final"}, "inliers to be one of raw, reweighted"),
        ({"small_sample": True, "scaling": "quantile"}, "small_sample=False with scaling='quant"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ConfigError, match=f"fit_detmcd: expected {message}"):
        fit_detmcd(torch.zeros(50, 3), **settings)


def test_patches_that_do_not_fit_are_refused():
    patch = torch.zeros(50, 3)
    with pytest.raises(ShapeError, match=r"fit_detmcd: expected patches of shape \(\*, K, P\)"):
        fit_detmcd(torch.zeros(3))
    with pytest.raises(ShapeError, match="fit_detmcd: expected mask of shape"):
        fit_detmcd(patch, torch.ones(49, dtype=torch.bool))
    with pytest.raises(ShapeError, match="fit_detmcd: expected patches of float32 or float64"):
        fit_detmcd(patch.long())
    with pytest.raises(ConfigError, match="expected points with 3 coordinates"):
        fit_detmcd(torch.randn(50, 2), small_sample=True)
    with pytest.raises(ConfigError, match="fit_fastmcd: expected num_starts of at least 1, got 0"):
        fit_fastmcd(torch.zeros(5, 3), num_starts=0)


def gaps(folder, convert, chosen):
    """How far above the best known objective the fits of the chosen cases are."""
    patches, cases, best = load_oracles(folder, "best_known_mcd")
    for level, fraction in FRACTIONS.items():
        known = {
            name: convert(points)
            for name, points in patches.items()
            if isinstance(best.get(name, {}).get(f"a{level}", {}).get("logdet"), float)
            and chosen(cases[name])
        }
        fits = fit_all(known, lambda batch, a=fraction: fit_fastmcd(batch, support_fraction=a))
        for name, fit in fits.items():
            answer = best[name][f"a{level}"]
            yield name, fit.log_det.item() - answer["logdet"], answer["proven_global"]


def test_objective_reaches_the_best_known(oracles_folder):
    seen = 0
    for name, gap, proven in gaps(oracles_folder, torch.from_numpy, lambda case: case["n"] <= 51):
        assert -1e-8 <= gap <= (1e-8 if proven else 0.05), name
        seen += 1
    assert seen > 110


def test_objective_of_float32_reaches_the_best_known(oracles_folder):
    groups = ("edge", "corner", "outliers", "curved")
    seen = 0
    for name, gap, _ in gaps(oracles_folder, local_float32, lambda c: c["group"] in groups):
        assert -1e-3 <= gap <= 0.051, name
        seen += 1
    assert seen == 42


def test_finds_the_subset_of_robustbase_where_the_objectives_agree(oracles_folder):
    patches, _, robustbase = load_oracles(oracles_folder, "r_robustbase")
    agreed = 0
    for name in ("planar_tilt", "edge120_60", "out30_cluster", "corner_56", "curved_saddle"):
        answer = robustbase[name]["fastmcd500_50"]
        fit = fit_fastmcd(torch.from_numpy(patches[name]))
        if abs(fit.log_det.item() - answer["crit"]) < 1e-9:
            assert points_of(fit.raw_support) == set(answer["best"])
            agreed += 1
    assert agreed >= 4


def test_objective_is_affine_equivariant(rng):
    patches = torch.randn(4, 30, 3, generator=rng, dtype=torch.float64)
    patches[:, :10] += 3
    matrix = torch.tensor([[2.0, 0.3, 0.0], [0.1, 0.5, -0.2], [0.0, 0.4, 1.5]]).double()
    fit = fit_fastmcd(patches, num_starts=100)
    moved = fit_fastmcd(patches @ matrix.T + 7, num_starts=100)
    assert torch.equal(fit.raw_support, moved.raw_support)
    expected = fit.log_det + 2 * matrix.det().abs().log()
    torch.testing.assert_close(moved.log_det, expected)
    torch.testing.assert_close(moved.covariance, matrix @ fit.covariance @ matrix.T)


def test_equal_sets_are_kept_once():
    determinants = torch.tensor([[3.0], [1.0], [2.0], [1.0], [2.0]], dtype=torch.float64)
    members = torch.arange(5.0).reshape(1, 5, 1)
    kept = _distinct_best(_Concentrated(members, determinants), 3)
    assert kept.members.flatten().tolist() == [1, 2, 0]
    assert kept.determinants.flatten().tolist() == [1, 2, 3]


def test_parts_of_the_starts_change_nothing(rng, monkeypatch):
    patches = torch.randn(3, 20, 3, generator=rng)
    whole = fit_fastmcd(patches, num_starts=300)
    monkeypatch.setattr("torchrg.robust.mcd._LANES_IN_CACHE", 30)
    monkeypatch.setattr("torchrg.robust.starts.ROWS_IN_CACHE", 7)
    for one, other in zip(whole, fit_fastmcd(patches, num_starts=300), strict=True):
        assert torch.equal(one, other)
