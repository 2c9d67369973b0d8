"""Jets of degree 2: against CGAL, on analytic surfaces, and where they are not determined."""

import json

import numpy as np
import torch

from torchrg.linalg import unsigned_angle_deg
from torchrg.linalg.moments import unbind_columns
from torchrg.normals import fit_jet, fit_normals_jet, fit_normals_pca
from torchrg.normals.jet import fit_paraboloids, least_squares

# Sums of CGAL lose digits far from the origin; the frame of exact planes and lines is arbitrary.
LOSES_DIGITS = ("utm", "off1e4")
NO_FRAME = {"exact", "line"}
ANGLE_DEG = {torch.float64: 1e-5, torch.float32: 0.01}
RELATIVE = {torch.float64: 1e-7, torch.float32: 1e-3}
# Of curvatures times the size of the patch, for patches that are flat but for noise.
ABSOLUTE = {torch.float64: 1e-12, torch.float32: 1e-6}


def cgal_cases(folder):
    """Patches with CGAL's answers, where these are to be trusted."""
    cases = json.loads((folder / "cases.json").read_text())
    answers = json.loads((folder / "cgal_jet.json").read_text())["cases"]
    with np.load(folder / "inputs.npz") as patches:
        for name, answer in answers.items():
            known = answer["deg2"]
            usable = "error" not in known and "nan" not in known["normal"]
            if usable and not name.endswith(LOSES_DIGITS) and cases[name]["group"] not in NO_FRAME:
                yield name, patches[name], known


def test_normals_and_curvatures_are_those_of_cgal(oracles_folder, dtype):
    compared = 0
    for name, patch, known in cgal_cases(oracles_folder):
        if dtype == torch.float32 and name.endswith("aniso_units"):
            continue
        local = torch.from_numpy(patch - patch[0])
        size = local.abs().max()
        fit = fit_jet((local / size).to(dtype))
        assert fit.valid, name
        normal = torch.tensor(known["normal"], dtype=torch.float64)
        assert unsigned_angle_deg(fit.normals.double(), normal) < ANGLE_DEG[dtype], name
        turned = fit.normals.double() @ normal < 0
        mine = fit.principal_curvatures.double() / size
        mine = -mine.flip(0) if turned else mine
        expected = torch.tensor([known["k1"], known["k2"]], dtype=torch.float64)
        largest = expected.abs().max()
        assert (mine - expected).abs().max() <= RELATIVE[dtype] * largest + ABSOLUTE[
            dtype
        ] / size, name
        if (expected[0] - expected[1]) > 0.01 * largest:
            first = fit.principal_directions.double()[1 if turned else 0]
            direction = torch.tensor(known["d1"], dtype=torch.float64)
            assert unsigned_angle_deg(first, direction) < 10 * ANGLE_DEG[dtype], name
        foot = torch.tensor(known["origin"], dtype=torch.float64) - torch.from_numpy(patch[0])
        assert (fit.foot.double() * size - foot).abs().max() < RELATIVE[dtype] * size, name
        compared += 1
    assert compared > 55


def test_curvatures_of_a_sphere_are_those_of_its_radius(rng):
    directions = torch.randn(30, 40, 3, generator=rng, dtype=torch.float64) * 0.05
    directions[..., 2] = 1
    directions[:, 0, :2] = 0
    sphere = 2 * torch.nn.functional.normalize(directions, dim=-1)
    fit = fit_jet(sphere)
    outwards = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    assert unsigned_angle_deg(fit.normals, outwards).max() < 0.05
    assert torch.allclose(fit.principal_curvatures.abs(), torch.tensor(0.5).double(), rtol=0.02)
    assert fit_normals_pca(sphere).normals.sub(fit.normals).norm() > 0


def test_curvatures_scale_with_the_unit(rng):
    patch = torch.randn(30, 3, generator=rng, dtype=torch.float64) * torch.tensor([1, 1, 0.1])
    small, large = fit_jet(patch), fit_jet(patch * 1000)
    assert torch.allclose(small.principal_curvatures, large.principal_curvatures * 1000)
    assert torch.allclose(small.normals, large.normals)


def test_fewer_than_six_points_give_the_plane(rng, dtype):
    for count in (3, 4, 5):
        patch = torch.randn(count, 3, generator=rng, dtype=torch.float64).to(dtype)
        fit = fit_jet(patch)
        assert unsigned_angle_deg(fit.normals, fit_normals_pca(patch).normals) < 0.01
        assert not fit.principal_curvatures.any()


