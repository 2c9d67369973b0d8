"""Votes for the side with more free space."""

from itertools import product

import pytest
import torch

from torchrg.neighbors import canonical_order
from torchrg.normals.free_space import vote_free_side


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
