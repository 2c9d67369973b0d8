"""What the tests of consensus normals by kernels share."""

import pytest

from tests.kernels.clouds import clouds, definitions, lists
from torchrg.normals.consensus.noise import estimate_noise
from torchrg.normals.pca import fit_points_pca

CLOUDS = {name: points for name, points in clouds().items() if name != "line"}


@pytest.fixture(params=CLOUDS)
def points(request):
    return CLOUDS[request.param]


@pytest.fixture(params=[False, True], ids=["all", "masked"])
def near(request, points):
    return lists(points, 50, request.param)


@pytest.fixture
def survey(points, near):
    with definitions():
        fit = fit_points_pca(points, near)
        return fit, estimate_noise(points, near, fit)
