"""Morton codes hold the bits of three numbers; the canonical order follows them."""

import numpy as np
import pytest
import torch

from tests.kernels.clouds import definitions, needs_library
from torchrg import estimate_normals, segment_planes
from torchrg.errors import CloudWarning
from torchrg.neighbors.order import (
    ascending_rows,
    canonical_order,
    distinct_points,
    distinct_rows,
    mark_distinct,
    morton_codes,
    scatter_rows,
    spread_bits,
)


def test_morton_codes_hold_the_bits_of_three_numbers(rng):
    numbers = torch.randint(0, 2**21, (500, 3), generator=rng)
    codes = sum(spread_bits(numbers[:, axis]) << axis for axis in range(3))
    for code, triple in zip(codes.tolist(), numbers.tolist(), strict=True):
        bits = "".join(
            str(triple[axis] >> bit & 1) for bit in reversed(range(21)) for axis in (2, 1, 0)
        )
        assert code == int(bits, 2)


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("origin", [0.0, -3e6])
def test_kernel_of_morton_codes_equals_the_definition(precision, origin):
    points = (np.random.default_rng(0).random((5000, 3)) * (8, 6, 3) + origin).astype(precision)
    found = morton_codes(points)
    with definitions():
        expected = morton_codes(points)
    assert len(np.unique(expected)) > 100
    np.testing.assert_array_equal(found, expected)


def test_duplicates_are_side_by_side_in_the_order_they_came_in(rng):
    points = torch.randint(0, 4, (5000, 3), generator=rng).double()
    order = canonical_order(points).tolist()
    places = [tuple(row) for row in points.tolist()]
    first = {}
    for row in order:
        first.setdefault(places[row], len(first))
    assert order == sorted(range(len(places)), key=lambda row: (first[places[row]], row))


def test_mark_distinct_by_example():
    assert mark_distinct(
        torch.tensor([1.0, 1.0, 2.0, 2.0]), torch.tensor([0, 0, 0, 1])
    ).tolist() == [True, False, True, True]


def test_distinct_rows_by_example():
    assert distinct_rows(torch.ones(4, 3), torch.tensor([7, 5, 7, 5])).tolist() == [1, 0]


def test_ascending_rows_by_example():
    assert ascending_rows(torch.tensor([0.5, -2.0, 0.0, -0.0, 0.5])).tolist() == [1, 2, 3, 0, 4]


def test_scatter_rows_by_example():
    assert scatter_rows(torch.tensor([7, 8]), torch.tensor([2, 0]), 3, fill=-1).tolist() == [
        8,
        -1,
        7,
    ]


def test_a_cloud_without_finite_points_is_told():
    cloud = torch.full((30, 3), torch.nan)
    for find in (distinct_points, segment_planes, estimate_normals):
        with pytest.warns(CloudWarning, match="expected finite points, got none of 30") as caught:
            find(cloud)
        assert len(caught) == 1
    assert len(distinct_points(torch.zeros(0, 3)).rows) == 0
