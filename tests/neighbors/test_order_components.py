"""Connected components of graphs with signs."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array, csgraph

from tests.kernels.clouds import definitions, needs_library
from torchrg.neighbors.order import connected_components


@pytest.fixture(params=[True, False], ids=["kernels", "definition"])
def served(request):
    with nullcontext() if request.param else definitions():
        yield


@pytest.mark.usefixtures("served")
def test_signs_follow_links_and_a_component_that_no_signs_fit_falls_apart():
    # A chain that turns once, and a triangle that turns once, as a Moebius strip does.
    starts, ends = torch.tensor([[0, 1, 3, 4, 5], [1, 2, 4, 5, 3]])
    flips = torch.tensor([True, False, False, False, True])
    numbers, signs = connected_components(6, starts, ends, flips)
    assert numbers.tolist() == [0, 0, 0, 1, 2, 3]
    assert signs.tolist() == [1, -1, -1, 1, 1, 1]


@pytest.mark.usefixtures("served")
def test_nodes_without_links_are_components():
    numbers, signs = connected_components(3, *torch.empty(2, 0, dtype=torch.int64))
    assert (numbers.tolist(), signs.tolist()) == ([0, 1, 2], [1, 1, 1])


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("wrong", [0.0, 0.1], ids=["consistent", "torn"])
def test_kernels_and_definition_find_the_same_components(rng, wrong):
    for count in range(1, 60):
        ends = torch.randint(0, count, (2, 50), generator=rng)
        side = torch.rand(count, generator=rng) < 0.5
        is_turned = side[ends[0]] ^ side[ends[1]] ^ (torch.rand(50, generator=rng) < wrong)
        found = connected_components(count, *ends, is_turned)
        with definitions():
            expected = connected_components(count, *ends, is_turned)
        assert torch.equal(found[0], expected[0])
        assert torch.equal(found[1], expected[1])


@pytest.mark.usefixtures("served")
def test_components_are_those_of_a_search_through_the_graph(rng):
    starts, ends = torch.randint(0, 400, (2, 300), generator=rng)
    graph = coo_array((np.ones(300), (starts.numpy(), ends.numpy())), shape=(400, 400))
    found, signs = connected_components(400, starts, ends)
    assert np.array_equal(found, csgraph.connected_components(graph, directed=False)[1])
    assert (signs == 1).all()
