"""How a cloud samples its surfaces, against loops, and unchanged by what does not change it."""

import math
from functools import cache

import numpy as np
import pytest
import torch

from torchrg import load_config, search_knn
from torchrg.neighbors import canonical_order, distinct_points, measure_sampling, sample_voxels
from torchrg.neighbors.knn import prepare_search
from torchrg.structures import Sampling

K = 50
COUNT = 40_000
"""Points of the made rooms: 50 neighbors are within 15 cm, as in real ones."""
HEIGHT = 2.7
"""Height of the made rooms in meters."""
NOISE = 0.002
"""Noise of the made laser scan in meters."""


def measure(points: np.ndarray, k: int = K) -> Sampling:
    cloud = torch.as_tensor(points, dtype=torch.float32)
    cloud = cloud[canonical_order(cloud)]
    return measure_sampling(cloud, search_knn(cloud, k))


@cache
def walls(seed: int, count: int = COUNT) -> np.ndarray:
    """Six walls of a room of 4 by 5 by 2.7 m, exact, of as many points by their area."""
    rng = np.random.default_rng(seed)
    extent = np.array([4.0, 5.0, HEIGHT])
    areas = np.array([extent.prod() / side for side in extent])
    sides = []
    for axis, area in enumerate(areas):
        for place in (0.0, extent[axis]):
            points = rng.random((round(count * area / areas.sum() / 2), 3)) * extent
            points[:, axis] = place
            sides.append(points)
    return np.concatenate(sides)


def scan(seed: int) -> np.ndarray:
    """Walls with independent noise, as a laser scanner measures them."""
    points = walls(seed)
    return points + np.random.default_rng(seed + 100).normal(0, NOISE, points.shape)


def reconstruction(seed: int) -> np.ndarray:
    """Walls that are bent by waves of a meter, each centimeters high, as reconstructions are."""
    points = walls(seed)
    waves = 0.03 * np.sin(2 * math.pi * (points[:, [1, 2, 0]] + points[:, [2, 0, 1]]))
    return points + waves


CLOUDS = {"scan": scan, "reconstruction": reconstruction}


@pytest.mark.parametrize("kind", CLOUDS)
def test_neighbors_of_the_sample_alone_give_the_same_measures(kind):
    cloud = torch.as_tensor(CLOUDS[kind](0), dtype=torch.float32)
    cloud = distinct_points(cloud).points
    expected = measure_sampling(cloud, search_knn(cloud, K))
    assert measure_sampling(cloud, prepare_search(cloud.numpy(), K)) == expected


@pytest.fixture(params=CLOUDS)
def cloud(request):
    return CLOUDS[request.param](1)


def literal_measures(points: np.ndarray, k: int) -> list[float]:
    """All measures except height, point by point, of all neighbors there are."""
    small, large, exact, radius, first, flatness = [], [], [], [], [], []
    order = np.linspace(0, len(points) - 1, min(600, len(points))).astype(int)
    cloud = torch.as_tensor(points, dtype=torch.float32)
    cloud = cloud[canonical_order(cloud)].double().numpy()
    lists = search_knn(torch.as_tensor(cloud, dtype=torch.float32), k).indices.numpy()

    def deviation(near: np.ndarray) -> float:
        centered = near - near.mean(axis=0)
        return float(np.linalg.svd(centered)[1][-1] / math.sqrt(len(near) - 3))

    for row in order:
        distances = np.linalg.norm(cloud[lists[row]] - cloud[row], axis=1)
        near = cloud[lists[row][np.argsort(distances, kind="stable")]]
        distances.sort()
        wide = np.unique(lists[lists[row][::3]])
        apart = np.linalg.norm(cloud[wide] - cloud[row], axis=1)
        far = cloud[wide[np.argsort(apart, kind="stable")[:100]]]
        small.append(deviation(near[:16]))
        large.append(deviation(far))
        exact.append(deviation(near[:9]) <= 1e-3 * distances[8])
        radius.append(distances[-1])
        first.append(distances[1])
        flatness.append(deviation(near) / distances[-1])
    flat = np.array(flatness) <= np.median(flatness)
    deviation = np.median(np.array(large)[flat])
    whiteness = np.median(np.array(small)[flat]) / deviation
    density = k / (math.pi * np.median(radius) ** 2)
    variation = np.std(first) / np.mean(first)
    return [min(whiteness, 1.0), variation, np.mean(exact), density, deviation]


def test_the_measures_are_those_of_loops(cloud):
    found = measure(cloud)
    whiteness, variation, exactness, density, deviation = literal_measures(cloud, K)
    assert found.whiteness == pytest.approx(whiteness, rel=0.01)
    assert found.variation == pytest.approx(variation, rel=0.01)
    assert found.exactness == pytest.approx(exactness, abs=0.005)
    assert found.density == pytest.approx(density, rel=0.01)
    assert found.deviation == pytest.approx(deviation, rel=0.01)


