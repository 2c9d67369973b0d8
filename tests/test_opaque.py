"""Functions of patches under compilers and transformations, against eager."""

from functools import partial

import pytest
import torch
from torch import nn

from torchrg.errors import ConfigError
from torchrg.linalg import covariance, eigh3
from torchrg.normals import fit_normals_irls, fit_normals_jet, fit_normals_pca, fit_normals_robust
from torchrg.robust import (
    fit_detmcd,
    fit_detmm,
    fit_dets,
    fit_fastmcd,
    fit_mve,
    mad,
    median,
    qn,
    tau,
)


def normals_of(fit, **settings):
    """Return a function of patches to normals without sign, and curvature."""

    def call(patches, *mask):
        found = fit(patches, *mask, **settings)
        return found.normals[..., :, None] * found.normals[..., None, :], found.curvature

    return call


def moments_of(fit, **settings):
    """Return a function of patches to location and covariance."""

    def call(patches):
        found = fit(patches, **settings)
        return found.location, found.covariance

    return call


def decompose(patches):
    values, vectors = eigh3(covariance(patches)[1])
    return values, vectors[..., :, None, 0] * vectors[..., None, :, 0]


def irls(patches):
    noise = torch.full_like(patches[..., 0, 0], 0.02)
    return normals_of(fit_normals_irls, noise=noise, mu_decay=9.0)(patches)


FUNCTIONS = {
    "covariance": covariance,
    "eigh3": decompose,
    "pca": normals_of(fit_normals_pca),
    "jet": normals_of(fit_normals_jet),
    "irls": irls,
    "qn": lambda patches: (qn(patches, dim=-2, finite_sample=True),),
    "median": lambda patches: (median(patches, dim=-2),),
    "mad": lambda patches: (mad(patches, dim=-2),),
    "tau": lambda patches: (tau(patches, dim=-2),),
    "detmcd": moments_of(fit_detmcd, starts="robustbase", small_sample=True),
    "fastmcd": moments_of(fit_fastmcd, num_starts=20),
    "mve": moments_of(fit_mve, num_starts=20),
    "dets": moments_of(fit_dets),
    "detmm": moments_of(fit_detmm, tuned_for="location"),
    "robust normals": normals_of(fit_normals_robust, estimator=fit_detmm),
}
functions = pytest.mark.parametrize("name", FUNCTIONS)
# Torch's own, where it inlines a function that has no gradient to record.
of_torch = pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")


@pytest.fixture
def patches():
    """Return four noisy faces with some points next to them, no two eigenvalues equal."""
    rng = torch.Generator().manual_seed(0)
    points = torch.randn(4, 15, 3, generator=rng, dtype=torch.float64)
    points = points * torch.tensor([1.0, 0.7, 0.05])
    points[:, 9:, 2] += 0.5 * points[:, 9:, 0].abs()
    return points


def loss_of(name):
    def loss(patches):
        return sum((part**2).sum() for part in FUNCTIONS[name](patches))

    return loss


def gradient(name, patches):
    (found,) = torch.autograd.grad(loss_of(name)(leaf := patches.clone().requires_grad_()), leaf)
    assert found.abs().max() > 0
    return found


def assert_close(found, expected):
    for part, wanted in zip(found, expected, strict=True):
        assert torch.allclose(part, wanted, rtol=1e-9, atol=1e-12)


@functions
def test_vmap_is_a_loop(name, patches):
    found = torch.vmap(FUNCTIONS[name])(patches)
    assert_close(found, FUNCTIONS[name](patches))
    # Any axis, and one vmap within another.
    grid = patches.unflatten(0, (2, 2)).movedim(1, -1)
    twice = torch.vmap(torch.vmap(FUNCTIONS[name], in_dims=-1))(grid)
    assert_close((part.flatten(0, 1) for part in twice), FUNCTIONS[name](patches))


@functions
def test_gradients_flow_through_vmap(name, patches):
    leaf = patches.clone().requires_grad_()
    sum((part**2).sum() for part in torch.vmap(FUNCTIONS[name])(leaf)).backward()
    assert_close([leaf.grad], [gradient(name, patches)])


