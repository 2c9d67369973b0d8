"""Consensus normals: right at edges, smooth on curved surfaces, the same whatever the order."""

import dataclasses

import pytest
import torch

from tests.kernels.clouds import both, clouds, lists, needs_library
from tests.made import make_shape
from torchrg.config import NormalsConfig
from torchrg.errors import ConfigError
from torchrg.linalg import unsigned_angle_deg
from torchrg.neighbors import canonical_order, search_knn
from torchrg.normals import estimate_normals
from torchrg.normals.consensus import adapted_count, estimate_consensus
from torchrg.normals.jet import fit_normals_jet
from torchrg.normals.pca import fit_normals_pca, fit_points
from torchrg.structures import Neighbors

CLOUDS = {name: points for name, points in clouds().items() if name != "line"}


def in_order(points, truth):
    order = canonical_order(points)
    return points[order].contiguous(), truth[order]


def shape(name, num_points, noise=0.0):
    scene = make_shape(name, num_points, noise, seed=1)
    return in_order(scene.points, scene.normals)


def consensus(points, k=50, chunk_size=16384, **settings):
    config = NormalsConfig(k=k, **settings)
    return estimate_consensus(points, search_knn(points, k), config, chunk_size)


def errors(fit, truth):
    angles = unsigned_angle_deg(fit.normals.double(), truth.double())
    return float(angles.mean()), float(angles.square().mean().sqrt())


def fit_all(points, estimate, k=50):
    return fit_points(points, search_knn(points, k), estimate)


@pytest.mark.parametrize("noise", [0.006, 0.012])
def test_consensus_is_no_worse_than_pca_in_noise(noise):
    points, truth = shape("dodecahedron", 5000, noise)
    mean, rms = errors(consensus(points), truth)
    pca_mean, pca_rms = errors(fit_all(points, fit_normals_pca), truth)
    assert mean <= 1.05 * pca_mean
    assert rms**2 <= 1.05 * pca_rms**2


def test_neighborhoods_that_grow_with_the_noise_are_better_than_fixed_ones():
    points, truth = shape("torus", 5000, 0.012)
    mean, rms = errors(consensus(points, adaptive_k=300), truth)
    fixed_mean, fixed_rms = errors(fit_all(points, fit_normals_jet), truth)
    assert mean < 0.9 * fixed_mean
    assert rms < 0.9 * fixed_rms
    assert mean < errors(consensus(points), truth)[0]


def test_both_faces_and_the_rim_of_a_plate_are_told_apart():
    points, truth = shape("thin_plate", 12_000)
    radius = (points[search_knn(points, 50).indices[:, -1].long()] - points).norm(dim=1)
    assert radius.median() > 0.02, "both faces lie in one neighbourhood"
    assert errors(consensus(points), truth)[0] < 0.5


@pytest.fixture(scope="module")
def noisy_bracket():
    points, _ = shape("bracket", 2000, 0.002)
    return points, consensus(points)


def test_masked_neighbors_do_not_count(noisy_bracket):
    points, fit = noisy_bracket
    known = search_knn(points, 50).indices
    own = torch.arange(len(points), dtype=torch.int32)[:, None].expand(-1, 10)
    valid = torch.cat([torch.ones_like(known), torch.zeros_like(own)], dim=1).bool()
    neighbors = Neighbors(torch.cat([known, own], dim=1), valid)
    other = estimate_consensus(points, neighbors, NormalsConfig(k=60), 16384)
    angles = unsigned_angle_deg(fit.normals, other.normals)
    assert float(angles.median()) < 0.1
    assert float((fit.sharp == other.sharp).float().mean()) > 0.95


def test_degenerate_clouds_have_documented_answers():
    line = torch.zeros(60, 3)
    line[:, 0] = torch.arange(60.0)
    for cloud in (line, torch.ones(60, 3)):
        fit = consensus(cloud)
        assert not fit.valid.any()
        assert not fit.sharp.any()
        assert float(fit.normals.abs().max()) == 0
    grid = torch.cartesian_prod(torch.arange(9.0), torch.arange(9.0), torch.zeros(1))
    for cloud in (grid, grid.repeat(3, 1)):
        fit = consensus(cloud)
        assert fit.valid.all()
        assert not fit.sharp.any()
        assert torch.equal(fit.normals.abs(), torch.tensor([[0.0, 0, 1]]).expand(len(cloud), 3))
        assert float(fit.curvature.max()) < 1e-12


def test_few_neighbors_give_pca():
    points, _ = shape("cube", 300)
    fit, pca = consensus(points, k=8), estimate_normals(points, method="pca", k=8)
    assert torch.equal(fit.normals, pca.normals)
    assert not fit.sharp.any()


def test_adaptive_k_must_not_be_below_k():
    with pytest.raises(ConfigError, match="adaptive_k"):
        dataclasses.replace(NormalsConfig(), adaptive_k=20)


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize(
    ("name", "masked"),
    [*((name, False) for name in CLOUDS), ("room", True), ("grid", True), ("doubled", True)],
)
def test_kernels_find_the_normals_of_the_definition(name, masked):
    points = CLOUDS[name][::3].contiguous() if masked else CLOUDS[name]
    near = lists(points, 50, masked)
    config = NormalsConfig(noise_scope="regional" if masked else "local")
    found, expected = both(estimate_consensus, points, near, config, 1024)
    # Double precision hides that roots in torch are off by a bit, but not from each of many points.
    for one, other in zip(found, expected, strict=True):
        same = one.nan_to_num() == other.nan_to_num()
        assert same.float().mean() > 0.9995


def test_adapted_count_by_example():
    fractions = torch.full((500,), 0.3)
    assert adapted_count(fractions, 50, NormalsConfig(adaptive_k=300)) == 200
