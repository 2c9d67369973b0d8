"""What every estimator promises, whatever it computes."""

import warnings

import pytest
import torch

from torchrg import segment_planes
from torchrg.errors import ConfigError
from torchrg.linalg import unsigned_angle_deg
from torchrg.neighbors import search_knn
from torchrg.normals import ESTIMATORS, estimate_normals
from torchrg.structures import Neighbors

K = 20
COUNT = 102
# Degrees by which a unit, an origin or a precision may turn a normal. MVE and the methods that take
# one of several solutions may take another one at the few points where two are equally good.
SAME_DEG = 0.02
SWAPPED = 3


methods = pytest.mark.parametrize("method", sorted(ESTIMATORS))
# Its hundreds of small steps take a second however few the points.
methods_but_irls = pytest.mark.parametrize("method", sorted(ESTIMATORS.keys() - {"irls"}))


@pytest.fixture(scope="module")
def corner():
    """Noisy floor and two walls, and their normals; float32."""
    rng = torch.Generator().manual_seed(3)
    points = torch.rand(COUNT, 3, generator=rng)
    face = torch.arange(COUNT) % 3
    points[torch.arange(COUNT), face] = 0.02 * torch.randn(COUNT, generator=rng)
    return points, torch.eye(3)[face]


@pytest.fixture(scope="module")
def fits(corner):
    """The fit of each method to the corner, made once."""
    return {method: estimate_normals(corner[0], method=method, k=K) for method in ESTIMATORS}


def assert_same(fit, expected, tolerance_deg=SAME_DEG):
    turned = unsigned_angle_deg(fit.normals.double(), expected.normals.double()) > tolerance_deg
    assert turned.sum() <= SWAPPED
    assert torch.equal(fit.valid, expected.valid)
    difference = (fit.curvature.double() - expected.curvature.double()).abs()
    assert (difference > 1e-4).sum() <= SWAPPED


def assert_equal(fit, expected):
    for name in ("normals", "curvature", "valid", "residual_rms"):
        assert torch.equal(getattr(fit, name), getattr(expected, name)), name
    assert (fit.sharp is None) == (expected.sharp is None)
    assert fit.sharp is None or torch.equal(fit.sharp, expected.sharp)


@methods
def test_fit_is_right_and_in_its_ranges(corner, fits, method):
    fit = fits[method]
    assert unsigned_angle_deg(fit.normals, corner[1]).median() < 15
    assert fit.valid.all()
    assert torch.allclose(fit.normals.norm(dim=1), torch.ones(COUNT), atol=1e-5)
    assert fit.curvature.min() >= 0
    assert fit.curvature.max() <= 1 / 3
    assert fit.residual_rms.isfinite().all()
    assert fit.residual_rms.min() >= 0
    assert (fit.sharp is not None) == (method in ("paper", "consensus"))


@methods_but_irls
@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_unit_changes_nothing(corner, fits, method, unit):
    fit = estimate_normals(corner[0] * unit, method=method, k=K)
    assert_same(fit, fits[method])
    near = torch.isclose(fit.residual_rms, fits[method].residual_rms * unit, rtol=1e-3, atol=0)
    assert (~near).sum() <= SWAPPED


@methods_but_irls
def test_far_origin_changes_nothing_in_float64(corner, fits, method):
    # Multiples of 2^-20, so that the move itself rounds nothing.
    points = (corner[0].double() * 2**20).round() / 2**20
    fit = estimate_normals(points + 5e6, method=method, k=K)
    assert fit.normals.dtype == torch.float64
    assert_same(fit, fits[method])


@methods_but_irls
def test_order_changes_nothing(corner, fits, method):
    order = torch.randperm(COUNT, generator=torch.Generator().manual_seed(0))
    fit = estimate_normals(corner[0][order], method=method, k=K)
    assert_equal(fit, fits[method].map(lambda part: part[order]))


@methods_but_irls
def test_chunk_size_changes_nothing(corner, fits, method):
    # The last chunk is a single point.
    fit = estimate_normals(corner[0], method=method, k=K, chunk_size=COUNT - 1)
    assert_equal(fit, fits[method])


@pytest.mark.parametrize("method", ["pca", "jet", "paper", "detmcd"])
def test_number_of_threads_changes_nothing(method, set_threads):
    # Enough numbers for torch to share them out: it does not below 32,768.
    points = torch.rand(1700, 3, generator=torch.Generator().manual_seed(0))
    points[:, 2] *= torch.arange(1700) % 2 / 10
    found = []
    for count in (1, 2):
        set_threads(count)
        found.append(estimate_normals(points, method=method, k=K))
    assert_equal(*found)


