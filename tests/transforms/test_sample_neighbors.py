"""A sample may carry its neighbors, so that they are searched once, with the same results."""

import pickle

import pytest
import torch
from torch import nn
from torch.utils.data import default_collate

from torchrg.datasets import collate_offset
from torchrg.neighbors import knn
from torchrg.scenes import make_room
from torchrg.transforms import (
    CenterCloud,
    EstimateNormals,
    GrowRegions,
    MakeSuperpoints,
    OrientNormals,
    SegmentPlanes,
)


@pytest.fixture
def searches(monkeypatch):
    """Numbers of neighbors that are searched, one for each search of a cloud."""
    asked = []
    search = knn.search_rows

    def counted(points, rows, order, indices, start=0):
        asked.append(indices.shape[1])
        search(points, rows, order, indices, start)

    monkeypatch.setattr(knn, "search_rows", counted)
    return asked


def steps(*, keep, k=50):
    return nn.Sequential(
        EstimateNormals("classic", k=k, keep_neighbors=keep),
        OrientNormals(keep_neighbors=keep),
        GrowRegions("classic", keep_neighbors=keep),
        MakeSuperpoints(),
    )


def check_equal(sample, other):
    assert sample.keys() == other.keys()
    for key, values in sample.items():
        torch.testing.assert_close(values, other[key], rtol=0, atol=0, equal_nan=True)


@pytest.fixture(scope="module")
def coord():
    return make_room(2500, 0.003, 0).points


def test_neighbors_are_searched_once_and_results_are_the_same(coord, searches):
    sample = {"coord": coord}
    carried = steps(keep=True)(sample)
    assert searches == [50]
    alone = steps(keep=False)(sample)
    assert searches[1:] == [50, 20, 50, 9]
    check_equal(carried, alone)


def test_those_of_the_segmentation_serve_superpoints(coord, searches):
    carried = nn.Sequential(SegmentPlanes("classic", keep_neighbors=True), MakeSuperpoints())
    alone = nn.Sequential(SegmentPlanes("classic"), MakeSuperpoints())
    check_equal(carried({"coord": coord}), alone({"coord": coord}))
    assert searches == [50, 50, 9]


def test_each_cloud_of_a_batch_has_its_own(coord, searches):
    parts = [{"coord": coord}, {"coord": coord[:1500] + 0.5}]
    batch = collate_offset(parts)
    carried = steps(keep=True)(batch)
    assert searches == [50, 50]
    check_equal(carried, steps(keep=False)(batch))


def test_more_than_were_searched_are_searched_anew(coord, searches):
    carried = steps(keep=True, k=30)({"coord": coord})
    assert searches == [30, 50]
    check_equal(carried, steps(keep=False, k=30)({"coord": coord}))


def moved(sample):
    return CenterCloud()(sample)


def without_some(sample):
    return {key: v[::2] if torch.is_tensor(v) else v for key, v in sample.items()}


def one_changed(sample):
    coord = sample["coord"].clone()
    coord[7] = torch.nan
    return {**sample, "coord": coord}


def in_double(sample):
    return {**sample, "coord": sample["coord"].double()}


@pytest.mark.parametrize("change", [moved, without_some, one_changed, in_double])
def test_those_of_other_points_are_not_used(coord, searches, change):
    sample = EstimateNormals("classic", keep_neighbors=True)({"coord": coord})
    other = change(sample)
    assert other["neighbors"] is sample["neighbors"]
    found = GrowRegions("classic")(other)
    assert searches == [50, 50]
    del other["neighbors"]
    check_equal(found, GrowRegions("classic")(other))


def test_another_order_of_the_same_points_changes_nothing(coord, searches):
    sample = EstimateNormals("classic", keep_neighbors=True)({"coord": coord})
    order = torch.randperm(len(coord), generator=torch.Generator().manual_seed(0))
    turned = {key: v[order] if torch.is_tensor(v) else v for key, v in sample.items()}
    found = GrowRegions("classic")(turned)
    assert searches == [50]
    assert torch.equal(found["plane"], GrowRegions("classic")(sample)["plane"][order])


def test_they_are_in_the_sample_only_where_asked_for_and_survive_pickling(coord, searches):
    assert "neighbors" not in EstimateNormals("classic")({"coord": coord})
    sample = EstimateNormals("classic", keep_neighbors=True)({"coord": coord})
    there = pickle.loads(pickle.dumps(sample))
    searches.clear()
    found = GrowRegions("classic")(there)
    assert (searches, "neighbors" in found) == ([], False)
    assert "neighbors" in there
    check_equal(found, GrowRegions("classic")(sample))


def test_no_collate_function_joins_them(coord):
    samples = [EstimateNormals("classic", k=9, keep_neighbors=True)({"coord": coord[:99]})] * 2
    with pytest.raises(TypeError, match="NeighborSearch"):
        default_collate(samples)
    assert collate_offset(samples).keys() == samples[0].keys() - {"neighbors"} | {"offset"}


def test_samples_of_pyg_carry_them_too(coord, searches):
    data = pytest.importorskip("torch_geometric.data")
    batch = data.Batch.from_data_list([data.Data(pos=coord), data.Data(pos=coord[:1500])])
    carried, alone = steps(keep=True)(batch), steps(keep=False)(batch)
    assert searches[:2] == [50, 50]
    assert len(searches) == 2 + 2 * 4
    assert "neighbors" not in carried
    for key in ("normal", "plane", "superpoint"):
        assert torch.equal(carried[key], alone[key])
