"""Weighted planes through or near a point, with weights that grow stricter step by step."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchrg.normals.frame import principal_frame

HEAVY = 0.25
"""Points of a weight above this make up the plane."""

_LEAST_STEPS = 5


class Surroundings(NamedTuple):
    """Points about a query point each: coordinates and whether they count, shape ``(n, K)``."""

    x: Tensor
    y: Tensor
    z: Tensor
    counted: Tensor

    def take(self, rows: Tensor | slice) -> "Surroundings":
        """Return some of the rows."""
        return Surroundings(*(part[rows] for part in self))

    def about(self, centers: Tensor) -> "Surroundings":
        """Return the points relative to other centers, shape ``(n, 3)``."""
        x, y, z = (
            part - center for part, center in zip(self[:3], centers.T[..., None], strict=True)
        )
        return Surroundings(x, y, z, self.counted)

    def distances(self, normals: Tensor) -> Tensor:
        """Return signed distances to planes through the centers, shape ``(n, K)``."""
        x, y, z = (part * n for part, n in zip(self[:3], normals.T[..., None], strict=True))
        total: Tensor = x + y + z
        return total


class Plane(NamedTuple):
    """Planes near query points, and the scale of the weights.

    Attributes:
        normal: Unit normals, shape ``(n, 3)``.
        center: Points of the planes, relative to the query points, shape ``(n, 3)``.
        mu: Squared distance at which the weight is a quarter, shape ``(n, 1)``.
        weighed_normal: Normals that the last weights were taken with, shape ``(n, 3)``.
        weighed_mu: ``mu`` that the last weights were taken with, shape ``(n, 1)``.
    """

    normal: Tensor
    center: Tensor
    mu: Tensor
    weighed_normal: Tensor
    weighed_mu: Tensor

    def take(self, rows: Tensor | slice) -> "Plane":
        """Return some of the rows."""
        return Plane(*(part[rows] for part in self))


def start_plane(normal: Tensor, mu: Tensor) -> Plane:
    """Return planes through the query points.

    Example:
        >>> start_plane(torch.eye(3)[:1], torch.ones(1, 1)).center
        tensor([[0., 0., 0.]])
    """
    return Plane(normal, torch.zeros_like(normal), mu, normal, mu)


def anneal(
    points: Surroundings, plane: Plane, limit: Tensor, decay: float, *, shift: bool
) -> Plane:
    r"""Reweight and refit planes while ``mu`` shrinks to a limit.

    Each step divides ``mu`` by ``decay``, weighs every point by ``(mu / (mu + r^2))^2`` of its
    distance ``r``, and takes the direction in which the weighted points are flattest about the
    center. With ``shift`` the center first moves along the normal to the weighted mean of the heavy
    points, their weights being those of the step before.

    Args:
        points: Points about each query point.
        plane: Where to start.
        limit: Where ``mu`` ends, shape ``(n, 1)``: the first value at or below it, with ``shift``
            the last one at or above. At least five steps are made.
        decay: Above 1.
        shift: Whether the center moves.

    Returns:
        The planes after their last step. Patches leave the batch when they are done.

    Example:
        >>> xy = torch.tensor([[[1.0, -1, 0, 0]], [[0, 0, 1, -1]]])
        >>> cross = Surroundings(*xy, torch.zeros(1, 4), torch.ones(1, 4))
        >>> start = start_plane(torch.tensor([[0.0, 0.6, 0.8]]), torch.ones(1, 1))
        >>> anneal(cross, start, torch.full((1, 1), 0.1), 1.5, shift=False).normal.abs()
        tensor([[0., 0., 1.]])
    """
    step = _shift_and_refit if shift else _refit
    num_steps = _count_steps(plane.mu.detach(), limit, decay, stay_above=shift)
    order = num_steps.argsort(descending=True, stable=True)
    remaining = num_steps[order].tolist()
    points, plane = points.take(order), plane.take(order)
    active = len(remaining)
    for done in range(remaining[0] if remaining else 0):
        while remaining[active - 1] <= done:
            active -= 1
        part = slice(0, active)
        moved = _run(step, points.take(part), plane.take(part), decay)
        rest = plane.take(slice(active, None))
        plane = Plane(*map(torch.cat, zip(moved, rest, strict=True)))
    return plane.take(order.argsort())


def weigh(distances: Tensor, mu: Tensor, counted: Tensor) -> Tensor:
    """Return Geman-McClure weights.

    Args:
        distances: Distances to planes, shape ``(n, K)``.
        mu: Squared distance at which the weight is a quarter, shape ``(n, 1)``.
        counted: 0 for points that do not count, else 1, shape ``(n, K)``.

    Returns:
        Weights in [0, 1], shape ``(n, K)``.

    Example:
        >>> weigh(torch.tensor([[0.0, 2.0]]), torch.full((1, 1), 4.0), torch.ones(1, 2))
        tensor([[1.0000, 0.2500]])
    """
    weights = mu / (mu + distances * distances)
    return weights * weights * counted


def _refit(points: Surroundings, plane: Plane, decay: float) -> Plane:
    """Return the next plane through the same center."""
    return _flattest(points.about(plane.center), plane, decay)


def _shift_and_refit(points: Surroundings, plane: Plane, decay: float) -> Plane:
    """Return the next plane, through the mean height of the heavy points."""
    points = points.about(plane.center)
    weights = weigh(points.distances(plane.weighed_normal), plane.weighed_mu, points.counted)
    heavy = weights * (weights > HEAVY)
    total = heavy.sum(dim=-1, keepdim=True)
    heights = (heavy * points.distances(plane.normal)).sum(dim=-1, keepdim=True)
    shift = plane.normal * (heights / torch.where(total > 0, total, 1.0))
    return _flattest(points.about(shift), plane._replace(center=plane.center + shift), decay)


def _flattest(points: Surroundings, plane: Plane, decay: float) -> Plane:
    """Return the next plane, with the normal along which the weighted points are flattest."""
    mu = plane.mu / decay
    weights = weigh(points.distances(plane.normal), mu, points.counted)
    x, y, z, _ = points
    wx, wy = weights * x, weights * y
    xx, xy, xz = ((wx * part).sum(dim=-1) for part in (x, y, z))
    yy, yz, zz = (wy * y).sum(dim=-1), (wy * z).sum(dim=-1), (weights * z * z).sum(dim=-1)
    rows = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
    matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return Plane(principal_frame(matrix).normals, plane.center, mu, plane.normal, mu)


def _run(
    step: Callable[[Surroundings, Plane, float], Plane],
    points: Surroundings,
    plane: Plane,
    decay: float,
) -> Plane:
    """Run a step; if gradients are wanted, keep its input only and run it again for them."""
    if not (torch.is_grad_enabled() and plane.normal.requires_grad):
        return step(points, plane, decay)
    result: Plane = checkpoint(step, points, plane, decay, use_reentrant=False)
    return result


def _count_steps(mu: Tensor, limit: Tensor, decay: float, *, stay_above: bool) -> Tensor:
    """Return the number of divisions that bring ``mu`` to the limit, shape ``(n,)``.

    Counted by dividing, not by a logarithm, whose last bit depends on where an element stands.
    """
    num_steps = torch.zeros(len(mu), dtype=torch.int64, device=mu.device)
    while True:
        following = mu / decay
        goes_on = following >= limit if stay_above else mu > limit
        if not bool(goes_on.any()):
            return num_steps.clamp(min=_LEAST_STEPS)
        num_steps += goes_on.squeeze(-1)
        mu = torch.where(goes_on, following, mu)
