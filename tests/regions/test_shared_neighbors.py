"""Shared neighbors against sets."""

import numpy as np
import pytest
import torch

from tests.regions import growing_clouds
from torchrg.neighbors import search_knn
from torchrg.regions.shared_neighbors import connected_neighbors, min_shared_neighbors
from torchrg.structures import Neighbors


def expected(neighbors, min_shared):
    lists = neighbors.indices.tolist()
    counted = [[True] * len(row) for row in lists]
    if neighbors.valid is not None:
        counted = neighbors.valid.tolist()
    sets = [
        {j for j, c in zip(a, b, strict=True) if c} for a, b in zip(lists, counted, strict=True)
    ]
    return torch.tensor(
        [
            [len(own & sets[j]) >= min_shared for j in row]
            for own, row in zip(sets, lists, strict=True)
        ]
    )


@pytest.mark.parametrize("kind", ["graded", "blob", "doubled", "lattice"])
@pytest.mark.parametrize("max_distance", [None, 0.3])
def test_counts_equal_those_of_sets(kind, max_distance, monkeypatch):
    monkeypatch.setattr("torchrg.regions.shared_neighbors._BLOCK_SIZE", 16)
    points = growing_clouds.prepare(growing_clouds.KINDS[kind](np.random.default_rng(0)), 12)[0]
    neighbors = search_knn(points, 12, max_distance=max_distance, canonical=True)
    counted = torch.ones(len(points), 12).bool() if max_distance is None else neighbors.valid
    spare = []
    for min_shared in (0, 1, 6, 9, 12):
        for rows in (slice(0, 50), slice(50, len(points))):
            found = connected_neighbors(neighbors, min_shared, spare, rows, counted[rows])
            assert torch.equal(found, (expected(neighbors, min_shared) & counted)[rows])


def test_long_lists_do_not_overflow_the_counter():
    neighbors = Neighbors(torch.arange(300).expand(300, 300))
    everyone = torch.ones(300, 300, dtype=torch.bool)
    assert connected_neighbors(neighbors, 300, [], slice(0, 300), everyone).all()


def test_only_edges_that_were_asked_for_are_answered():
    neighbors = Neighbors(torch.arange(4).expand(4, 4))
    asked = torch.eye(4, dtype=torch.bool)
    assert torch.equal(connected_neighbors(neighbors, 2, [], slice(0, 4), asked), asked)


def test_the_fraction_is_the_decimal_that_was_written():
    assert [min_shared_neighbors(f, k) for f, k in [(0.07, 100), (0.58, 50), (0.57, 100)]] == [
        7,
        29,
        57,
    ]
