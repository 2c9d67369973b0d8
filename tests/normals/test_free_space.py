"""Sides with more free space, in rooms whose normals are partly wrong."""

from itertools import product

import numpy as np
import pytest
import torch

from tests.kernels.clouds import definitions
from tests.normals.test_orient import box_room, shuffled_signs
from torchrg.neighbors import canonical_order, search_knn
from torchrg.normals import orient_normals
from torchrg.normals.free_space import _free_gaps, cell_width, vote_free_side


@pytest.mark.parametrize("sides", [(7, 5, 9), (300, 300, 40), (2**19, 2**19, 2**19)])
def test_kernel_of_free_gaps_equals_the_definition(sides):
    rng = np.random.default_rng(3)
    cells = np.unique(np.stack([rng.integers(0, side, 5000) for side in sides]), axis=1)
    cells = torch.from_numpy(cells - cells.min(axis=1, keepdims=True)).int()
    for steps in product((-1, 0, 1), repeat=3):
        if steps > (0, 0, 0):
            found = _free_gaps(cells, steps)
            with definitions():
                expected = _free_gaps(cells, steps)
            for values, others in zip(found, expected, strict=True):
                assert torch.equal(values, others)


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


def literal_vote(cells, cell, normal):
    """Step from a cell in all 26 directions until the next occupied cell or out of the box."""
    occupied = set(map(tuple, cells.tolist()))
    sides = cells.amax(dim=0) + 1
    total = 0.0
    for steps in product((-1, 0, 1), repeat=3):
        direction = torch.tensor(steps)
        if not direction.any():
            continue
        stride = float(direction.double().norm())
        cosine = float(normal.double() @ direction.double()) / stride
        position, free = cell + direction, 0
        while is_inside(position, sides) and tuple(position.tolist()) not in occupied:
            position, free = position + direction, free + 1
        weight = 1.0 if is_inside(position, sides) else 0.5
        total += weight * cosine * abs(cosine) * stride * free / (stride * free + 8)
    return total


def is_inside(position, sides):
    return bool(((position >= 0) & (position < sides)).all())


@pytest.mark.parametrize("seed", range(4))
def test_votes_are_those_of_literal_steps(seed):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(80, 3, generator=generator) * torch.tensor([3.0, 2.0, 1.0])
    points = points[canonical_order(points)]
    normals = torch.nn.functional.normalize(torch.randn(80, 3, generator=generator), dim=1)
    rows, near, width = torch.arange(0, 80, 3), torch.arange(80, dtype=torch.int32)[:, None], 0.1
    votes = vote_free_side(points, normals, near, rows, width)
    cells = ((points - points.amin(dim=0)) / width).long()
    expected = torch.tensor([literal_vote(cells, cells[row], normals[row]) for row in rows])
    torch.testing.assert_close(votes, expected, atol=1e-5, rtol=1e-5)
    assert float(expected.abs().min()) > 1e-4


@pytest.mark.parametrize("sign", [1, -1])
def test_a_plate_ends_paths_between_its_faces(sign):
    """Half a cell apart, both faces are in the same cells."""
    grid = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0))
    faces = [torch.cat([grid, torch.full((64, 1), height)], dim=1) for height in (0.1, 0.6)]
    roof = torch.tensor([[4.0, 4.0, 9.0], [4.0, 4.0, -9.0]])
    points = torch.cat([*faces, roof])
    normals = torch.tensor([0.0, 0, sign]).expand(130, 3).contiguous()
    near = torch.stack([torch.arange(130), (torch.arange(130) + 64) % 128], dim=1).int()
    rows = torch.tensor([27, 91])
    lower, upper = vote_free_side(points, normals, near, rows, 1.0).tolist()
    assert sign * lower < -0.4
    assert sign * upper > 0.4
