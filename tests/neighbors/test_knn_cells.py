"""Neighbors by cells against all distances, on clouds that are easy and hard for cells."""

from functools import lru_cache

import numpy as np
import pytest
import torch

from tests.kernels.clouds import needs_library
from torchrg.neighbors import search_knn
from torchrg.neighbors.knn import build_grids, prepare_search, search_grids
from torchrg.scenes import make_room

SIZE = 1000


def _surface(rng):
    return np.c_[rng.random((SIZE, 2)), 0.001 * rng.standard_normal(SIZE)]


def _falloff(rng):
    radius = rng.random(SIZE) ** 3 + 1e-3
    turn = 2 * np.pi * rng.random(SIZE)
    return np.c_[radius * np.cos(turn), radius * np.sin(turn), 0 * radius]


def _far_apart(rng):
    cloud = _surface(rng)
    cloud[::2] += 1e9
    return cloud


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Cells are used for clouds as small as these, and a tree for what they leave."""
    monkeypatch.setattr("torchrg.neighbors.knn._MIN_FOR_CELLS", 400)


CLOUDS = {
    "surface": _surface,
    "room": lambda rng: make_room(SIZE, 0.003, 3).points.double().numpy(),
    "volume": lambda rng: rng.random((SIZE, 3)),
    "falloff": _falloff,
    "exact grid": lambda rng: np.argwhere(np.ones((32, 32, 1))) * 0.25,
    "grid with rounding": lambda rng: (
        np.argwhere(np.ones((32, 32, 1))) + 1e-9 * rng.random((1024, 3))
    ),
    "quantised": lambda rng: np.unique(np.round(_surface(rng), 2), axis=0),
    "line": lambda rng: np.c_[rng.random(SIZE), np.zeros((SIZE, 2))],
    "far from the origin": lambda rng: _surface(rng) + 5e6,
    "in micrometres": lambda rng: _surface(rng) * 1e6,
    "two clouds far apart": _far_apart,
}


@lru_cache
def cloud_of(kind):
    """A cloud, and distances and rows of its 50 nearest by (distance, row) from all distances."""
    points = CLOUDS[kind](np.random.default_rng(0))
    return points, *all_distances(points, 50)


def all_distances(points, k):
    near, rows = [], []
    for point in points:
        x, y, z = (points - point).T
        distances = np.sqrt(x * x + y * y + z * z)
        order = np.argsort(distances, kind="stable")[:k]
        near.append(distances[order])
        rows.append(order)
    return np.array(near), np.array(rows)


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("k", [2, 17, 50])
@pytest.mark.parametrize("kind", CLOUDS)
def test_what_cells_answer_is_what_all_distances_say(kind, k, monkeypatch):
    monkeypatch.setattr("torchrg.neighbors.knn._MIN_FOR_CELLS", 1)
    points, _, rows = cloud_of(kind)
    found = np.empty((len(points), k), dtype=np.int32)
    requested = np.arange(len(points))
    left = search_grids(build_grids(points, requested, k), requested, found, requested)
    answered = np.setdiff1d(requested, left)
    np.testing.assert_array_equal(found[answered], rows[answered, :k])
    if kind == "surface" and k > 2:
        assert len(left) < 0.1 * len(points)


@pytest.mark.parametrize("kind", CLOUDS)
def test_cells_and_tree_together_find_the_neighbors_of_every_point(kind):
    points, near, _ = cloud_of(kind)
    found = search_knn(torch.from_numpy(points), 20).indices.numpy()
    x, y, z = np.moveaxis(points[:, None] - points[found], 2, 0)
    np.testing.assert_array_equal(np.sqrt(x * x + y * y + z * z), near[:, :20])


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
def test_no_tree_is_built_where_cells_resolve_every_point(monkeypatch):
    trees = []
    monkeypatch.setattr("torchrg.neighbors.knn._MIN_FOR_CELLS", 1)
    monkeypatch.setattr("torchrg.neighbors.knn.build_tree", trees.append)
    for kind in ("room", "exact grid", "grid with rounding"):
        points, _, rows = cloud_of(kind)
        search_knn(torch.from_numpy(points), 20)
        some = np.array([7, 3, 7])
        np.testing.assert_array_equal(prepare_search(points, 20)(some), rows[some, :20])
    assert trees == []


def test_duplicates_and_a_limit_of_the_distance_go_through_cells_too():
    points = torch.from_numpy(_surface(np.random.default_rng(2))[:400]).repeat_interleave(3, dim=0)
    found = search_knn(points, 12, max_distance=0.06)
    distances = (points[:, None] - points[found.indices.long()]).norm(dim=-1)
    near, _ = all_distances(points.numpy(), 12)
    assert (found.indices[:, 0] == torch.arange(len(points))).all()
    torch.testing.assert_close(found.valid, torch.from_numpy(near <= 0.06))
    torch.testing.assert_close(
        torch.where(found.valid, distances, 0), torch.from_numpy(np.where(near <= 0.06, near, 0))
    )
