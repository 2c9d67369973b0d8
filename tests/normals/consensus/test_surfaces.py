"""Broken planes make edges sharp, and paraboloids leave smooth surfaces smooth."""

import pytest

from tests.normals.test_consensus import consensus, errors, fit_all, shape
from torchrg.normals.jet import fit_normals_jet
from torchrg.normals.pca import fit_normals_pca


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
