"""Smoothed and chosen planes by kernels and by definition."""

import pytest
import torch

from tests.kernels.clouds import MIN_EQUAL, assert_same_planes, both, needs_library
from torchrg.normals.consensus.smoothing import _inliers, choose_planes, smooth_planes
from torchrg.normals.consensus.surfaces import TangentPlanes

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")


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
