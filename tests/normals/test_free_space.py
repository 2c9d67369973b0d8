"""Sides with more free space, in rooms whose normals are partly wrong."""

import pytest
import torch

from tests.normals.test_orient import box_room, shuffled_signs
from torchrg.neighbors import search_knn
from torchrg.normals import orient_normals
from torchrg.normals.free_space import cell_width, vote_free_side


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
