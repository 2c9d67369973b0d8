"""Planes of robust fits: PCA on the points that the fit keeps, right among outliers."""

from functools import partial

import pytest
import torch

from torchrg.config import NormalsConfig
from torchrg.errors import ShapeError
from torchrg.linalg import unsigned_angle_deg
from torchrg.neighbors import search_knn
from torchrg.neighbors.knn import gather_patches
from torchrg.normals import (
    estimate_normals,
    fit_normals_pca,
    fit_normals_robust,
)
from torchrg.robust import fit_detmcd, fit_detmm, fit_fastmcd, fit_mve

FITS = {
    robust: partial(fit_normals_robust, estimator=robust)
    for robust in (fit_detmcd, fit_fastmcd, fit_mve, fit_detmm)
}
fits = pytest.mark.parametrize("fit", FITS.values(), ids=[robust.__name__ for robust in FITS])


def contaminated(rng, fraction, count=20, k=40):
    """Noisy floors of which a share of the points is scattered above; float64."""
    patches = torch.rand(count, k, 3, generator=rng, dtype=torch.float64)
    patches[..., 2] = 0.01 * torch.randn(count, k, generator=rng, dtype=torch.float64)
    num_outliers = round(fraction * k)
    high = torch.rand(count, num_outliers, generator=rng, dtype=torch.float64)
    patches[:, k - num_outliers :, 2] = 0.1 + high * patches[:, k - num_outliers :, 0]
    return patches


@pytest.mark.parametrize("robust", FITS)
def test_plane_is_that_of_the_points_that_are_kept(rng, robust):
    patches = contaminated(rng, 0.3)
    found, kept = FITS[robust](patches), robust(patches).support
    for row in range(len(patches)):
        expected = fit_normals_pca(patches[row][kept[row]])
        assert unsigned_angle_deg(found.normals[row], expected.normals) < 1e-6
        assert torch.allclose(found.curvature[row], expected.curvature)
        assert torch.allclose(found.residual_rms[row], expected.residual_rms)


@fits
def test_gradients_flow_through_the_plane_of_the_kept_points(rng, fit):
    patches = contaminated(rng, 0.3, count=2).requires_grad_()
    fit(patches).normals[:, 0].sum().backward()
    assert patches.grad.isfinite().all()
    assert patches.grad.abs().sum() > 0
    kept = patches.grad.abs().sum(dim=-1) > 0
    assert not kept.all()


def test_wrong_shapes_are_refused():
    with pytest.raises(ShapeError, match="fit_normals_robust: expected patches of shape"):
        fit_normals_robust(torch.zeros(5, 2))


@pytest.mark.parametrize(
    ("method", "robust", "settings"),
    [
        ("detmcd", fit_detmcd, {"support_fraction": 0.9, "inlier_quantile": 0.8}),
        ("fastmcd", fit_fastmcd, {"support_fraction": 0.9, "inlier_quantile": 0.8}),
        ("mve", fit_mve, {"support_fraction": 0.9, "inlier_quantile": 0.8}),
        ("detmm", fit_detmm, {"inlier_quantile": 0.8}),
    ],
)
def test_settings_reach_the_fit(rng, method, robust, settings):
    points = torch.rand(60, 3, generator=rng)
    points[::2, 2] *= 0.02
    neighbors = search_knn(points, 20)
    found = estimate_normals(
        points, neighbors=neighbors, config=NormalsConfig(method=method, **settings)
    )
    settings = dict(settings)
    settings["quantile"] = settings.pop("inlier_quantile")
    patches = gather_patches(points, neighbors.indices)
    expected = FITS[robust](patches, **settings)
    assert torch.allclose(found.normals, expected.normals)
    assert not torch.allclose(found.curvature, FITS[robust](patches).curvature)
