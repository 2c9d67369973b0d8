"""vmap, torch.func, torch.compile and torch.export of the functions of patches, against eager."""

from functools import partial

import pytest
import torch
from torch import nn
from torch._dynamo.testing import CompileCounter

import torchrg
from torchrg import (
    estimate_normals,
    grow_regions,
    make_superpoints,
    search_knn,
    segment_planes,
)
from torchrg.depth import segment_depth
from torchrg.errors import ConfigError, ShapeError
from torchrg.linalg import covariance, eigh3
from torchrg.normals import (
    fit_normals_irls,
    fit_normals_jet,
    fit_normals_pca,
    fit_normals_robust,
    orient_normals,
)
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
from torchrg.transforms import EstimateNormals, SegmentPlanes


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
    return normals_of(fit_normals_irls, noise=noise, mu_decay=3.0)(patches)


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


class Model(nn.Module):
    """A model with a function of clouds in its middle."""

    def __init__(self, middle):
        super().__init__()
        torch.manual_seed(0)
        self.before, self.middle, self.after = nn.Linear(3, 3), middle, nn.Linear(3, 3)

    def forward(self, points):
        return self.after(self.middle(self.before(points)))


def regions_of(points):
    neighbors = search_knn(points, 5)
    return grow_regions(points, points, points[:, 0], neighbors, "classic")


CAMERA = torch.tensor([[30.0, 0, 1], [0, 30, 19.5], [0, 0, 1]])
NORMALS, PLANES = EstimateNormals(method="pca", k=8), SegmentPlanes("classic")
MIDDLES = {
    "estimate_normals": lambda points: estimate_normals(points, method="pca", k=8).normals,
    "EstimateNormals": lambda points: NORMALS({"coord": points})["normal"],
    "segment_planes": lambda points: points * (segment_planes(points).labels[:, None] + 1),
    "SegmentPlanes": lambda points: PLANES({"coord": points})["normal"],
    "search_knn": lambda points: points[search_knn(points, 3).indices[:, 2]],
    "orient_normals": lambda points: orient_normals(points, points),
    "make_superpoints": lambda points: points * (make_superpoints(points).labels[:, None] + 1),
    "grow_regions": lambda points: points * (2 + regions_of(points)[:, None]),
    "segment_depth": lambda points: points * (2 + segment_depth(points, CAMERA).labels),
}
OF_CLOUDS = set(MIDDLES) - {"EstimateNormals", "SegmentPlanes"}


# Torch's own, when a graph goes on with a tensor in its middle.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")
@pytest.mark.parametrize("name", MIDDLES)
def test_functions_of_clouds_break_a_graph_and_the_rest_is_compiled(name):
    model, points = (
        Model(MIDDLES[name]),
        torch.rand(40, 3, generator=torch.Generator().manual_seed(0)),
    )
    torch._dynamo.reset()
    counter = CompileCounter()
    found = torch.compile(model, backend=counter)(points)
    assert torch.equal(found, model(points))
    found.sum().backward()
    # One graph before and one behind, with a Linear each.
    assert counter.frame_count >= 2
    assert model.before.weight.grad is None or model.before.weight.grad.isfinite().all()


@pytest.mark.parametrize("name", sorted(OF_CLOUDS))
@pytest.mark.parametrize("call", [torch.vmap, torch.func.grad, torch.func.jacrev])
def test_functions_of_clouds_say_where_they_do_not_run(call, name):
    with pytest.raises(ShapeError, match=r"\w+: expected points with values, got a tensor of vmap"):
        call(lambda points: MIDDLES[name](points).sum())(torch.rand(2, 9, 3))


@of_torch
@pytest.mark.parametrize("name", sorted(OF_CLOUDS))
def test_functions_of_clouds_are_not_exported(name):
    class Whole(nn.Module):
        def forward(self, points):
            return MIDDLES[name](points)

    with pytest.raises(torch._dynamo.exc.Unsupported):
        torch.export.export(Whole(), (torch.rand(40, 3),), strict=True)


# What the tests of this file call otherwise.
NAMES = {
    "pca": "fit_normals_pca",
    "jet": "fit_normals_jet",
    "irls": "fit_normals_irls",
    "robust normals": "fit_normals_robust",
    **{name: f"fit_{name}" for name in ("detmcd", "fastmcd", "mve", "dets", "detmm")},
}


@pytest.mark.parametrize(
    ("kind", "tested"), [("Functions of patches", FUNCTIONS), ("Functions of clouds", OF_CLOUDS)]
)
def test_the_reference_names_the_functions_that_are_tested(kind, tested):
    listed = torchrg.__doc__.split(f"{kind} (")[1].partition(")")[0]
    names = {NAMES.get(name, name) for name in tested}
    assert set(listed.replace("`", "").replace(",", " ").split()) == names
