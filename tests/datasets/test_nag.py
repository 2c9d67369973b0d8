"""Levels of superpoints nest as Superpoint Transformer documents its NAG."""

import io
import sys
from itertools import pairwise

import numpy as np
import pytest
import torch

from torchrg import make_superpoints
from torchrg.config import SuperpointsConfig, load_config
from torchrg.datasets import make_nag
from torchrg.datasets.layouts import LAYOUTS, LayoutScan
from torchrg.datasets.nag import encode_nag
from torchrg.errors import ShapeError
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room
from torchrg.structures import Superpoints

Data = pytest.importorskip("torch_geometric.data", reason="needs PyG").Data


@pytest.fixture(scope="module")
def nested():
    room = make_room(num_points=4000, noise=0.003, seed=5)
    seg = segment_planes(room.points, load_config("classic"))
    parts = make_superpoints(room.points, seg, SuperpointsConfig(counts=(150, 80, 20)))
    return room, parts, make_nag(room.points, parts, y=room.labels, normal=room.normals)


def test_levels_agree_in_both_directions(nested):
    """What ``NAG.debug`` and ``Cluster.to_super_index`` of the transformer ask for."""
    room, parts, levels = nested
    assert len(levels) == 4
    assert all(isinstance(level, Data) for level in levels)
    assert torch.equal(levels[0].pos, room.points)
    assert torch.equal(levels[0].y, room.labels)
    counts = [int(labels.max()) + 1 for labels in (parts.labels, *parts.levels)]
    assert counts[1:] == [80, 20]
    assert [level.num_nodes for level in levels] == [4000, *counts]
    assert "super_index" not in levels[-1]
    assert "sub" not in levels[0]
    for low, high in pairwise(levels):
        index, sub = low.super_index, high.sub
        assert index.dtype == sub.pointers.dtype == sub.points.dtype == torch.int64
        assert int(index.max()) + 1 == high.num_nodes == len(sub.pointers) - 1
        assert sub.pointers[0] == 0
        assert sub.pointers[-1] == low.num_nodes == len(sub.points)
        sizes = sub.pointers.diff()
        assert (sizes > 0).all()
        assert len(torch.unique(sub.points)) == len(sub.points)
        back = torch.empty_like(index)
        back[sub.points] = torch.arange(high.num_nodes).repeat_interleave(sizes)
        assert torch.equal(back, index)


def test_every_point_is_in_its_superpoint_of_each_level(nested):
    room, parts, levels = nested
    index = torch.arange(4000)
    for (low, high), labels in zip(pairwise(levels), (parts.labels, *parts.levels), strict=True):
        index = low.super_index[index]
        assert torch.equal(index, labels)
        assert torch.equal(high.node_size, labels.bincount())
        for part in range(0, high.num_nodes, 7):
            assert torch.allclose(
                high.pos[part], room.points[labels == part].mean(dim=0), atol=1e-5
            )


def test_own_classes_of_the_transformer_are_used(nested):
    room, parts, _ = nested
    made = make_nag(room.points.numpy(), parts, data=dict, cluster=lambda *csr: ("CSR", *csr))
    assert made[1]["sub"][0] == "CSR"
    assert set(made[1]) == {"pos", "node_size", "sub", "super_index"}


def test_points_without_a_superpoint_are_refused(nested):
    points = torch.cat([torch.rand(50, 3), torch.full((1, 3), torch.nan)])
    with pytest.raises(ShapeError, match="expected a superpoint for every point, got 1 points"):
        make_nag(points, make_superpoints(points))


@pytest.mark.parametrize(
    ("fine", "coarse", "message"),
    [
        ([0, 1, 3, 3], [], "consecutive superpoint IDs from 0 in level 0, got 2 for no p"),
        ([0, 1, 2, 2], [[0, 0, 2, 2]], "superpoint IDs from 0 in level 1, got 1 for no point"),
        ([0, 1, 2, 2], [[0, 0, 1, -1]], "superpoint IDs from 0 in level 1, got -1 for a point"),
        ([0, 1, 2, 2], [[0, 0, 1, 0]], "each superpoint in one of level 1, got 2 in two; merge"),
        ([0, 1, 2, 2], [[0, 0, 1]], r"expected labels of shape \(N\), got \(3,\)|with N=4"),
    ],
)
def test_levels_that_do_not_nest_are_refused_by_the_first(fine, coarse, message):
    parts = Superpoints(torch.tensor(fine), torch.zeros(4), tuple(map(torch.tensor, coarse)))
    with pytest.raises(ShapeError, match=message):
        make_nag(torch.eye(4, 3), parts, data=dict)


