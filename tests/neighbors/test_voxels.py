"""Voxels against a loop over points."""

from itertools import permutations

import numpy as np
import pytest
import torch

from torchrg.neighbors import sample_voxels, voxels


def voxels_by_loop(points, size):
    """The point nearest to the middle of each cell, and the cell of each point."""
    low = points.min(axis=0)
    nearest, cell_of = {}, []
    for row, point in enumerate(points):
        scaled = (point - low) / size
        cell = tuple(np.floor(scaled).astype(int))
        distance = ((scaled - np.floor(scaled) - 0.5) ** 2).sum()
        cell_of.append(cell)
        if cell not in nearest or distance < nearest[cell][0]:
            nearest[cell] = (distance, row)
    rows = sorted(row for _, row in nearest.values())
    place = {cell: rows.index(row) for cell, (_, row) in nearest.items()}
    return rows, [place[cell] for cell in cell_of]


def test_voxels_are_those_of_a_loop_over_points(rng):
    points = torch.rand(400, 3, generator=rng, dtype=torch.float64) * 3 - 1e6
    rows, inverse = sample_voxels(points, 0.5)
    expected_rows, expected_inverse = voxels_by_loop(points.numpy(), 0.5)
    assert rows.tolist() == expected_rows
    assert inverse.tolist() == expected_inverse


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [0.05, 0.5])
def test_voxels_found_in_slabs_are_those_of_the_whole_cloud(rng, monkeypatch, kind, size):
    points = (torch.rand(3000, 3, generator=rng) * torch.tensor([1, 4, 2])).to(kind)
    points[::5] = (points[::5] * 4).round() / 4  # Duplicates, and points at equal distances.
    points[::7], points[3::50, 1] = torch.nan, torch.inf
    whole, given = sample_voxels(points, size), points.clone()
    for num_points in (1000, 7, 1):
        monkeypatch.setattr(voxels, "_POINTS_AT_ONCE", num_points)
        parts = sample_voxels(points, size)
        assert torch.equal(parts.rows, whole.rows)
        assert torch.equal(parts.inverse, whole.inverse)
    assert torch.equal(points.nan_to_num(), given.nan_to_num())


def test_more_cells_than_whole_numbers_count_are_told_apart():
    corner = 2.0**30 - 1
    points = torch.tensor([[0.0, 0, 0], [16, 0, 0], [corner] * 3], dtype=torch.float64)
    assert sample_voxels(points, 1.0).inverse.tolist() == [0, 1, 2]


def test_equally_near_points_are_chosen_by_coordinates_in_any_order():
    # The cell of width 1 begins at the first point; all others are 0.25 from its middle.
    near = [[0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [0.5, 0.25, 0.5], [0.5, 0.5, 0.75]]
    for others in permutations(near):
        points = torch.tensor([[0.0, 0, 0], *others])
        assert points[sample_voxels(points, 1.0).rows].tolist() == [[0.25, 0.5, 0.5]]