def test_noise_is_white_and_waves_are_not():
    assert measure(scan(1)).whiteness > 0.9
    assert measure(reconstruction(1)).whiteness < 0.3


@pytest.mark.parametrize(
    ("points", "exactness"), [(walls(1), 0.95), (scan(1), 0.0)], ids=["exact", "scan"]
)
def test_points_on_exact_planes_are_exact(points, exactness):
    assert measure(points).exactness == pytest.approx(exactness, abs=0.1)


def test_density_and_height_are_those_of_the_room():
    found = measure(scan(1))
    area = 2 * (4 * 5 + 4 * HEIGHT + 5 * HEIGHT)
    assert found.density == pytest.approx(COUNT / area, rel=0.1)
    assert found.height == pytest.approx(HEIGHT, rel=0.01)


def test_spacings_of_grids_do_not_vary_and_those_of_random_points_do():
    steps = np.linspace(0, 2, 60)
    grid = np.stack([*np.meshgrid(steps, steps), np.zeros((60, 60))], axis=-1).reshape(-1, 3)
    assert measure(grid).variation < 1e-3
    assert measure(walls(1)).variation == pytest.approx(math.sqrt(4 / math.pi - 1), rel=0.1)


def test_any_order_gives_the_same_measures(cloud):
    shuffled = np.random.default_rng(0).permutation(cloud)
    assert measure(shuffled) == measure(cloud)


@pytest.mark.parametrize("unit", [1000.0, 39.37])
def test_another_unit_scales_height_and_density_alone(cloud, unit):
    found, scaled = measure(cloud), measure(cloud * unit)
    assert scaled[:3] == pytest.approx(found[:3], rel=0.006)
    assert scaled.height == pytest.approx(found.height * unit, rel=0.006)
    assert scaled.density == pytest.approx(found.density / unit**2, rel=0.006)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda points: points + np.array([100.0, -50.0, 20.0]), id="origin"),
        pytest.param(
            lambda points: points @ np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0],
            id="rotation",
        ),
        pytest.param(lambda points: points[points[:, 1] < 3], id="a part of the room"),
        pytest.param(lambda points: points[::2], id="half of the points"),
        pytest.param(
            lambda points: points[sample_voxels(points, 0.03).rows.numpy()], id="voxels of 3 cm"
        ),
    ],
)
@pytest.mark.parametrize("kind", CLOUDS)
def test_the_choice_stays_where_the_surfaces_stay(kind, change):
    def choice(points):
        growing = load_config().with_sampling(measure(points)).growing
        return growing.facet_tolerance

    here, there = choice(CLOUDS[kind](1)), choice(change(CLOUDS[kind](2)))
    assert there is None if here is None else there == pytest.approx(here, rel=0.05)


DEGENERATE = {
    "ten points": np.random.default_rng(0).random((10, 3)),
    "one place": np.ones((500, 3)),
    "one line": np.linspace(0, 1, 500)[:, None] * [1.0, 2.0, 3.0],
    "one plane": np.random.default_rng(0).random((500, 3)) * [1, 1, 0],
    "pairs": np.repeat(np.random.default_rng(0).random((250, 3)), 2, axis=0),
    "two places": np.repeat([[0.0, 0, 0], [1, 1, 1]], 200, axis=0),
    "one point": np.zeros((1, 3)),
    "far": np.random.default_rng(0).random((500, 3)) + 1e6,
    "sphere": (lambda v: v / np.linalg.norm(v, axis=1, keepdims=True))(
        np.random.default_rng(0).normal(size=(2000, 3))
    ),
    "tiny": 1e-12 * np.random.default_rng(0).random((500, 3)),
    "huge": 1e12 * np.random.default_rng(0).random((500, 3)),
}


@pytest.mark.parametrize("points", DEGENERATE.values(), ids=DEGENERATE)
def test_degenerate_clouds_have_measures_and_choices(points):
    cloud = torch.as_tensor(points, dtype=torch.float32)
    cloud = cloud[canonical_order(cloud)]
    found = measure_sampling(cloud, search_knn(cloud, min(K, len(cloud))))
    assert all(math.isfinite(value) for value in found), found
    growing = load_config().with_sampling(found).growing
    assert isinstance(growing.min_size, int)
    assert growing.facet_tolerance is None or growing.facet_tolerance > 0


def test_too_few_points_are_not_measured():
    assert measure(walls(1)[:16], k=16) == Sampling()
