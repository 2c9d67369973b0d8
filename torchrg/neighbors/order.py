"""Canonical point order along a Morton curve, independent of the input order."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg._checks import as_tensor, check_points
from torchrg._parallel import ROWS_AT_ONCE, map_chunks, map_tasks, nonzero_rows, split_rows
from torchrg.errors import CloudWarning, warn
from torchrg.structures import UNLABELED, AnyCloud
from torchrg.structures.points import bounding_box, short_repr

MORTON_BITS = 21
"""Bits per coordinate in a Morton code: three of them fit int64."""
_SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts that halve the runs of adjacent bits, and the resulting bit masks."""


def canonical_order(points: AnyCloud, ties: Sequence[Tensor] = ()) -> Tensor:
    """Return an order of finite points ``(N, 3)`` that depends on their coordinates alone.

    Points are sorted along a Morton curve through the bounding box, and lexicographically within
    one of its cells; only exact duplicates keep their input order. The order breaks ties between
    equal distances. Points close in this order are close in space, which speeds up later indexing.
    ``ties`` are columns ``(N,)`` by which exact duplicates are sorted.

    Returns:
        Row indices, shape ``(N,)``, int64: ``points[order]`` is in canonical order.

    Raises:
        ShapeError: If the shape or dtype is not as above.

    References:
        [1] G. Morton. A computer oriented geodetic data base. IBM, 1966.

    Example:
        >>> canonical_order(torch.tensor([[3.0, 0, 0], [1, 0, 0], [2, 0, 0]])).tolist()
        [1, 2, 0]
    """
    tensor = as_tensor("canonical_order", "points", points)
    check_points("canonical_order", tensor)
    coordinates = tensor.detach().cpu().numpy()
    if len(coordinates) == 0:
        return torch.zeros(0, dtype=torch.int64, device=tensor.device)
    order, codes = map(Tensor.numpy, sort_integers(torch.from_numpy(morton_codes(coordinates))))
    is_equal = codes[1:] == codes[:-1]
    if is_equal.any():
        is_tied = np.zeros(len(order), dtype=bool)
        is_tied[1:] |= is_equal
        is_tied[:-1] |= is_equal
        rows = order[is_tied]
        x, y, z = coordinates[rows].T
        columns = [column.detach().cpu().numpy()[rows] for column in reversed(ties)]
        order[is_tied] = rows[np.lexsort((rows, *columns, z, y, x, codes[is_tied]))]
    return torch.from_numpy(order).to(tensor.device)


def finite_rows(points: Tensor, ties: Sequence[Tensor] = ()) -> Tensor:
    """Return the rows of the finite points ``(N, 3)`` in :func:`canonical_order`, int64."""
    if len(points) == 0 or bool(torch.stack(points.aminmax()).isfinite().all()):
        return canonical_order(points, ties)
    rows = nonzero_rows(points.isfinite().all(dim=-1))
    return rows[canonical_order(points[rows], [column[rows] for column in ties])]


def mark_distinct(*columns: Tensor) -> Tensor:
    """Return a mask ``(N,)`` of rows that differ from the previous row of columns ``(N,)``."""
    is_first = torch.ones_like(columns[0], dtype=torch.bool)
    is_first[1:] = columns[0][1:] != columns[0][:-1]
    for column in columns[1:]:
        is_first[1:] |= column[1:] != column[:-1]
    return is_first


@short_repr
class DistinctPoints(NamedTuple):
    """The distinct finite points of a cloud, in canonical order.

    Attributes:
        points: One point per position, shape ``(P, 3)``.
        rows: Row of that point in the cloud, shape ``(P,)``, int64.
        inverse: Position index of each point of the cloud, shape ``(N,)``, int64; -1 if not finite.
    """

    points: Tensor
    rows: Tensor
    inverse: Tensor

    @property
    def num_copies(self) -> int:
        """Number of duplicates, i.e. points after the first one of each position."""
        return int(torch.count_nonzero(self.inverse >= 0)) - len(self.rows)

    def restore(self, values: Tensor, *, fill: float = 0) -> Tensor:
        """Expand values per position to all points; see :func:`expand_to_points`."""
        return expand_to_points(values, self.inverse, fill=fill)


