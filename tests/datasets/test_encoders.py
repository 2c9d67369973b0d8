"""Normals of a scan without any are what pretrained encoders expect: unit, and into the room."""

import numpy as np
import pytest

import torchrg
from torchrg.scenes import make_room


def encoder_input(point, grid_size=0.05):
    """Sonata's default transform in our own words: centred, one point a cell, nine features."""
    point = {key: np.asarray(values, np.float32) for key, values in point.items()}
    low, high = point["coord"].min(axis=0), point["coord"].max(axis=0)
    point["coord"] = point["coord"] - [*(low + high)[:2] / 2, low[2]]
    cells = np.floor(point["coord"] / grid_size).astype(np.int64)
    cells -= cells.min(axis=0)
    rows = np.unique(cells, axis=0, return_index=True)[1]
    point = {key: values[rows] for key, values in point.items()}
    point["color"] = point["color"] / 255
    features = np.hstack([point[key] for key in ("coord", "color", "normal")])
    return rows, cells[rows], features.astype(np.float32)


@pytest.fixture(scope="module")
def room():
    return make_room(num_points=20_000, noise=0.003, seed=1)


def test_normals_turned_inside_look_into_the_room(room):
    color = np.random.default_rng(0).integers(0, 256, (20_000, 3)).astype(np.uint8)
    normals = torchrg.estimate_normals(room.points).normals
    normals = torchrg.normals.orient_normals(room.points, normals, towards="interior")
    point = {"coord": room.points.numpy(), "color": color, "normal": normals.numpy()}
    rows, cells, features = encoder_input(point)
    assert features.shape == (len(rows), 9)
    assert features.dtype == np.float32
    assert np.isfinite(features).all()
    assert cells.min() == 0
    assert np.allclose(np.linalg.norm(features[:, 6:], axis=1), 1, atol=1e-4)
    assert np.array_equal(features[:, 3:6], color[rows].astype(np.float32) / 255)
    truth, kinds = room.normals.numpy()[rows], np.array(room.kinds)
    shell = np.isin(kinds[room.labels.numpy()[rows]], ("floor", "ceiling", "wall"))
    shell &= room.labels.numpy()[rows] >= 0
    right = (features[:, 6:] * truth).sum(axis=1) > 0
    assert shell.sum() > 10_000
    assert right[shell].mean() >= 0.99
    assert right.mean() > 0.97
