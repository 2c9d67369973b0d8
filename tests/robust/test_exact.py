import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchrg
from tests.robust.oracle_cases import ESTIMATORS, angle_deg, normal_of
from torchrg.errors import ConfigError
from torchrg.robust import fit_detmcd, fit_dets

# The cases include patches of fewer than six points.
pytestmark = pytest.mark.filterwarnings("ignore:.*too few to trust the covariance")


def assert_sound(fit):
    """Everything is finite where there is a fit, but for the distances off an exact plane."""
    for name, field in fit._asdict().items():
        if name in ("sq_distances", "log_det"):
            continue
        assert torch.isfinite(field).all(), name
    assert not fit.sq_distances.isnan().any()
    assert not fit.log_det[fit.valid].isnan().any()
    assert not (fit.exact_fit & ~fit.valid).any()
    assert (fit.support.any(-1) == fit.valid).all()
    assert (fit.log_det[fit.exact_fit] == -torch.inf).all()


def tilted_plane(rng, num_points, dtype=torch.float64):
    """Points exactly on z = x / 2 + y / 4: dyadic coordinates, no rounding."""
    grid = torch.randint(-512, 512, (num_points, 2), generator=rng).to(dtype) / 256
    return torch.stack([grid[:, 0], grid[:, 1], grid[:, 0] / 2 + grid[:, 1] / 4], dim=1)


NORMAL = np.array([0.5, 0.25, -1]) / np.linalg.norm([0.5, 0.25, -1])


@pytest.mark.parametrize("file", ["region_growing_tutorial.pcd", "kinect_capture0001.pcd"])
def test_no_real_neighborhood_is_unsound(scan, file):
    points = torchrg.read_cloud(scan(file)).points
    points = points[torch.isfinite(points).all(dim=1)]
    some = points[:: len(points) // 40]
    neighbors = torch.cdist(some, points).topk(50, largest=False).indices
    for name, fit in ESTIMATORS.items():
        found = fit(points[neighbors])
        assert_sound(found)
        assert found.valid.all(), name


@pytest.mark.parametrize("count", [27, 50])
def test_majority_on_a_plane_is_an_exact_fit(estimator, count, dtype, rng):
    patch = torch.rand(50, 3, generator=rng, dtype=dtype)
    patch[torch.randperm(50, generator=rng)[:count]] = tilted_plane(rng, count, dtype)
    on_plane = patch[:, 2] == patch[:, 0] / 2 + patch[:, 1] / 4
    fit = estimator(patch)
    assert fit.exact_fit
    assert torch.equal(fit.support, on_plane)
    assert angle_deg(normal_of(fit.covariance), NORMAL) < (1e-4 if dtype == torch.float32 else 1e-5)
    assert (fit.sq_distances[on_plane] == 0).all()
    assert (fit.sq_distances[~on_plane] == torch.inf).all()


@pytest.mark.parametrize(("unit", "offset"), [(1e6, 0.0), (1e-6, 4e6)])
def test_exact_fit_in_any_unit_and_far_from_the_origin(estimator, unit, offset, rng):
    turn = torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float64)).Q
    plane = tilted_plane(rng, 32)
    others = torch.rand(18, 3, generator=rng, dtype=torch.float64)
    patch = torch.cat([plane, others]) @ turn.T * unit + offset * unit
    fit = estimator(patch)
    assert fit.exact_fit
    assert fit.support[:32].all()
    assert not fit.support[32:].any()
    tolerance = 1e-5 if offset == 0 else 1e-6 / 1e-2
    assert angle_deg(normal_of(fit.covariance / unit**2), turn.numpy() @ NORMAL) < tolerance


@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_no_exact_plane_is_missed(offset, dtype, rng):
    patches = torch.randn(1500, 50, 3, generator=rng, dtype=torch.float64)
    patches[:, :30, 2] = 0
    turn = torch.linalg.qr(torch.randn(1500, 3, 3, generator=rng, dtype=torch.float64)).Q
    shift = offset * torch.randn(1500, 1, 3, generator=rng, dtype=torch.float64)
    fit = fit_detmcd((patches @ turn + shift).to(dtype), starts="planes")
    assert fit.exact_fit.all()
    assert fit.support[:, :30].all()
    assert fit.support[:, 30:].sum() < 5


def test_half_of_the_points_on_a_plane_is_no_exact_mcd(rng):
    patch = torch.rand(50, 3, generator=rng, dtype=torch.float64)
    patch[:26] = tilted_plane(rng, 26)
    fit = fit_detmcd(patch, starts="planes")
    assert not fit.exact_fit
    assert fit.valid
    assert angle_deg(normal_of(fit.covariance), NORMAL) < 1
    assert fit_dets(patch).exact_fit


