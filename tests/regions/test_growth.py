"""Growth: what it refuses, degenerate clouds, and what each setting does."""

import tracemalloc

import pytest
import torch

from tests.regions import growing_clouds
from tests.regions.growing_clouds import papers_growing
from torchrg.errors import ShapeError
from torchrg.neighbors import search_knn
from torchrg.regions import grow_regions
from torchrg.regions.growth import grow_fifo
from torchrg.structures import Neighbors

CLASSIC = papers_growing(seed_rule="curvature", connectivity=None, coplanarity=False, min_size=1)


def strip(num_points, angle_step_deg):
    """Points on a line whose normals turn by a step from one to the next."""
    angle = torch.deg2rad(torch.arange(num_points, dtype=torch.float64) * angle_step_deg)
    points = torch.zeros(num_points, 3, dtype=torch.float64)
    points[:, 0] = torch.arange(num_points)
    normals = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], dim=1)
    return points, normals, torch.zeros(num_points, dtype=torch.float64), search_knn(points, 3)


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
    cloud = points, normals, torch.zeros(num_points), neighbors
    assert grow_regions(*cloud, config).tolist() == [0] * num_points
    none = torch.zeros(num_points, dtype=torch.bool)
    assert grow_regions(*cloud, config, valid=none).tolist() == [-1] * num_points


def test_exact_and_quantized_walls_and_equal_points_do_not_shatter():
    grid = torch.cartesian_prod(torch.arange(30.0), torch.arange(30.0), torch.zeros(1))
    step = 1e-3
    rough = grid + (torch.rand(grid.shape, generator=torch.Generator().manual_seed(1)) * 20 * step)
    rough[:, 2] = (rough[:, 2] / (20 * step) > 0.9) * step
    for points in (grid, rough, torch.full((20, 3), 0.3)):
        cloud = growing_clouds.prepare(points.numpy(), min(50, len(points)), dtype=torch.float32)
        config = papers_growing(connectivity=0.5, min_size=1)
        labels = grow_regions(*cloud, config)
        assert (labels == 0).float().mean() > 0.97


def test_a_long_chain_of_one_way_edges_is_followed_to_its_end():
    roots = grow_chain(20_000, joins=1)
    assert not roots.any()


def test_no_python_number_is_kept_for_every_point():
    num_points = 10_000
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normals": torch.ones(9, 3).double()}, r"expected normals of shape \(N, 3\) with N=10"),
        ({"curvature": torch.ones(10, 3).double()}, r"expected curvature of shape \(N\)"),
        (
            {"neighbors": Neighbors(torch.zeros(5, 3).int())},
            r"neighbors of shape \(N, K\)",
        ),
        ({"points": torch.ones(10, 3)}, "of one dtype"),
        ({"valid": torch.ones(10)}, "expected valid of bool"),
    ],
)
def test_wrong_shapes_are_refused(change, message):
    names = ("points", "normals", "curvature", "neighbors")
    with pytest.raises(ShapeError, match=f"grow_regions: .*{message}"):
        grow_regions(**{**dict(zip(names, strip(10, 0.0), strict=True)), **change})


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
