"""Connected components of graphs with signs."""

from contextlib import nullcontext

import pytest
import torch

from tests.kernels.clouds import definitions, needs_library
from torchrg.neighbors.components import Components


def components_of(num_nodes, *links):
    """Return components and signs, links given in one call each."""
    components = Components(num_nodes)
    for starts, ends, is_turned in links:
        nodes = (torch.as_tensor(values, dtype=torch.int32) for values in (starts, ends))
        components.link(*nodes, torch.as_tensor(is_turned, dtype=torch.bool))
    return components.find()


@pytest.fixture(params=[True, False], ids=["kernels", "definition"])
def served(request):
    with nullcontext() if request.param else definitions():
        yield


@pytest.mark.usefixtures("served")
def test_signs_follow_links_and_a_component_that_no_signs_fit_falls_apart():
    # A chain that turns once, and a triangle that turns once, as a Moebius strip does.
    chain, strip = ([0, 1], [1, 2], [True, False]), ([3, 4, 5], [4, 5, 3], [False, False, True])
    numbers, signs = components_of(6, chain, strip)
    assert numbers.tolist() == [0, 0, 0, 1, 2, 3]
    assert signs.tolist() == [1, -1, -1, 1, 1, 1]


@pytest.mark.usefixtures("served")
def test_nodes_without_links_are_components():
    for links in ([], [([], [], [])]):
        numbers, signs = components_of(3, *links)
        assert (numbers.tolist(), signs.tolist()) == ([0, 1, 2], [1, 1, 1])


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("wrong", [0.0, 0.1], ids=["consistent", "torn"])
def test_kernels_and_definition_find_the_same_components(rng, wrong):
    for count in range(1, 60):
        ends = torch.randint(0, count, (2, 50), generator=rng, dtype=torch.int32)
        side = torch.rand(count, generator=rng) < 0.5
        is_turned = side[ends[0]] ^ side[ends[1]] ^ (torch.rand(50, generator=rng) < wrong)
        # In any number of calls.
        parts = [(*ends[:, rows], is_turned[rows]) for rows in (slice(20), slice(20, 50))]
        found = components_of(count, *parts)
        with definitions():
            expected = components_of(count, *parts)
        assert torch.equal(found[0], expected[0])
        assert torch.equal(found[1], expected[1])
