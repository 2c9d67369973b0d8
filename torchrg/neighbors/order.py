"""The canonical order of points, along a Morton curve: no result depends on the input order."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._parallel import ROWS_AT_ONCE, chunks_of, places_of
from torchrg.structures import UNLABELED, bounding_box

MORTON_BITS = 21
"""Bits of a number in a Morton code: three of them fit an int64."""

_SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts that halve the runs of neighbouring bits, and where the bits then are."""


def canonical_order(points: Tensor | NDArray[np.floating], ties: Sequence[Tensor] = ()) -> Tensor:
    """Return an order of the points ``(N, 3)``, finite, that depends on their coordinates alone.

    Points are sorted along a Morton curve through the bounding box, within one cell of it
    lexicographically; only exact duplicates keep the order they came in. It breaks ties between
    equal distances, and points close in this order are close in space, which makes every later
    gather faster. ``ties`` are columns ``(N,)`` by which exact duplicates are sorted.

    Returns:
        Row numbers, shape ``(N,)``, int64: ``points[order]`` is in canonical order.

    Raises:
        ShapeError: If the shape or dtype is not as above.

    References:
        [1] G. Morton. A computer oriented geodetic data base. IBM, 1966.

    Example:
        >>> canonical_order(torch.tensor([[3.0, 0, 0], [1, 0, 0], [2, 0, 0]])).tolist()
        [1, 2, 0]
    """
    tensor = as_tensor("canonical_order", "points", points)
    check_shapes("canonical_order", points=(tensor, "N 3"))
    check_floating("canonical_order", points=tensor)
    coordinates = tensor.detach().cpu().numpy()
    if len(coordinates) == 0:
        return torch.zeros(0, dtype=torch.int64, device=tensor.device)
    codes = morton_codes(coordinates)
    # Six times faster than a stable sort; what is equal is put in order below.
    order = np.argsort(codes)
    codes = codes[order]
    same = codes[1:] == codes[:-1]
    if same.any():
        tied = np.zeros(len(order), dtype=bool)
        tied[1:] |= same
        tied[:-1] |= same
        rows = order[tied]
        x, y, z = coordinates[rows].T
        columns = [column.detach().cpu().numpy()[rows] for column in reversed(ties)]
        order[tied] = rows[np.lexsort((rows, *columns, z, y, x, codes[tied]))]
    return torch.from_numpy(order).to(tensor.device)


def finite_rows(points: Tensor, ties: Sequence[Tensor] = ()) -> Tensor:
    """Return the rows of the finite ones of points ``(N, 3)``, in :func:`canonical_order`, int64.

    Example:
        >>> finite_rows(torch.tensor([[3.0, 0, 0], [torch.nan, 0, 0], [2, 0, 0]])).tolist()
        [2, 0]
    """
    x, y, z = points.isfinite().unbind(dim=-1)
    is_finite = x & y & z
    if bool(is_finite.all()):
        return canonical_order(points, ties)
    rows = places_of(is_finite)
    return rows[canonical_order(points[rows], [column[rows] for column in ties])]


def mark_first(*columns: Tensor) -> Tensor:
    """Return which rows of columns ``(N,)`` differ from the row before them, shape ``(N,)``, bool.

    Example:
        >>> mark_first(torch.tensor([1.0, 1.0, 2.0, 2.0]), torch.tensor([0, 0, 0, 1])).tolist()
        [True, False, True, True]
    """
    is_first = torch.ones_like(columns[0], dtype=torch.bool)
    is_first[1:] = columns[0][1:] != columns[0][:-1]
    for column in columns[1:]:
        is_first[1:] |= column[1:] != column[:-1]
    return is_first


class DistinctPoints(NamedTuple):
    """The distinct finite points of a cloud, in canonical order.

    Attributes:
        points: One point of each position, shape ``(P, 3)``.
        rows: Row of that point in the cloud, shape ``(P,)``, int64.
        inverse: Position of each point of the cloud, shape ``(N,)``, int64; -1 for a point that is
            not finite.
    """

    points: Tensor
    rows: Tensor
    inverse: Tensor

    @property
    def num_copies(self) -> int:
        """Number of points beyond the first one of each position."""
        return int(torch.count_nonzero(self.inverse >= 0)) - len(self.rows)

    def restore(self, values: Tensor, *, fill: int = 0) -> Tensor:
        """Return the value of its position for each point; see :func:`restore_points`."""
        return restore_points(values, self.inverse, fill=fill)


