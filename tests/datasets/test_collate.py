"""Ragged batches keep every point, and say where each cloud ends."""

import numpy as np
import pytest
import torch

from torchrg.datasets import collate_offset
from torchrg.errors import ShapeError
from torchrg.transforms import SampleVoxels, expand_to_points


def sample_of(count, name):
    return {
        "coord": torch.rand(count, 3),
        "segment": np.arange(count),
        "origin": torch.zeros(1, 3),
        "name": name,
        "scale": 0.5,
        "area": torch.tensor(count),
    }


def test_points_are_joined_and_names_listed():
    samples = [sample_of(2, "a"), sample_of(0, "b"), sample_of(3, "c")]
    batch = collate_offset(samples)
    assert batch["offset"].tolist() == [2, 2, 5]
    assert batch["offset"].dtype == torch.int64
    begin = 0
    for sample, end in zip(samples, batch["offset"], strict=True):
        assert torch.equal(batch["coord"][begin:end], sample["coord"])
        assert batch["segment"][begin:end].tolist() == sample["segment"].tolist()
        begin = end
    assert batch["name"] == ["a", "b", "c"]
    assert batch["origin"].shape == (3, 3)
    assert batch["scale"].tolist() == [0.5] * 3
    assert batch["area"].tolist() == [2, 0, 3]


def test_batches_join_to_batches():
    samples = [sample_of(count, "x") for count in (2, 3, 4)]
    twice = collate_offset([collate_offset(samples[:2]), collate_offset(samples[2:])])
    assert twice["offset"].tolist() == collate_offset(samples)["offset"].tolist() == [2, 5, 9]


def test_other_names_of_the_coordinates():
    assert collate_offset([{"pos": torch.zeros(4, 3)}], coord="pos")["offset"].tolist() == [4]


def test_samples_that_differ_are_refused():
    with pytest.raises(ShapeError, match="got color in only one of samples 0 and 1"):
        collate_offset([{"coord": torch.zeros(1, 3)}, {"coord": torch.zeros(1, 3), "color": 1}])
    with pytest.raises(ShapeError, match="expected 'coord', got pos"):
        collate_offset([{"pos": torch.zeros(1, 3)}])
    with pytest.raises(ShapeError, match="got none"):
        collate_offset([])


def test_labels_of_clouds_are_counted_on_where_asked():
    clouds = [[0, -1, 1], [], [-1], [2, 0, 1]]
    samples = [
        {"coord": torch.zeros(len(plane), 3), "plane": torch.tensor(plane, dtype=torch.int64)}
        for plane in clouds
    ]
    assert collate_offset(samples)["plane"].tolist() == [0, -1, 1, -1, 2, 0, 1]
    assert collate_offset(samples, unique=["plane"])["plane"].tolist() == [0, -1, 1, -1, 4, 2, 3]
    with pytest.raises(ShapeError, match="expected 'superpoint', got coord, plane"):
        collate_offset(samples, unique=("plane", "superpoint"))


def test_what_names_points_names_rows_of_the_batch():
    """Labels of a batch go back to the points of all clouds, and to no point without a voxel."""
    clouds = [torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0], [1, 0, 0]]), torch.eye(3)]
    samples = [SampleVoxels(0.5)({"coord": cloud}) for cloud in clouds]
    for batch in (collate_offset(samples), collate_offset([collate_offset(samples)])):
        back = expand_to_points(batch["coord"], batch["inverse"], fill=-1)
        assert batch["inverse"].lt(0).tolist() == [False, True, False, False, False, False]
        assert torch.equal(back[[0, 2, 3, 4, 5]], torch.cat(clouds)[[0, 2, 3, 4, 5]])
    twice = collate_offset([collate_offset(samples)] * 2)
    assert twice["inverse"].tolist() == [0, -1, 1, 2, 3, 4, 5, -1, 6, 7, 8, 9]


def test_names_of_entries_stay_one_list():
    samples = [{**sample_of(2, "a"), "index_valid_keys": ("coord", "segment")} for _ in range(2)]
    batch = collate_offset(samples)
    assert batch["index_valid_keys"] == ["coord", "segment"]
