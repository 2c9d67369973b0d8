"""Growth: what it refuses, degenerate clouds, and what each setting does."""

import tracemalloc

import numpy as np
import pytest
import torch

from tests.regions import growing_clouds
from tests.regions.growing_clouds import papers_growing
from torchrg.errors import ShapeError
from torchrg.neighbors import search_knn
from torchrg.regions import grow_regions
from torchrg.regions.growth import curvature_limit, grow_fifo, rank_by_count, rank_by_size
from torchrg.structures import Neighbors

CLASSIC = papers_growing(seed_rule="curvature", connectivity=None, coplanarity=False, min_size=1)


def strip(num_points, angle_step_deg):
    """Points on a line whose normals turn by a step from one to the next."""
    angle = torch.deg2rad(torch.arange(num_points, dtype=torch.float64) * angle_step_deg)
    points = torch.zeros(num_points, 3, dtype=torch.float64)
    points[:, 0] = torch.arange(num_points)
    normals = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], dim=1)
    return points, normals, torch.zeros(num_points, dtype=torch.float64), search_knn(points, 3)


def test_points_above_thecurvature_limit_join_but_do_not_spread():
    points, normals, curvature, neighbors = strip(9, 0.0)
    curvature[4] = 0.2
    config = papers_growing(**{**vars(CLASSIC), "curvature_quantile": 0.5})
    labels = grow_regions(points, normals, curvature, neighbors, config)
    assert labels.tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1]


def test_the_increment_rule_compares_with_the_point_that_was_joined():
    points, normals, curvature, neighbors = strip(9, 0.0)
    curvature = (torch.arange(9, dtype=torch.float64) - 1).clamp(min=0) / 32
    # The limit is 1/32: each step of curvature is within it, most values are above.
    config = papers_growing(**{**vars(CLASSIC), "curvature_quantile": 0.25})
    by_value = grow_regions(points, normals, curvature, neighbors, config)
    assert by_value.max() > 1
    config = papers_growing(**{**vars(config), "seed_rule": "increment"})
    assert grow_regions(points, normals, curvature, neighbors, config).max() == 0


def test_a_point_that_joined_unconnected_is_a_seed_once_a_connected_seed_reaches_it():
    # 0 claims 2, but only 1 shares three neighbors with it; 3 hangs on 2 alone.
    rows = [[0, 2, 1, 5], [1, 0, 2, 4], [2, 1, 4, 3], [3, 5, 4, 0], [4, 5, 3, 0], [5, 0, 3, 4]]
    points, normals, _, _ = strip(6, 0.0)
    cloud = (points, normals, torch.arange(6).double(), Neighbors(torch.tensor(rows)))
    settings = {"coplanarity": False, "curvature_quantile": 1.0, "min_size": 1}
    assert grow_regions(*cloud, papers_growing(**settings)).tolist() == [0] * 6
    printed = papers_growing(**settings, connectivity_scope="region")
    assert grow_regions(*cloud, printed).tolist() == [0, 0, 0, 1, 1, 1]


def testcurvature_limit_is_the_lower_quantile():
    for num_values in (12, 237):
        values = torch.rand(num_values, generator=torch.Generator().manual_seed(0))
        for fraction in (0.0, 0.5, 0.95, 0.98, 1.0):
            expected = np.quantile(values.numpy(), fraction, method="lower")
            assert curvature_limit(values, fraction).item() == expected


def test_regions_smaller_than_min_size_are_not_labelled():
    points, normals, curvature, neighbors = strip(10, 0.0)
    normals[:3] = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    config = papers_growing(**{**vars(CLASSIC), "min_size": 4})
    labels = grow_regions(points, normals, curvature, neighbors, config)
    assert labels.tolist() == [-1] * 3 + [0] * 7


def test_labels_descend_by_size_then_by_first_point():
    labels = rank_by_size(torch.tensor([7, 7, 2, 2, 5, 5, 5, -1]), 2)
    assert labels.tolist() == [1, 1, 2, 2, 0, 0, 0, -1]
    assert rank_by_count(torch.tensor([0, 1, 1, -1])).tolist() == [1, 0, -1]


def test_points_without_finite_normal_or_curvature_do_not_join():
    points, normals, curvature, neighbors = strip(12, 0.0)
    normals[3] = torch.nan
    curvature[7] = torch.nan
    labels = grow_regions(points, normals, curvature, neighbors, CLASSIC)
    assert labels[3] == labels[7] == -1
    # With two neighbors on a line no one reaches across.
    assert len(labels.unique()) == 4


