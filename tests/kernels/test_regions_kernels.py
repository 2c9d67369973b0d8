"""Neighbors and growth by kernels are those of the definitions to the bit."""

import dataclasses

import pytest
import torch

from tests.kernels.clouds import both, clouds, definitions, growing_cloud, lists, needs_library
from torchrg.config import load_config
from torchrg.neighbors import canonical_order, search_knn
from torchrg.regions.adjacency import KnnAdjacency, find_adjacency, find_region_pairs
from torchrg.regions.growth import grow
from torchrg.regions.shared_neighbors import SharedNeighbors
from torchrg.scenes import make_room
from torchrg.structures import Sampling

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")

CLOUDS = clouds()
ROOM = make_room(num_points=9000, noise=0.003, seed=4).points
MANY = {
    "room": ROOM,
    "tiny": ROOM * 1e-18,
    "huge": ROOM * 1e10,
    "far": ROOM.double() + 5e6,
    "grid": torch.cartesian_prod(torch.arange(40.0), torch.arange(40.0), torch.arange(4.0)),
    "doubled": torch.cat([ROOM[:4000], ROOM[:3000], ROOM[:2000]]),
    "outliers": torch.cat([ROOM, 1e5 * torch.eye(3)]),
    "line": torch.linspace(0, 1, 5000)[:, None] * torch.tensor([1.0, 0, 0]),
}


@pytest.mark.parametrize("k", [1, 2, 30, 120])
@pytest.mark.parametrize("name", MANY)
def test_neighbors_are_those_of_the_definition(name, k):
    found = search_knn(MANY[name], k).indices
    with definitions():
        assert torch.equal(found, search_knn(MANY[name], k).indices)


def test_neighbors_of_a_batch_and_of_points_in_order_are_those_of_the_definition():
    batch, ends = torch.cat([ROOM, ROOM[:3000] + 1]), torch.tensor([9000, 12000])
    ordered = ROOM[canonical_order(ROOM)]
    found = search_knn(batch, 20, offset=ends), search_knn(ordered, 20, canonical=True)
    with definitions():
        expected = search_knn(batch, 20, offset=ends), search_knn(ordered, 20, canonical=True)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one.indices, other.indices)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("k", [1, 9, 50, 64])
@pytest.mark.parametrize("name", CLOUDS)
def test_shared_neighbors_are_those_of_the_definition(name, k, masked):
    near = lists(CLOUDS[name], k, masked)
    num_points, width = near.indices.shape
    draws = torch.rand(num_points, width, generator=torch.Generator().manual_seed(2))
    asked = near.mask() & (draws < 0.8)
    some = slice(100, 250)
    for least, rows in ((1, some), (width // 3, slice(0, num_points)), (width, some)):
        shared = SharedNeighbors(near, least)
        found = shared.connected(rows, asked[rows])
        with definitions():
            assert torch.equal(found, shared.connected(rows, asked[rows]))


@pytest.mark.parametrize("k", [9, 50, 70])
@pytest.mark.parametrize("preset", ["classic", "paper", "consensus"])
@pytest.mark.parametrize("name", ["room", "grid", "doubled"])
def test_regions_are_those_of_the_definition(name, preset, k):
    config = load_config(preset).with_sampling(Sampling()).growing
    late = {"connectivity": 0.3, "connectivity_scope": "seed"}
    by_region = {
        "curvature_scope": "neighborhood",
        "connectivity": 0.2,
        "connectivity_scope": "region",
    }
    for changes in ({}, {"min_size": 5}, {"seed_rule": "increment"}, late, by_region):
        settings = dataclasses.replace(config, **changes)
        cloud = growing_cloud(CLOUDS[name], k, masked=k == 9, reach=3.0)
        found = grow(cloud, settings, 700)
        with definitions():
            expected = grow(cloud, settings, 700)
        # Which of their points a region too small to count begins with does not matter.
        counts = torch.bincount(expected + 1, minlength=len(expected) + 1)[1:]
        large = (expected >= 0) & (counts[expected] >= settings.min_size)
        assert torch.equal(found[large], expected[large])
        assert torch.equal(found.cpu() >= 0, expected >= 0)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("slabs_per_meter", [3, 300])
def test_adjacency_is_that_of_the_definition(masked, slabs_per_meter):
    near = lists(ROOM, 20, masked)
    # Most rows are inside thick slabs; thin ones have more possible pairs than there are points.
    labels = (ROOM[:, 0] - ROOM[:, 0].min()).mul(slabs_per_meter).long() - 2
    count = int(labels.max()) + 1
    generator = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    curved = torch.arange(count) % 5 == 0
    arguments = ROOM, labels, near, normal, torch.full((count,), 0.01)
    for found, expected in (
        both(find_region_pairs, labels, near),
        both(KnnAdjacency(near).contacts, labels),
        both(find_adjacency, *arguments, curved=curved),
    ):
        assert len(found[0]) > 5
        for one, other in zip(found, expected, strict=True):
            assert torch.equal(one, other)
    assert torch.equal(*both(KnnAdjacency(near).boundary, labels))
