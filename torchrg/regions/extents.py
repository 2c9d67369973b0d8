"""The smallest rectangle in its plane that holds each region."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.regions.segments import Segments

_NUM_DIRECTIONS = 32
_SLACK = 1 - 1e-6
_COARSE_STEP_DEG, _FINE_STEP_DEG = 2.0, 0.1


class Rectangles(NamedTuple):
    """Rectangles about M regions.

    Attributes:
        sides: Length of the long and of the short side, shape ``(M, 2)``.
        directions: Unit directions of the long and of the short side in the plane's coordinates,
            shape ``(M, 2, 2)``.
        center: Center of each rectangle, shape ``(M, 2)``, along those directions.
    """

    sides: Tensor
    directions: Tensor
    center: Tensor


def fit_rectangles(segments: Segments, u: Tensor, v: Tensor) -> Rectangles:
    """Find the rectangle of least area about each region, to a tenth of a degree.

    The turn is searched with the extreme points of 64 directions; the sides then hold all points.

    Args:
        segments: The regions.
        u: First coordinate in the plane, in the order of :meth:`Segments.take`.
        v: Second coordinate.

    Returns:
        The rectangles. A region of one place has sides 0.

    Example:
        >>> corners = torch.tensor([[0.0, 0], [2, 2], [3, 1], [1, -1]])
        >>> segments = Segments(torch.zeros(4, dtype=torch.int64))
        >>> fit_rectangles(segments, *corners.unbind(1)).sides
        tensor([[2.8284, 1.4142]])
    """
    turn = _best_turn(*_extreme_points(segments, u, v))
    cosine, sine = turn.cos(), turn.sin()
    c, s = segments.spread(cosine), segments.spread(sine)
    one, other = segments.bounds(u * c + v * s), segments.bounds(v * c - u * s)
    low, high = (torch.stack(pair, dim=1) for pair in zip(one, other, strict=True))
    directions = torch.stack([cosine, sine, -sine, cosine], dim=1).view(-1, 2, 2)
    sides, centers = high - low, (high + low) / 2
    swap = sides[:, 0] < sides[:, 1]
    return Rectangles(
        torch.where(swap[:, None], sides.flip(1), sides),
        torch.where(swap[:, None, None], directions.flip(1), directions),
        torch.where(swap[:, None], centers.flip(1), centers),
    )


def _extreme_points(segments: Segments, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return corners of each region's convex hull, two arrays ``(M, 2 * directions)``."""
    # Stretching keeps the corners of a hull; a thin strip needs it to have more than two.
    scale_u, scale_v = (segments.spread(segments.mean(x.abs())) for x in (u, v))
    wide_u = u / torch.where(scale_u > 0, scale_u, 1.0)
    wide_v = v / torch.where(scale_v > 0, scale_v, 1.0)
    corners = _extremes(segments, wide_u, wide_v, (0.0, math.pi / 2))
    angles = [math.pi * step / _NUM_DIRECTIONS for step in range(_NUM_DIRECTIONS)]
    # Nearer to the origin than the hull of four of its points is anywhere: no corner of the hull.
    near = _least_reach(wide_u[corners], wide_v[corners], angles) * _SLACK
    outer = wide_u * wide_u + wide_v * wide_v >= segments.spread(near * near.abs())
    rows = outer.nonzero().squeeze(1)
    corners = rows[_extremes(Segments(segments.labels[rows]), wide_u[rows], wide_v[rows], angles)]
    return u[corners], v[corners]


def _extremes(segments: Segments, u: Tensor, v: Tensor, angles: Sequence[float]) -> Tensor:
    """Return the places of the points that reach farthest along and against directions."""
    places = []
    for angle in angles:
        reach = u * math.cos(angle) + v * math.sin(angle)
        places += [
            segments.first_of_each(reach == segments.spread(bound))
            for bound in segments.bounds(reach)
        ]
    return torch.stack(places, dim=1)


def _least_reach(u: Tensor, v: Tensor, angles: Sequence[float]) -> Tensor:
    """Return how far some points reach along that direction, or against, where it is least."""
    reach = [u * math.cos(angle) + v * math.sin(angle) for angle in angles]
    ends = [bound for along in reach for bound in (along.amax(dim=1), -along.amin(dim=1))]
    return torch.stack(ends).amin(dim=0)


def _best_turn(u: Tensor, v: Tensor) -> Tensor:
    """Return the angle of least area in [0, 90) degrees, in radians, shape ``(M,)``."""
    best = torch.zeros(len(u), dtype=u.dtype, device=u.device)
    for step, reach in ((_COARSE_STEP_DEG, 90.0), (_FINE_STEP_DEG, _COARSE_STEP_DEG)):
        start = best.clone()
        least = torch.full_like(best, math.inf)
        for place in range(-round(reach / step) + 1, round(reach / step)):
            if reach == 90.0 and place < 0:
                continue
            turn = start + math.radians(place * step)
            cosine, sine = turn.cos()[:, None], turn.sin()[:, None]
            one, other = u * cosine + v * sine, v * cosine - u * sine
            area = (one.amax(1) - one.amin(1)) * (other.amax(1) - other.amin(1))
            best = torch.where(area < least, turn, best)
            least = torch.minimum(least, area)
    return best