@functions
def test_functional_gradients_are_those_of_autograd(name, patches):
    expected = gradient(name, patches)
    assert_close([torch.func.grad(loss_of(name))(patches)], [expected])
    assert_close([torch.vmap(torch.func.grad(loss_of(name)))(patches)], [expected])
    # The rows of a Jacobian add up to the gradient of the sum.
    rows = torch.func.jacrev(lambda points: FUNCTIONS[name](points)[0])(patches[0])
    leaf = patches[0].clone().requires_grad_()
    (whole,) = torch.autograd.grad(FUNCTIONS[name](leaf)[0].sum(), leaf)
    assert_close([rows.flatten(0, -3).sum(dim=0)], [whole])


@pytest.mark.slow
@of_torch
@functions
def test_compiled_without_graph_breaks(name, patches):
    torch.compiler.reset()  # The functions share code, which torch compiles only so many times.
    compiled = torch.compile(FUNCTIONS[name], fullgraph=True, backend="aot_eager")
    assert_close(compiled(patches), FUNCTIONS[name](patches))
    leaf = patches.clone().requires_grad_()
    sum((part**2).sum() for part in compiled(leaf)).backward()
    assert_close([leaf.grad], [gradient(name, patches)])


class Exported(nn.Module):
    def __init__(self, name):
        super().__init__()
        self.function = FUNCTIONS[name]

    def forward(self, patches):
        return self.function(patches)


@pytest.mark.slow
@of_torch
@functions
def test_exported_for_any_number_of_patches(name, patches):
    sizes = {0: torch.export.Dim("patches", min=2, max=1000)}
    program = torch.export.export(Exported(name), (patches,), dynamic_shapes=({**sizes},))
    more = torch.cat([patches.flip(0), patches])
    assert_close(program.module()(more), FUNCTIONS[name](more))


@functions
def test_shapes_without_values_on_meta(name, patches):
    found = FUNCTIONS[name](patches.to("meta"))
    expected = [part.shape for part in FUNCTIONS[name](patches)]
    assert [part.shape for part in found] == expected


@of_torch
@pytest.mark.parametrize("fit", [fit_detmcd, fit_detmm])
def test_masks_travel_with_their_patches(fit, patches):
    mask = torch.rand(4, 15, generator=torch.Generator().manual_seed(1)) < 0.8
    expected = fit(patches, mask)
    assert_close(torch.vmap(fit)(patches, mask)[:6], expected[:6])
    shared = fit(patches, mask[:1].expand(4, -1))
    assert_close(torch.vmap(fit, in_dims=(0, None))(patches, mask[0])[:6], shared[:6])
    planes = normals_of(fit_normals_pca)
    assert_close(torch.vmap(planes)(patches, mask), planes(patches, mask))
    compiled = torch.compile(fit, fullgraph=True, backend="eager")
    assert torch.equal(compiled(patches, mask).support, expected.support)


def test_masked_scales_and_other_axes_under_vmap(patches):
    mask = torch.rand(4, 15, 3, generator=torch.Generator().manual_seed(1)) < 0.8
    found = torch.vmap(lambda x, m: qn(x, dim=0, mask=m))(patches, mask)
    assert torch.allclose(found, qn(patches, dim=1, mask=mask))


def test_what_does_not_fit_into_an_operation_is_refused(patches):
    draw = partial(fit_fastmcd, generator=torch.Generator())
    with pytest.raises(ConfigError, match="expected no generator in a compiler or under vmap"):
        torch.vmap(draw)(patches)


@functions
@pytest.mark.filterwarnings("ignore:.*torch.jit.script")
def test_forward_mode_is_refused_in_our_words(patches, name):
    patch = patches[0].double()
    if name == "covariance":
        torch.func.jacfwd(FUNCTIONS[name])(patch)
        return
    for mode in (torch.func.jacfwd, torch.func.hessian):
        with pytest.raises(NotImplementedError, match="reverse mode only; use"):
            mode(lambda x: FUNCTIONS[name](x)[0].sum())(patch)


def test_second_derivatives_of_opaque_functions_are_refused(patches):
    hessian = torch.func.jacrev(torch.func.jacrev(lambda x: qn(x)))
    with pytest.raises(NotImplementedError, match="scale_of_rows: has no second derivatives"):
        hessian(patches[0, :, 0])
