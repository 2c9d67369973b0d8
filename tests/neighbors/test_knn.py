"""Neighbors are exact, ties and duplicates included, whatever the order of the points."""

import numpy as np
import pytest
import torch

from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import canonical_order, search_knn
from torchrg.neighbors import knn as knn_module
from torchrg.neighbors.knn import gather_columns, gather_patches, prepare_search, search_nearest


def brute_force(points, k):
    """Sort all points by (not itself, distance, canonical order), one by one."""
    rank = np.empty(len(points), dtype=int)
    rank[canonical_order(points).numpy()] = np.arange(len(points))
    squares = ((points[:, None].astype(float) - points[None].astype(float)) ** 2).sum(axis=-1)
    return [
        sorted(range(len(points)), key=lambda j: (j != i, squares[i, j], rank[j]))[:k]
        for i in range(len(points))
    ]


@pytest.mark.parametrize("levels", [2, 3, 5, 1000])
def test_neighbors_are_those_of_brute_force(levels):
    for seed in range(25):
        generator = np.random.default_rng(seed)
        size = int(generator.integers(3, 70))
        points = generator.integers(0, levels, (size, 3)).astype(np.float32)
        k = int(generator.integers(1, size + 1))
        assert search_knn(points, k).indices.tolist() == brute_force(points, k)


def test_chunks_and_threads_change_nothing(rng, monkeypatch, set_threads):
    points = torch.rand(3000, 3, generator=rng)
    whole = search_knn(points, 9).indices
    monkeypatch.setattr(knn_module, "ROWS_AT_ONCE", 117)
    assert torch.equal(search_knn(points, 9).indices, whole)
    set_threads(1 if torch.get_num_threads() > 1 else 2)
    assert torch.equal(search_knn(points, 9).indices, whole)


def test_a_point_comes_first_even_among_many_duplicates():
    points = np.zeros((1000, 3), dtype=np.float32)
    points[500:] = 1
    indices = search_knn(points, 20).indices
    assert torch.equal(indices[:, 0], torch.arange(1000, dtype=torch.int32))
    assert all(len(set(row)) == 20 for row in indices.tolist())
    assert bool((indices[:500] < 500).all())


def test_no_neighbor_crosses_clouds(rng):
    points = torch.rand(100, 3, generator=rng)
    together = search_knn(points, 5, offset=torch.tensor([30, 100])).indices
    assert torch.equal(together[:30], search_knn(points[:30], 5).indices)
    assert torch.equal(together[30:], search_knn(points[30:], 5).indices + 30)


def test_far_neighbors_do_not_count(rng):
    points = torch.rand(200, 3, generator=rng)
    neighbors = search_knn(points, 10, max_distance=0.2)
    distances = gather_patches(points, neighbors.indices).norm(dim=-1)
    plain = gather_patches(points, search_knn(points, 10).indices).norm(dim=-1)
    assert torch.equal(neighbors.valid, plain <= 0.2)
    assert not distances[~neighbors.valid].any()


def test_a_far_origin_changes_nothing_in_float64(rng):
    points = (torch.rand(500, 3, generator=rng) * 1024).round().double() / 1024
    moved = points + torch.tensor([5e5, 4e6, 100.0], dtype=torch.float64)
    assert torch.equal(search_knn(points, 15).indices, search_knn(moved, 15).indices)


def test_canonical_order_depends_on_coordinates_alone(rng):
    points = torch.rand(500, 3, generator=rng)
    shuffled = points[torch.randperm(500, generator=rng)]
    assert torch.equal(points[canonical_order(points)], shuffled[canonical_order(shuffled)])


def test_canonical_order_keeps_near_points_together(rng):
    points = torch.rand(4096, 3, generator=rng)
    along = points[canonical_order(points)].diff(dim=0).norm(dim=1).mean()
    assert along < 0.2 * points.diff(dim=0).norm(dim=1).mean()


@pytest.mark.parametrize("k", [0, 6, -1, 10**23, 1e300, float("nan")])
def test_no_memory_is_taken_for_more_neighbors_than_points(k):
    with pytest.raises(ShapeError, match=r"expected k from 1 to the number of points \(5\), got"):
        search_knn(torch.rand(5, 3), k)


def test_more_points_than_lists_of_int32_can_name_are_refused():
    with pytest.raises(ShapeError, match="expected at most 2,147,483,647 points, got 2,147,483,6"):
        search_knn(torch.zeros(1, 3).expand(2**31, 3), 5)


@pytest.mark.parametrize(
    ("points", "settings", "error", "message"),
    [
        (torch.rand(5, 3), {"max_distance": -1.0}, ConfigError, "max_distance >= 0, got -1"),
        (torch.rand(5, 3), {"max_distance": torch.nan}, ConfigError, "max_distance >= 0, got nan"),
        (torch.tensor([[torch.nan, 0, 0]] * 2), {}, ShapeError, ".* got 2 of 2 with NaN or Inf"),
        (torch.rand(5, 3), {"offset": torch.tensor([2, 4])}, ShapeError, "offset to ascend to the"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(points, settings, error, message):
    with pytest.raises(error, match=f"search_knn: expected {message}"):
        search_knn(points, 2, **settings)


def test_search_nearest_by_example():
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    assert search_nearest(points, np.array([[0.9, 0, 0], [3, 0, 0]]), 0.2).tolist() == [1, -1]


def test_prepare_search_by_example():
    search = prepare_search(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]), 2)
    assert search(np.array([2, 0])).tolist() == [[2, 1], [0, 1]]


def test_gather_columns_by_example():
    points = torch.tensor([[5.0, 0, 0], [7, 1, 0]])
    assert gather_columns(points, torch.tensor([[0, 1]]))[0].tolist() == [[0.0, 2.0]]