def test_two_scan_lines_leave_out_what_they_do_not_determine(rng):
    u = torch.rand(20, generator=rng, dtype=torch.float64)
    v = torch.arange(20) % 2
    patch = torch.stack([u, 0.1 * v, 0.1 * u * u], dim=-1)
    fit = fit_jet(patch)
    slope = torch.stack([-0.2 * u[0], torch.zeros(()), torch.ones(())]).double()
    assert fit.valid
    # Height is no exact quadratic of the tilted frame, and the lines are a tenth apart.
    assert unsigned_angle_deg(fit.normals, slope / slope.norm()) < 3
    assert fit.residual_rms < 1e-4


def test_residual_is_that_of_the_surface_and_curvature_that_of_the_plane(rng):
    u, v = torch.rand(2, 60, generator=rng, dtype=torch.float64)
    bowl = torch.stack([u, v, 0.2 * (u * u + v * v)], dim=-1)
    fit, plane = fit_normals_jet(bowl), fit_normals_pca(bowl)
    assert fit.residual_rms < 0.1 * plane.residual_rms
    assert torch.equal(fit.curvature, plane.curvature)


def test_query_is_the_first_point_that_counts(rng):
    u, v = torch.rand(2, 40, generator=rng, dtype=torch.float64)
    bowl = torch.stack([u, v, 0.3 * u * u], dim=-1)
    mask = torch.arange(40) >= 7
    fit = fit_jet(torch.where(mask[:, None], bowl, torch.nan), mask)
    assert torch.allclose(fit.normals, fit_jet(bowl[7:]).normals)
    assert torch.allclose(fit.foot, fit_jet(bowl[7:]).foot)


def test_least_squares_is_that_of_numpy(rng):
    columns = torch.randn(4, 6, 25, generator=rng, dtype=torch.float64)
    columns[..., 3] *= 1e3
    target = torch.randn(4, 25, generator=rng, dtype=torch.float64)
    found, residual = least_squares([(columns[:, i], 1e-12) for i in range(6)], target)
    for row in range(4):
        matrix = columns[row].T.numpy()
        expected, *_ = np.linalg.lstsq(matrix, target[row].numpy(), rcond=None)
        assert np.allclose(torch.cat([c[row] for c in found]), expected)
        assert np.allclose(residual[row], target[row].numpy() - matrix @ expected)


def test_dependent_columns_are_left_out(rng):
    a, b = torch.randn(2, 1, 10, generator=rng, dtype=torch.float64)
    found, residual = least_squares([(a, 1e-9), (b, 1e-9), (a - 2 * b, 1e-9)], 3 * a + b)
    assert torch.allclose(torch.cat(found, dim=1), torch.tensor([[3.0, 1, 0]]).double())
    assert residual.abs().max() < 1e-12


def literal_paraboloid(patch, up):
    """Fit one height field with numpy's least squares."""
    helper = np.eye(3)[np.argmin(np.abs(up))]
    first = np.cross(up, helper)
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    u, v, h = patch @ first, patch @ second, patch @ up
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    a, b, c = (solution := np.linalg.lstsq(design, h, rcond=None)[0])[:3]
    normal = up - b * first - c * second
    length = np.sqrt(1 + b * b + c * c)
    rest = h - design @ solution
    return normal / length, a / length, np.sqrt((rest**2).sum() / (len(u) - 6))


def test_paraboloids_are_those_of_numpy(rng):
    patches = torch.randn(40, 30, 3, generator=rng, dtype=torch.float64)
    patches[:, 0] = 0
    ups = torch.nn.functional.normalize(torch.randn(40, 3, generator=rng).double(), dim=1)
    found = fit_paraboloids(unbind_columns(patches), ups, torch.ones(40, 30).double())
    for row in range(40):
        normal, offset, deviation = literal_paraboloid(patches[row].numpy(), ups[row].numpy())
        assert np.allclose(found[0][row].numpy(), normal, atol=1e-8)
        assert np.isclose(float(found[1][row]), offset, atol=1e-8)
        assert np.isclose(float(found[2][row]), deviation, atol=1e-8)


def test_paraboloids_of_two_scan_lines_are_their_plane():
    line = torch.linspace(-1, 1, 15)
    lines = torch.stack([line.repeat(2), torch.tensor([0.0, 0.5]).repeat_interleave(15)], dim=1)
    patch = torch.cat([lines, torch.zeros(30, 1)], dim=1)[None]
    up = torch.tensor([[0.0, 0.0, 1.0]])
    normals, offsets, deviations = fit_paraboloids(unbind_columns(patch), up, torch.ones(1, 30))
    assert torch.allclose(normals, up)
    assert float(offsets.abs() + deviations) < 1e-6
