"""What the tests of robust estimators share."""

import pytest
import torch

from tests.robust.oracle_cases import ESTIMATORS


@pytest.fixture(params=ESTIMATORS)
def estimator(request):
    return ESTIMATORS[request.param]


@pytest.fixture
def patches(rng, dtype):
    """Thin patches with outliers, coordinates on a grid: differences are exact."""
    points = torch.randn(6, 40, 3, generator=rng, dtype=torch.float64)
    points[..., 2] *= 0.1
    points[:, :12, 2] += 1.5
    return ((points * 256).round() / 256).to(dtype)
