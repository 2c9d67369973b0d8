"""Modules give what the functions give."""

import io
from typing import get_args

import pytest
import torch
from torch import nn

from torchrg import nn as modules
from torchrg.errors import ConfigError, ShapeError
from torchrg.linalg import covariance
from torchrg.normals import fit_normals_pca
from torchrg.robust import RobustFit, fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve, qn


def test_modules_are_the_functions(rng):
    patches = torch.randn(6, 30, 3, generator=rng)
    assert torch.equal(modules.Covariance()(patches), covariance(patches)[1])
    assert torch.equal(modules.Qn()(patches[..., 0]), qn(patches[..., 0]))
    corrected = modules.Qn(finite_sample=True)(patches[..., 0])
    assert torch.equal(corrected, qn(patches[..., 0], finite_sample=True))


@pytest.mark.parametrize(
    ("module", "function", "settings"),
    [
        (modules.DetMCD, fit_detmcd, {"support_fraction": 0.75, "starts": "robustbase"}),
        (modules.FastMCD, fit_fastmcd, {"num_starts": 20, "quantile": 0.9}),
        (modules.DetMM, fit_detmm, {"quantile": 0.9, "tuned_for": "location"}),
        (modules.DetS, fit_dets, {"quantile": 0.9, "starts": "planes", "chunk_size": 3}),
        (modules.MVE, fit_mve, {"num_starts": 20, "chunk_size": 2}),
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
    with pytest.raises(ConfigError, match="expected method to be one of jacobi, linalg, got 'svd'"):
        modules.Eigh("svd")


def test_settings_are_shown():
    assert repr(modules.Qn(finite_sample=True)) == "Qn(dim=-1, finite_sample=True)"
    assert repr(modules.Eigh()) == "Eigh(method='jacobi')"


def thin(rng, count=6):
    patches = torch.randn(count, 20, 3, generator=rng, dtype=torch.float64)
    return patches * torch.tensor([1.0, 0.8, 0.01])


def test_modules_follow_one_another_from_patches_to_normals(rng):
    patches = thin(rng)
    expected = fit_normals_pca(patches).normals
    for eigh in (modules.Eigh(), modules.Eigh("linalg")):
        found = nn.Sequential(modules.Covariance(), eigh, modules.Normal())(patches)
        assert torch.allclose((found * expected).sum(-1).abs(), torch.ones(6).double())
    robust = nn.Sequential(modules.DetMM(), modules.Eigh(), modules.Normal())(patches)
    assert ((robust * expected).sum(-1).abs() > 0.999).all()


def test_a_model_with_them_learns(rng):
    torch.manual_seed(0)
    robust = nn.Sequential(modules.DetMCD(starts="planes"), modules.Eigh(), modules.Normal())
    model = nn.Sequential(nn.Linear(3, 3), robust, nn.Linear(3, 2)).double()
    model(thin(rng)).square().sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())
    assert model[0].weight.grad.abs().max() > 0


@pytest.mark.parametrize("method", get_args(modules.Method))
def test_normals_of_patches_by_every_estimator(rng, method):
    patches, mask = thin(rng), torch.rand(6, 20, generator=rng) < 0.9
    module = modules.PatchNormals(method, **({"noise": 0.02} if method == "irls" else {}))
    found = module(patches, mask)
    assert (found[:, 2].abs() > 0.99).all()
    assert torch.equal(module.fit(patches, mask).normals, found)
    leaf = patches.clone().requires_grad_()
    (module(leaf) ** 2)[:, 0].sum().backward()
    assert leaf.grad.isfinite().all()
    assert f"method='{method}'" in repr(module)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: modules.DetMCD(support_fraction=2), "support_fraction from 0.5 to 1, got 2"),
        (lambda: modules.DetMCD(starts="nope"), "starts to be one of paper, robustbase, planes, m"),
        (lambda: modules.DetMCD(chunk_size=0), "chunk_size of at least 1, got 0"),
        (lambda: modules.FastMCD(num_starts=0), "num_starts of at least 1, got 0"),
        (lambda: modules.MVE(quantile=1.5), "quantile above 0 and below 1, got 1.5"),
        (lambda: modules.DetS(starts="nope"), "starts to be one of"),
        (lambda: modules.DetMM(tuned_for="nope"), "tuned_for to be one of shape, location"),
        (lambda: modules.Qn(dim=0.5), "Qn: expected dim to be an integer, got 0.5"),
        (lambda: modules.PatchNormals("svd"), "method to be one of pca, jet, irls, .*, got 'svd'"),
        (lambda: modules.PatchNormals("irls"), "expected noise > 0 for irls"),
        (lambda: modules.PatchNormals("detmcd", start="paper"), "unexpected keyword .* 'start'"),
        (lambda: modules.PatchNormals("detmm", quantile=2), "quantile above 0 and below 1, got 2"),
    ],
)
def test_wrong_settings_are_refused_when_a_module_is_made(make, message):
    with pytest.raises(ConfigError, match=message) as info:
        make()
    assert "\n" not in str(info.value)


