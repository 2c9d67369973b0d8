"""Unsigned directions: merged centers and diameters."""

import torch

from tests.metrics.sphere_clusters import scattered
from torchrg.metrics import score_clusters
from torchrg.metrics.sphere import (
    _diameter_candidates,
    find_centers,
    merge_directions,
    unit_vectors,
)


def test_distinct_directions_merge_parallel_walls():
    rng = torch.Generator().manual_seed(0)
    axes = torch.eye(3)[[0, 1, 2, 0, 1]] * torch.tensor([1, 1, 1, -1, 1])[:, None]
    directions, labels = scattered(rng, [200] * 5, 0.01, axes=axes)
    merged = score_clusters(directions, labels, distinct_directions=True)
    expected = score_clusters(directions, labels % 3)
    assert merged == expected
    assert merged.clusters == 3
    assert merged.dbi < 0.1


def test_distinct_directions_join_centers_up_to_the_angle():
    degrees = torch.deg2rad(torch.tensor([0.0, 5.0, 10.0, 40.0], dtype=torch.float64))
    normals = torch.stack([degrees.cos(), degrees.sin(), 0 * degrees], dim=1)
    clusters = [
        score_clusters(
            normals, torch.arange(4), distinct_directions=True, max_angle_deg=angle
        ).clusters
        for angle in (0.0, 4.9, 5.1, 31.0)
    ]
    assert clusters == [4, 4, 2, 1]


def test_only_the_rim_of_an_arc_can_hold_its_diameter():
    angles = torch.linspace(-0.1, 0.1, 101, dtype=torch.float64)
    arc = torch.stack([angles.sin(), torch.zeros_like(angles), angles.cos()], dim=1)
    assert len(_diameter_candidates(arc, arc[50])) == 2


def test_unit_vectors_by_example():
    unit, exists = unit_vectors(torch.tensor([[0.0, 3, 4], [0, 0, 0], [torch.nan, 0, 0]]))
    assert (unit[0].tolist(), exists.tolist()) == ([0.0, 0.6, 0.8], [True, False, False])


def test_find_centers_by_example():
    directions = torch.tensor([[0.6, 0.0, 0.8], [0.6, 0.0, -0.8]], dtype=torch.float64)
    assert find_centers(directions, torch.tensor([0, 0]))[0].abs().tolist() == [[0.0, 0.0, 1.0]]


def test_merge_directions_by_example():
    axes = torch.eye(3, dtype=torch.float64)
    assert merge_directions(torch.stack([axes[0], axes[1], -axes[0]])).tolist() == [0, 1, 0]
