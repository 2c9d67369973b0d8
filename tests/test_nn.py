"""Modules give what the functions give."""

import pytest
import torch

from torchrg import nn as modules
from torchrg.errors import ConfigError
from torchrg.linalg import covariance
from torchrg.robust import fit_detmcd, fit_detmm, fit_fastmcd, qn


def test_modules_are_the_functions(rng):
    patches = torch.randn(6, 30, 3, generator=rng)
    assert torch.equal(modules.Covariance()(patches)[1], covariance(patches)[1])
    assert torch.equal(modules.Qn()(patches[..., 0]), qn(patches[..., 0]))
    corrected = modules.Qn(finite_sample=True)(patches[..., 0])
    assert torch.equal(corrected, qn(patches[..., 0], finite_sample=True))


@pytest.mark.parametrize(
    ("module", "function", "settings"),
    [
        (modules.DetMCD, fit_detmcd, {"support_fraction": 0.75, "starts": "robustbase"}),
        (modules.FastMCD, fit_fastmcd, {"num_starts": 20, "quantile": 0.9}),
        (modules.DetMM, fit_detmm, {"quantile": 0.9, "tuned_for": "location"}),
    ],
)
def test_fits_are_those_of_the_functions(rng, module, function, settings):
    patches = torch.randn(4, 30, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.01])
    ours, theirs = module(**settings)(patches), function(patches, **settings)
    assert torch.equal(ours.covariance, theirs.covariance)
    assert torch.equal(ours.support, theirs.support)
    assert all(f"{name}={value!r}" in repr(module(**settings)) for name, value in settings.items())


def test_both_decompositions_agree(rng):
    matrix = covariance(torch.randn(50, 30, 3, generator=rng, dtype=torch.float64))[1]
    ours, lapack = modules.Eigh()(matrix), modules.Eigh("linalg")(matrix)
    assert torch.allclose(ours[0], lapack[0])
    assert torch.allclose((ours[1] * lapack[1]).sum(dim=-2).abs(), torch.ones(50, 3).double())


def test_unknown_decomposition_is_refused():
    with pytest.raises(ConfigError, match="expected method to be jacobi or linalg, got 'svd'"):
        modules.Eigh("svd")


def test_settings_are_shown():
    assert repr(modules.Qn(finite_sample=True)) == "Qn(dim=-1, finite_sample=True)"
    assert repr(modules.Eigh()) == "Eigh(method='jacobi')"
