"""Every kernel does what the function of torch does that stands next to it."""

import pytest
import torch

from tests.kernels.clouds import both, needs_library
from torchrg.robust.scale import _majority_difference

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")


def special_rows(n):
    """Sorted rows of n values: random, tied, constant, mixed magnitudes, infinite, with NaN."""
    generator = torch.Generator().manual_seed(n)
    rows = torch.randn(60, n, generator=generator)
    rows[10:20] = rows[10:20].round()
    rows[20:25] = 3.0
    rows[25:30] *= 10.0 ** torch.randint(-30, 30, (5, n), generator=generator)
    rows[30, 0] = torch.inf
    rows[31, -1] = -torch.inf
    rows[32, : n // 2] = torch.inf
    rows[33, 0] = torch.nan
    rows[34] = torch.tensor([-3e38, 3e38]).repeat(n)[:n]
    rows[35:40] *= 1e-42
    return rows.sort(dim=1).values


@pytest.mark.parametrize("n", [2, 3, 4, 7, 8, 9, 15, 16, 17, 50, 51, 300])
def test_differences_are_those_of_the_definition_to_the_bit(n):
    found, expected = both(_majority_difference, special_rows(n))
    assert torch.equal(found.nan_to_num(nan=-1.0), expected.nan_to_num(nan=-1.0))
