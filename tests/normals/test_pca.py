"""PCA planes: against NumPy, at every width, through vmap, compilers and autograd."""

import numpy as np
import pytest
import torch

from torchrg.errors import ShapeError
from torchrg.linalg import unsigned_angle_deg
from torchrg.normals import fit_normals_pca


def random_patches(rng, count=40, k=15, spread=(1.0, 0.7, 0.1)):
    return torch.randn(count, k, 3, generator=rng, dtype=torch.float64) * torch.tensor(spread)


def strips(rng, width, dtype, count=200, k=50):
    """Patches of length one and the given width, turned at random."""
    flat = torch.rand(count, k, 3, generator=rng, dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(count, 3, 3, generator=rng, dtype=torch.float64))[0]
    return (flat * torch.tensor([1.0, width, 0.0]) @ turn).to(dtype)


def test_fit_is_that_of_numpy(rng):
    patches = random_patches(rng)
    fit = fit_normals_pca(patches)
    for row, points in enumerate(patches.numpy()):
        values, vectors = np.linalg.eigh(np.cov(points, rowvar=False, bias=True))
        assert abs(fit.normals[row].numpy() @ vectors[:, 0]) == pytest.approx(1, abs=1e-12)
        assert fit.curvature[row].item() == pytest.approx(values[0] / values.sum(), rel=1e-10)
        assert fit.residual_rms[row].item() == pytest.approx(np.sqrt(values[0]), rel=1e-10)


def test_masked_points_do_not_count_whatever_they_hold(rng):
    patches = random_patches(rng)
    mask = torch.rand(patches.shape[:2], generator=rng) < 0.6
    fit = fit_normals_pca(torch.where(mask[..., None], patches, torch.nan), mask)
    for row in range(len(patches)):
        alone = fit_normals_pca(patches[row][mask[row]])
        assert unsigned_angle_deg(fit.normals[row], alone.normals) < 1e-6
        assert torch.allclose(fit.curvature[row], alone.curvature)


def test_masked_points_of_narrow_patches_do_not_count_either(rng, dtype):
    mask = torch.rand(200, 50, generator=rng) < 0.7
    for width, expected in ((1e-3, True), (0.0, False)):
        patches = torch.where(mask[..., None], strips(rng, width, dtype), torch.nan)
        assert (fit_normals_pca(patches, mask).valid == expected).all()


def test_leading_axes_are_free(rng):
    patches = random_patches(rng, count=12)
    fit = fit_normals_pca(patches)
    shaped = fit_normals_pca(patches.reshape(3, 2, 2, 15, 3))
    assert torch.equal(shaped.normals.reshape(12, 3), fit.normals)
    assert torch.equal(fit_normals_pca(patches[0]).normals, fit.normals[0])


@pytest.mark.parametrize("width", [1e-1, 1e-2, 1e-3, 1e-4])
def test_narrow_strips_are_planes(rng, dtype, width):
    fit = fit_normals_pca(strips(rng, width, dtype))
    assert fit.valid.all()


@pytest.mark.parametrize("far", [0.0, 1.0, 1000.0])
def test_lines_are_no_planes_wherever_they_are(rng, dtype, far):
    lines = (strips(rng, 0.0, torch.float64) + far).to(dtype)
    fit = fit_normals_pca(lines)
    assert not fit.valid.any()
    assert not fit.normals.any()


def test_resolution_decides_what_is_rounding(rng):
    patches = strips(rng, 1e-4, torch.float64)
    size = torch.full((len(patches),), 1e-3, dtype=torch.float64)
    assert not fit_normals_pca(patches, resolution=size).valid.any()
    assert fit_normals_pca(patches, resolution=size * 1e-3).valid.all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(5, 2),), r"patches of shape \(\*, K, 3\), got \(5, 2\)"),
        ((torch.zeros(2, 5, 3), torch.ones(2, 4, dtype=torch.bool)), "mask of shape"),
        ((torch.zeros(5, 3, dtype=torch.int64),), "float32 or float64, got int64"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(ShapeError, match=message):
        fit_normals_pca(*arguments)
