"""Two planes that meet: what an edge looks like from one of its points."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.normals.columns import Columns, fit_planes, residuals

_NUM_ROUNDS = 4
_FIRST_GAP = 2.0
_LEAST_POINTS = 5
_NUM_PARAMETERS = 6


class Wedge(NamedTuple):
    """The plane of each point, one of the two of its neighbourhood.

    Attributes:
        normals: Unit normals, shape ``(n, 3)``.
        offsets: Of the planes ``normal . q = offset`` about the point, shape ``(n,)``.
        deviations: Standard deviation of all neighbours from the two planes, shape ``(n,)``;
            infinite where there is no second plane.
    """

    normals: Tensor
    offsets: Tensor
    deviations: Tensor


def fit_wedges(
    columns: Columns, normals: Tensor, offsets: Tensor, noise: Tensor, counted: Tensor
) -> Wedge:
    r"""Fit the surface of the intersection of two half-spaces to each neighbourhood.

    Let ``e_1`` and ``e_2`` be the distances of a point inside the two planes, each towards the side
    where the points of the other plane are. The solid between them has the signed distance
    ``min(e_1, e_2)``: each point belongs to the plane where it is least inside (ridges and valleys,
    sharp or blunt, alike). Planes and sides are fitted in turn, from one plane and the points
    beyond twice the noise on its fuller side. The point itself belongs to a plane by the same rule,
    which, unlike the nearest of two unbounded planes, is right for points that noise has moved out
    of the solid.

    Args:
        columns: Coordinates of the neighbours about each point.
        normals: One plane of each neighbourhood, shape ``(n, 3)``.
        offsets: Its offsets, shape ``(n,)``.
        noise: Standard deviation of the noise, shape ``(n,)``.
        counted: Weights 0 or 1, shape ``(n, K)``.

    Returns:
        The plane of each point, and how well the two explain all points.

    Example:
        >>> from torchrg.normals.columns import split_columns
        >>> x, y = torch.arange(-2.0, 3), torch.arange(0.0, 4)
        >>> floor = torch.cartesian_prod(x, y, torch.zeros(1))
        >>> corner = torch.cat([torch.tensor([[0.0, 1, 0]]), floor, floor[:, [0, 2, 1]]])
        >>> columns = split_columns((corner - corner[:1])[None])
        >>> start, zero, noise = torch.tensor([[0.0, 1, 0]]), torch.zeros(1), torch.tensor([0.1])
        >>> wedge = fit_wedges(columns, start, zero - 1, noise, torch.ones(1, 41))
        >>> wedge.normals.abs(), bool(wedge.deviations < 0.01)
        (tensor([[0., 0., 1.]]), True)
    """
    rests = residuals(columns, normals, offsets)
    gap = _FIRST_GAP * noise[:, None]
    above, below = (rests > gap) * counted, (rests < -gap) * counted
    on_second = torch.where((above.sum(dim=1) >= below.sum(dim=1))[:, None], above, below)
    on_first = counted - on_second
    present = torch.ones_like(noise, dtype=torch.bool)
    inside = [rests, rests]
    planes = [(normals, offsets), (normals, offsets)]
    for _ in range(_NUM_ROUNDS):
        present &= (on_first.sum(dim=1) >= _LEAST_POINTS) & (on_second.sum(dim=1) >= _LEAST_POINTS)
        planes = [fit_planes(columns, on)[:2] for on in (on_first, on_second)]
        inside = [
            _inside(residuals(columns, *plane), other)
            for plane, other in zip(planes, (on_second, on_first), strict=True)
        ]
        on_first = (inside[0] < inside[1]) * counted
        on_second = counted - on_first
    outer = torch.minimum(*inside)
    freedom = (counted.sum(dim=1) - _NUM_PARAMETERS).clamp_(min=1)
    deviations = ((outer * outer * counted).sum(dim=1) / freedom).sqrt_()
    first = inside[0][:, 0] < inside[1][:, 0]
    return Wedge(
        torch.where(first[:, None], planes[0][0], planes[1][0]),
        torch.where(first, planes[0][1], planes[1][1]),
        torch.where(present, deviations, torch.inf),
    )


def _inside(rests: Tensor, other: Tensor) -> Tensor:
    """Return distances from a plane, positive on the side where the other plane's points are."""
    return torch.where(((rests * other).sum(dim=1) >= 0)[:, None], rests, -rests)
