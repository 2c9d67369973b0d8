"""Iteratively weighted PCA: against its authors' program, a loop in NumPy, and at edges."""

import json

import numpy as np
import pytest
import torch

from torchrg.config import NormalsConfig
from torchrg.errors import ConfigError, ShapeError
from torchrg.linalg import unsigned_angle_deg
from torchrg.normals import estimate_normals, fit_normals_irls, fit_normals_pca


def edges(rng, count, on_own=12, on_other=6, noise=0.01):
    """Patches over a right-angled edge, the first point on the floor; float64."""
    options = {"generator": rng, "dtype": torch.float64}
    floor = torch.rand(count, on_own, 3, **options)
    floor[..., 2] = noise * torch.randn(count, on_own, **options)
    wall = torch.rand(count, on_other, 3, **options)
    wall[..., 0] = noise * torch.randn(count, on_other, **options)
    return torch.cat([floor, wall], dim=1)


def literal(patch, noise, decay):
    """The algorithm for one neighbourhood, step by step."""
    points = patch[1:] - patch[0]
    limit = (noise / 2) ** 2

    def flattest(offsets, weights):
        return np.linalg.eigh((weights[:, None] * offsets).T @ offsets)[1][:, 0]

    def weights_of(distances, mu):
        return (mu / (mu + distances**2)) ** 2

    def through_query(normal, mu):
        steps = 0
        while mu > limit or steps < 5:
            mu /= decay
            normal = flattest(points, weights_of(points @ normal, mu))
            steps += 1
        return normal, weights_of(points @ normal, mu)

    def near_query(normal, weights, mu):
        mu, center = max(mu, limit), np.zeros(3)
        steps = max(5, int(np.floor(np.log(mu / limit) / np.log(decay))))
        for _ in range(steps):
            distances, heavy = (points - center) @ normal, weights > 0.25
            if heavy.any():
                center = center + normal * np.average(distances[heavy], weights=weights[heavy])
            mu /= decay
            weights = weights_of((points - center) @ normal, mu)
            normal = flattest(points - center, weights)
        if ((points - center) @ normal).sum() > 0:
            normal = -normal
        return normal, center @ normal, (weights > 0.25).mean()

    centered = points - points.mean(axis=0)
    start = flattest(centered, np.ones(len(points)))
    if np.sqrt(((centered @ start) ** 2).mean()) <= noise:
        return start
    largest = ((points @ start) ** 2).max()
    through, weights = through_query(start, largest)
    first, error, fraction = near_query(through, weights, largest / 4)
    if abs(start @ first) >= 0.996:
        return first
    across = np.cross(np.cross(start, first), first)
    across /= np.linalg.norm(across)
    mu = np.sort((points @ across) ** 2)[int(0.35 * len(points))]
    other, weights = through_query(across, mu)
    if abs(through @ other) >= 0.95:
        return first
    second, other_error, other_share = near_query(other, weights, mu / 2)
    if error < other_error and fraction > 0.1:
        return first
    if other_share > 0.1:
        return second
    return first if fraction > 0.1 or error < other_error else second


@pytest.mark.parametrize(
    ("on_own", "on_other", "spread", "noise"),
    [(12, 6, 0.01, 0.02), (9, 9, 0.03, 0.02), (6, 12, 0.02, 0.02), (10, 8, 0.1, 0.15)],
    ids=["edge", "half", "minority", "few steps"],
)
def test_fit_is_that_of_the_loop(rng, on_own, on_other, spread, noise):
    patches = edges(rng, 25, on_own=on_own, on_other=on_other, noise=spread)
    size = torch.full((25,), noise, dtype=torch.float64)
    fit = fit_normals_irls(patches, noise=size, mu_decay=1.5)
    expected = np.stack([literal(patch, noise, 1.5) for patch in patches.numpy()])
    assert unsigned_angle_deg(fit.normals, torch.from_numpy(expected)).max() < 1e-5
    assert fit.valid.all()


