import pytest
import torch

from tests.robust.oracle_cases import ESTIMATORS
from torchrg.robust import fit_detmcd


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
