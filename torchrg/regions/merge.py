"""Regions that touch and lie on one plane become one."""

import heapq
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import eigh3_of_few

_LEAST_CONTACTS = 3


class Moments(NamedTuple):
    """What merging reads of each of M regions.

    Attributes:
        weight: Number of points, shape ``(M,)``.
        mean: Mean of the points, shape ``(M, 3)``.
        covariance: Covariance of the points, shape ``(M, 3, 3)``.
        scale: Distance from its plane that counts as lying on it, shape ``(M,)``.
    """

    weight: Tensor
    mean: Tensor
    covariance: Tensor
    scale: Tensor


def merge_coplanar(
    moments: Moments, pairs: Tensor, num_contacts: Tensor, *, tolerance: float
) -> Tensor:
    """Merge regions pair by pair, the pair that fits best first.

    Two regions are merged when one plane explains both: the root mean square distance of either to
    the plane through both is at most ``tolerance`` times its own scale. What is merged is one
    region from then on.

    Args:
        moments: The regions, in float64, about an origin near them.
        pairs: Pairs of regions that touch, shape ``(E, 2)``.
        num_contacts: Number of points that touch, shape ``(E,)``; less than three do not count.
        tolerance: See above.

    Returns:
        For each region the smallest of those it is merged with, shape ``(M,)``, int64.

    Example:
        >>> flat = torch.diag(torch.tensor([1.0, 1, 1e-6]).double()).expand(3, 3, 3)
        >>> mean = torch.tensor([[0.0, 0, 0], [4, 0, 0], [8, 0, 1]]).double()
        >>> regions = Moments(torch.ones(3).double(), mean, flat, torch.full((3,), 1e-3).double())
        >>> pairs, contacts = torch.tensor([[0, 1], [1, 2]]), torch.tensor([9, 9])
        >>> merge_coplanar(regions, pairs, contacts, tolerance=1.2).tolist()
        [0, 0, 2]
    """
    groups = [_row(moments, i) for i in range(len(moments.weight))]
    touching: list[set[int]] = [set() for _ in groups]
    owner = list(range(len(groups)))
    pairs = pairs[num_contacts >= _LEAST_CONTACTS]
    misfits = _misfit(_select(moments, pairs[:, 0]), _select(moments, pairs[:, 1]))
    queue = []
    for (a, b), misfit in zip(pairs.tolist(), misfits.tolist(), strict=True):
        touching[a].add(b)
        touching[b].add(a)
        if misfit <= tolerance:
            queue.append((misfit, a, b, 0, 0))
    heapq.heapify(queue)
    age = [0] * len(groups)
    while queue:
        _, a, b, age_a, age_b = heapq.heappop(queue)
        if owner[a] != a or owner[b] != b or (age[a], age[b]) != (age_a, age_b):
            continue
        groups[a] = _joined(groups[a], groups[b])
        owner[b] = a
        age[a] += 1
        touching[a] |= touching[b]
        touching[a] = {_root(owner, c) for c in touching[a]} - {a}
        for c in touching[a]:
            touching[c].add(a)
            first, second = min(a, c), max(a, c)
            misfit = float(_misfit(groups[first], groups[second]))
            if misfit <= tolerance:
                heapq.heappush(queue, (misfit, first, second, age[first], age[second]))
    return torch.tensor([_root(owner, i) for i in range(len(owner))], dtype=torch.int64)


def _root(owner: list[int], i: int) -> int:
    while owner[i] != i:
        owner[i] = owner[owner[i]]
        i = owner[i]
    return i


def _select(moments: Moments, rows: Tensor) -> Moments:
    return Moments(*(values[rows] for values in moments))


def _row(moments: Moments, i: int) -> Moments:
    return Moments(*(values[i : i + 1] for values in moments))


def _joined(a: Moments, b: Moments) -> Moments:
    """Return the moments of two sets of regions, taken together one by one."""
    weight = a.weight + b.weight
    share_a, share_b = (a.weight / weight)[:, None], (b.weight / weight)[:, None]
    mean = share_a * a.mean + share_b * b.mean
    covariance = torch.zeros_like(a.covariance)
    for part, share in ((a, share_a), (b, share_b)):
        shift = part.mean - mean
        spread = part.covariance + shift[:, :, None] * shift[:, None, :]
        covariance = covariance + share[:, :, None] * spread
    return Moments(weight, mean, covariance, torch.maximum(a.scale, b.scale))


def _misfit(a: Moments, b: Moments) -> Tensor:
    """Return how far from the joint plane the worse of two regions is, in its own scales."""
    both = _joined(a, b)
    normal = eigh3_of_few(both.covariance)[1][:, :, 0]
    misfits = []
    for part in (a, b):
        own = (normal[:, None] @ part.covariance @ normal[:, :, None])[:, 0, 0]
        shift = ((part.mean - both.mean) * normal).sum(dim=1)
        rms = (own.clamp(min=0) + shift * shift).sqrt()
        misfits.append(torch.where(rms > 0, rms / part.scale, 0.0))
    return torch.maximum(*misfits)
