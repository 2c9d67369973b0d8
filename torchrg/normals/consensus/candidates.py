"""Pairs of neighbors that span candidate planes with their point."""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchrg.normals.consensus import constants


def candidate_ranks(num_neighbors: int) -> Tensor:
    """Return the ranks ``(P, 2)`` of the neighbors that span candidates with the point."""
    pairs = _pairs(num_neighbors, constants.NUM_CANDIDATES, constants.CANDIDATE_POWER)
    return torch.tensor(pairs, dtype=torch.int64, device="cpu").view(-1, 2)


@cache
def _pairs(num_neighbors: int, num_pairs: int, power: float) -> tuple[tuple[int, int], ...]:
    """Return pairs of ranks: spread over all neighbors, near ones more often."""
    last = num_neighbors - 1
    if last < 2:
        return ()
    # The plastic number's low-discrepancy sequence covers the square of pairs evenly.
    steps = np.arange(1, 8 * num_pairs)[:, None] * np.array([0.7548776662466927, 0.569840290998])
    ranks = 1 + np.floor(last * (steps % 1.0) ** power).astype(int)
    pairs = dict.fromkeys((min(a, b), max(a, b)) for a, b in ranks.tolist() if a != b)
    return tuple(pairs)[:num_pairs]
