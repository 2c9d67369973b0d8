"""OrientNormals: each cloud of every kind of sample on its own, to rooms, axes and viewpoints."""

import warnings

import numpy as np
import pytest
import torch
from torch import nn

from torchrg.errors import ConfigError, ShapeError
from torchrg.normals import orient_normals
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room
from torchrg.transforms import OrientNormals, SegmentPlanes


@pytest.fixture(scope="module")
def rooms():
    """Coordinates and normals of rooms of different size that lie within each other."""
    clouds = [make_room(1500 + 300 * seed, 0.003, seed).points.float() for seed in range(3)]
    return [(points, segment_planes(points, "classic").normals) for points in clouds]


@pytest.fixture(scope="module")
def batch(rooms):
    """The rooms as one sample of Pointcept's kind."""
    counts = torch.tensor([len(points) for points, _ in rooms])
    coord, normal = (torch.cat([room[i] for room in rooms]) for i in range(2))
    return {"coord": coord, "normal": normal, "offset": counts.cumsum(0)}


def test_planes_and_then_sides_are_the_two_functions(rooms):
    points, _ = rooms[0]
    bare = segment_planes(points, "classic", orient="none")
    steps = nn.Sequential(SegmentPlanes("classic", orient="none"), OrientNormals())
    found = steps({"coord": points})
    assert torch.equal(found["normal"], orient_normals(points, bare.normals))
    assert not torch.equal(found["normal"], bare.normals)
    assert torch.equal(found["plane"], bare.labels)


@pytest.mark.parametrize("towards", ["interior", "consistent", "-x", "up"])
def test_each_cloud_of_a_batch_is_oriented_on_its_own(rooms, batch, towards):
    way = {"up": "+z"}.get(towards, towards)
    expected = torch.cat([orient_normals(*room, orient=way) for room in rooms])
    given = batch["normal"].clone()
    found = OrientNormals(towards)(batch)
    assert torch.equal(found["normal"], expected)
    assert torch.equal(batch["normal"], given)
    numbers = torch.arange(3).repeat_interleave(torch.tensor([len(p) for p, _ in rooms]))
    sample = {"coord": batch["coord"], "normal": batch["normal"], "batch": numbers}
    assert torch.equal(OrientNormals(towards)(sample)["normal"], expected)


def test_viewpoints_are_of_all_clouds_of_each_or_of_each_point(rooms, batch):
    places = torch.tensor([[0.5, 0.6, 0.7], [3.0, 1.0, 1.0], [9.0, 9.0, 2.0]], dtype=torch.float64)

    def looking(places):
        pairs = zip(rooms, places, strict=True)
        each = [orient_normals(*r, orient="viewpoint", viewpoint=place) for r, place in pairs]
        return torch.cat(each)

    transform, one = OrientNormals("viewpoint"), looking(places[:1].expand(3, 3))
    for place in (places[0], places[:1]):
        assert torch.equal(transform({**batch, "viewpoint": place})["normal"], one)
    given = OrientNormals("viewpoint", places[0].tolist())
    assert torch.equal(given(batch)["normal"], one)
    for_each = looking(places)
    assert torch.equal(transform({**batch, "viewpoint": places})["normal"], for_each)
    counts = torch.tensor([len(points) for points, _ in rooms])
    of_points = places.repeat_interleave(counts, dim=0)
    assert torch.equal(transform({**batch, "viewpoint": of_points})["normal"], for_each)
    with pytest.raises(ShapeError, match="viewpoint"):
        transform({**batch, "viewpoint": places[:2]})
    renamed = OrientNormals("viewpoint", keys={"viewpoint": "origin"})
    assert torch.equal(renamed({**batch, "origin": places})["normal"], for_each)


def test_arrays_stay_arrays_and_columns_of_lists_are_kept(rooms):
    points, normals = rooms[0]
    sample = {"coord": points.numpy(), "normal": normals.numpy(), "index_valid_keys": ["coord"]}
    found = OrientNormals()(sample)
    np.testing.assert_array_equal(found["normal"], orient_normals(points, normals).numpy())
    assert isinstance(found["normal"], np.ndarray)
    assert found["index_valid_keys"] == ["coord", "normal"]
    assert sample["index_valid_keys"] == ["coord"]


def test_batches_of_pyg_are_oriented_cloud_by_cloud(rooms):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = pytest.importorskip("torch_geometric").data
    place = torch.tensor([[0.5, 0.6, 0.7]])
    samples = [
        data.Data(pos=points, normal=normals, viewpoint=place + i)
        for i, (points, normals) in enumerate(rooms)
    ]
    for transform in (OrientNormals(), OrientNormals("viewpoint")):
        expected = torch.cat([transform(sample).normal for sample in samples])
        found = transform(data.Batch.from_data_list(samples))
        assert torch.equal(found.normal, expected)
        assert len(found.to_data_list()) == 3


def test_empty_clouds_and_points_without_place_pass():
    empty = torch.empty(0, 3)
    assert OrientNormals()({"coord": empty, "normal": empty})["normal"].shape == (0, 3)
    nowhere = torch.full((4, 3), torch.nan)
    sample = {"coord": nowhere, "normal": torch.zeros(4, 3)}
    assert not OrientNormals()(sample)["normal"].any()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OrientNormals("inwards"), "orient to be one of auto, .*none, got 'inwards'"),
        (lambda: OrientNormals("up", (0, 0, 1)), "viewpoint must be three numbers .* with 'up'"),
        (lambda: OrientNormals("viewpoint", (0, 1)), r"three numbers .*got \(0, 1\) with 'viewp"),
        (
            lambda: OrientNormals("viewpoint")({"coord": torch.eye(3), "normal": torch.eye(3)}),
            "expected a sample with 'viewpoint', got coord, normal",
        ),
        (lambda: OrientNormals()({"coord": torch.eye(3)}), "expected a sample with 'normal'"),
    ],
)
def test_mistakes_are_one_line(make, message):
    with pytest.raises(ConfigError, match=message) as info:
        make()
    assert "\n" not in str(info.value)
