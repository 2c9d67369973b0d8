"""Broken planes and paraboloids by kernels and by definition."""

import pytest
import torch

from tests.kernels.clouds import MIN_EQUAL, assert_same_planes, both, needs_library
from torchrg.normals.consensus.surfaces import _paraboloids, broken_planes

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")


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
