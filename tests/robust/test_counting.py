"""Counting finds the same difference as looking at all of them."""

from itertools import combinations
from math import comb

import pytest
import torch

from torchrg.robust import counting

KINDS = {
    "normal": lambda rows, n, rng: torch.randn(rows, n, generator=rng),
    "ties": lambda rows, n, rng: torch.randint(0, 4, (rows, n), generator=rng).float(),
    "heavy": lambda rows, n, rng: torch.randn(rows, n, generator=rng) ** 9,
    "float64": lambda rows, n, rng: torch.randn(rows, n, generator=rng).double(),
    "two places": lambda rows, n, rng: (
        torch.rand(rows, n, generator=rng) + 9 * torch.arange(n) // n
    ),
    "equal": lambda rows, n, rng: torch.zeros(rows, n),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [2, 3, 7, 8, 49, 50])
def test_the_difference_is_that_of_sorting_all(kind, n):
    rng = torch.Generator().manual_seed(n)
    for num_rows in (1, 16, 37):
        rows = KINDS[kind](num_rows, n, rng).sort(dim=1).values
        first, second = torch.tensor(list(combinations(range(n), 2))).unbind(dim=1)
        differences = (rows[:, second] - rows[:, first]).sort(dim=1).values
        expected = differences[:, comb(n // 2 + 1, 2) - 1]
        assert torch.equal(counting.majority_difference(rows), expected)
    assert counting.majority_difference(rows[:0]).shape == (0,)
