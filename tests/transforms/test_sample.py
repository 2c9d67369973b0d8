"""Small transforms on every kind of sample."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from torchrg.config import load_config
from torchrg.errors import ConfigError
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room
from torchrg.transforms import (
    CenterCloud,
    KeepFinite,
    SampleVoxels,
    SegmentPlanes,
    expand_to_points,
    sample_voxels,
)


def test_labels_of_voxels_go_back_to_every_point():
    room = make_room(6000, 0.003, 1)
    points = room.points.clone()
    points[7] = torch.nan
    config = load_config("classic")
    seg = segment_planes(points, config, voxel=0.1)
    rows, inverse = sample_voxels(points, 0.1)
    assert inverse[7] == seg.labels[7] == -1
    own = segment_planes(points[rows], config).labels
    back = expand_to_points(own, inverse, fill=-1)
    pairs = torch.stack([back, seg.labels]).unique(dim=1)
    assert pairs[0].unique().numel() == pairs[1].unique().numel() == pairs.shape[1]
    assert (seg.planes.count.diff() <= 0).all()
    assert seg.planes.count.tolist() == torch.bincount(seg.labels[seg.labels >= 0]).tolist()


def test_planes_of_voxels_are_numbered_by_their_points(rng):
    wide = torch.rand(4000, 3, generator=rng) * torch.tensor([2.0, 2, 0])
    dense = torch.rand(9000, 3, generator=rng) * torch.tensor([1.0, 0, 1])
    seg = segment_planes(torch.cat([wide, dense]), load_config("classic"), voxel=0.05)
    assert seg.planes.count.tolist() == torch.bincount(seg.labels[seg.labels >= 0]).tolist()
    assert seg.labels[:4000].mode().values == 1
    assert seg.labels[4000:].mode().values == 0
    assert seg.planes.normal[0].abs().argmax() == 1


def test_planes_of_voxels_are_measured_on_all_points_and_meet_under_their_new_numbers(rng):
    # Where voxels are most, points are fewest: every plane gets another number.
    floor, wall, ramp = (torch.rand(count, 3, generator=rng) for count in (3000, 12000, 6000))
    floor = floor * torch.tensor([2.0, 2.0, 0.0])
    wall = wall * torch.tensor([2.0, 0.0, 1.0])
    angle = math.radians(40)
    ramp = ramp * torch.tensor([1.0, 1.5, 0.0]) + torch.tensor([0.0, 0.5, 0.0])
    ramp = torch.stack(
        [2 + ramp[:, 0] * math.cos(angle), ramp[:, 1], ramp[:, 0] * math.sin(angle)], dim=1
    )
    points = torch.cat([wall, ramp, floor]).double()
    seg = segment_planes(points, voxel=0.04)
    planes = seg.planes
    assert planes.normal.abs().argmax(dim=1).tolist() == [1, 2, 2]
    assert planes.adjacency.pairs.tolist() == [[0, 2], [1, 2]]
    assert planes.adjacency.dihedral_deg.tolist() == pytest.approx([90, 40], abs=0.5)
    assert planes.adjacency.boundary_length.tolist() == pytest.approx([2, 1.5], rel=0.1)
    assert planes.area.tolist() == pytest.approx([2, 1.5, 4], rel=0.05)
    for plane in planes:
        members = points[seg.labels == plane.id]
        assert plane.count == len(members)
        torch.testing.assert_close(plane.centroid, members.mean(dim=0))
        height = members @ plane.normal - plane.offset
        assert plane.rms == pytest.approx(float(height.square().mean().sqrt()), abs=1e-9)
        widths = (members @ plane.axes.T).aminmax(dim=0)
        torch.testing.assert_close(plane.extent, widths.max - widths.min)


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_sizes_are_refused(size):
    with pytest.raises(ConfigError, match="expected size > 0"):
        SampleVoxels(size)


def test_voxels_reduce_every_entry_with_a_row_a_point_and_no_other(rng):
    coord = torch.rand(300, 3, generator=rng)
    sample = {"coord": coord, "segment": torch.arange(300), "name": "a", "pose": torch.eye(4)}
    small = SampleVoxels(0.4)(sample)
    assert torch.equal(coord[small["segment"]], small["coord"])
    assert small["inverse"].shape == (300,)
    assert small["name"] == "a"
    assert small["pose"].shape == (4, 4)
    assert set(sample) == {"coord", "segment", "name", "pose"}


def test_voxels_never_cross_the_clouds_of_a_batch(rng):
    coord = torch.rand(200, 3, generator=rng)
    both = SampleVoxels(0.5)({"coord": coord.repeat(2, 1), "offset": torch.tensor([200, 400])})
    one = SampleVoxels(0.5)({"coord": coord})
    count = len(one["coord"])
    assert torch.equal(both["coord"], one["coord"].repeat(2, 1))
    assert both["offset"].tolist() == [count, 2 * count]
    assert torch.equal(both["inverse"], torch.cat([one["inverse"], one["inverse"] + count]))


def test_centered_cloud_and_origin_give_the_coordinates_back(dtype):
    # From 2^24 on float32 has every second number, and the middle is between two of them.
    far = 2.0**24
    coord = torch.tensor([[far, 5e6, 1], [far + 2, 5e6, 3], [far, 5e6, 1]], dtype=dtype)
    sample = CenterCloud()({"coord": coord})
    assert sample["coord"].tolist() == [[-1, 0, -1], [1, 0, 1], [-1, 0, -1]]
    assert torch.equal(sample["coord"] + sample["origin"], coord.double())
    again = CenterCloud()({**sample, "coord": sample["coord"][::2]})
    assert again["coord"].tolist() == [[0, 0, 0]] * 2
    assert torch.equal(again["coord"] + again["origin"], coord[::2].double())


def test_points_that_are_not_finite_leave_with_their_entries():
    coord = torch.tensor([[0.0, 0, 0], [torch.inf, 0, 0], [1, 0, 0], [0, torch.nan, 0]])
    sample = KeepFinite()({"coord": coord, "segment": torch.arange(4)})
    assert sample["segment"].tolist() == [0, 2]


def test_transforms_compose_and_keep_numpy_samples_numpy():
    coord = make_room(5000, 0.003, 2).points.numpy()
    coord[3] = np.nan
    steps = nn.Sequential(KeepFinite(), CenterCloud(), SampleVoxels(0.05), SegmentPlanes("classic"))
    sample = steps({"coord": coord, "index_valid_keys": ["coord"]})
    assert isinstance(sample["plane"], np.ndarray)
    assert len(sample["plane"]) == len(sample["coord"]) < 4999
    assert {"plane", "normal", "curvature"} <= set(sample["index_valid_keys"])


def test_a_second_sampling_goes_on_from_the_first(rng):
    coord = torch.rand(300, 3, generator=rng)
    coord[4] = torch.nan
    sample = SampleVoxels(0.4)(KeepFinite()(SampleVoxels(0.1)({"coord": coord})))
    once = sample_voxels(coord, 0.1)
    twice = sample_voxels(coord[once.rows], 0.4)
    assert len(sample["inverse"]) == 300
    for point, voxel in enumerate(sample["inverse"].tolist()):
        first = int(once.inverse[point])
        assert voxel == (-1 if first < 0 else int(twice.inverse[first]))


def test_points_that_leave_are_named_by_no_row():
    coord = torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0], [1, 0, 0]])
    sample = KeepFinite()({"coord": coord, "inverse": torch.tensor([2, 1, 0, 2, -1])})
    assert sample["inverse"].tolist() == [1, -1, 0, 1, -1]
    with pytest.raises(
        ConfigError, match="expected inverse to contain rows of 3 points, got row 3"
    ):
        KeepFinite()({"coord": coord, "inverse": torch.tensor([3])})
