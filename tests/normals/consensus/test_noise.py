"""The noise of a cloud is found without knowing the surface."""

import dataclasses

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.made import make_shape
from torchrg.config import load_config
from torchrg.neighbors import search_knn
from torchrg.normals.consensus.noise import estimate_noise, regional_noise
from torchrg.normals.pca import fit_normals_pca, fit_points
from torchrg.pipeline import segment_planes
from torchrg.structures import Neighbors


def survey(points, k=50):
    neighbors = search_knn(points, k)
    fit = fit_points(points, neighbors, fit_normals_pca)
    return estimate_noise(points, neighbors, fit)


@pytest.mark.parametrize("name", ["cube", "sphere", "bracket", "cylinder"])
@pytest.mark.parametrize("noise", [0.002, 0.006])
def test_noise_is_right_on_flat_curved_and_broken_surfaces(name, noise):
    clean = make_shape(name, 4000, 0.0, seed=2).points
    points = make_shape(name, 4000, noise, seed=2).points
    truth = float((points - clean).std())
    found = float(survey(points).noise.median())
    assert 0.85 * truth < found < 1.2 * truth


def test_an_exact_face_has_only_rounding_as_noise():
    noise = survey(make_shape("cube", 5000, 0.0, seed=2).points).noise
    assert 0 < float(noise.quantile(0.5)) < 1e-6


def test_noise_is_as_long_as_the_unit():
    points = make_shape("cube", 2000, 0.004, seed=2).points
    scale = 2.0**-13
    assert torch.allclose(survey(points * scale).noise, survey(points).noise * scale, rtol=1e-4)


def test_noise_of_points_given_twice_is_that_of_the_points():
    points = make_shape("cube", 3000, 0.004, seed=2).points
    found = float(survey(torch.cat([points, points])).noise.median())
    assert found == pytest.approx(float(survey(points, 25).noise.median()), rel=0.1)


@pytest.mark.parametrize("gap", [0.02, 0.04, 0.08])
def test_noise_of_a_plate_is_not_its_thickness(gap):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2000, 3, generator=generator)
    points[:, 2] = gap * (points[:, 2] > 0.5) + 0.003 * torch.randn(2000, generator=generator)
    found = survey(points).noise
    assert float(found.median()) == pytest.approx(0.003, rel=0.2)
    assert float(found.quantile(0.95)) < 0.006


def test_even_spread_across_a_plane_is_noise():
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1))
    points[:, 2] *= 0.1
    assert float(survey(points).noise.median()) > 0.02


class LargestResult(TorchDispatchMode):
    """Notes how many elements the largest new tensor of floats has."""

    most = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor) and result.is_floating_point():
            self.most = max(self.most, result.numel() * (not function.is_view))
        return result


def test_masked_neighbours_take_memory_by_chunks_only():
    points = make_shape("cube", 3000, 0.004, seed=2).points
    neighbors = search_knn(points, 20)
    fit = fit_points(points, neighbors, fit_normals_pca)
    counted = torch.ones_like(neighbors.indices, dtype=torch.bool)
    with LargestResult() as results:
        found = estimate_noise(points, Neighbors(neighbors.indices, counted), fit, chunk_size=500)
    assert results.most < counted.numel()
    whole = estimate_noise(points, neighbors, fit)
    assert torch.allclose(found.noise, whole.noise, rtol=1e-5)


def ramped_step(offset, ramp, noise, half_width, spacing=0.02):
    """A board parallel to a wall, and the step about it as a slope so many points wide.

    Returns the points, and the height of each as a share of that of the board.
    """
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(10_000, 3, generator=generator) * 100 * spacing
    outside = (points[:, :2] - 50 * spacing).abs().amax(dim=1) - half_width * spacing
    slope = (0.5 - outside / (ramp * spacing)).clamp(0, 1)
    points[:, 2] = offset * slope + noise * torch.randn(10_000, generator=generator)
    return points, slope


@pytest.mark.parametrize(("offset", "ramp"), [(0.03, 2), (0.05, 3), (0.07, 2), (0.1, 4)])
def test_a_step_that_was_rounded_is_no_noise_of_the_region(offset, ramp):
    points, height = ramped_step(offset, ramp, 0.001, 4)
    neighbors = search_knn(points, 50)
    fit = fit_points(points, neighbors, fit_normals_pca)
    local = estimate_noise(points, neighbors, fit).noise
    assert local[height == 1].median() > 0.0013
    found = torch.minimum(local, regional_noise(local, neighbors))
    assert found.max() < 0.001
    assert found.median() > 0.0007
    assert found.min() > 0.0005


@pytest.mark.parametrize(
    ("offset", "ramp", "noise"),
    [(0.015, 1, 0.002), (0.025, 2, 0.004), (0.05, 3, 0.004), (0.1, 4, 0.004)],
)
def test_a_board_a_few_times_the_noise_off_its_wall_is_a_face(offset, ramp, noise):
    points, height = ramped_step(offset, ramp, noise, 5)
    config = load_config()
    regional = dataclasses.replace(config.normals, noise_scope="regional")
    labels = segment_planes(points, dataclasses.replace(config, normals=regional)).labels
    wall = labels[height == 0].mode().values
    board = labels[height == 1]
    assert float((labels[height == 0] == wall).float().mean()) > 0.97
    assert float((board == wall).float().mean()) < 0.25
    assert float((board == board.mode().values).float().mean()) > 0.7


def test_regional_noise_by_example():
    line = torch.arange(8)
    neighbors = Neighbors(torch.stack([line, line - 1, line + 1], dim=1).clamp(0, 7).int())
    noise = torch.tensor([1.0, 1, 1, 9, 9, 1, 1, 1])
    assert repr(regional_noise(noise, neighbors)) == "tensor([1., 1., 1., 1., 1., 1., 1., 1.])"
