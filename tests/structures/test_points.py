"""Origins of far clouds, and arrays of integers."""

import numpy as np
import pytest
import torch

import torchrg
from torchrg.structures.points import are_integers, bounding_box, local_origin


@pytest.mark.parametrize(
    ("low", "high", "origin"),
    [
        ((0, 0, 0), (8, 6, 3), (0, 0, 0)),
        ((500_000, 4_000_000, 1), (500_010, 4_000_020, 3), (500_005, 4_000_010, 2)),
        ((-np.inf, 0, 0), (1, 1, 1), (0, 0, 0)),
    ],
)
def test_only_a_far_cloud_gets_another_origin(low, high, origin):
    assert local_origin(np.array(low, float), np.array(high, float)).tolist() == list(origin)


def test_the_box_of_points_is_that_of_their_columns():
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    low, high = bounding_box(points)
    assert (low == points.min(axis=0)).all()
    assert (high == points.max(axis=0)).all()


def test_integers_stored_as_floats_are_integers():
    assert are_integers(np.array([1.0, -2.0]))
    assert are_integers(np.array([True]))
    assert not are_integers(np.array([1.5, 2]))
    assert not are_integers(np.array([np.nan, 2]))


@pytest.fixture(scope="module")
def results():
    """Return a result of every public kind."""
    room = torchrg.scenes.make_room(1500, seed=0)
    seg = torchrg.segment_planes(room.points, "classic")
    fit = torchrg.estimate_normals(room.points, method="pca")
    patches = room.points[:40].view(2, 20, 3)
    return [
        *(room, seg, fit, seg.planes, seg.planes[0], seg.planes.adjacency, seg.sampling),
        torchrg.search_knn(room.points, 3),
        torchrg.make_superpoints(room.points, seg),
        torchrg.nn.DetMCD()(patches),
        torchrg.nn.Eigh()(torchrg.nn.Covariance()(patches)),
        torchrg.normals.fit_jet(patches),
        torchrg.neighbors.sample_voxels(room.points, 0.1),
        torchrg.neighbors.distinct_points(room.points),
        torchrg.metrics.score_labels(seg.labels, room.labels),
        torchrg.metrics.score_normals(seg.normals, room.normals),
        torchrg.metrics.contingency_table(seg.labels, room.labels),
        torchrg.metrics.score_partition(seg.labels, room.labels, room.points),
        torchrg.io.result.Result(torchrg.Cloud(room.points), provenance={"a": 1}),
        torchrg.datasets.RGBDFrame("a.png", torch.diag(torch.tensor([9.0, 9, 1])), 1.0),
    ]


def test_every_result_prints_in_a_short_line(results):
    for result in results:
        line = repr(result)
        assert line.startswith((type(result).__name__, "None"))
        assert "\n" not in line
        assert "tensor(" not in line
        assert len(line) < 300
    assert repr(results[7]) == "Neighbors(indices=int32 (1500, 3))"
