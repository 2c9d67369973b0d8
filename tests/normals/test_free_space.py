"""Free paths from cells with points."""

import math
from itertools import product

import numpy as np
import pytest
import torch

from tests.kernels.clouds import definitions
from tests.normals.test_orient import box_room, shuffled_signs
from torchrg.neighbors import search_knn
from torchrg.normals import orient_normals
from torchrg.normals.free_space import _free_gaps, _free_paths, cell_width, vote_free_side


def walked_path(occupied, cell, steps):
    """Walk over empty cells to the next one with points or out of the grid."""
    at, count = np.array(cell) + steps, 0
    while ((at >= 0) & (at < occupied.shape)).all():
        if occupied[tuple(at)]:
            return count, 1.0
        at, count = at + steps, count + 1
    return count, 0.5


def test_free_paths_are_those_of_a_walk_through_a_dense_grid():
    rng = np.random.default_rng(2)
    occupied = rng.random((7, 5, 9)) < 0.15
    at = np.stack(np.nonzero(occupied))
    at = (at - at.min(axis=1, keepdims=True)).astype(np.int32)
    occupied = np.zeros(at.max(axis=1) + 1, dtype=bool)
    occupied[tuple(at)] = True
    for steps in product((-1, 0, 1), repeat=3):
        if steps <= (0, 0, 0):
            continue
        stride = math.sqrt(sum(map(abs, steps)))
        some = np.arange(at.shape[1])
        for found, sign in zip(_free_paths(at, some, steps, stride), (1, -1), strict=True):
            for cell, worth in zip(at.T, found, strict=True):
                count, weight = walked_path(occupied, cell, sign * np.array(steps))
                expected = weight * count * stride / (count * stride + 8)
                assert worth == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("sides", [(7, 5, 9), (300, 300, 40), (2**19, 2**19, 2**19)])
def test_kernel_of_free_gaps_equals_the_definition(sides):
    rng = np.random.default_rng(3)
    cells = np.unique(np.stack([rng.integers(0, side, 5000) for side in sides]), axis=1)
    cells = (cells - cells.min(axis=1, keepdims=True)).astype(np.int32)
    for steps in product((-1, 0, 1), repeat=3):
        if steps > (0, 0, 0):
            found = _free_gaps(cells, steps)
            with definitions():
                expected = _free_gaps(cells, steps)
            for values, others in zip(found, expected, strict=True):
                assert np.array_equal(values, others)


@pytest.fixture(scope="module")
def spoiled():
    """Two rooms whose every tenth normal is up to 45 degrees off; the points and the truth."""
    rng = torch.Generator().manual_seed(3)
    points, inwards = box_room((4.0, 3.0, 2.5), (0.0, 0.0, 0.0), rng, count=1500)
    across = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=rng), dim=1)
    across -= (across * inwards).sum(dim=1, keepdim=True) * inwards
    normals = inwards.clone()
    normals[::10] += torch.nn.functional.normalize(across, dim=1)[::10]
    return points, torch.nn.functional.normalize(normals, dim=1), inwards


def test_single_wrong_normals_take_the_side_of_those_around_them(spoiled):
    points, normals, inwards = spoiled
    oriented = orient_normals(points, shuffled_signs(normals))
    right = (oriented * inwards).sum(dim=1) > 0
    assert right[::10].double().mean() > 0.995
    # On their own they would be right less often.
    near, rows = search_knn(points, 20).indices, torch.arange(len(points))
    alone = vote_free_side(points, normals, near, rows, cell_width(points, near)) > 0
    assert alone[::10].double().mean() < right[::10].double().mean()


def test_cells_along_an_axis_are_numbered_by_nineteen_bits(rng):
    points = torch.rand(300, 3, generator=rng, dtype=torch.float64)
    near = cell_width(points, search_knn(points, 20).indices)
    assert 0.1 < near < 0.5
    points[0, 1] = 1e9
    wide = cell_width(points, search_knn(points, 20).indices)
    assert wide == pytest.approx(1e9 / 2**18)
