"""Subset sizes, consistency factors and support."""

import pytest
import torch

from tests.robust.oracle_cases import FRACTIONS, LIBRA, load_oracles
from tests.robust.test_mcd import CUTOFF
from torchrg.robust import fit_detmcd
from torchrg.robust.weights import consistency_factor, subset_size


def test_scatter_of_all_points_is_not_scaled(rng):
    patch = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    fit = fit_detmcd(patch, support_fraction=1.0, **LIBRA)
    torch.testing.assert_close(fit.raw_covariance, patch.T.cov())


def test_size_of_the_subset_is_that_of_robustbase(oracles_folder):
    _, _, robustbase = load_oracles(oracles_folder, "r_robustbase")
    seen = 0
    for answers in robustbase.values():
        for level, fraction in FRACTIONS.items():
            answer = answers[f"detmcd_{level}"]
            if "h" in answer:
                assert subset_size(answers["n"], 3, fraction) == answer["h"]
                assert answer["raw_cnp2"][0] == pytest.approx(
                    consistency_factor(answer["h"] / answers["n"], 3), rel=1e-12
                )
                seen += 1
    assert seen == 129
    assert subset_size(50, 3, 1.0) == 50


def test_distances_decide_the_support(rng):
    patches = torch.randn(30, 50, 3, generator=rng, dtype=torch.float64)
    fit = fit_detmcd(patches)
    assert torch.equal(fit.support, fit.sq_distances <= CUTOFF)
    offset = patches - fit.raw_location[:, None]
    expected = (offset @ torch.linalg.inv(fit.raw_covariance) * offset).sum(-1)
    torch.testing.assert_close(fit.sq_distances, expected)
    inliers = patches[0][fit.support[0]]
    torch.testing.assert_close(fit.location[0], inliers.mean(0))
