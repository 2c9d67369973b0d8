"""Neighbors of blocks and the boxes they are found by, against all distances."""

import itertools

import numpy as np
import pytest
import torch

from torchrg.neighbors.blocks import farthest_neighbor, find_boxes, near_boxes, search_block
from torchrg.neighbors.knn import search_rows
from torchrg.neighbors.order import finite_rows


def lattice(rng):
    return np.stack(np.mgrid[:20, :20, :1], axis=-1).reshape(-1, 3) * 0.1


def doubled(rng):
    places = rng.uniform(0, 1, (150, 3))
    return np.concatenate([places, places[:80], np.repeat(places[:2], 70, axis=0)])


def cluster_and_outliers(rng):
    cluster = 0.01 * rng.uniform(0, 1, (300, 3)) + 0.5
    return np.concatenate([rng.uniform(0, 1, (60, 3)), cluster, [[500.0, 0, 0], [-900, 3, 4]]])


def equal(rng):
    return np.ones((90, 3))


CLOUDS = (lattice, doubled, cluster_and_outliers, equal)


def in_order(make):
    """A cloud in canonical order."""
    points = torch.from_numpy(make(np.random.default_rng(0)).astype(np.float32))
    return points[finite_rows(points)].numpy()


def nearest(points, k):
    """The first k rows of all points by (not itself, distance, row)."""
    away = points[:, None].astype(np.float64) - points
    distances = np.sqrt(away[..., 0] ** 2 + away[..., 1] ** 2 + away[..., 2] ** 2)
    np.fill_diagonal(distances, -1.0)
    return np.argsort(distances, axis=1, kind="stable")[:, :k]


def blocks_of(boxes, size):
    """Ranges of about so many rows that end where boxes do."""
    ends = boxes.starts[np.searchsorted(boxes.starts, np.arange(0, boxes.starts[-1], size))]
    bounds = np.unique(np.append(ends, boxes.starts[-1])).tolist()
    return [slice(*rows) for rows in itertools.pairwise(bounds)]


@pytest.mark.parametrize("make", CLOUDS)
@pytest.mark.parametrize(("size", "most"), [(5, None), (60, None), (100, 130), (100, 1)])
def test_neighbors_of_blocks_are_the_nearest_of_all(make, size, most):
    points = in_order(make)
    boxes = find_boxes(points, 8)
    for k in (1, 12):
        found = np.empty((len(points), k), dtype=np.int32)
        for block in blocks_of(boxes, size):
            search_block(points, boxes, block, search_rows, found, most)
        np.testing.assert_array_equal(found, nearest(points, k))


@pytest.mark.parametrize("make", CLOUDS)
def test_boxes_hold_few_points_each_and_all_together(make):
    points = in_order(make)
    boxes = find_boxes(points, 8)
    assert boxes.starts[0] == 0
    assert boxes.starts[-1] == len(points)
    for box, (start, stop) in enumerate(itertools.pairwise(boxes.starts)):
        inside = points[start:stop]
        assert len(inside) <= 8 or (inside == inside[0]).all()
        np.testing.assert_array_equal(boxes.low[box], inside.min(axis=0))
        np.testing.assert_array_equal(boxes.high[box], inside.max(axis=0))


def test_near_boxes_are_those_with_a_corner_within_reach():
    points = in_order(cluster_and_outliers)
    boxes = find_boxes(points, 8)
    chosen, reach = np.arange(0, len(boxes.low), 9), np.random.default_rng(1).uniform(0, 0.4, 999)
    gap = np.maximum(
        boxes.low - boxes.high[chosen][:, None], boxes.low[chosen][:, None] - boxes.high
    ).clip(min=0)
    expected = np.linalg.norm(gap, axis=2) <= reach[: len(chosen), None]
    near = near_boxes(boxes, chosen, reach[: len(chosen)])
    np.testing.assert_array_equal(near, expected.any(axis=0))


def test_the_bound_of_a_box_holds_for_all_its_points():
    points = in_order(cluster_and_outliers)
    boxes = find_boxes(points, 8)
    last = points[nearest(points, 12)[:, -1]].astype(np.float64)
    distances = np.linalg.norm(last - points, axis=1)
    for box, (start, stop) in enumerate(itertools.pairwise(boxes.starts)):
        assert distances[start:stop].max() <= farthest_neighbor(boxes, box, 12)
