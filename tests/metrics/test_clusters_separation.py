"""The closest directions of two clusters against all pairs."""

import math

import pytest
import torch

from tests.metrics.sphere_clusters import scattered
from torchrg.metrics.clusters import closest_between
from torchrg.metrics.sphere import chord_table, chord_to_angle


def closest_of_all_pairs(directions, clusters):
    angles = chord_to_angle(chord_table(directions, directions))
    return float(angles[clusters[:, None] != clusters].min())


@pytest.mark.parametrize("num_clusters", [2, 3, 8, 300])
@pytest.mark.parametrize("spread", [1e-6, 0.02, 0.5, 5.0])
def test_closest_pair_is_that_of_all_pairs(rng, num_clusters, spread):
    sizes = torch.randint(1, 1200 // num_clusters, (num_clusters,), generator=rng).tolist()
    directions, clusters = scattered(rng, sizes, spread)
    expected = closest_of_all_pairs(directions, clusters)
    assert closest_between(directions, clusters) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("max_cells", [0, 5, 40])
@pytest.mark.parametrize("spread", [0.02, 0.5])
def test_both_searches_find_the_same_pair(rng, monkeypatch, max_cells, spread):
    directions, clusters = scattered(rng, [50, 60, 70, 1, 2], spread)
    expected = closest_of_all_pairs(directions, clusters)
    monkeypatch.setattr("torchrg.metrics.clusters._MAX_CELLS", max_cells)
    assert closest_between(directions, clusters) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("max_cells", [0, 4096])
def test_opposite_directions_across_the_equator_are_close(monkeypatch, max_cells):
    monkeypatch.setattr("torchrg.metrics.clusters._MAX_CELLS", max_cells)
    for turn in range(3):
        a = torch.tensor([[math.cos(0.01), 0, math.sin(0.01)], [0, 1, 0]], dtype=torch.float64)
        b = torch.tensor([[-math.cos(0.02), 0, math.sin(0.02)]], dtype=torch.float64)
        rows = torch.cat([a, b]).roll(turn, dims=1)
        for clusters in ([0, 0, 1], [1, 1, 0]):
            angle = closest_between(rows, torch.tensor(clusters))
            assert angle == pytest.approx(0.03, rel=1e-12)


@pytest.mark.parametrize("max_cells", [0, 4096])
def test_repeated_directions_do_not_hide_the_closest_pair(rng, monkeypatch, max_cells):
    monkeypatch.setattr("torchrg.metrics.clusters._MAX_CELLS", max_cells)
    directions, clusters = scattered(rng, [5, 5], 0.01, axes=torch.eye(3)[:2])
    expected = closest_of_all_pairs(directions, clusters)
    repeated = closest_between(directions.repeat(50, 1), clusters.repeat(50))
    assert repeated == pytest.approx(expected, rel=1e-12)


def test_repeated_directions_are_searched_once(rng, monkeypatch):
    searched = []
    monkeypatch.setattr(
        "torchrg.metrics.clusters._closest_chord",
        lambda points, *_: searched.append(len(points)) or 1.0,
    )
    directions, clusters = scattered(rng, [5, 5], 0.01, axes=torch.eye(3)[:2])
    closest_between(directions.repeat(50, 1), clusters.repeat(50))
    assert searched == [10]


def test_a_shared_direction_is_no_distance(rng):
    directions, clusters = scattered(rng, [20, 20], 0.01, axes=torch.eye(3)[:2])
    directions[30] = -directions[3]
    assert closest_between(directions, clusters) == 0


def test_directions_apart_by_rounding_end_the_search():
    z = torch.tensor([[0.6, 0, 0.8]], dtype=torch.float64)
    nudged = torch.nextafter(z, torch.ones_like(z))
    assert closest_between(torch.cat([z, nudged]), torch.tensor([0, 1])) < 1e-15


def test_one_cluster_has_no_other():
    assert closest_between(torch.eye(3).double(), torch.zeros(3).long()) == math.inf


def test_nearly_exact_planes_far_apart_are_settled_without_trees(rng, monkeypatch):
    # In a dense cluster seen from afar all points are about equally near: a tree would look at
    # every pair.
    def refuse(*_arguments):
        raise AssertionError

    monkeypatch.setattr("torchrg.metrics.clusters._closest_by_digits", refuse)
    directions, clusters = scattered(rng, [20_000] * 3, 1e-6, axes=torch.eye(3))
    assert closest_between(directions, clusters) == pytest.approx(math.pi / 2, abs=2e-5)
