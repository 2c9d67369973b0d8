"""Gradients: from clouds to normals, through eigenvectors, robust fits and scales."""

from functools import partial

import pytest
import torch
from torch.autograd import gradcheck

import torchrg
from torchrg.config import NormalsConfig
from torchrg.errors import ConfigError
from torchrg.linalg import eigh3, unsigned_angle_deg
from torchrg.normals import (
    ESTIMATORS,
    estimate_normals,
    find_sharp_points,
    fit_jet,
    fit_normals_irls,
    fit_normals_pca,
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
from torchrg.robust.mm import breakdown_constant, efficiency_constant
from torchrg.transforms import EstimateNormals, SegmentPlanes

FITS = sorted(ESTIMATORS.keys() - {"consensus"})
irls = partial(fit_normals_irls, noise=torch.tensor(0.01), mu_decay=4.0)
# A scale that shrinks by a third in a step, for as few steps as still make sense.
FEW_STEPS = NormalsConfig(irls_decay=1.5)


def bracket(seed, count=14, dtype=torch.float64):
    """Return two noisy faces that meet at a right angle."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=rng, dtype=torch.float64)
    face = torch.arange(count) % 2
    noise = torch.randn(count, generator=rng, dtype=torch.float64)
    points[torch.arange(count), face] = 0.02 * noise
    return points.to(dtype)


def projectors(points, method):
    """Return the normals without their sign."""
    normals = estimate_normals(points, method=method, k=10, config=FEW_STEPS).normals
    return normals[:, :, None] * normals[:, None, :]


@pytest.mark.parametrize("method", FITS)
def test_normals_of_a_cloud_have_the_gradient_of_finite_differences(method):
    points = bracket(0).requires_grad_()
    assert gradcheck(partial(projectors, method=method), points, fast_mode=True, atol=1e-4)


@pytest.mark.parametrize("method", FITS)
def test_gradients_change_no_value(method, dtype):
    points = bracket(0, 40, dtype)
    plain = estimate_normals(points, method=method, k=10, config=FEW_STEPS)
    points.requires_grad_()
    fit = estimate_normals(points, method=method, k=10, config=FEW_STEPS)
    assert torch.equal(fit.valid, plain.valid)
    # Without a gradient, kernels fit in single precision, whatever the type of the points.
    step = 1e-4 if method in ("pca", "paper") or dtype == torch.float64 else 0
    assert unsigned_angle_deg(fit.normals, plain.normals).max() <= 60 * step
    for found, expected in (
        (fit.curvature, plain.curvature),
        (fit.residual_rms, plain.residual_rms),
    ):
        assert (found - expected).abs().max() <= step
    assert fit.normals.requires_grad
    assert fit.curvature.requires_grad


@pytest.mark.parametrize("fit", [fit_normals_pca, fit_jet], ids=["pca", "jet"])
def test_planes_of_patches_have_the_gradient_of_finite_differences(fit):
    rows = [*range(0, 24, 2), *range(1, 9, 2)]  # most on the face of the first point
    patches = torch.stack([bracket(seed, 24)[rows] for seed in (0, 1)])
    mask = (torch.arange(16) != 6).expand(2, 16)

    def all_parts(points):
        found = fit(points, mask)._asdict()
        # Directions of curvature have no sign.
        names = ("normals", "curvature", "residual_rms", "foot", "principal_curvatures")
        return tuple(found[name] for name in names if name in found)

    assert gradcheck(all_parts, patches.requires_grad_(), fast_mode=True)


def test_gradients_reach_a_sample_and_survive_orientation():
    points = bracket(0, 40).requires_grad_()
    sample = EstimateNormals(method="pca", k=10)({"coord": points})
    turned = orient_normals(
        points, sample["normal"], orient="viewpoint", viewpoint=torch.ones(3).double()
    )
    (turned[:, 2] ** 2).sum().backward()
    assert points.grad.isfinite().all()
    assert points.grad.abs().max() > 0
    assert find_sharp_points(sample["normal"], torchrg.search_knn(points, 10)).dtype == torch.bool


def test_consensus_refuses_points_that_require_gradients():
    points = bracket(0).requires_grad_()
    with pytest.raises(ConfigError, match=r"expected a method with gradients \(detmcd, .*got 'con"):
        estimate_normals(points, method="consensus")
    with torch.no_grad():
        assert not estimate_normals(points, method="consensus").normals.requires_grad


@pytest.mark.parametrize("preset", ["classic", "paper", "consensus"])
def test_planes_of_points_that_require_gradients_are_the_same(preset):
    points = bracket(0, 300, torch.float32)
    config = torchrg.load_config(preset)
    plain = torchrg.segment_planes(points, config)
    points.requires_grad_()
    found = torchrg.segment_planes(points, config)
    assert torch.equal(found.labels, plain.labels)
    assert torch.equal(found.normals, plain.normals)
    assert SegmentPlanes(preset)({"coord": points})["plane"].equal(plain.labels)
    assert torchrg.make_superpoints(points, found).labels.equal(
        torchrg.make_superpoints(points.detach(), plain).labels
    )


def test_a_loss_on_normals_moves_a_bent_strip_flat():
    # A strip that bends by 60 degrees, and points that may only move up and down.
    x, y = torch.cartesian_prod(torch.linspace(0, 1, 12), torch.linspace(0, 0.3, 4)).unbind(1)
    height = (0.6 * (x - 0.5).abs()).requires_grad_()
    optimizer = torch.optim.Adam([height], lr=0.01)

    def turns():
        points = torch.stack([x, y, height], dim=1)
        normals = torchrg.estimate_normals(points, method="pca", k=9).normals
        return 1 - normals[:, 2] ** 2

    before = turns().mean().item()
    for _ in range(150):
        optimizer.zero_grad()
        loss = turns().mean()
        loss.backward()
        optimizer.step()
    assert before > 0.2
    assert turns().mean().item() < 0.002
    assert float(height.detach().max() - height.detach().min()) < 0.1


def spectra(kind, count, dtype):
    """Return covariances with isotropic, thin or nearly repeated eigenvalues."""
    rng = torch.Generator().manual_seed(5)
    turn = torch.linalg.qr(torch.randn(count, 3, 3, generator=rng, dtype=torch.float64))[0]
    noise = torch.rand(count, 3, generator=rng, dtype=torch.float64)
    values = {
        "isotropic": 1 + noise,
        "thin": torch.tensor([1e-4, 0.5, 1.0]) * (1 + noise),
        "nearly": 1 + noise * 10 ** (-12 * torch.rand(count, 1, generator=rng)).double(),
    }[kind]
    return ((turn * values[:, None]) @ turn.mT).to(dtype)


@pytest.mark.parametrize("kind", ["isotropic", "thin", "nearly"])
def test_gradients_of_eigh_are_those_of_torch_and_never_nan(kind, dtype):
    # 10,000 covariances, a loss of values and projectors, whose gradients no sign can change.
    matrices = spectra(kind, 10_000, dtype)
    weights = torch.randn(10_000, 3, 3, generator=torch.Generator().manual_seed(1)).to(dtype)

    def gradient(decompose, given):
        given = given.clone().requires_grad_()
        values, vectors = decompose(given)
        flat = vectors[..., 0]
        loss = (values * weights[:, 0].to(values)).sum()
        loss = loss + (flat[..., :, None] * flat[..., None, :] * weights.to(values)).sum()
        (found,) = torch.autograd.grad(loss, given)
        return values.detach(), found

    _, found = gradient(eigh3, matrices)
    values, expected = gradient(torch.linalg.eigh, matrices.double())
    assert found.isfinite().all()
    # A gap is known to a rounding of the largest value, and the gradient is of one by the gap.
    gap = values.diff(dim=1).amin(dim=1) / values[:, 2]
    error = (found.double() - expected).abs().amax(dim=(1, 2)) / expected.abs().amax(dim=(1, 2))
    clear = gap > 0.05
    assert clear.sum() > (1 if kind == "nearly" else 5000)
    assert error[clear].max() < {torch.float32: 1e-4, torch.float64: 1e-9}[dtype]
    known = {torch.float32: 1e-5, torch.float64: 1e-13}[dtype]
    assert (error * gap)[gap > known].max() < known * 10


@pytest.mark.parametrize("diagonal", [(0.0, 1, 1), (0, 0, 1), (1, 1, 1), (0, 0, 0)])
def test_repeated_eigenvalues_have_finite_gradients(dtype, diagonal):
    matrix = torch.diag(torch.tensor(diagonal, dtype=dtype)).requires_grad_()
    values, vectors = eigh3(matrix)
    (values.sum() + (vectors**3).sum()).backward()
    assert matrix.grad.isfinite().all()


@pytest.mark.parametrize("fit", [fit_normals_pca, fit_jet, irls], ids=["pca", "jet", "irls"])
@pytest.mark.parametrize(
    "points",
    [
        torch.zeros(8, 3),
        torch.eye(3),
        torch.cat([torch.eye(3), -torch.eye(3)]),
        torch.cartesian_prod(torch.arange(3.0), torch.arange(3.0), torch.zeros(1)),
        torch.arange(8.0)[:, None].expand(8, 3),
    ],
    ids=["one place", "triangle", "octahedron", "lattice", "line"],
)
def test_planes_with_repeated_eigenvalues_have_finite_gradients(fit, points):
    points = points.clone().requires_grad_()
    parts = fit(points)._asdict().values()
    sum(part.sum() for part in parts if part is not None and part.requires_grad).backward()
    assert points.grad.isfinite().all()


def test_normal_of_a_plane_with_a_round_disc_has_its_gradient():
    # The two larger eigenvalues are equal; the smallest eigenvector is still well defined.
    def normal(matrix):
        flat = eigh3((matrix + matrix.mT) / 2)[1][..., 0]
        return flat[:, None] * flat

    matrix = torch.diag(torch.tensor([0.1, 1, 1], dtype=torch.float64)).requires_grad_()
    assert gradcheck(normal, matrix)


def test_eigenvalues_and_projectors_have_second_derivatives():
    def loss(matrix):
        values, vectors = eigh3((matrix + matrix.mT) / 2)
        return (values**2).sum() + vectors[..., 0].pow(4).sum()

    matrix = spectra("isotropic", 2, torch.float64).requires_grad_()
    assert torch.autograd.gradgradcheck(loss, matrix)


def thin_patches(seed, shape=(2, 24)):
    rng = torch.Generator().manual_seed(seed)
    points = torch.randn(*shape, 3, generator=rng, dtype=torch.float64)
    points = points * torch.tensor([1.0, 0.7, 0.02])
    points[..., :5, 2] += 2
    return points


@pytest.mark.parametrize(
    "fit", [fit_detmcd, partial(fit_detmcd, inliers="reweighted"), fit_fastmcd, fit_mve]
)
def test_location_and_covariance_have_the_gradient_of_the_chosen_points(fit):
    def both(patches):
        found = fit(patches)
        return found.location, found.covariance

    for seed in range(3):
        patches = thin_patches(seed).requires_grad_()
        assert gradcheck(both, patches, fast_mode=True)
    assert not fit(patches).raw_covariance.requires_grad


@pytest.mark.parametrize(
    ("fit", "cutoff"),
    [(fit_dets, breakdown_constant(3)), (fit_detmm, efficiency_constant(3, "shape"))],
)
def test_gradient_of_weighted_fits_holds_weights_fixed(fit, cutoff):
    patches = thin_patches(0).requires_grad_()
    found = fit(patches)
    weights = (1 - found.sq_distances / cutoff**2).clamp(min=0) ** 2
    mean = (weights[..., None] * patches).sum(1) / weights.sum(1, keepdim=True)
    assert torch.allclose(mean, found.location, rtol=1e-6)
    towards = torch.randn(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ours = torch.autograd.grad((found.location * towards).sum(), patches, retain_graph=True)[0]
    theirs = torch.autograd.grad((mean * towards).sum(), patches)[0]
    assert torch.allclose(ours, theirs, rtol=1e-6)
    assert found.covariance.requires_grad


def test_points_that_do_not_count_have_no_gradient():
    patches = thin_patches(0)
    patches[0, 20:] = torch.nan
    mask = torch.ones(2, 24, dtype=torch.bool)
    mask[1, 7] = False
    patches.requires_grad_()
    fit_detmcd(patches, mask).covariance.sum().backward()
    assert patches.grad.isfinite().all()
    assert not patches.grad[0, 20:].any()
    assert not patches.grad[1, 7].any()


@pytest.mark.parametrize("scale", [median, mad, qn, tau, partial(qn, finite_sample=True)])
@pytest.mark.parametrize("count", [7, 12])
def test_scales_have_the_gradient_of_the_values_they_pick(scale, count):
    values = torch.randn(5, count, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    mask = torch.rand(5, count, generator=torch.Generator().manual_seed(3)) < 0.8
    values.requires_grad_()
    assert torch.equal(scale(values), scale(values.detach()))
    assert gradcheck(scale, values)
    assert gradcheck(lambda x: scale(x.mT, dim=0, mask=mask.mT), values)


def test_qn_of_its_pair():
    values = torch.tensor([1.0, 2.0, 4.0, 8.0, 100.0], requires_grad=True)
    qn(values).backward()
    assert values.grad.tolist() == pytest.approx([-2.2219, 0, 2.2219, 0, 0])
    broken = torch.tensor([1.0, torch.nan, 2.0], requires_grad=True)
    assert qn(broken).isnan()