def distinct_points(points: Tensor, ties: Sequence[Tensor] = ()) -> DistinctPoints:
    """Find the distinct ones of points ``(N, 3)``, which stand for their copies.

    Copies in the neighborhood of a point take the places of other points there, so neighbors are
    searched among distinct points. Of equal points the one of the least ``ties`` is taken, columns
    ``(N,)``, else the first.

    Example:
        >>> cloud = torch.tensor([[2.0, 0, 0], [1, 0, 0], [2, 0, 0], [torch.nan, 0, 0]])
        >>> distinct = distinct_points(cloud)
        >>> distinct.rows.tolist(), distinct.inverse.tolist(), distinct.num_copies
        ([1, 0], [1, 0, 1, -1], 1)
    """
    rows = finite_rows(points, ties)
    # Three times faster than indexing.
    ordered = points.index_select(0, rows)
    is_first = mark_first(*ordered.detach().unbind(dim=1))
    inverse = torch.full((len(points),), UNLABELED, device=points.device)
    inverse.index_copy_(0, rows, is_first.cumsum(0) - 1)
    if not bool(is_first.all()):
        ordered, rows = ordered[is_first], rows[is_first]
    return DistinctPoints(ordered, rows, inverse)


def distinct_rows(points: Tensor, *values: Tensor) -> Tensor:
    """Return the rows of finite points ``(N, 3)`` that differ, in canonical order, int64.

    Points also differ where one of the ``values`` ``(N,)`` does.

    Example:
        >>> distinct_rows(torch.ones(4, 3), torch.tensor([7, 5, 7, 5])).tolist()
        [1, 0]
    """
    rows = finite_rows(points, values)
    columns = points[rows].unbind(dim=1)
    is_first = mark_first(*columns, *(column[rows] for column in values))
    return rows if bool(is_first.all()) else rows[is_first]


def ascending_rows(values: Tensor) -> Tensor:
    """Return the rows of values ``(N,)`` in their order, of equal ones in that of the rows, int64.

    Where NaN goes is not said.

    Example:
        >>> ascending_rows(torch.tensor([0.5, -2.0, 0.0, -0.0, 0.5])).tolist()
        [1, 2, 3, 0, 4]
    """
    if values.dtype != torch.float32 or values.device.type != "cpu":
        return values.argsort(stable=True)
    # Ten times faster: whole numbers of the bits, where those of negative values descend, and row.
    bits = (values + 0.0).numpy().view(np.int32)
    keys = (bits ^ ((bits >> 31) & np.int32(2**31 - 1))).astype(np.int64) << 32
    keys |= np.arange(len(keys))
    keys.sort()
    keys &= 2**32 - 1
    return torch.from_numpy(keys)


def restore_rows(values: Tensor, rows: Tensor, num_points: int, *, fill: int = 0) -> Tensor:
    """Return values ``(n, ...)`` at the rows they belong to, and a filling at all others.

    Example:
        >>> restore_rows(torch.tensor([7, 8]), torch.tensor([2, 0]), 3, fill=-1).tolist()
        [8, -1, 7]
    """
    result = values.new_full((num_points, *values.shape[1:]), fill)
    return result.index_copy_(0, rows, values)


def restore_points(values: Tensor, inverse: Tensor, *, fill: int = 0) -> Tensor:
    """Give each point the value of its position or voxel, shape ``(N, ...)``.

    ``values`` has a row for each of these, ``inverse`` ``(N,)`` that of each point. Points of a
    negative one, which have none, get ``fill``; for labels :data:`torchrg.UNLABELED`.

    Example:
        >>> restore_points(torch.tensor([7, 8]), torch.tensor([1, -1, 0, 1]), fill=-1).tolist()
        [8, -1, 7, 8]
    """
    has_value = inverse >= 0
    if bool(has_value.all()):
        return values.index_select(0, inverse)
    result = values.new_full((len(inverse), *values.shape[1:]), fill)
    result[has_value] = values[inverse[has_value]]
    return result


def morton_codes(coordinates: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the Morton code of each of finite points ``(N, 3)`` in the cube about the cloud."""
    codes = np.zeros(len(coordinates), dtype=np.int64)
    if len(codes) == 0:
        return codes
    low, high = bounding_box(coordinates)
    extent = float((high - low).max())
    if extent == 0:
        return codes
    kernel = {"f4": "morton_codes", "f8": "morton_codes_double"}.get(coordinates.dtype.str[1:])
    for rows in chunks_of(len(codes), ROWS_AT_ONCE):
        if kernel and kernels.serve():
            points = as_tensor("morton_codes", "coordinates", coordinates[rows])
            codes[rows] = kernels.call(kernel, points, *low.tolist(), extent)[0].numpy()
            continue
        relative = (coordinates[rows] - low) / extent
        steps = torch.from_numpy((relative * (2**MORTON_BITS - 1)).astype(np.int64))
        for axis in range(3):
            codes[rows] |= (spread_bits(steps[:, axis]) << axis).numpy()
    return codes


def spread_bits(values: Tensor) -> Tensor:
    """Put two zero bits between the bits of numbers below 2**21, int64."""
    for shift, pattern in _SPREADS:
        values = (values | values << shift) & pattern
    return values
