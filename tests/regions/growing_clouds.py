"""Small clouds that try region growing, and the settings without what consensus adds."""

import dataclasses

import numpy as np
import torch

from torchrg.config import load_config
from torchrg.linalg import covariance, eigh3
from torchrg.neighbors import search_knn
from torchrg.neighbors.knn import gather_patches
from torchrg.neighbors.order import finite_rows


def papers_growing(**changes):
    """Return the growth of the preset paper, with some settings changed."""
    return dataclasses.replace(load_config("paper").growing, **changes)


def room(rng, n, noise=0.0):
    """Floor and two walls that meet in a corner."""
    points = rng.uniform(0, 1, (n, 3))
    points[np.arange(n), rng.integers(0, 3, n)] = 0
    return points + noise * rng.normal(size=(n, 3))


def lattice(rng, n, step=0.1):
    """An L of lattice points: everything is tied with everything."""
    side = int((n / 2) ** 0.5)
    u, v = (c.ravel() * step for c in np.mgrid[:side, :side])
    return np.concatenate(
        [np.stack([u, v, 0 * u], 1), np.stack([0 * u[side:], v[side:], u[side:]], 1)]
    )


def quantized(rng, n):
    """A noisy room with coordinates rounded to a coarse step, duplicates included."""
    return np.round(room(rng, n, 0.02) / 0.05) * 0.05


def doubled(rng, n):
    """Every point twice, a few of them many times."""
    points = room(rng, n // 2, 0.01)
    return np.concatenate([points, points[: n // 3], points[:3], points[:3], points[:3]])


def blob(rng, n):
    """No surface at all."""
    return rng.normal(size=(n, 3))


def sphere(rng, n):
    points = rng.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def plates(rng, n):
    """Two parallel plates closer than the spacing of their points."""
    points = rng.uniform(0, 1, (n, 3))
    points[:, 2] = 0.03 * rng.integers(0, 2, n)
    return points


def graded(rng, n):
    """A plane whose density falls off sharply: neighbors are far from mutual."""
    points = rng.uniform(0, 1, (n, 3)) ** 4
    points[:, 2] = 0.01 * rng.normal(size=n) * points[:, 0]
    return points


def line(rng, n):
    """Collinear points with a few off the line."""
    points = np.zeros((n, 3))
    points[:, 0] = rng.uniform(0, 1, n)
    points[: n // 5, 1:] = 0.1 * rng.normal(size=(n // 5, 2))
    return points


KINDS = {
    "exact room": lambda rng: room(rng, 130),
    "room": lambda rng: room(rng, 130, 0.005),
    "noisy room": lambda rng: room(rng, 110, 0.03),
    "lattice": lambda rng: lattice(rng, 128),
    "quantized": lambda rng: quantized(rng, 110),
    "doubled": lambda rng: doubled(rng, 90),
    "blob": lambda rng: blob(rng, 90),
    "sphere": lambda rng: sphere(rng, 130),
    "plates": lambda rng: plates(rng, 130),
    "graded": lambda rng: graded(rng, 130),
    "line": lambda rng: line(rng, 100),
}


def prepare(coordinates, k, *, dtype=torch.float64, ties=0):
    """Return points in canonical order with PCA normals, curvature and neighbors.

    With ``ties``, curvatures are rounded up to as many different values.
    """
    points = torch.as_tensor(np.asarray(coordinates), dtype=dtype)
    points = points[finite_rows(points)]
    neighbors = search_knn(points, k, canonical=True)
    values, vectors = eigh3(covariance(gather_patches(points, neighbors.indices))[1])
    total = values.sum(dim=1)
    curvature = torch.where(total > 0, values[:, 0].clamp(min=0) / total, 0)
    if ties:
        curvature = (curvature * ties * 3).ceil() / (ties * 3)
    normals = vectors[:, :, 0]
    return points, normals / normals.norm(dim=1, keepdim=True), curvature, neighbors
