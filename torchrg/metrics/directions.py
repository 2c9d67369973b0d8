"""Clusters that face one way, found from their centres."""

import math

import torch
from torch import Tensor

from torchrg.metrics.sphere import chord_table


def merge_directions(
    centers: Tensor, *, max_angle_deg: float = 5.0, max_pairs: int = 2**17
) -> Tensor:
    """Number the groups of centres that are joined by steps of a small angle.

    Args:
        centers: Unit vectors, shape ``(M, 3)``, float64; opposite ones are one direction.
        max_angle_deg: Largest step, included.
        max_pairs: Chords in memory at a time; does not change the result.

    Returns:
        Group of each centre, 0, 1, ... in the order of their first members, shape ``(M,)``, int64.

    Example:
        >>> axes = torch.eye(3, dtype=torch.float64)
        >>> merge_directions(torch.stack([axes[0], axes[1], -axes[0]])).tolist()
        [0, 1, 0]
    """
    longest = 2 * math.sin(math.radians(max_angle_deg) / 2)
    groups = torch.full((len(centers),), -1, device=centers.device)
    group = 0
    while len(rest := (groups < 0).nonzero().squeeze(1)):
        frontier = rest[:1]
        while len(frontier):
            groups[frontier] = group
            rest = rest[groups[rest] < 0]
            near = torch.zeros_like(rest, dtype=torch.bool)
            for block in torch.split(frontier, max(1, max_pairs // max(1, len(rest)))):
                near |= (chord_table(centers[block], centers[rest]) <= longest).any(dim=0)
            frontier = rest[near]
        group += 1
    return groups
