"""Small sets of points to start a search from."""

from functools import lru_cache
from itertools import combinations
from math import comb

import torch
from torch import Tensor


@lru_cache(maxsize=64)
def elemental_sets(num_points: int, size: int, num_sets: int, seed: int) -> Tensor:
    """Choose sets of ``size`` among ``num_points`` points at random, or all where they are few.

    The same sets serve every patch, so a patch's result depends on the seed and on nothing else
    in its batch.

    Args:
        num_points: n.
        size: Points of a set, at most n.
        num_sets: How many to draw.
        seed: Of the draw.

    Returns:
        Point indices, shape ``(S, size)``, int64: all sets in lexicographic order where there are
        at most ``5 * num_sets``, otherwise ``num_sets`` of them.

    Example:
        >>> elemental_sets(4, 3, 1, 0).tolist()
        [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    """
    if comb(num_points, size) <= 5 * num_sets:
        return torch.tensor(list(combinations(range(num_points), size)))
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(num_sets, num_points, generator=generator)
    return draws.argsort(dim=1, stable=True)[:, :size]


def draw_seed(generator: torch.Generator | None) -> int:
    """Take one seed from a generator; without one the seed is 0."""
    if generator is None:
        return 0
    return int(torch.randint(2**62, (), generator=generator, device=generator.device))
