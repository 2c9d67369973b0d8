"""The kernels of consensus normals do what the functions of torch next to them do."""

import pytest
import torch

from tests.kernels.clouds import clouds, definitions, lists, needs_library
from torchrg.config import NormalsConfig
from torchrg.linalg import unsigned_angle_deg
from torchrg.normals.consensus import estimate_consensus
from torchrg.normals.consensus.noise import estimate_noise
from torchrg.normals.consensus.smoothing import _inliers, choose_planes, smooth_planes
from torchrg.normals.consensus.surfaces import TangentPlanes, _paraboloids, broken_planes
from torchrg.normals.pca import fit_points_pca

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")

CLOUDS = {name: points for name, points in clouds().items() if name != "line"}
MIN_EQUAL = 0.98
"""Share of the points at which a choice, as that of a best plane, is the same: rounding may decide
between two that are as good."""


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


def both(function, *arguments, **settings):
    found = function(*arguments, **settings)
    with definitions():
        return found, function(*arguments, **settings)


def assert_same_planes(found, expected, unit, fraction=1.0, rows=slice(None)):
    """Compare normals and offsets, by angle and to a share of a unit for each row."""
    angle = unsigned_angle_deg(found[0], expected[0])[rows]
    turned = torch.where((found[0] * expected[0]).sum(dim=1) < 0, -1.0, 1.0)
    error = ((found[1] * turned - expected[1]).abs() / unit)[rows]
    same = (angle < 0.1) & (error < 1e-3)
    assert same.float().mean() >= fraction, (angle.max(), error.max())


def test_broken_planes(points, near, survey):
    fit, (_, _, noise, _) = survey
    # The kernel is for points of equally many neighbors.
    count = near.mask().sum(dim=1)
    rows = (fit.valid & noise.isfinite() & (count == count.mode().values)).nonzero().squeeze(1)
    (voted, meeting), (voted_too, meeting_too) = (
        both(broken_planes, points, near.select(rows), noise[rows], fit.normals[rows])
        if near.valid is None
        else both(
            broken_planes, points, type(near)(*near.select(rows)), noise[rows], fit.normals[rows]
        )
    )
    # To the bit: rounding would decide between planes that are as good.
    for found, expected in zip((*voted, *meeting), (*voted_too, *meeting_too), strict=True):
        assert torch.equal(found.nan_to_num(), expected.nan_to_num())


def test_paraboloids(points, near, survey):
    fit, (_, _, _, radius) = survey
    rows = fit.valid.nonzero().squeeze(1)
    found, expected = both(_paraboloids, points, *near, fit.normals, rows)
    enough = near.mask()[rows].sum(dim=1) > 6
    assert_same_planes(found[:2], expected[:2], radius[rows], MIN_EQUAL, enough)
    error = ((found[2] - expected[2]).abs() / radius[rows])[enough]
    assert (error < 1e-3).float().mean() >= MIN_EQUAL


def test_smoothing(points, near, survey):
    fit, (offsets, _, noise, radius) = survey
    planes = TangentPlanes(fit.normals, offsets)
    errors = torch.where(radius > 0, 2 * noise / radius, 1.0)
    rows = (fit.valid & noise.isfinite()).nonzero().squeeze(1)[::2]
    found, expected = both(smooth_planes, points, near, planes, noise, errors, rows, chunk_size=700)
    finite = expected.offsets.isfinite()
    assert torch.equal(found.offsets.isfinite(), finite)
    assert_same_planes(found, expected, radius, 1.0, finite & (radius > 0))


def test_choice_among_planes(points, near, survey):
    fit, (offsets, _, noise, radius) = survey
    planes = TangentPlanes(fit.normals, offsets)
    rows = (fit.valid & noise.isfinite()).nonzero().squeeze(1)[::3]
    found, expected = both(choose_planes, points, near, planes, noise, rows, chunk_size=700)
    assert_same_planes(found, expected, radius, MIN_EQUAL, radius > 0)


def test_inliers(points, near, survey):
    fit, (offsets, _, noise, radius) = survey
    rows = (fit.valid & noise.isfinite()).nonzero().squeeze(1)
    found, expected = both(_inliers, points, *near, fit.normals, offsets, noise, rows)
    same = found[0] == expected[0]
    assert same.float().mean() > MIN_EQUAL
    error = (found[1] - expected[1]).abs() / radius[rows, None] ** 2
    assert error[same].max() < 1e-5


def test_normals_of_a_cloud_are_the_same(points):
    near = lists(points, 50, masked=False)
    found, expected = both(estimate_consensus, points, near, NormalsConfig(), 1024)
    # Double precision hides that roots in torch are off by a bit, but not from each of many points.
    for one, other in zip(found, expected, strict=True):
        same = one.nan_to_num() == other.nan_to_num()
        assert same.float().mean() > 0.9995