def read_h5(content):
    """All arrays of a file by their paths."""
    h5py = pytest.importorskip("h5py", reason="needs the extra nag")
    arrays = {}
    with h5py.File(io.BytesIO(content)) as file:
        assert file.attrs["start_i_level"] == 0
        file.visititems(
            lambda path, item: arrays.update({path: item[()]} if hasattr(item, "dtype") else {})
        )
    return arrays


def test_the_file_has_the_arrays_that_nag_load_reads(nested):
    """Names and shapes are those of ``NAG.save``, ``Data.save``, ``CSRData.save``."""
    room, parts, _ = nested
    y = torch.nn.functional.one_hot(room.labels % 5, 6)
    levels = make_nag(
        room.points.float(), parts, data=dict, y=y, rgb=torch.full((4000, 3), 7).byte()
    )
    arrays = read_h5(encode_nag(levels))
    assert {path.partition("/")[0] for path in arrays} == {f"level_{i}" for i in range(4)}
    found = {path.partition("/")[2] for path in arrays if path.startswith("level_1")}
    assert found == {
        "pos", "node_size", "super_index", "_cluster_/sub/pointers", "_cluster_/sub/value_0",
        "_cluster_/sub/is_index_value", "_csr_/y/pointers", "_csr_/y/columns", "_csr_/y/values",
        "_csr_/y/shape",
    }  # fmt: skip
    assert arrays["level_0/rgb"].dtype == np.uint8
    assert arrays["level_0/pos"].dtype == np.float32
    np.testing.assert_array_equal(arrays["level_0/pos"], room.points.float())
    assert arrays["level_2/_cluster_/sub/is_index_value"].tolist() == [1]
    index = np.arange(4000)
    for level, labels in enumerate((parts.labels, *parts.levels)):
        index = arrays[f"level_{level}/super_index"][index]
        np.testing.assert_array_equal(index, labels)
        pointers, columns, values, shape = (
            arrays[f"level_{level + 1}/_csr_/y/{name}"]
            for name in ("pointers", "columns", "values", "shape")
        )
        dense = np.zeros(shape, int)
        dense[np.repeat(np.arange(len(pointers) - 1), np.diff(pointers)), columns] = values
        expected = np.zeros(shape, int)
        np.add.at(expected, (labels.numpy(), (room.labels % 5).numpy()), 1)
        np.testing.assert_array_equal(dense, expected)
    assert "level_3/super_index" not in arrays


def test_equal_levels_give_equal_bytes(nested):
    pytest.importorskip("h5py", reason="needs the extra nag")
    room, parts, _ = nested
    first, second = (encode_nag(make_nag(room.points, parts, data=dict)) for _ in range(2))
    assert first == second


def test_s3dis_has_the_numbers_of_classes_of_the_transformer(tmp_path):
    coord, color = np.zeros((14, 3), np.float32), np.zeros((14, 3), np.uint8)
    coord[:, 0] = np.arange(14)
    given = {"color": color, "segment": np.array([*range(13), 0]), "instance": np.arange(14)}
    parts = np.repeat([0, 1], 7)
    scan = LayoutScan("Area_1_a", "", "Area_1/a", "S3DIS", coord, coord, parts, parts, given)
    ((path, content),) = LAYOUTS["nag"]["S3DIS"](scan).items()
    assert path == "nag/Area_1_a.h5"
    columns = read_h5(content)["level_0/_csr_/y/columns"]
    # Its OBJECT_LABEL: table is 8, chair 7, sofa 10, bookcase 9.
    assert columns.tolist() == [0, 1, 2, 3, 4, 5, 6, 8, 7, 10, 9, 11, 12, 0]


def test_a_command_without_h5py_or_place_is_one_line(tmp_path, run, folder_of_clouds, monkeypatch):
    pytest.importorskip("h5py", reason="needs the extra nag")
    source, out = folder_of_clouds("a.ply"), tmp_path / "out"
    command = ("convert", "folder", source, out, "--layout", "nag", "--preset", "classic")
    out.mkdir()
    (out / "nag").write_text("a file where the folder would be")
    reported = run(*command)
    assert reported.code == 3
    assert "a: " in reported.err
    assert "nag: cannot be created: File exists." in reported.err
    own = {".torchrg.lock", "report.json"}
    assert {path.name for path in out.rglob("*")} == {"nag", *own}
    (out / "nag").unlink()
    assert run(*command, "--partition.counts", "200", "40", "--level", "1").code == 0
    arrays = read_h5((out / "nag" / "a.h5").read_bytes())
    assert len(arrays["level_1/pos"]) == 40
    assert {path.partition("/")[0] for path in arrays} == {"level_0", "level_1"}
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert "h5py is needed to write layout nag; install it with" in run(*command).error
