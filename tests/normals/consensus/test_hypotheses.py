"""Planes that meet are found, and the point is on the right one."""

import pytest
import torch

from torchrg.linalg import unsigned_angle_deg
from torchrg.linalg.moments import unbind_columns
from torchrg.normals.consensus.hypotheses import (
    fit_corners,
    fit_wedges,
    split_by_votes,
    vote_planes,
)


def faces(normals, rng, noise, first, num=40):
    """Sample the boundary of an intersection of half-spaces near its tip, face ``first`` ahead."""
    normals = torch.nn.functional.normalize(torch.tensor(normals), dim=1)
    found, owners = [], []
    for face, normal in enumerate(normals):
        points = torch.rand(4000, 3, generator=rng) * 2 - 1
        points = points - (points @ normal)[:, None] * normal
        others = normals[torch.arange(len(normals)) != face]
        inside = ((points @ others.T) < -0.05).all(dim=1)
        found.append(points[inside][:num])
        owners += [face] * len(found[-1])
    ahead = sorted(range(len(owners)), key=lambda row: (owners[row] != first, row))
    points = torch.cat(found)[ahead]
    points = points + noise * torch.randn(points.shape, generator=rng)
    return (points - points[:1])[None], normals[first]


@pytest.mark.parametrize("angle", [(1.0, 0.0), (0.3, 1.0), (-0.5, 1.0)])
@pytest.mark.parametrize("sign", [1, -1])
def test_ridges_and_valleys_blunt_and_sharp_are_explained(angle, sign, rng):
    patch, truth = faces([[0.0, 0, 1], [*angle, 0.2]], rng, 0.005, first=0)
    columns = unbind_columns(patch * sign)
    counted, noise = torch.ones_like(columns[0]), torch.tensor([0.005])
    start = vote_planes(columns, noise, truth[None], counted)
    wedge = fit_wedges(columns, *start, noise)[0]
    assert float(wedge.deviations) < 1.3 * 0.005
    assert float(unsigned_angle_deg(wedge.normals, truth[None])) < 1.5


def test_a_corner_needs_three_planes(rng):
    patch, truth = faces([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], rng, 0.005, first=2)
    columns = unbind_columns(patch)
    counted, noise = torch.ones_like(columns[0]), torch.tensor([0.005])
    start = vote_planes(columns, noise, truth[None], counted)
    wedge = fit_wedges(columns, *start, noise)[0]
    corner = fit_corners(columns, split_by_votes(columns, *start, noise))
    assert float(wedge.deviations) > 2 * 0.005
    assert float(corner.deviations) < 1.3 * 0.005
    assert float(unsigned_angle_deg(corner.normals, truth[None])) < 1.5


def test_a_single_plane_is_no_wedge(rng):
    columns = unbind_columns(torch.rand(1, 50, 3, generator=rng) * torch.tensor([1.0, 1, 0]))
    noise = torch.tensor([0.01])
    up, zero = torch.tensor([[0.0, 0, 1]]), torch.zeros(1)
    assert not fit_wedges(columns, up, zero, noise)[0].deviations.isfinite().any()
