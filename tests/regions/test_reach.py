"""Growth along condensed edges, against one seed after the other."""

import itertools

import numpy as np
import pytest

from torchrg.regions.edges import EdgeLists
from torchrg.regions.reach import condense, join_condensed


def first_to_reach(targets, seeds):
    """The first seed from which edges lead to each point, by following them."""
    heads = np.full(len(targets), -1)
    for seed in seeds:
        waiting = [seed]
        while waiting:
            point = waiting.pop()
            if heads[point] < 0:
                heads[point] = seed
                waiting += targets[point]
    return heads


def edges_of(targets, block):
    """The edges of the points of a block."""
    lists = targets[block]
    starts = np.cumsum([0, *map(len, lists)])
    return EdgeLists(starts, np.array(list(itertools.chain(*lists)), dtype=np.int32))


@pytest.mark.parametrize("mean_degree", [0.5, 1.2, 3.0])
@pytest.mark.parametrize("size", [7, 40, 200])
def test_condensed_growth_is_growth_seed_by_seed(mean_degree, size):
    rng = np.random.default_rng(int(10 * mean_degree) + size)
    targets = [
        # Mostly near, as neighbours are in canonical order.
        np.unique((row + rng.integers(-9, 10, rng.poisson(mean_degree))).clip(0, 199)).tolist()
        for row in range(200)
    ]
    seeds = rng.permutation(200)[:60].astype(np.int32)
    blocks = [slice(start, min(start + size, 200)) for start in range(0, 200, size)]
    found = join_condensed([condense(edges_of(targets, some), some) for some in blocks], seeds)
    np.testing.assert_array_equal(found, first_to_reach(targets, seeds))


def test_condensed_edges_are_fewer():
    ring = [[(row + 1) % 50, (row - 1) % 50] for row in range(50)]
    whole = condense(edges_of(ring, slice(0, 50)), slice(0, 50))
    assert len(whole.sources) == 0
    assert whole.components.tolist() == [0] * 50
    half = condense(edges_of(ring, slice(0, 25)), slice(0, 25))
    assert half.targets.tolist() == [25, 49]