def distinct_points(points: AnyCloud, ties: Sequence[Tensor] = ()) -> DistinctPoints:
    """Find the distinct points of ``(N, 3)``, which represent their duplicates.

    Duplicates would displace other points in a neighborhood, so neighbors are searched among
    distinct points. The representative has the smallest ``ties``, columns ``(N,)``, or is the
    first. Warn if no point is finite.

    Example:
        >>> cloud = torch.tensor([[2.0, 0, 0], [1, 0, 0], [2, 0, 0], [torch.nan, 0, 0]])
        >>> distinct = distinct_points(cloud)
        >>> distinct.rows.tolist(), distinct.inverse.tolist(), distinct.num_copies
        ([1, 0], [1, 0, 1, -1], 1)
    """
    points = as_tensor("distinct_points", "points", points)
    rows = finite_rows(points, ties)
    if len(rows) == 0 < len(points):
        warn(f"expected finite points, got none of {len(points):,}; check them.", CloudWarning)
    ordered = expand_to_points(points, rows)
    is_first = mark_distinct(*ordered.detach().unbind(dim=1))
    inverse = torch.full((len(points),), UNLABELED, device=points.device)
    inverse.index_copy_(0, rows, is_first.cumsum(0) - 1)
    if not bool(is_first.all()):
        ordered, rows = ordered[is_first], rows[is_first]
    return DistinctPoints(ordered, rows, inverse)


def distinct_rows(points: Tensor, *values: Tensor) -> Tensor:
    """Return the rows of distinct finite points ``(N, 3)``, in canonical order, int64.

    Points also differ if one of the ``values`` ``(N,)`` differs.
    """
    rows = finite_rows(points, values)
    columns = points[rows].unbind(dim=1)
    is_first = mark_distinct(*columns, *(column[rows] for column in values))
    return rows if bool(is_first.all()) else rows[is_first]


def ascending_rows(values: Tensor) -> Tensor:
    """Return the rows that sort values ``(N,)`` in ascending order, ties by row, int64.

    The position of NaN is undefined.
    """
    if values.dtype != torch.float32 or values.device.type != "cpu":
        return values.argsort(stable=True)
    # Ten times faster: integers of the value bits, reversed for negative values.
    bits = (values + 0.0).view(torch.int32)
    return sort_integers((bits ^ ((bits >> 31) & 0x7FFFFFFF)).long())[0]


