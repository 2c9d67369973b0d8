"""The voxel size proposed before a cloud is segmented, against the voxels themselves."""

import pytest
import torch

from torchrg.batch.sites import propose_voxel
from torchrg.neighbors import sample_voxels


@pytest.fixture
def floor():
    """Points of one density on a square, some of them missing."""
    points = 10 * torch.rand(60_000, 3, generator=torch.Generator().manual_seed(0)) - 3
    points[:, 2] = 1
    points[::100] = torch.nan
    return points


def test_the_proposed_voxel_leaves_half_of_the_points(floor):
    size = propose_voxel(floor)
    assert 0.47 < len(sample_voxels(floor, size).rows) / 59_400 < 0.53


def test_points_at_one_place_have_a_voxel():
    assert propose_voxel(torch.ones(5, 3)) >= 0