def test_a_generator_draws_the_starts(rng):
    patches = thin(rng)
    for module in (modules.FastMCD(num_starts=1), modules.MVE(num_starts=1)):
        first, again, other = (
            module(patches, generator=torch.Generator().manual_seed(seed)).raw_covariance
            for seed in (1, 1, 2)
        )
        assert torch.equal(first, again)
        assert not torch.equal(first, other)


def test_other_sizes_are_sent_to_the_other_decomposition(rng):
    fit = modules.DetMCD()(torch.randn(2, 40, 5, generator=rng))
    with pytest.raises(ShapeError, match=r'Eigh: .*got \(2, 5, 5\); use Eigh\("linalg"\)'):
        modules.Eigh()(fit)
    assert modules.Eigh("linalg")(fit).vectors.shape == (2, 5, 5)


# Each as a chain from patches, as the modules are used.
CHAINS = {
    "Covariance": modules.Covariance(),
    "Eigh": nn.Sequential(modules.Covariance(), modules.Eigh()),
    "Eigh linalg": nn.Sequential(modules.Covariance(), modules.Eigh("linalg")),
    "Normal": nn.Sequential(modules.DetMCD(), modules.Eigh(), modules.Normal()),
    "Qn": modules.Qn(-2, finite_sample=True),
    "DetMCD": modules.DetMCD(inliers="reweighted"),
    "FastMCD": modules.FastMCD(num_starts=20),
    "MVE": modules.MVE(num_starts=20),
    "DetS": modules.DetS(),
    "DetMM": modules.DetMM(),
} | {
    f"PatchNormals {method}": modules.PatchNormals(
        method, **({"noise": 0.02} if method == "irls" else {})
    )
    for method in get_args(modules.Method)
}
chains = pytest.mark.parametrize("name", CHAINS)
SHORT = ("DetMCD", "Normal", "Qn")
short_chains = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in SHORT)) for name in CHAINS]
)
"""Chains of which three are tried as a rule: the functions behind them have tests of their own."""


def unsigned(found):
    """Return tensors that no sign of a normal changes."""
    if isinstance(found, modules.Eigen):
        return found.values, found.vectors[..., :1] * found.vectors[..., :1].mT
    if isinstance(found, RobustFit):
        return found.location, found.covariance
    if found.shape[-2:] != (3, 3):  # normals, or scales, which are positive
        return (found[..., :, None] * found[..., None, :],)
    return (found,)


def test_every_module_is_among_the_chains():
    assert {name.split()[0] for name in CHAINS} == set(modules.__all__) - {"Eigen"}


def assert_same(found, expected):
    for part, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(part, wanted, rtol=1e-9, atol=1e-12)


@short_chains
def test_modules_under_vmap_are_loops(name, rng):
    patches = thin(rng, 4)
    expected = unsigned(CHAINS[name](patches))
    assert_same(torch.vmap(lambda patch: unsigned(CHAINS[name](patch)))(patches), expected)
    singles = [unsigned(CHAINS[name](patch)) for patch in patches]
    assert_same(map(torch.stack, zip(*singles, strict=True)), expected)


# The gradients of DetS and DetMM hold the weights of the points: see test_gradients.py.
@pytest.mark.parametrize("name", sorted(CHAINS.keys() - {"DetS", "DetMM"}))
def test_gradients_of_modules_are_numerical_derivatives(name, rng):
    patches = thin(rng, 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: unsigned(CHAINS[name](x)), patches, fast_mode=True)


@pytest.mark.slow
@chains
@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")
def test_modules_compile_without_graph_breaks(name, rng):
    torch.compiler.reset()
    patches = thin(rng, 3)
    compiled = torch.compile(CHAINS[name], fullgraph=True, backend="eager")
    assert_same(unsigned(compiled(patches)), unsigned(CHAINS[name](patches)))


@short_chains
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_traced_modules_are_saved_for_any_number_of_patches(name, rng):
    file = io.BytesIO()
    torch.jit.save(torch.jit.trace(CHAINS[name], thin(rng, 3)), file)
    file.seek(0)
    patches = thin(rng, 5)
    expected = CHAINS[name](patches)
    found = torch.jit.load(file)(patches)
    torch.testing.assert_close(found, expected if torch.is_tensor(expected) else tuple(expected))