def sort_integers(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rows that sort int64 keys ``(N,)``, ties by row, and the keys in this order."""
    if kernels.serve():
        rows, ascending, *_ = kernels.call("sort_integers", keys)
        return rows, ascending
    ascending, rows = keys.sort(stable=True)
    return rows, ascending


def scatter_rows(values: Tensor, rows: Tensor, num_points: int, *, fill: int = 0) -> Tensor:
    """Scatter values ``(n, ...)`` to their rows, with ``fill`` at all other rows."""
    result = values.new_full((num_points, *values.shape[1:]), fill)
    return result.index_copy_(0, rows, values)


def expand_to_points(values: Tensor, inverse: Tensor, *, fill: float = 0) -> Tensor:
    """Return each point's value of its position or voxel, shape ``(N, ...)``.

    ``values`` has one row per position or voxel; ``inverse`` ``(N,)`` is the row of each point.
    Points with a negative row get ``fill``; for labels use :data:`torchrg.UNLABELED`.

    Example:
        >>> expand_to_points(torch.tensor([7, 8]), torch.tensor([1, -1, 0, 1]), fill=-1).tolist()
        [8, -1, 7, 8]
    """
    if len(values) == 0:
        return values.new_full((len(inverse), *values.shape[1:]), fill)

    def work(rows: slice) -> Tensor:
        missing = (inverse[rows] < 0).view(-1, *[1] * (values.ndim - 1))
        return values.index_select(0, inverse[rows].clamp(min=0)).masked_fill_(missing, fill)

    return torch.cat(map_chunks(work, len(inverse), ROWS_AT_ONCE, values.device))


def morton_codes(coordinates: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the Morton codes of finite points ``(N, 3)`` in the bounding cube of the cloud."""
    codes = np.zeros(len(coordinates), dtype=np.int64)
    if len(codes) == 0:
        return codes
    low, high = bounding_box(coordinates)
    extent = float((high - low).max())
    if extent == 0:
        return codes

    def work(rows: slice) -> None:
        positions = coordinates[rows].astype(np.float64)
        if kernels.serve():
            points = torch.from_numpy(positions)
            codes[rows] = kernels.call("morton_codes", points, *low.tolist(), extent)[0].numpy()
            return
        relative = (positions - low) / extent
        steps = torch.from_numpy((relative * (2**MORTON_BITS - 1)).astype(np.int64))
        for axis in range(3):
            codes[rows] |= (spread_bits(steps[:, axis]) << axis).numpy()

    map_tasks(work, split_rows(len(codes), ROWS_AT_ONCE), torch.device("cpu"))
    return codes


def spread_bits(values: Tensor) -> Tensor:
    """Insert two zero bits between the bits of integers below 2**21, int64."""
    for shift, pattern in _SPREADS:
        values = (values | values << shift) & pattern
    return values


def connected_components(
    num_nodes: int, starts: Tensor, ends: Tensor, is_flipped: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the component of each node, in the order of first nodes, and its sign, 1 or -1.

    Links join the nodes ``starts`` and ``ends``, shape ``(L,)``. The signs of two nodes agree along
    a link, or differ along a flipped one, ``(L,)``, bool, default none. If links contradict each
    other, every node of their component remains single. Components ``(n,)`` are int32.
    """
    links = starts.cpu().int(), ends.cpu().int()
    flips = torch.zeros_like(links[0], dtype=torch.bool) if is_flipped is None else is_flipped
    marks = torch.zeros(2, num_nodes, dtype=torch.bool)
    forest = torch.arange(num_nodes, dtype=torch.int32), marks[0], marks[1]
    if kernels.serve():
        kernels.call("link_nodes", *links, flips, *forest)
        kernels.call("flatten_nodes", *forest)
    else:
        forest = _double_cover(num_nodes, *links, flips)
    roots, differs, is_contradictory = forest
    # Single nodes of contradictory components come last.
    roots, single = roots.long(), nonzero_rows(is_contradictory)
    roots[single] = num_nodes + single
    is_used = torch.zeros(2 * num_nodes, dtype=torch.bool).index_fill_(0, roots, True)
    signs = torch.where(differs & ~is_contradictory, -1.0, 1.0)
    components = is_used.cumsum(0, dtype=torch.int32)[roots].sub_(1)
    return components.to(starts.device), signs.to(starts.device)


def _double_cover(
    num_nodes: int, starts: Tensor, ends: Tensor, flips: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return each node's component, whether it is flipped, and whether links disagree.

    The double cover contains each node with both signs. Components ascend with their first nodes.
    """
    from scipy.sparse import coo_array, csgraph

    other = num_nodes * flips
    starts = torch.cat([starts, starts + num_nodes])
    ends = torch.cat([ends + other, ends + num_nodes - other])
    links = np.ones(len(starts)), (starts.numpy(), ends.numpy())
    cover = coo_array(links, shape=(2 * num_nodes, 2 * num_nodes))
    numbers = torch.from_numpy(csgraph.connected_components(cover, directed=False)[1])
    upright, opposite = numbers.view(2, num_nodes)
    return torch.minimum(upright, opposite), upright > opposite, upright == opposite
