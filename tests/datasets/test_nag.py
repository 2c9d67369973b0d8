"""Levels of superpoints nest as Superpoint Transformer documents its NAG."""

from itertools import pairwise

import pytest
import torch

from torchrg import make_superpoints
from torchrg.config import SuperpointsConfig, load_config
from torchrg.datasets import make_nag
from torchrg.errors import ShapeError
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room

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
    with pytest.raises(ShapeError, match="expected a superpoint of every point, got 1 points"):
        make_nag(points, make_superpoints(points))
