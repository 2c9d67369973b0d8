"""Arrays in files: their rows are those of the array, and what is written there stays there."""

import os

import numpy as np
import pytest
import torch

from torchrg.errors import ConfigError, FormatError
from torchrg.regions.adjacency import NearestPoints
from torchrg.store import FolderStore
from torchrg.structures import Neighbors


@pytest.fixture
def kept(tmp_path):
    """A store with an array of rows wider and narrower than a page, and the arrays."""
    rng = np.random.default_rng(0)
    arrays = {
        "lists": rng.integers(0, 9, (5000, 50)).astype(np.int32),
        "wide": rng.normal(size=(40, 700)),
        "flat": rng.integers(0, 2, 70_001).astype(np.bool_),
        "none": np.empty((0, 7), np.float32),
    }
    store = FolderStore(tmp_path)
    store.begin()
    for name, values in arrays.items():
        store.save(name, values)
    return store, arrays


def test_rows_on_disk_are_those_of_the_array(kept):
    store, arrays = kept
    rng = np.random.default_rng(1)
    for name, values in arrays.items():
        found = store.lazy(name)
        assert found.shape == values.shape
        assert found.dtype == torch.from_numpy(values).dtype
        slices = [slice(None), slice(0, 0), slice(3, 1 + len(values) // 2), slice(-2, None)]
        some = [rng.integers(0, len(values), count) for count in (0, 1, 30, 9000) if len(values)]
        for rows in [*slices, *some, *map(np.sort, some)]:
            np.testing.assert_array_equal(found[rows], values[rows])
            given = rows if isinstance(rows, slice) else torch.from_numpy(rows)
            np.testing.assert_array_equal(found[given], values[rows])
            np.testing.assert_array_equal(store.read(name)[rows], values[rows])


def test_nearest_neighbors_are_columns_that_stay_on_disk(kept):
    store, arrays = kept
    beside = NearestPoints(Neighbors(store.lazy("lists")))
    rows = torch.tensor([4, 4999, 4, 77])
    np.testing.assert_array_equal(beside.around(rows), arrays["lists"][rows, 1:9])
    assert beside.neighbors.indices.shape == (5000, 8)
    np.testing.assert_array_equal(store.lazy("lists")[rows, 0], arrays["lists"][rows, 0])


def test_what_is_written_into_rows_stays_in_them(kept):
    store, arrays = kept
    lists = store.lazy("lists")
    some = lists[:100]
    some[:10] = -7
    assert bool((some[:10] == -7).all())
    np.testing.assert_array_equal(lists[:100], arrays["lists"][:100])
    whole = store.map("lists")
    whole[:10] = -7
    assert bool((whole[:10] == -7).all())
    np.testing.assert_array_equal(store.get("lists"), arrays["lists"])


def test_an_array_on_disk_is_not_taken_for_one_in_memory(kept):
    lists = kept[0].lazy("lists")
    with pytest.raises(TypeError, match="write them by its store"):
        lists[:10] = -7
    for work in (lambda: lists + 1, lists.clone, lambda: lists.add_(1)):
        with pytest.raises(TypeError, match=r"take those you need|unsupported operand"):
            work()
    with pytest.raises(ConfigError, match="expected tile_size >= 1, got 0"):
        FolderStore("x", tile_size=0)


def test_rows_that_the_disk_has_lost_are_one_line(kept):
    store, _ = kept
    lists = store.lazy("lists")
    os.truncate(store.path("lists"), 200_000)
    assert len(lists[:900]) == 900
    for rows in (slice(None), np.array([5, 4000])):
        with pytest.raises(FormatError, match=r"lists\.npy: is damaged: .*; run the same again"):
            lists[rows]
