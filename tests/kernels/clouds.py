"""Clouds, and lists of neighbors, on which kernels are compared with their definitions."""

import contextlib
from unittest import mock

import torch

from torchrg import kernels
from torchrg.neighbors import canonical_order, search_knn
from torchrg.normals.pca import fit_points_pca
from torchrg.regions.edges import GrowingInput
from torchrg.regions.growth import to_column_major
from torchrg.scenes import make_room
from torchrg.structures import Neighbors

needs_library = kernels.name_of_library() is not None


@contextlib.contextmanager
def definitions():
    """Let nothing but the definitions run."""
    with mock.patch.object(kernels, "serve", return_value=False):
        yield


def clouds():
    """Points by name: made, exact, collinear, doubled, tiny, huge and far ones."""
    generator = torch.Generator().manual_seed(0)
    room = make_room(num_points=1500, noise=0.003, seed=3).points
    line = torch.zeros(300, 3)
    line[:, 0] = torch.rand(300, generator=generator)
    bent = room[:1000].clone()
    bent[:, 2] = bent[:, :2].square().sum(dim=1) / 10
    return {
        "room": room,
        "grid": torch.cartesian_prod(torch.arange(12.0), torch.arange(12.0), torch.arange(2.0)),
        "line": line,
        "bent": bent,
        "doubled": room[:750].repeat(2, 1),
        "tiny": room[:1000] * 1e-18,
        "huge": room[:1000] * 1e15,
        "far": room[:1000] + 500.0,
    }


def lists(points, k, masked):
    """Neighbors of points, some of them masked out if asked for."""
    indices = search_knn(points, min(k, len(points))).indices
    if not masked:
        return Neighbors(indices)
    counted = torch.rand(indices.shape, generator=torch.Generator().manual_seed(1)) < 0.7
    counted[:, 0] = True
    counted[:4] = torch.arange(indices.shape[1]) < torch.arange(4)[:, None]
    own = torch.arange(len(points), dtype=torch.int32)[:, None]
    return Neighbors(torch.where(counted, indices, own), counted)


def growing_cloud(points, k, masked, reach=None, **settings):
    points = points[canonical_order(points)]
    near = lists(points, k, masked)
    with definitions():
        fit = fit_points_pca(points, near)
    valid = fit.valid.clone()
    valid[::17] = False
    if reach is not None:
        reach = reach * fit.residual_rms
        reach[::5] = torch.inf
    columns = to_column_major(points), to_column_major(fit.normals)
    return GrowingInput(*columns, fit.curvature, near, valid, reach, **settings)


def both(function, *arguments, **settings):
    """Return what a function returns by kernels and by definition."""
    found = function(*arguments, **settings)
    with definitions():
        return found, function(*arguments, **settings)
