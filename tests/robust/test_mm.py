import functools

import pytest
import torch

from tests.robust.oracle_cases import (
    FLAT_IN_FLOAT32,
    WRONG_RRCOV,
    angle_deg,
    eigenvalue_error,
    fit_all,
    load_oracles,
    local_float32,
    normal_of,
)
from torchrg.errors import ConfigError
from torchrg.robust import fit_detmm, fit_dets
from torchrg.robust.mm import breakdown_constant, efficiency_constant

# The cases include patches of fewer than six points.
pytestmark = pytest.mark.filterwarnings("ignore:.*too few to trust the covariance")


@functools.cache
def all_fits(folder, fit, convert, without):
    """Fits of patches with at most half of the points on one plane, by their names."""
    patches, cases = load_oracles(folder)
    known = {
        name: convert(points)
        for name, points in patches.items()
        if not cases[name]["exact_fit_50"] and name not in ("exact_z0_k26", *without)
    }
    return fit_all(known, fit)


def regular_fits(folder, fit, families, convert=torch.from_numpy, without=()):
    """Those fits, with the families' answers."""
    _, _, *answers = load_oracles(folder, *families)
    for name, found in all_fits(folder, fit, convert, tuple(without)).items():
        yield name, found, *(family[name] for family in answers)


def fit_for_location(batch):
    return fit_detmm(batch, tuned_for="location")


def assert_same_scatter(found, expected, tolerance, name):
    error = eigenvalue_error(found.covariance, expected, found.covariance.dtype)
    assert error < tolerance, name


def scale_of(fit):
    return (fit.log_det / 6).exp().item()


def test_dets_is_that_of_rrcov_and_of_the_reference(oracles_folder):
    compared = {"rrcov": 0, "ours": 0}
    for name, fit, rrcov, ours in regular_fits(oracles_folder, fit_dets, ["r_rrcov", "ref_numpy"]):
        if "cov" in rrcov["dets"] and name not in WRONG_RRCOV:
            assert_same_scatter(fit, rrcov["dets"]["cov"], 1e-6, name)
            assert scale_of(fit) == pytest.approx(rrcov["dets"]["crit"], rel=1e-8), name
            compared["rrcov"] += 1
        if "s_cov" in ours.get("dets_mm", {}):
            assert_same_scatter(fit, ours["dets_mm"]["s_cov"], 1e-6, name)
            compared["ours"] += 1
    assert compared == {"rrcov": 60, "ours": 62}


@pytest.mark.parametrize(("target", "short"), [("shape", "shape"), ("location", "loc")])
def test_detmm_is_that_of_rrcov_and_of_the_reference(oracles_folder, target, short):
    compared = 0
    for name, fit, rrcov, ours in regular_fits(
        oracles_folder,
        fit_detmm if target == "shape" else fit_for_location,
        ["r_rrcov", "ref_numpy"],
    ):
        known = [ours.get("dets_mm", {}).get(f"mm_{short}_cov")]
        if name not in WRONG_RRCOV:
            known.append(rrcov[f"detmm_{short}_tight"].get("cov"))
        for expected in known:
            if expected is not None:
                assert_same_scatter(fit, expected, 1e-5, name)
                angle = angle_deg(normal_of(fit.covariance), normal_of(expected))
                assert angle < 1e-4, name
                compared += 1
    assert compared == 122


def test_detmm_agrees_with_statsmodels_where_the_scales_do(oracles_folder):
    agreed = 0
    for name, fit, statsmodels in regular_fits(oracles_folder, fit_detmm, ["py_statsmodels"]):
        answer = statsmodels.get("detmm_shape", {})
        if "cov" not in answer or name.endswith(("x1e-06", "x1e-05")):
            continue
        if abs(scale_of(fit) / answer["scale"] - 1) < 1e-4:
            assert_same_scatter(fit, answer["cov"], 1e-3, name)
            agreed += 1
    assert agreed > 40


def test_float32_agrees(oracles_folder):
    compared = 0
    for fit, key, tolerance in ((fit_dets, "s_cov", 1e-4), (fit_detmm, "mm_shape_cov", 1e-3)):
        for name, found, ours in regular_fits(
            oracles_folder, fit, ["ref_numpy"], local_float32, FLAT_IN_FLOAT32
        ):
            expected = ours.get("dets_mm", {}).get(key)
            if expected is None:
                continue
            if name == "planar_very_fine":
                tolerance = 1e-3  # its noise is a hundred times the rounding of a coordinate
            assert_same_scatter(found, expected, tolerance, name)
            compared += 1
            if name != "line_noisy":
                angle = angle_deg(normal_of(found.covariance), normal_of(expected))
                assert angle < 0.02, name
    assert compared == 122


def test_tuning_constants_are_those_of_the_literature():
    assert breakdown_constant(1) == pytest.approx(1.547645, abs=1e-6)
    assert breakdown_constant(3) == pytest.approx(3.4528816505, abs=1e-9)
    assert efficiency_constant(1, "location") == pytest.approx(4.685065, abs=1e-6)
    assert efficiency_constant(3, "shape") == pytest.approx(6.096266441, abs=1e-6)
    assert efficiency_constant(3, "location") == pytest.approx(5.490249172, abs=1e-6)


def test_mm_is_affine_equivariant_from_equal_starts(rng):
    patches = torch.randn(10, 40, 3, generator=rng, dtype=torch.float64)
    patches[:, :10] += 4
    matrix = torch.tensor([[2.0, 0.3, 0.0], [0.1, 0.5, -0.2], [0.0, 0.4, 1.5]]).double()
    fit = fit_detmm(patches, starts="planes")
    moved = fit_detmm(patches @ matrix.T + 7, starts="planes")
    torch.testing.assert_close(moved.location, fit.location @ matrix.T + 7, rtol=1e-5, atol=1e-8)
    expected = matrix @ fit.covariance @ matrix.T
    torch.testing.assert_close(moved.covariance, expected, rtol=1e-5, atol=1e-8)


def test_refusals():
    with pytest.raises(ConfigError, match="fit_detmm: expected tuned_for to be one of shape"):
        fit_detmm(torch.zeros(5, 3), tuned_for="scale")
    with pytest.raises(ConfigError, match="fit_dets: expected starts to be one of paper"):
        fit_dets(torch.zeros(5, 3), starts="none")
