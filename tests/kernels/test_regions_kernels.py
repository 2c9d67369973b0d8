"""Neighbors and growth by kernels are those of the definitions to the bit."""

import dataclasses
import itertools

import pytest
import torch

from tests.kernels.clouds import both, clouds, definitions, growing_cloud, lists, needs_library
from torchrg.config import load_config
from torchrg.neighbors import canonical_order, search_knn
from torchrg.neighbors.order import sort_integers
from torchrg.regions.adjacency import KnnAdjacency, find_adjacency, find_region_pairs
from torchrg.regions.edges import are_coplanar
from torchrg.regions.growth import grow
from torchrg.scenes import make_room
from torchrg.structures import Sampling

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")

CLOUDS = clouds()
ROOM = make_room(num_points=5000, noise=0.003, seed=4).points
MANY = {
    "room": ROOM,
    "tiny": ROOM * 1e-18,
    "huge": ROOM * 1e10,
    "far": ROOM.double() + 5e6,
    "grid": torch.cartesian_prod(torch.arange(40.0), torch.arange(40.0), torch.arange(4.0)),
    "doubled": torch.cat([ROOM[:2500], ROOM[:1500], ROOM[:1000]]),
    "outliers": torch.cat([ROOM, 1e5 * torch.eye(3)]),
    "line": torch.linspace(0, 1, 5000)[:, None] * torch.tensor([1.0, 0, 0]),
}


@pytest.mark.parametrize("k", [1, 30, 120])
@pytest.mark.parametrize("name", MANY)
def test_neighbors_are_those_of_the_definition(name, k):
    found = search_knn(MANY[name], k).indices
    with definitions():
        assert torch.equal(found, search_knn(MANY[name], k).indices)


def test_neighbors_of_a_batch_and_of_points_in_order_are_those_of_the_definition():
    batch, ends = torch.cat([ROOM, ROOM[:2000] + 1]), torch.tensor([5000, 7000])
    ordered = ROOM[canonical_order(ROOM)]
    found = search_knn(batch, 20, offset=ends), search_knn(ordered, 20, canonical=True)
    with definitions():
        expected = search_knn(batch, 20, offset=ends), search_knn(ordered, 20, canonical=True)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one.indices, other.indices)


@pytest.mark.parametrize("size", [1, 2**20, 2**62])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_sorted_integers_are_those_of_the_definition(size, count):
    keys = torch.randint(-size, size, (count,), generator=torch.Generator().manual_seed(3))
    ends = torch.tensor([2**63 - 1, -(2**63), 0, -1])
    for integers in (keys, torch.cat([keys, ends])):
        found, expected = both(sort_integers, integers)
        assert torch.equal(found[0], expected[0])
        assert torch.equal(found[1], expected[1])


PRESETS = ("classic", "paper", "consensus")


@pytest.mark.parametrize(
    ("name", "k"),
    [*itertools.product(CLOUDS, [9, 64]), ("room", 70), ("grid", 70), ("doubled", 70)],
)
def test_regions_are_those_of_the_definition(name, k):
    preset = PRESETS[(list(CLOUDS).index(name) + k) % 3]
    config = load_config(preset).with_sampling(Sampling()).growing
    by_region = {"curvature_scope": "neighborhood", "connectivity_scope": "region"}
    for changes in (
        {},
        {"min_size": 5},
        {"seed_rule": "increment", "max_distance": 0.3, "max_angle_deg": 90.0},
        {"connectivity": 0.3, "connectivity_scope": "seed"},
        {"connectivity": 0.2, **by_region},
        {"connectivity": 1.0, **by_region},
    ):
        settings = dataclasses.replace(config, **changes)
        cloud = growing_cloud(CLOUDS[name], k, k == 9, reach=3.0, signed_normals=k == 64)
        found = grow(cloud, settings, 700)
        with definitions():
            expected = grow(cloud, settings, 700)
        # Which of their points a region too small to count begins with does not matter.
        counts = torch.bincount(expected + 1, minlength=len(expected) + 1)[1:]
        large = (expected >= 0) & (counts[expected] >= settings.min_size)
        assert torch.equal(found[large], expected[large])
        assert torch.equal(found.cpu() >= 0, expected >= 0)


@pytest.mark.parametrize("k", [1, 9, 50])
@pytest.mark.parametrize("name", CLOUDS)
def test_coplanar_neighbors_are_those_of_the_definition(name, k):
    cloud, rows = growing_cloud(CLOUDS[name], k, False), slice(3, 250)
    mask = torch.rand(247, k, generator=torch.Generator().manual_seed(2)) < 0.1
    cloud.points[90] *= 1e30  # Its differences are not finite.
    for floor in (0.0, 0.05):
        near = cloud.neighbors.select(rows)
        found, expected = both(are_coplanar, cloud, near, mask, None, floor)
        assert torch.equal(found, expected)
        assert not found[~mask].any()


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
