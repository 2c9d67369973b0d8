"""Planes that are kept within objects: no plane has points of two of them."""

import numpy as np
import pytest
import torch

from tests.kernels.clouds import definitions
from torchrg import scratch, segment_planes
from torchrg.errors import ShapeError
from torchrg.io.result import describe_planes
from torchrg.neighbors import sample_voxels, search_knn
from torchrg.neighbors.knn import restrict_to_groups
from torchrg.structures import UNLABELED, Neighbors

PRESETS = ("consensus", "classic", "paper")


def solids(made):
    """The objects that the room was made of; its shell is one, whose walls and floor meet."""
    return torch.where(made.labels >= 0, made.objects[made.labels.clamp(min=0)], -1)


def panels(made):
    """Cubes of 2.1 m: every wall is of many objects in one plane, which merging would join."""
    places = (made.points / 2.1).floor().long()
    return places[:, 0] * 10_000 + places[:, 1] * 100 + places[:, 2]


def speckled(made):
    """Solids in which every fifth point is of another object."""
    chosen = torch.rand(len(made.points), generator=torch.Generator().manual_seed(4)) < 0.2
    return torch.where(chosen, 7000, solids(made))


OBJECTS = {make.__name__: make for make in (solids, panels, speckled)}


def assert_within(seg, objects):
    """Each plane has points of one object, the one that the table names."""
    assert len(seg.planes.object) == len(seg.planes.count) > 0
    assert seg.planes.object.dtype == torch.int64
    for plane, own in enumerate(seg.planes.object.tolist()):
        assert objects[seg.labels == plane].unique().tolist() == [own]


@pytest.mark.parametrize(
    ("kind", "preset"),
    [*((kind, "consensus") for kind in OBJECTS), ("panels", "classic"), ("speckled", "paper")],
)
def test_no_plane_has_points_of_two_objects(kind, preset, room):
    made = room(3000)
    objects = OBJECTS[kind](made)
    free = segment_planes(made.points, preset)
    assert any(len(objects[free.labels == plane].unique()) > 1 for plane in range(3))
    assert free.planes.object is None
    assert_within(segment_planes(made.points, preset, within=objects), objects)


@pytest.mark.parametrize("kind", OBJECTS)
def test_the_order_of_points_changes_nothing(kind, room, rng):
    made = room(2000)
    objects, order = OBJECTS[kind](made), torch.randperm(2000, generator=rng)
    seg = segment_planes(made.points, within=objects)
    other = segment_planes(made.points[order], within=objects[order])
    assert torch.equal(other.labels, seg.labels[order])
    assert torch.equal(other.planes.object, seg.planes.object)


def test_kernels_definitions_and_arrays_on_disk_agree(room, tmp_path, set_threads):
    made = room(2000)
    objects = panels(made)
    seg = segment_planes(made.points, within=objects)
    with definitions():
        assert torch.equal(segment_planes(made.points, within=objects).labels, seg.labels)
    with scratch.on_disk(tmp_path):
        assert torch.equal(segment_planes(made.points, within=objects).labels, seg.labels)
    set_threads(1)
    assert torch.equal(segment_planes(made.points, within=objects).labels, seg.labels)


@pytest.mark.parametrize("preset", PRESETS)
def test_one_object_is_as_none(preset, room):
    points = room(2500, 0.003, 1).points
    # With copies, a position may have points of several objects.
    cloud = torch.cat([points, points[:9]])
    seg = segment_planes(cloud, preset)
    same = segment_planes(cloud, preset, within=np.full(len(cloud), 9, np.int16))
    assert torch.equal(same.labels, seg.labels)
    # Planes are faces in the orientation, too.
    assert torch.equal(same.normals, seg.normals)
    assert same.planes.object.tolist() == [9] * len(seg.planes.count)


def test_voxels_that_objects_share_have_a_part_for_each(room):
    made = room(8000)
    objects = panels(made)
    seg = segment_planes(made.points, voxel=0.15, within=objects)
    assert_within(seg, objects)
    assert torch.equal(torch.bincount(seg.labels + 1)[1:], seg.planes.count)
    rows, inverse = sample_voxels(made.points, 0.15)
    is_other = objects != objects[rows][inverse]
    assert is_other.sum() > 100
    assert (seg.labels[is_other] >= 0).float().mean() > 0.7


def test_the_table_names_the_object_beside_planes_that_meet_across(room):
    made = room(6000)
    seg = segment_planes(made.points, within=panels(made))
    rows = describe_planes(seg.planes)["planes"]
    assert [row["object"] for row in rows] == seg.planes.object.tolist()
    across = seg.planes.object[seg.planes.adjacency.pairs]
    assert (across[:, 0] != across[:, 1]).any()
    assert "object" not in describe_planes(segment_planes(made.points).planes)["planes"][0]


def test_nearest_neighbours_of_the_group_come_first(rng):
    points = torch.rand(300, 3, generator=rng, dtype=torch.float64)
    groups = torch.randint(0, 3, (300,), generator=rng)
    kept = restrict_to_groups(search_knn(points, 20), groups, 64)
    every = search_knn(points, 20).indices
    for row in range(300):
        own = [i for i in every[row].tolist() if groups[i] == groups[row]]
        assert kept.indices[row, : len(own)].tolist() == own
        assert kept.valid[row].tolist() == [True] * len(own) + [False] * (20 - len(own))
        assert (kept.indices[row, len(own) :] == row).all()


def test_a_group_may_be_missing_at_the_last_position():
    # Row 2 is of group 1 at position 1, and its neighbor, position 2, has no point of group 1.
    near = Neighbors(torch.tensor([[0, 1, 2], [1, 0, 2], [2, 1, 0]]))
    positions, groups = torch.tensor([0, 1, 1, 2]), torch.tensor([0, 0, 1, 0])
    kept = restrict_to_groups(near, groups, 4, positions)
    assert kept.valid.sum(dim=1).tolist() == [3, 3, 1, 3]
    assert kept.indices[2].tolist() == [2, 2, 2]


def test_points_that_are_not_finite_are_of_no_plane(room):
    made = room(2000)
    points = torch.cat([made.points, torch.full((3, 3), torch.nan)])
    objects = torch.cat([panels(made), torch.tensor([1, 2, 3])])
    seg = segment_planes(points, within=objects)
    assert (seg.labels[-3:] == UNLABELED).all()
    assert_within(seg, objects)


@pytest.mark.parametrize(
    ("objects", "message"),
    [
        (torch.zeros(50), "segment_planes: expected integer within, got torch.float32"),
        (torch.zeros(49, dtype=torch.int64), "segment_planes: expected within of shape"),
        (torch.zeros(50, 1, dtype=torch.int64), "segment_planes: expected within of shape"),
    ],
)
def test_what_numbers_no_points_is_refused(objects, message):
    with pytest.raises(ShapeError, match=message):
        segment_planes(torch.rand(50, 3), within=objects)
