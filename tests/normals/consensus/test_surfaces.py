"""Broken planes make edges sharp, and paraboloids leave smooth surfaces smooth."""

import pytest
import torch

from tests.kernels.clouds import both, clouds, lists, needs_library
from tests.normals.test_consensus import consensus, errors, fit_all, shape
from torchrg.normals.consensus.surfaces import broken_planes
from torchrg.normals.jet import fit_normals_jet
from torchrg.normals.pca import fit_normals_pca, fit_points_pca


@pytest.mark.parametrize("name", ["cube", "octahedron", "stairs", "cylinder"])
@pytest.mark.parametrize("noise", [0.0, 0.0025])
def test_edges_are_sharper_than_those_of_pca_and_jet(name, noise):
    points, truth = shape(name, 3000, noise)
    mean, rms = errors(consensus(points), truth)
    for estimate in (fit_normals_pca, fit_normals_jet):
        other_mean, other_rms = errors(fit_all(points, estimate), truth)
        assert mean < 0.7 * other_mean
        assert rms < other_rms


@pytest.mark.parametrize("name", ["sphere", "torus", "rounded_box"])
@pytest.mark.parametrize("noise", [0.0, 0.0025])
def test_smooth_surfaces_are_as_smooth_as_the_better_of_pca_and_jet(name, noise):
    points, truth = shape(name, 5000, noise)
    _, rms = errors(consensus(points), truth)
    best = min(errors(fit_all(points, fit), truth)[1] for fit in (fit_normals_pca, fit_normals_jet))
    assert rms <= 1.1 * best + 0.001


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize(("k", "masked"), [(12, False), (17, True)])
def test_planes_of_the_kernel_are_those_of_the_definition(k, masked):
    points = clouds()["room"]
    near = lists(points, k, masked)
    fit, noise = fit_points_pca(points, near), torch.full((len(points),), 0.0015)
    # One call takes points with equal numbers of counted neighbors.
    all_rows = (near.mask().sum(dim=1) == 12).nonzero().squeeze(1)
    # Point 512 alone: the points of its first plane are final one turn before those of the second.
    for rows in (all_rows, torch.tensor([512])):
        arguments = points, near.select(rows), noise[rows], fit.normals[rows]
        (voted, meeting), (of_voted, of_meeting) = both(broken_planes, *arguments)
        for one, other in zip((*voted, *meeting), (*of_voted, *of_meeting), strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=1e-6)
