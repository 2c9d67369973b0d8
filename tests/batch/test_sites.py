"""The number of sites before a cloud is segmented, against the voxels themselves."""

import pytest
import torch

from torchrg.batch.sites import count_sites, propose_voxel
from torchrg.neighbors import sample_voxels


@pytest.fixture
def floor():
    """Points of one density on a square, some of them missing."""
    points = 10 * torch.rand(60_000, 3, generator=torch.Generator().manual_seed(0)) - 3
    points[:, 2] = 1
    points[::100] = torch.nan
    return points


@pytest.mark.parametrize("size", [0.03, 0.2, 100.0])
def test_sites_are_voxels_with_points(floor, size):
    assert count_sites(floor, size) == len(sample_voxels(floor, size).rows)


def test_the_proposed_voxel_leaves_half_of_the_points(floor):
    size = propose_voxel(floor)
    assert 0.47 < count_sites(floor, size) / 59_400 < 0.53


def test_points_at_one_place_are_one_site():
    points = torch.ones(5, 3)
    assert count_sites(points, 0.1) == 1
    assert propose_voxel(points) >= 0