def test_all_points_on_a_line_or_in_one_place_have_no_plane(estimator, dtype, rng):
    line = torch.rand(50, 1, generator=rng, dtype=dtype) * torch.tensor([0.0, 2.0, 0.0]).to(dtype)
    diagonal = torch.randint(-9, 9, (50, 1), generator=rng).to(dtype).expand(-1, 3)
    for patch in (line, diagonal, torch.full((50, 3), 0.1, dtype=dtype), torch.zeros(50, 3)):
        fit = estimator(patch, min_dimension=2)
        assert not fit.valid
        assert not fit.support.any()
        assert not fit.covariance.any()
        whole = estimator(patch)
        assert whole.exact_fit
        assert whole.support.all()
        wide = patch.double().numpy()
        np.testing.assert_allclose(whole.location, wide.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(whole.covariance, np.cov(wide.T), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("count", [25, 36])
@pytest.mark.parametrize("free", [0, 1])
def test_a_majority_on_a_line_or_in_one_place_is_fitted_as_one_that_nearly_is(
    estimator, count, free
):
    numbers = np.random.default_rng(3)
    noise, patch = numbers.standard_normal((count, 3 - free)), numbers.standard_normal((40, 3))
    fits = []
    for away in (0, 1e-6):
        patch[:count, free:] = away * noise
        fits.append(estimator(torch.from_numpy(patch.copy())))
        assert fits[-1].support[:count].sum() > 0.6 * count
        assert not fits[-1].support[count:].any()
    exact, near = fits
    assert exact.exact_fit
    assert exact.support[:count].all()
    assert not near.exact_fit
    assert (exact.location - near.location).abs().max() < 0.4 * free + 1e-5


def test_a_least_dimension_that_points_do_not_have_is_refused(estimator, rng):
    patch = torch.rand(9, 3, generator=rng)
    assert estimator(patch, min_dimension=1).valid
    for wrong in (-1, 3, 10**23):
        with pytest.raises(ConfigError, match="expected min_dimension from 0 to 2 for points"):
            estimator(patch, min_dimension=wrong)


def test_majority_on_a_line_leaves_the_plane_of_the_others_to_normals(estimator, rng):
    line = torch.randint(-512, 512, (30, 1), generator=rng) * torch.tensor([0.5, 1.0, 2.0]) / 64
    patch = torch.cat([line.double(), tilted_plane(rng, 20)])
    place = torch.cat([torch.full((30, 3), 0.3).double(), tilted_plane(rng, 20)])
    for points in (patch, place):
        fit = estimator(points, min_dimension=2)
        assert fit.exact_fit
        assert angle_deg(normal_of(fit.covariance), NORMAL) < 1e-5
        assert estimator(points).support.tolist() == [True] * 30 + [False] * 20


def test_two_lines_span_a_plane(estimator):
    steps = torch.arange(25.0, dtype=torch.float64)
    zero = torch.zeros(25, dtype=torch.float64)
    first = torch.stack([steps, zero, zero], dim=1)
    second = torch.stack([steps[:15], zero[:15] + 3, zero[:15] + 1.5], dim=1)
    more = first[:10] + torch.tensor([25.0, 0.0, 0.0])
    fit = estimator(torch.cat([first, more, second]), min_dimension=2)
    assert fit.exact_fit
    assert fit.support.all()
    expected = np.array([0, -0.5, 1]) / np.hypot(0.5, 1)
    assert angle_deg(normal_of(fit.covariance), expected) < 1e-5


def test_few_points(estimator, rng):
    patches = torch.randn(4, 6, 3, generator=rng, dtype=torch.float64)
    for count in range(7):
        for least in (0, 1, 2):
            fit = estimator(patches[:, :count], min_dimension=least)
            assert_sound(fit)
            assert (fit.valid == (count > least)).all()
            assert (fit.exact_fit == (least < count <= 3)).all()
    fit = estimator(patches[:, :3])
    normal = torch.linalg.cross(patches[:, 1] - patches[:, 0], patches[:, 2] - patches[:, 0])
    for covariance, expected in zip(fit.covariance, normal, strict=True):
        assert angle_deg(normal_of(covariance), expected / expected.norm()) < 1e-4


def test_non_finite_points_do_not_count(estimator, rng):
    patches = torch.randn(5, 40, 3, generator=rng, dtype=torch.float64)
    spoiled = torch.cat([patches, torch.full((5, 3, 3), torch.nan, dtype=torch.float64)], dim=1)
    spoiled[0, 40, 0] = torch.inf
    spoiled[0, 40, 1:] = 0
    fit, clean = estimator(spoiled), estimator(patches)
    assert torch.equal(fit.location, clean.location)
    assert torch.equal(fit.support[:, :40], clean.support)
    assert not fit.support[:, 40:].any()
    assert (fit.sq_distances[:, 40:] == torch.inf).all()
    assert not estimator(torch.full((50, 3), torch.nan)).valid


def test_masked_points_do_not_count(estimator, rng):
    patches = torch.randn(9, 50, 3, generator=rng, dtype=torch.float64)
    mask = torch.rand(9, 50, generator=rng) < 0.8
    mask[0], mask[1], mask[2] = True, False, torch.arange(50) < 3
    spoiled = torch.where(mask[..., None], patches, 1e9)
    fit = estimator(spoiled, mask=mask)
    assert not fit.support[~mask].any()
    assert not fit.valid[1]
    for row in (0, 3, 8):
        single = estimator(patches[row][mask[row]])
        assert torch.equal(fit.location[row], single.location)
        assert torch.equal(fit.covariance[row], single.covariance)
        assert torch.equal(fit.support[row][mask[row]], single.support)


def coordinates(scales):
    steps = st.integers(-3, 3).map(float)
    return st.one_of(steps, st.sampled_from([0.0, 0.1, 1e-3]), st.floats(-1, 1, width=32)).flatmap(
        lambda value: st.sampled_from(scales).map(lambda scale: value * scale)
    )


@st.composite
def patches(draw):
    """Ties, duplicates, points on common lines and planes, magnitudes that differ much."""
    num_points = draw(st.sampled_from([4, 5, 8, 13, 20, 50]))
    scales = draw(st.sampled_from([[1.0], [1.0, 1e-4], [1e6, 1.0], [1e-9], [1e15, 1e-3]]))
    few = draw(st.integers(1, num_points))
    point = st.tuples(*[coordinates(scales)] * 3)
    distinct = draw(st.lists(point, min_size=few, max_size=few))
    order = draw(st.lists(st.integers(0, few - 1), min_size=num_points, max_size=num_points))
    patch = np.array([distinct[i] for i in order])
    flat = draw(st.sampled_from(["no", "axis", "tilt", "line"]))
    fraction = draw(st.integers(0, num_points))
    if flat == "axis":
        patch[:fraction, draw(st.integers(0, 2))] = draw(coordinates(scales))
    elif flat == "tilt":
        patch[:fraction, 2] = patch[:fraction, 0] / 2 - patch[:fraction, 1]
    elif flat == "line":
        patch[:fraction, 1], patch[:fraction, 2] = 2 * patch[:fraction, 0], -patch[:fraction, 0]
    return patch


@given(
    patch=patches(),
    name=st.sampled_from(sorted(ESTIMATORS)),
    fraction=st.sampled_from([0.5, 0.75, 1.0]),
    least=st.sampled_from([0, 1, 2]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@settings(max_examples=40, deadline=None)
def test_no_degenerate_patch_is_unsound(patch, name, fraction, least, dtype):
    options = {} if name in ("dets", "detmm") else {"support_fraction": fraction}
    options["min_dimension"] = least
    points = torch.from_numpy(patch).to(dtype)
    fit = ESTIMATORS[name](points[None], **options)
    assert_sound(fit)
    wide = points.double().numpy()
    assert fit.valid.item() <= (np.linalg.matrix_rank(wide - wide[0]) >= least)
    assert fit.valid.item() or least > 0


def test_degenerate_patches_leave_their_neighbors_alone(estimator, rng):
    regular = torch.randn(4, 50, 3, generator=rng, dtype=torch.float64)
    plane = tilted_plane(rng, 50)
    line = torch.zeros(50, 3, dtype=torch.float64)
    line[:, 0] = torch.arange(50)
    mixed = torch.stack([regular[0], plane, regular[1], line, regular[2], line * 0, regular[3]])
    fit, clean = estimator(mixed, min_dimension=2), estimator(regular)
    assert torch.equal(fit.covariance[::2], clean.covariance)
    assert torch.equal(fit.support[::2], clean.support)
    assert fit.exact_fit.tolist() == [False, True] + [False] * 5
    assert fit.valid.tolist() == [True, True, True, False, True, False, True]
