"""Kernels of robust fits equal their definitions to the bit."""

from unittest import mock

import pytest
import torch

from tests.kernels.clouds import both, needs_library
from torchrg.robust import starts as robust_starts
from torchrg.robust.exact import find_flats
from torchrg.robust.lanes import columns_of_points, smallest_points
from torchrg.robust.mcd import _concentrate
from torchrg.robust.starts import initial_sets

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")


def special_columns(n):
    """Columns of 70 patches of n points: random, tied, coinciding, flat, thin, tiny differences."""
    patches = torch.randn(70, n, 3, generator=torch.Generator().manual_seed(n))
    patches[10:20] = (2 * patches[10:20]).round()
    patches[20:30, : n * 55 // 100] = patches[20:30, :1]
    patches[30:40, : n * 6 // 10, 0] = 0
    patches[40:50, :, 2] *= 1e-5
    patches[50:60, ::3] *= 1e-30
    patches[60:65] = 0
    return columns_of_points(patches / patches.abs().amax(dim=(1, 2), keepdim=True).clamp(min=1))


SIZES = [2, 3, 4, 7, 8, 31, 50, 70]


@pytest.mark.parametrize("n", SIZES)
def test_smallest_points_are_those_of_the_definition(n):
    distances = special_columns(n)[0].square()
    for size in {1, -(-n // 2), n - 1, n}:
        found, expected = both(smallest_points, distances, size)
        assert torch.equal(found, expected)


@pytest.mark.parametrize("n", SIZES)
def test_flats_are_those_of_the_definition(n):
    tolerance = torch.full((70,), 1e-6)
    found, expected = both(find_flats, special_columns(n), tolerance, n // 2 + 1)
    assert torch.equal(found[0], expected[0])
    assert torch.equal(found[1], expected[1])
    assert n < 4 or 10 < (found[0] < 3).sum() < 60


@pytest.mark.parametrize("starts", ["paper", "robustbase"])
@pytest.mark.parametrize("n", SIZES)
def test_concentrated_starts_are_those_of_the_definition(n, starts):
    columns, size = special_columns(n), n // 2 + 1
    sets, expected_sets = both(initial_sets, columns, size, starts)
    assert torch.equal(sets[0], expected_sets[0])
    for initial in (sets[0], sets[0].repeat(1, 3, 1), sets[0][:, :1]):
        arguments = columns, initial, sets[1], size, torch.full((70,), 1e-12)
        for max_steps in (1, 100):
            found, expected = both(_concentrate, *arguments, max_steps)
            assert torch.equal(found.members, expected.members)
            assert torch.equal(found.determinants, expected.determinants)


@pytest.mark.parametrize("n", [7, 8, 50, 150])
def test_deterministic_starts_are_those_of_the_definition(n):
    random = torch.randn(9, n, 3, generator=torch.Generator().manual_seed(n))
    line = random[..., :1] * torch.tensor([1.0, 2.0, 3.0])
    outliers, copies = random.clone(), random.clone()
    outliers[:, : n * 4 // 10] += 50
    copies[:, : n // 2 + 1] = random[:, :1]
    kinds = random, random + 1e3, (2 * random).round(), outliers, line, copies
    num_undefined = []
    for patches in kinds:
        columns = columns_of_points(patches)
        definition = mock.Mock(wraps=robust_starts._sphered_sets)
        with mock.patch.object(robust_starts, "_sphered_sets", definition):
            found = initial_sets(columns, n // 2 + 1, "paper")[0]
        num_undefined.append(sum(call.args[0][0].shape[1] for call in definition.mock_calls))
        assert torch.equal(found, both(initial_sets, columns, n // 2 + 1, "paper")[1][0])
    # Kernels leave patches to the definition where a scale is zero: on lines and among copies.
    assert num_undefined[:2] == [0, 0]
    assert num_undefined[3:] == [0, 9, 9]