@methods_but_irls
def test_points_that_are_not_finite_take_no_part(corner, fits, method):
    bad = torch.tensor([[torch.nan, 0, 0], [0, torch.inf, 0]])
    points = torch.cat([bad[:1], corner[0], bad[1:]])
    fit = estimate_normals(points, method=method, k=K)
    assert_equal(fit.map(lambda part: part[1:-1]), fits[method])
    for row in (0, -1):
        assert not fit.valid[row]
        assert not fit.normals[row].any()


@pytest.mark.parametrize("method", sorted(ESTIMATORS.keys() - {"irls", "detmm"}))
def test_neighbors_outside_the_radius_do_not_count(corner, method):
    # The columns beyond the most neighbors of any point hold nothing that counts.
    points = corner[0][:70]
    wide = search_knn(points, 40, max_distance=0.45)
    most = int(wide.valid.sum(dim=1).max())
    cut = Neighbors(wide.indices[:, :most].contiguous(), wide.valid[:, :most].contiguous())
    fit = estimate_normals(points, method=method, neighbors=wide)
    expected = estimate_normals(points, method=method, neighbors=cut)
    assert most < 40
    assert_same(fit, expected)


@methods
def test_a_point_without_near_neighbors_is_not_valid(corner, method):
    points = torch.cat([corner[0], torch.tensor([[9.0, 9, 9]])])
    fit = estimate_normals(points, method=method, k=K, max_distance=0.6)
    assert fit.valid[:-1].all()
    assert not fit.valid[-1]
    assert not fit.normals[-1].any()


@methods
@pytest.mark.parametrize("axis", [0, 2])
def test_exact_axis_aligned_plane_is_found(method, axis, dtype):
    plane = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)).to(dtype)
    plane[:, axis] = 1.7
    fit = estimate_normals(plane, method=method, k=K)
    assert fit.valid.all()
    assert torch.allclose(fit.normals.abs(), torch.eye(3, dtype=dtype)[axis], atol=1e-6)
    assert fit.curvature.max() < 1e-12
    assert fit.residual_rms.max() < 1e-6


@methods
def test_plane_on_a_millimetre_grid_is_found(method):
    uv = torch.rand(100, 2, generator=torch.Generator().manual_seed(0))
    normal = torch.tensor([0.2, -0.3, 1.0])
    normal = normal / normal.norm()
    height = -(uv * normal[:2]).sum(dim=1) / normal[2]
    points = (torch.cat([uv, height[:, None]], dim=1) * 1000).round() / 1000
    fit = estimate_normals(points, method=method, k=K)
    assert fit.valid.all()
    assert unsigned_angle_deg(fit.normals, normal[None]).max() < 1.5
    assert fit.residual_rms.max() < 1e-3


@methods_but_irls
def test_duplicates_are_no_trouble(corner, method):
    points = corner[0][:50].repeat(3, 1)
    fit = estimate_normals(points, method=method, k=K)
    assert fit.normals.isfinite().all()
    assert fit.curvature.isfinite().all()
    lengths = fit.normals.norm(dim=1)
    assert torch.allclose(lengths, fit.valid.float(), atol=1e-5)
    # The three of each place see the same neighbors.
    turned = unsigned_angle_deg(fit.normals[:50], fit.normals[50:100])
    assert (turned > SAME_DEG).sum() <= SWAPPED


@methods
@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.3, -0.7, 0.2), (0.0, 0.0, 0.0)])
def test_a_line_and_one_place_have_no_plane(method, dtype, direction):
    along = torch.rand(40, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    line = (0.3 + along * torch.tensor(direction, dtype=torch.float64)).to(dtype)
    fit = estimate_normals(line, method=method, k=K)
    assert not fit.valid.any()
    assert not fit.normals.any()
    assert not fit.curvature.any()


@methods
@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_points_have_no_plane(method, count):
    fit = estimate_normals(torch.rand(count, 3), method=method)
    assert fit.normals.shape == (count, 3)
    assert not fit.valid.any()


@methods
def test_three_points_span_a_plane(method):
    fit = estimate_normals(torch.eye(3), method=method)
    assert fit.valid.all()
    assert torch.allclose(fit.normals.abs(), torch.full((3, 3), 3**-0.5), atol=1e-6)


def test_unknown_method_is_refused():
    with pytest.raises(ConfigError, match=r"method to be one of pca, .*, got 'best'"):
        estimate_normals(torch.rand(5, 3), method="best")


@pytest.mark.parametrize("name", ["k", "adaptive_k"])
def test_more_neighbors_than_a_cloud_has_are_refused(name, corner):
    points = corner[0].repeat(10, 1)  # Copies are no neighbors.
    message = rf"normals\.{name} of at most 512 for {COUNT} distinct points, got 100,000; lower"
    with pytest.raises(ConfigError, match=f"estimate_normals: expected {message}"):
        estimate_normals(points, **{name: 100_000})
    with pytest.raises(ConfigError, match=f"segment_planes: expected {message}"):
        segment_planes(points, **{f"normals.{name}": 100_000})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimate_normals(points, method="pca", k=512)