@pytest.mark.slow
def test_normals_are_those_of_the_authors(oracles_folder):
    cases = json.loads((oracles_folder / "irpca.json").read_text())
    rows = [
        (name, float(noise), answer)
        for name, by_noise in cases.items()
        for noise, answer in by_noise.items()
    ]
    with np.load(oracles_folder / "inputs.npz") as archive:
        inputs = {name: torch.from_numpy(archive[name]) for name in cases}
    size = max(len(points) for points in inputs.values())
    patches = torch.full((len(rows), size, 3), torch.nan, dtype=torch.float64)
    for row, (name, _, _) in enumerate(rows):
        patches[row, : len(inputs[name])] = inputs[name]
    noise = torch.tensor([noise for _, noise, _ in rows], dtype=torch.float64)
    fit = fit_normals_irls(patches, ~patches.isnan().any(dim=-1), noise=noise, mu_decay=1.01)
    for program, tolerance in (("mepp2_float32", 0.05), ("numpy_float64", 1e-4)):
        expected = [answer[program]["normal"] for _, _, answer in rows]
        known = torch.nn.functional.normalize(torch.tensor(expected, dtype=torch.float64), dim=1)
        assert unsigned_angle_deg(fit.normals, known).max() < tolerance


def test_plane_within_the_noise_is_that_of_pca_without_the_query(rng):
    patch = torch.rand(20, 3, generator=rng, dtype=torch.float64)
    patch[:, 2] *= 0.01
    patch[0, 2] = 0.5
    fit = fit_normals_irls(patch, noise=torch.tensor(0.02, dtype=torch.float64))
    assert torch.allclose(fit.normals.abs(), fit_normals_pca(patch[1:]).normals.abs())


def test_points_of_the_other_face_do_not_count(rng):
    patches = edges(rng, 200, on_own=20, on_other=8)
    truth = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    noise = torch.full((200,), 0.01, dtype=torch.float64)
    fit = fit_normals_irls(patches, noise=noise, mu_decay=1.2)
    errors = unsigned_angle_deg(fit.normals, truth)
    assert errors.median() < 2
    assert unsigned_angle_deg(fit_normals_pca(patches).normals, truth).median() > 10
    # Curvature and residual are those of the face alone.
    good = errors < 5
    assert fit.residual_rms[good].median() < 0.02
    assert fit.curvature[good].median() < 1e-3


def test_masked_points_and_leading_axes(rng):
    patches = edges(rng, 4)
    mask = torch.ones(4, 18, dtype=torch.bool)
    mask[:, [0, 5, 17]] = False
    noise = torch.full((4,), 0.01, dtype=torch.float64)
    spoiled = torch.where(mask[..., None], patches, torch.nan)
    fit = fit_normals_irls(spoiled, mask, noise=noise, mu_decay=2.0)
    kept = patches[mask].reshape(4, 15, 3)
    expected = fit_normals_irls(kept, noise=noise, mu_decay=2.0)
    assert unsigned_angle_deg(fit.normals, expected.normals).max() < 1e-6
    shaped = fit_normals_irls(kept.reshape(2, 2, 15, 3), noise=noise.reshape(2, 2), mu_decay=2.0)
    assert torch.equal(shaped.normals.reshape(4, 3), expected.normals)
    single = fit_normals_irls(kept[0], noise=noise[0], mu_decay=2.0)
    assert torch.equal(single.normals, expected.normals[0])


def test_gradients_are_right(rng):
    patches = edges(rng, 2, on_own=12, on_other=4, noise=0.02).requires_grad_()
    noise = torch.full((2,), 0.02, dtype=torch.float64)

    def fit(points):
        found = fit_normals_irls(points, noise=noise, mu_decay=4.0)
        return found.normals, found.curvature, found.residual_rms

    turned = unsigned_angle_deg(fit(patches)[0], fit_normals_pca(patches).normals)
    assert turned.min() > 1
    assert torch.autograd.gradcheck(fit, patches, fast_mode=True)


def test_wrong_settings_are_refused(rng):
    patches = torch.rand(2, 9, 3, generator=rng)
    with pytest.raises(ConfigError, match=r"expected mu_decay > 1, got 1\.0"):
        fit_normals_irls(patches, noise=torch.ones(2), mu_decay=1.0)
    with pytest.raises(ShapeError, match="expected noise of shape"):
        fit_normals_irls(patches, noise=torch.ones(3))


def test_decay_is_a_setting_of_clouds(rng):
    points = torch.rand(300, 3, generator=rng)
    points[:, 2] *= 0.01
    points[150:, [0, 2]] = points[150:, [2, 0]]
    fits = [
        estimate_normals(points, config=NormalsConfig(method="irls", k=30, irls_decay=decay))
        for decay in (1.2, 4.0, 4.0)
    ]
    assert torch.equal(fits[1].normals, fits[2].normals)
    assert not torch.equal(fits[0].normals, fits[1].normals)
