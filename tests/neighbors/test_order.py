"""Morton codes hold the bits of three numbers; the canonical order follows them."""

import torch

from torchrg.neighbors.order import canonical_order, spread_bits


def test_morton_codes_hold_the_bits_of_three_numbers(rng):
    numbers = torch.randint(0, 2**21, (500, 3), generator=rng)
    codes = sum(spread_bits(numbers[:, axis]) << axis for axis in range(3))
    for code, triple in zip(codes.tolist(), numbers.tolist(), strict=True):
        bits = "".join(
            str(triple[axis] >> bit & 1) for bit in reversed(range(21)) for axis in (2, 1, 0)
        )
        assert code == int(bits, 2)


def test_duplicates_are_side_by_side_in_the_order_they_came_in(rng):
    points = torch.randint(0, 4, (5000, 3), generator=rng).double()
    order = canonical_order(points).tolist()
    places = [tuple(row) for row in points.tolist()]
    first = {}
    for row in order:
        first.setdefault(places[row], len(first))
    assert order == sorted(range(len(places)), key=lambda row: (first[places[row]], row))
