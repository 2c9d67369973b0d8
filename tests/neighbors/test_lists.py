"""Lists of neighbors that users pass are checked, once and in words, by every function."""

import contextlib

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tests.kernels.clouds import definitions
from torchrg import estimate_normals, grow_regions
from torchrg.config import preset_names
from torchrg.errors import ShapeError
from torchrg.normals import orient_normals
from torchrg.regions import summarize_planes
from torchrg.structures import Neighbors

COUNT = 300
K = 20


@pytest.fixture(scope="module")
def points(room):
    return room(COUNT).points


@pytest.fixture(scope="module")
def without_self(points):
    """The neighbors of scipy, without the column of the point itself."""
    return torch.from_numpy(cKDTree(points.numpy()).query(points.numpy(), K)[1][:, 1:])


def grow(points, neighbors, preset="consensus"):
    normals, rest = torch.eye(3)[[2]].expand(len(points), 3), torch.zeros(len(points))
    return grow_regions(points, normals, rest, neighbors, preset, residual_rms=rest)


FUNCTIONS = {
    "grow_regions": grow,
    "estimate_normals": lambda points, neighbors: estimate_normals(points, neighbors=neighbors),
    "orient_normals": lambda points, neighbors: orient_normals(
        points, torch.ones_like(points), neighbors=neighbors
    ),
    "summarize_planes": lambda points, neighbors: summarize_planes(
        points, torch.ones_like(points), torch.zeros(len(points)).long(), neighbors=neighbors
    ),
}
every_function = pytest.mark.parametrize("name", FUNCTIONS)


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("has_kernels", [True, False])
def test_every_growth_refuses_lists_without_the_point_itself(
    points, without_self, preset, has_kernels
):
    repair = "Put the row of the point first, as search_knn does"
    around = contextlib.nullcontext() if has_kernels else definitions()
    with around, pytest.raises(ShapeError, match=repair):
        grow(points, Neighbors(without_self), preset)
    own = torch.cat([torch.arange(COUNT)[:, None], without_self], dim=1)
    assert len(grow(points, Neighbors(own), preset)) == COUNT


@every_function
def test_lists_without_the_point_itself_are_refused_by_name(points, without_self, name):
    words = f"^{name}: expected each point as its own first neighbor, got other points in 300"
    with pytest.raises(ShapeError, match=words):
        FUNCTIONS[name](points, Neighbors(without_self))


@every_function
@pytest.mark.parametrize("row", [-1, COUNT, 2**31 - 1])
def test_rows_that_are_not_there_are_refused_by_name(points, without_self, name, row):
    lists = torch.cat([torch.arange(COUNT)[:, None], without_self], dim=1)
    lists[7, 3] = row
    with pytest.raises(ShapeError, match=f"^{name}: expected neighbors to be rows of 300 points"):
        FUNCTIONS[name](points, Neighbors(lists))


@every_function
@pytest.mark.parametrize(
    ("lists", "words"),
    [
        (torch.zeros(COUNT, 0, dtype=torch.int32), "expected at least 1 neighbor per point, got 0"),
        (torch.zeros(COUNT, 3), "expected neighbors of int32 or int64, got torch.float32"),
        (torch.zeros(9, 3, dtype=torch.int32), r"expected neighbors of shape \(N, K\) with N=300"),
        (np.zeros((COUNT, 3), np.int32), r"Pass Neighbors\(torch.as_tensor\(rows\)\)"),
    ],
    ids=["empty", "float", "few", "numpy"],
)
def test_lists_of_another_kind_are_refused_by_name(points, name, lists, words):
    with pytest.raises(ShapeError, match=f"^{name}: .*{words}"):
        FUNCTIONS[name](points, Neighbors(lists))


@every_function
def test_a_bare_tensor_is_no_neighbors(points, without_self, name):
    with pytest.raises(ShapeError, match=r"got Tensor. Pass Neighbors\(torch.as_tensor\(rows\)\)"):
        FUNCTIONS[name](points, without_self)
