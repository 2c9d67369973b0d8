"""Conditions under which neighbors join a region."""

import pytest
import torch

from tests.regions.growing_clouds import papers_growing
from tests.regions.test_growth import CLASSIC, strip
from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import search_knn
from torchrg.regions import grow_regions


def test_angle_limit_is_between_neighbours_and_inclusive():
    at_limit = strip(10, 4.999999)
    assert grow_regions(*at_limit, CLASSIC).tolist() == [0] * 10
    assert grow_regions(*strip(10, 5.000001), CLASSIC).tolist() == list(range(10))
    same = papers_growing(**{**vars(CLASSIC), "max_angle_deg": 0.0})
    assert grow_regions(*strip(10, 0.0), same).tolist() == [0] * 10


def test_right_angles_join_at_a_limit_of_ninety_degrees():
    points, _, curvature, neighbors = strip(4, 0.0)
    normals = torch.eye(3, dtype=torch.float64)[[0, 1, 2, 0]]
    config = papers_growing(**{**vars(CLASSIC), "max_angle_deg": 90.0})
    assert grow_regions(points, normals, curvature, neighbors, config).tolist() == [0] * 4


def test_neighbours_across_a_gap_join_only_within_the_distance():
    points, normals, curvature, _ = strip(10, 0.0)
    points[5:, 0] += 1
    neighbors = search_knn(points, 4)
    assert grow_regions(points, normals, curvature, neighbors, CLASSIC).max() == 0
    config = papers_growing(**{**vars(CLASSIC), "max_distance": 1.5})
    labels = grow_regions(points, normals, curvature, neighbors, config)
    assert labels.tolist() == [0] * 5 + [1] * 5


def test_points_of_another_color_join_only_within_the_distance():
    cloud = strip(10, 0.0)
    colors = torch.zeros(10, 3, dtype=torch.uint8)
    colors[5:] = 20
    for limit, expected in ((34.0, [0] * 5 + [1] * 5), (35.0, [0] * 10)):
        labels = grow_regions(*cloud, CLASSIC, colors=colors, max_color_distance=limit)
        assert labels.tolist() == expected
    with pytest.raises(ConfigError, match="grow_regions: expected colors"):
        grow_regions(*cloud, CLASSIC, max_color_distance=35.0)
    with pytest.raises(ConfigError, match="expected colors and max_color_distance >= 0"):
        grow_regions(*cloud, CLASSIC, colors=colors, max_color_distance=-1.0)


def test_faces_of_a_plate_join_only_without_planes_to_be_on():
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(600, 3, generator=rng, dtype=torch.float64)
    face = torch.arange(600) % 2
    points[:, 2] = 0.04 * face + 0.002 * torch.randn(600, generator=rng, dtype=torch.float64)
    cloud = (points, torch.eye(3).double()[[2] * 600], torch.zeros(600).double())
    cloud = (*cloud, search_knn(points, 30))
    rms = torch.full((600,), 0.002, dtype=torch.float64)
    assert grow_regions(*cloud, CLASSIC).max() == 0
    config = papers_growing(**{**vars(CLASSIC), "plane_reach": 4.0})
    labels = grow_regions(*cloud, config, residual_rms=rms)
    assert labels.max() == 1
    assert torch.equal(labels == labels[0], face == face[0])
    with pytest.raises(ConfigError, match="grow_regions: expected residual_rms"):
        grow_regions(*cloud, config)
    with pytest.raises(ShapeError, match=r"expected residual_rms of shape \(N\)"):
        grow_regions(*cloud, config, residual_rms=rms[:5])


def test_two_faces_of_a_thin_wall_join_only_if_normals_have_no_sign():
    points, normals, curvature, _ = strip(20, 0.0)
    points[1::2] += torch.tensor([-1.0, 0.0, 0.1], dtype=torch.float64)
    normals[1::2] *= -1
    neighbors = search_knn(points, 6)
    assert grow_regions(points, normals, curvature, neighbors, CLASSIC).max() == 0
    labels = grow_regions(points, normals, curvature, neighbors, CLASSIC, signed_normals=True)
    assert labels.tolist() == [0, 1] * 10
