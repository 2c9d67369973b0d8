"""PyG itself: its samples, batches, data sets and loader, before and after batching."""

import pickle
import warnings

import pytest
import torch

from torchrg.config import load_config
from torchrg.errors import ConfigError
from torchrg.neighbors import expand_to_points, sample_voxels
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.scenes import make_room
from torchrg.transforms import (
    CenterCloud,
    KeepFinite,
    MakeSuperpoints,
    SampleVoxels,
    SegmentPlanes,
)

SIZE = 0.3


@pytest.fixture(scope="module")
def pyg():
    """PyG; it compiles with what torch no longer likes, and says so when it is imported."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("torch_geometric")


@pytest.fixture(scope="module")
def clouds():
    """Three clouds, one with a point that is not finite."""
    clouds = [make_room(1200 + 100 * seed, 0.003, seed).points for seed in range(3)]
    clouds[1][5] = torch.nan
    return clouds


@pytest.fixture
def data(pyg, clouds):
    return [
        pyg.data.Data(pos=points, y=torch.arange(len(points)), num_nodes=len(points), name=str(i))
        for i, points in enumerate(clouds)
    ]


def same(first, second):
    """Whether two ``Data`` hold the same, NaN for NaN."""
    one, other = first.to_dict(), second.to_dict()
    return one.keys() == other.keys() and all(
        torch.equal(value.nan_to_num(), other[key].nan_to_num())
        for key, value in one.items()
        if isinstance(value, torch.Tensor)
    )


def test_data_gets_what_the_function_gives(data, clouds):
    for sample, points in zip(data, clouds, strict=True):
        found, expected = (
            SegmentPlanes("classic")(sample),
            segment_planes(points, load_config("classic")),
        )
        assert torch.equal(found.plane, expected.labels)
        assert torch.equal(found.normal, expected.normals)
        assert torch.equal(found.curvature, expected.curvature)
        assert "plane" not in sample


@pytest.mark.parametrize(
    "transform",
    [SegmentPlanes("classic"), SampleVoxels(SIZE), KeepFinite(), CenterCloud()],
    ids=lambda transform: type(transform).__name__,
)
def test_a_batch_becomes_what_its_clouds_become(pyg, data, transform):
    batch = pyg.data.Batch.from_data_list(data, follow_batch=["pos"])
    before = batch.clone()
    found = transform(batch)
    expected = pyg.data.Batch.from_data_list([transform(sample) for sample in data], ["pos"])
    assert type(found) is type(expected)
    assert same(found, expected)
    assert found.num_graphs == 3
    for one, sample in zip(found.to_data_list(), data, strict=True):
        assert same(one, transform(sample))
    assert same(batch, before)


def test_labels_of_a_batch_go_back_to_its_points(pyg, data, clouds):
    """Sampled before batching, after it, and twice: each time the same points, and none for NaN."""
    batch = pyg.data.Batch.from_data_list
    for found in (
        batch([SampleVoxels(SIZE)(sample) for sample in data]),
        SampleVoxels(SIZE)(batch(data)),
        KeepFinite()(SampleVoxels(SIZE)(batch(data))),
    ):
        back = expand_to_points(found.y, found.inverse_index, fill=-1)
        start = 0
        for points in clouds:
            rows, inverse = sample_voxels(points, SIZE)
            expected = torch.where(inverse >= 0, rows[inverse], -1)
            assert torch.equal(back[start : start + len(points)], expected)
            start += len(points)
        assert start == len(back)


def test_pyg_counts_planes_and_superpoints_on_under_names_of_an_index(pyg):
    names = {name: f"{name}_index" for name in ("plane", "superpoint")}
    steps = torch.nn.Sequential(SegmentPlanes("classic", keys=names), MakeSuperpoints(keys=names))
    rooms = [make_room(900 + 200 * seed, noise=0.003, seed=seed).points for seed in range(3)]
    rooms[1][5] = torch.nan
    made = [steps(pyg.data.Data(pos=points)) for points in rooms]
    for batch in (
        pyg.data.Batch.from_data_list(made),
        steps(pyg.data.Batch.from_data_list([pyg.data.Data(pos=points) for points in rooms])),
    ):
        ends = batch.ptr[1:-1].tolist()
        for name, key in names.items():
            parts = torch.tensor_split(batch[key], ends)
            known = [set(part[part >= 0].tolist()) for part in parts]
            assert len(set.union(*known)) == sum(map(len, known))
            for part, points in zip(parts, rooms, strict=True):
                seg = segment_planes(points, "classic")
                own = seg.labels if name == "plane" else make_superpoints(points, seg).labels
                assert torch.equal(part >= 0, own >= 0)
                shifts = (part - own)[own >= 0].unique()
                assert len(shifts) == 1
        assert torch.equal(batch.to_data_list()[2].plane_index, made[2].plane_index)


def test_what_was_added_to_a_batch_stays_with_it(pyg, data, clouds):
    batch = pyg.data.Batch.from_data_list(data)
    batch.row, batch.note = torch.arange(batch.num_nodes), "kept"
    found = KeepFinite()(batch)
    is_finite = torch.cat(clouds).isfinite().all(dim=1)
    assert torch.equal(found.row, is_finite.nonzero().flatten())
    assert found.note == "kept"
    assert found.num_nodes == int(is_finite.sum())


def test_a_batch_that_cannot_be_taken_apart_is_taken_by_its_rows(pyg, clouds):
    index = torch.arange(3).repeat_interleave(torch.tensor([len(points) for points in clouds]))
    made = pyg.data.Batch(pos=torch.cat(clouds), batch=index)
    cut = pyg.data.Batch.from_data_list([pyg.data.Data(pos=points) for points in clouds])
    cut.pos, cut.batch = cut.pos[7:], cut.batch[7:]
    cut.ptr = torch.tensor([0, *(torch.bincount(cut.batch).cumsum(0)).tolist()])
    found = SampleVoxels(SIZE)(made)
    expected = [sample_voxels(points, SIZE).rows for points in clouds]
    assert torch.bincount(found.batch).tolist() == [len(rows) for rows in expected]
    kept = KeepFinite()(cut)
    assert kept.ptr.tolist() == [0, 1193, 2492, 3892]
    assert len(kept.pos) == len(kept.batch) == 3892


def test_edges_are_refused_by_who_takes_points_out(pyg, data):
    data[0].edge_index = torch.tensor([[0, 1], [1, 2]])
    with pytest.raises(ConfigError, match="cannot remove points from samples with edge_index"):
        KeepFinite()(data[0])
    assert SegmentPlanes("classic")(data[0]).edge_index.shape == (2, 2)


def test_a_stored_data_set_and_its_loader_keep_clouds_in_step(pyg, data, clouds, tmp_path):
    class Stored(pyg.data.InMemoryDataset):
        def __init__(self, root, **transforms):
            super().__init__(root, log=False, **transforms)
            self.load(self.processed_paths[0])

        raw_file_names, processed_file_names = (), ("clouds.pt",)

        def process(self):
            self.save([self.pre_transform(sample) for sample in data], self.processed_paths[0])

    steps = pyg.transforms.Compose([KeepFinite(), SegmentPlanes("classic")])
    for _ in range(2):  # processed, then as it was stored: the transforms must look the same
        stored = Stored(str(tmp_path), pre_transform=SampleVoxels(SIZE), transform=steps)
        expected = [steps(SampleVoxels(SIZE)(sample)) for sample in data]
        assert all(same(stored[i], expected[i]) for i in range(3))
    loader = pyg.loader.DataLoader(
        stored, batch_size=3, num_workers=1, multiprocessing_context="fork"
    )
    (batch,) = loader
    assert same(batch, pyg.data.Batch.from_data_list(expected))
    back = expand_to_points(batch.y, batch.inverse_index, fill=-1)
    assert len(back) == sum(len(points) for points in clouds)
    assert (back == -1).nonzero().flatten().tolist() == [1205]
    assert same(pickle.loads(pickle.dumps(steps))(data[0]), steps(data[0]))
