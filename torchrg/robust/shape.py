"""Iterated reweighting with the bisquare: location and shape of many patches side by side."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg.robust.bisquare import BREAKDOWN, bisquare_loss, bisquare_weights
from torchrg.robust.lanes import median_points, sum_points, take_lanes
from torchrg.robust.scatter import Ellipsoid, fit_ellipsoid, sq_distances
from torchrg.robust.weights import chi2_quantile

MAX_STEPS = 300
_CHECK_EVERY = 4


class Shape(NamedTuple):
    """A weighted fit of each lane, its scatter scaled to determinant one.

    Attributes:
        weights: Of the points, shape ``(K, M)``.
        ellipsoid: Their factored scatter.
        distances: Squared distances to the scatter of determinant one, shape ``(K, M)``.
    """

    weights: Tensor
    ellipsoid: Ellipsoid
    distances: Tensor


def reweight_shape(
    columns: list[Tensor],
    start: Shape,
    scale: Tensor,
    floor: Tensor,
    cutoff: float,
    *,
    adapt_scale: bool,
) -> tuple[Shape, Tensor]:
    """Reweight until the weights settle; lanes that have settled leave the batch.

    With ``adapt_scale`` the scale takes one step to the M-scale before each reweighting: solving
    for it fully can lead to another local minimum.
    """
    eps = torch.finfo(scale.dtype).eps
    enough = 16 * eps if scale.dtype == torch.float32 else 4096 * eps
    weights, scales = start.weights.clone(), scale.clone()
    places = torch.arange(len(scale), device=scale.device)
    points, floors = columns, floor
    distances, previous = start.distances, start.weights
    for step in range(1, MAX_STEPS + 1):
        if adapt_scale:
            scale = _m_scale_step(distances, scale, cutoff)
        current = bisquare_weights(distances / (cutoff * scale) ** 2)
        distances = shape_of(points, current, floors).distances
        if step % _CHECK_EVERY and step != MAX_STEPS:
            previous = current
            continue
        change = sum_points((current - previous).abs())
        settled = change <= enough * sum_points(current)
        if step == MAX_STEPS:
            settled |= True
        done, moving = torch.nonzero(settled).squeeze(1), torch.nonzero(~settled).squeeze(1)
        if len(done):
            weights.index_copy_(1, places[done], current.index_select(1, done))
            scales[places[done]] = scale[done]
            if len(moving) == 0:
                break
            points = take_lanes(points, moving)
            places, scale, floors = places[moving], scale[moving], floors[moving]
            distances, current = take_lanes([distances, current], moving)
        previous = current
    return shape_of(columns, weights, floor), scales


def shape_of(columns: list[Tensor], weights: Tensor, floor: Tensor) -> Shape:
    """Fit the weighted points of each lane, and scale the scatter to determinant one."""
    total = sum_points(weights)
    ellipsoid = fit_ellipsoid(columns, weights, total, floor)
    return Shape(weights, ellipsoid, sq_distances(ellipsoid, volume(ellipsoid)))


def volume(ellipsoid: Ellipsoid) -> Tensor:
    """The P-th root of the determinant of each lane's sums of squares."""
    product = torch.ones_like(ellipsoid.squares[0], dtype=torch.float64)
    for square in ellipsoid.squares:
        product = product * square.double()
    root = 1 / len(ellipsoid.squares)
    if product.device.type == "cpu":
        # NumPy's power is the same for a value wherever it stands; torch's is not.
        product = torch.from_numpy(np.power(product.numpy(), root))
    else:
        product = product**root
    return product.to(ellipsoid.squares[0].dtype)


def m_scale(distances: Tensor, cutoff: float) -> Tensor:
    """Scale at which the mean loss of each lane's distances is half of its maximum."""
    scale = (median_points(distances) / chi2_quantile(0.5, 1)).sqrt()
    scale = scale.clamp(min=torch.finfo(scale.dtype).tiny)
    for _ in range(50):
        scale = _m_scale_step(distances, scale, cutoff)
    return scale


def _m_scale_step(distances: Tensor, scale: Tensor, cutoff: float) -> Tensor:
    loss = sum_points(bisquare_loss(distances / (cutoff * scale) ** 2)) / len(distances)
    return scale * (loss / BREAKDOWN).sqrt()


def choose_shape(condition: Tensor, a: Shape, b: Shape) -> Shape:
    """Shape a where the condition holds, otherwise b."""
    return Shape(
        torch.where(condition, a.weights, b.weights),
        Ellipsoid(
            [torch.where(condition, x, y) for x, y in zip(a[1].means, b[1].means, strict=True)],
            [
                torch.where(condition, x, y)
                for x, y in zip(a[1].residuals, b[1].residuals, strict=True)
            ],
            [torch.where(condition, x, y) for x, y in zip(a[1].squares, b[1].squares, strict=True)],
            a[1].singular | b[1].singular,
        ),
        torch.where(condition, a.distances, b.distances),
    )