@pytest.mark.parametrize("config", [CLASSIC, papers_growing(min_size=1)])
@pytest.mark.parametrize("num_points", [0, 1, 2, 3])
def test_tiny_clouds_work(config, num_points):
    points = torch.eye(3)[:num_points] * torch.tensor([1.0, 1, 0])
    k = min(num_points, 3)
    neighbors = Neighbors(torch.zeros(0, 0, dtype=torch.int32))
    if num_points:
        neighbors = search_knn(points, k)
    normals = torch.eye(3)[torch.full((num_points,), 2)]
    labels = grow_regions(points, normals, torch.zeros(num_points), neighbors, config)
    assert labels.tolist() == [0] * num_points


@pytest.mark.parametrize("config", [CLASSIC, papers_growing(min_size=1)])
def test_a_cloud_without_a_valid_point_has_no_region(config):
    cloud = strip(6, 0.0)
    none = torch.zeros(6, dtype=torch.bool)
    assert grow_regions(*cloud, config, valid=none).tolist() == [-1] * 6


@pytest.mark.parametrize("config", [CLASSIC, papers_growing(min_size=1)])
def test_equal_points_are_one_region(config):
    points = torch.full((20, 3), 0.3)
    neighbors = search_knn(points, 5)
    normals = torch.eye(3)[[2] * 20]
    labels = grow_regions(points, normals, torch.zeros(20), neighbors, config)
    assert (labels >= 0).all()


def test_exact_and_quantized_walls_do_not_shatter():
    grid = torch.cartesian_prod(torch.arange(30.0), torch.arange(30.0), torch.zeros(1))
    step = 1e-3
    rough = grid + (torch.rand(grid.shape, generator=torch.Generator().manual_seed(1)) * 20 * step)
    rough[:, 2] = (rough[:, 2] / (20 * step) > 0.9) * step
    for points in (grid, rough):
        cloud = growing_clouds.prepare(points.numpy(), 50, dtype=torch.float32)
        config = papers_growing(connectivity=0.5, min_size=1)
        labels = grow_regions(*cloud, config)
        assert (labels == 0).float().mean() > 0.97


def test_a_long_chain_of_one_way_edges_is_followed_to_its_end():
    roots = grow_chain(20_000, joins=1)
    assert not roots.any()


def test_no_python_number_is_kept_for_every_point():
    num_points = 30_000
    tracemalloc.start()
    roots = grow_chain(num_points, joins=0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert roots.tolist() == list(range(num_points))
    assert peak < 60 * num_points


def grow_chain(num_points, joins):
    """Grow from each point in turn, whose only neighbor is the next one, joined or not."""
    following = (torch.arange(num_points, dtype=torch.int32) + 1).clamp(max=num_points - 1)
    bits = torch.full((num_points, 1), joins)
    every, order = torch.ones(num_points, dtype=torch.bool), torch.arange(num_points)
    return grow_fifo(following[:, None], bits, None, every, every, order, late=False)


def test_numpy_arrays_are_accepted():
    points, normals, curvature, neighbors = strip(10, 0.0)
    labels = grow_regions(points.numpy(), normals.numpy(), curvature.numpy(), neighbors, CLASSIC)
    assert labels.tolist() == [0] * 10


def test_wrong_shapes_are_refused():
    points, normals, curvature, neighbors = strip(10, 0.0)
    with pytest.raises(
        ShapeError, match=r"grow_regions: expected normals of shape \(N, 3\) with N=10"
    ):
        grow_regions(points, normals[:9], curvature, neighbors)
    with pytest.raises(ShapeError, match=r"expected curvature of shape \(N\)"):
        grow_regions(points, normals, normals, neighbors)
    with pytest.raises(ShapeError, match=r"expected neighbors of shape \(N, K\)"):
        grow_regions(points, normals, curvature, Neighbors(neighbors.indices[:5]))
    with pytest.raises(ShapeError, match="of one dtype"):
        grow_regions(points.float(), normals, curvature, neighbors)
    with pytest.raises(ShapeError, match="expected valid of bool"):
        grow_regions(points, normals, curvature, neighbors, valid=curvature)


def test_residuals_within_rounding_do_not_limit_the_reach(rng):
    # An exact plane: what its points are off by says nothing of its noise.
    points = torch.rand(200, 3, generator=rng, dtype=torch.float64)
    points[:, 2] = 1e-9 * torch.randn(200, generator=rng)
    normals = torch.eye(3, dtype=torch.float64)[[2] * 200]
    config = papers_growing(**{**vars(CLASSIC), "plane_reach": 4.0})
    labels = grow_regions(
        points,
        normals,
        torch.zeros(200, dtype=torch.float64),
        search_knn(points, 12),
        config,
        residual_rms=torch.full((200,), 1e-12, dtype=torch.float64),
    )
    assert labels.unique().tolist() == [0]
