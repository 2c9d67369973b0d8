"""Covariances, weighted planes and statistics of segments."""

import numpy as np
import pytest
import torch

from torchrg.linalg import covariance, second_moments
from torchrg.linalg.moments import (
    Segments,
    eigh3_lapack,
    fit_planes_to_each,
    fit_weighted_planes,
    kth_smallest,
    reduce_runs,
    residuals,
    sum_neighbors,
    unbind_columns,
)


def test_planes_are_those_of_the_neighbors_with_a_weight():
    columns = unbind_columns(torch.tensor([[[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 0, 2]]]))
    weights = torch.tensor([[1.0, 1, 1, 0]]), torch.tensor([[1.0, 1, 0, 1]])
    normals, offsets, values = fit_weighted_planes(columns, weights[0])
    assert normals.abs().tolist() == [[0.0, 0.0, 1.0]]
    assert values[0, 0] == 0
    assert residuals(columns, normals, offsets).abs().tolist() == [[0.0, 0.0, 0.0, 1.0]]
    first, second = fit_planes_to_each(columns, weights)
    assert torch.equal(first[0], normals)
    assert second[0].abs().tolist() == [[0.0, 1.0, 0.0]]
    assert not second[1].any()


def test_covariance_is_that_of_numpy(rng):
    patches = torch.randn(7, 12, 4, generator=rng, dtype=torch.float64) + 1e6
    mean, matrix = covariance(patches)
    for row in range(7):
        points = patches[row].numpy()
        assert np.allclose(mean[row], points.mean(axis=0), rtol=1e-14)
        assert np.allclose(matrix[row], np.cov(points, rowvar=False, bias=True), rtol=1e-9)


def test_masked_points_do_not_count_whatever_they_hold(rng):
    patches = torch.randn(5, 10, 3, generator=rng, dtype=torch.float64)
    mask = torch.rand(5, 10, generator=rng) < 0.6
    mask[4] = False
    spoiled = torch.where(mask[..., None], patches, torch.nan)
    mean, matrix = covariance(spoiled, mask)
    for row in range(4):
        kept = patches[row][mask[row]]
        assert torch.allclose(mean[row], kept.mean(dim=0))
        assert torch.allclose(matrix[row], torch.cov(kept.T, correction=0))
    assert not mean[4].any()
    assert not matrix[4].any()


def test_weighted_moments_are_those_of_numpy_in_every_layout(rng):
    points = torch.randn(3, 20, 4, generator=rng, dtype=torch.float64)
    weights = torch.rand(3, 20, generator=rng, dtype=torch.float64)
    expected = torch.einsum("nk,nkp,nkq->npq", weights, points, points)
    rows = second_moments(points.unbind(dim=-1), weights)
    columns = points.permute(2, 1, 0).unbind(dim=0)
    lanes = second_moments(columns, weights.T, lambda column: column.sum(dim=0))
    scaled = second_moments(points.unbind(dim=-1), weights, total=weights.sum(dim=1))
    assert torch.allclose(rows, expected)
    assert torch.allclose(lanes, expected)
    assert torch.allclose(scaled, expected / weights.sum(dim=1)[:, None, None])


@pytest.mark.parametrize("size", [3, 200])
def test_quantiles_of_small_and_large_regions_are_those_of_sorted_values(size: int) -> None:
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(-1, 40, (40 * size,), generator=generator)
    labels[:40] = torch.arange(40)
    values = torch.rand(len(labels), generator=generator)
    segments = Segments(labels)
    for fraction in (0.0, 0.33, 0.5, 1.0):
        found = segments.quantile(segments.gather(values), fraction)
        expected = []
        for label in range(40):
            ascending = values[labels == label].sort().values
            expected.append(ascending[int(fraction * (len(ascending) - 1))])
        assert torch.equal(found, torch.stack(expected))


def test_a_matrix_that_is_not_finite_spoils_itself_alone():
    matrices = torch.diag(torch.tensor([3.0, 1.0, 2.0])).repeat(2, 1, 1)
    matrices[1, 0, 2] = torch.nan
    values, vectors = eigh3_lapack(matrices)
    assert values[0].tolist() == [1.0, 2.0, 3.0]
    assert vectors[0, :, 0].abs().tolist() == [0.0, 1.0, 0.0]
    assert values[1].isnan().all()
    assert vectors[1].isnan().all()


def test_reduce_runs_by_example():
    assert (
        repr(reduce_runs(torch.tensor([3.0, 1.0, 2.0]), torch.tensor([2, 1]), "min"))
        == "tensor([1., 2.])"
    )


def test_kth_smallest_by_example():
    assert repr(kth_smallest(torch.tensor([3.0, 1.0, 2.0]), 1)) == "tensor(2.)"


def test_sum_neighbors_by_example():
    assert repr(sum_neighbors(torch.arange(10.0))) == "tensor(45.)"
