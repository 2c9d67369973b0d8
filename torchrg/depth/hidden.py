"""Regions of one plane that only something nearer parts in a depth image."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.regions.fit import RegionPlanes

_EVERY = 4
"""Every fourth row and column is looked at."""
_LEAST_LINES = 2
"""Rows and columns, of those looked at, that must lead from one region to the other."""
_MOST_OFFSET = 0.5
"""The middle of the smaller region may be off the plane of the larger by this many of its
thicknesses."""
_LEAST_NEARER = 0.5
"""Least share, of the pixels between two regions, in front of their plane. The others may lie on it
or have no depth, as in the shadow of something nearer."""


class _Lines(NamedTuple):
    """Pixels of rows or of columns, ``(n, L)``, and their coordinates ``(n, L, 3)``."""

    points: Tensor
    seen: Tensor
    labels: Tensor


def hidden_contacts(
    points: Tensor, seen: Tensor, labels: Tensor, planes: RegionPlanes, reach: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the pairs of regions of one plane that only what is nearer parts, and their contacts.

    The middle of the smaller of two regions is on the plane of the larger, and along some rows or
    columns nothing between the two is behind that plane, and half of it or more is in front.
    Whatever is seen behind a plane shows that it ends there, as the floor between two tables of one
    height does.

    ``points`` ``(H * W, 3)`` and ``seen`` ``(H, W)`` are those of
    :class:`torchrg.depth.growth.InverseCloud`; ``reach`` ``(M,)`` is the distance from a plane that
    counts as on it, NaN for a curved region. Pairs ``(E, 2)`` and their numbers of contacts are as
    :func:`torchrg.regions.repair.merge_coplanar` takes them.
    """
    pixels = _Lines(points.view(*seen.shape, 3), seen, labels.view(seen.shape))
    rows = _Lines(*(part[::_EVERY] for part in pixels))
    columns = _Lines(*(part[:, ::_EVERY].transpose(0, 1).contiguous() for part in pixels))
    pairs, contacts = [], []
    for larger, smaller in _aligned_pairs(planes):
        plane = planes.normal[larger], planes.center[larger], reach[larger]
        lines = sum(_count_lines(part, (larger, smaller), *plane) for part in (rows, columns))
        if lines >= _LEAST_LINES:
            pairs.append((min(larger, smaller), max(larger, smaller)))
            contacts.append(lines * _EVERY)
    return labels.new_tensor(pairs).view(-1, 2), labels.new_tensor(contacts)


def _aligned_pairs(planes: RegionPlanes) -> list[tuple[int, int]]:
    """Return the pairs of a larger region and a smaller one whose middle is on its plane."""
    normal, center, count = planes.normal, planes.center, planes.num_points
    away = normal @ center.T - (normal * center).sum(dim=1, keepdim=True)
    aligned = away.abs() <= _MOST_OFFSET * planes.thickness[:, None]
    place = torch.arange(len(count), device=count.device)
    is_larger = (count[:, None] > count) | ((count[:, None] == count) & (place[:, None] < place))
    both_flat = ~(planes.curved[:, None] | planes.curved)
    return [(a, b) for a, b in (aligned & is_larger & both_flat).nonzero().tolist()]


def _count_lines(
    lines: _Lines, pair: tuple[int, int], normal: Tensor, center: Tensor, reach: Tensor
) -> int:
    """Return how many lines lead from one region of a pair to the other past what is nearer."""
    first, second = ((lines.labels == region) for region in pair)
    both = first.any(dim=1) & second.any(dim=1)
    if not bool(both.any()):
        return 0
    points, seen, first, second = lines.points[both], lines.seen[both], first[both], second[both]
    height = (points - center) @ normal
    in_front = seen & (height > reach)
    ends = first | second | (seen & (height < -reach))
    place = torch.arange(ends.shape[1], device=ends.device).expand_as(height)
    previous = torch.where(ends, place, -1).cummax(dim=1).values[:, :-1]
    passed = in_front.cumsum(dim=1)
    here, before = ends[:, 1:], previous.clamp(min=0)
    gap = place[:, 1:] - previous - 1
    nearer = passed[:, :-1] - passed.gather(1, before)
    other = (first[:, 1:] & second.gather(1, before)) | (second[:, 1:] & first.gather(1, before))
    leads = here & other & (previous >= 0) & (gap > 0) & (nearer >= _LEAST_NEARER * gap)
    return int(leads.any(dim=1).sum())
