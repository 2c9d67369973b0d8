"""Region adjacency: pairs of planes that meet, boundary lengths and angles."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import (
    ROWS_AT_ONCE,
    ROWS_IN_CACHE,
    Returned,
    limit_rows,
    map_chunks,
    map_tasks,
    nonzero_rows,
    split_rows,
)
from torchrg.linalg import unsigned_angle_deg
from torchrg.structures import Neighbors, PlaneAdjacency
from torchrg.structures.points import Rows

NUM_CONTACTS = 8
"""Nearest neighbors that count as adjacent; farther neighbors reach across gaps."""
_NEAREST = slice(1, NUM_CONTACTS + 1)
"""Their columns in the neighbor lists; the first one is the point itself."""
MIN_CONTACTS = 3
"""Minimum number of edges between two regions that meet or are merged: a single edge may be an
outlier's."""
PARALLEL_DEG = 15.0
"""Below this angle the intersection line of two planes may lie far from where the regions end."""
_CHUNKS_AT_ONCE = 16
"""Chunks of edges per parallel batch, few enough that their results need little memory."""
_MAX_CELL = 2.0**53
"""Largest cell index on a line. float64 cannot distinguish cells beyond it."""
_REACH = 4.0
"""Maximum out-of-plane component of an edge within the noise, in thicknesses of the planes."""
_MAX_STEEPNESS = 0.25
"""An edge follows the surface if its out-of-plane component is at most this fraction of the
distance to the 8th neighbor. Beyond this and the noise it leads to a parallel surface."""


def find_adjacency(
    points: Tensor,
    labels: Tensor,
    neighbors: Neighbors,
    normal: Tensor,
    thickness: Tensor,
    *,
    curved: Tensor,
) -> PlaneAdjacency:
    r"""Find pairs of regions that meet, and measure their common boundary.

    Non-parallel flat regions meet along the intersection line of their planes. Edges between their
    points, also across a narrow unlabeled strip, are projected onto it; the covered length without
    gaps is the boundary length. For parallel or curved regions only the 8 nearest neighbors count.
    Their length is that of a curve crossed by the edges. With density :math:`\rho` and n edges per
    point, a curve of length L crosses edges with :math:`\sum 1 / |e| = 2 n \rho L / \pi` (Cauchy
    and Crofton) [1].

    Planes are given by unit normals ``(M, 3)`` and the standard deviation of their points
    (``thickness``, ``(M,)``). Regions joined by fewer than three edges do not meet.

    References:
        [1] L. Santalo. Integral Geometry and Geometric Probability. Addison-Wesley, 1976.
    """
    edges = _RegionEdges(labels, neighbors)
    pairs = edges.pairs
    first, second = normal[pairs[:, 0]], normal[pairs[:, 1]]
    angle = unsigned_angle_deg(first, second)
    crossing = (angle > PARALLEL_DEG) & ~curved[pairs].any(dim=1)
    reach = _REACH * thickness[pairs].amax(dim=1)

    def measure(contacts: _Contacts) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        is_crossing = crossing[contacts.pair]
        on_lines = _select(contacts, is_crossing)
        on_curves = _select(contacts, ~is_crossing & (contacts.column <= NUM_CONTACTS))
        edge, pair = _edge_vectors(points, on_curves), on_curves.pair
        across = torch.stack([(edge * side[pair]).sum(dim=1) for side in (first, second)])
        spacing, num_nearest = _contact_radii(points, neighbors, on_curves.source)
        farthest = torch.maximum(reach[pair], _MAX_STEEPNESS * spacing)
        size = edge.norm(dim=1)
        length_each = math.pi**2 * spacing * spacing / (2 * num_nearest * num_nearest * size)
        length_each = torch.where(size > 0, length_each, 0.0)
        flat = across.abs().amax(dim=0) <= farthest
        return (
            on_lines.pair,
            _edge_vectors(points, on_lines).norm(dim=1),
            pair[flat],
            length_each[flat],
        )

    sums, counts = np.zeros((2, len(pairs))), np.zeros((2, len(pairs)), dtype=np.int64)
    # Added in a fixed order on every device.
    for measured in edges.map_contacts(measure):
        for kind in range(2):
            owner, values = (part.cpu().numpy() for part in measured[2 * kind : 2 * kind + 2])
            np.add.at(sums[kind], owner, values)
            np.add.at(counts[kind], owner, 1)
    sizes, lengths = torch.from_numpy(sums).to(points.device)
    on_line, on_curve = torch.from_numpy(counts).to(points.device)
    along = torch.linalg.cross(first, second)
    along = along / along.norm(dim=1, keepdim=True)
    length = _length_on_line(points, edges, along, sizes / on_line)
    meets = on_line + on_curve >= MIN_CONTACTS
    length = torch.where(crossing, length, lengths)
    rows = nonzero_rows(meets)
    return PlaneAdjacency(pairs[rows], length[rows], angle[rows])


class KnnAdjacency:
    """Adjacency of a point cloud: up to 8 nearest neighbors per point."""

    def __init__(self, neighbors: Neighbors) -> None:
        valid = None if neighbors.valid is None else neighbors.valid[:, _NEAREST]
        self._all, self.neighbors = neighbors, Neighbors(neighbors.indices[:, _NEAREST], valid)
        self._points = neighbors.indices[:, :1]

    def neighbor_rows(self, rows: Rows) -> Tensor:
        """Return the neighbors of the given points, shape ``(n, 8)``, padded with the point."""
        near, counted = self.neighbors.select(rows)
        return near if counted is None else torch.where(counted, near, self._points[rows])

    def contacts(self, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Apply :func:`find_region_pairs` to the nearest neighbors."""
        return find_region_pairs(labels, self._all, _NEAREST)

    def boundary(self, labels: Tensor) -> Tensor:
        """Return the points with a nearest neighbor in another region, also unlabeled points."""
        low, high, _ = _NEAREST.indices(self._all.indices.shape[1])
        narrow = labels.to(torch.int32)

        def mark(rows: slice) -> Tensor:
            part = torch.arange(rows.start, rows.stop, dtype=torch.int32, device=labels.device)
            if kernels.serve(narrow, *self._all):
                return kernels.call("mark_boundary", narrow, *self._all, part, low, high)[0]
            return _crosses(narrow, part, self._all.select(part), _NEAREST).any(dim=1)

        at_once = limit_rows(ROWS_AT_ONCE, self._all.indices.shape[1])
        return nonzero_rows(torch.cat(map_chunks(mark, len(labels), at_once, labels.device)))


def find_region_pairs(
    labels: Tensor, neighbors: Neighbors, columns: slice = slice(None)
) -> tuple[Tensor, Tensor]:
    """Return pairs of adjacent regions and the number of edges between them.

    For labels ``(N,)``, negative if unlabeled, and some columns of the lists: pairs ``(E, 2)``,
    smaller label first, ascending, and counts ``(E,)``.
    """
    edges = _RegionEdges(labels, neighbors, columns)
    return edges.pairs, edges.counts


class _Contacts(NamedTuple):
    """Edges between regions: pair index, end points, and column in the neighbor lists."""

    pair: Tensor
    source: Tensor
    target: Tensor
    column: Tensor


class _RegionEdges:
    """Edges between regions, found again on each pass: storing all could take more than the cloud.

    Edges of a cloud of one chunk are stored. ``pairs`` ``(E, 2)`` are the adjacent regions,
    ascending, and ``counts`` ``(E,)`` their edges.
    """

    def __init__(self, labels: Tensor, neighbors: Neighbors, columns: slice = slice(None)) -> None:
        # int32 indexing is three times faster.
        self._labels, self._neighbors, self._columns = labels.to(torch.int32), neighbors, columns
        self._num_regions = max(int(labels.max()) + 1, 1) if len(labels) else 1
        at_once = limit_rows(ROWS_IN_CACHE, neighbors.indices.shape[1])
        rows = nonzero_rows(self._labels >= 0).to(torch.int32)
        self._chunks = torch.split(rows, at_once)
        self._kept = self._find(rows) if len(self._chunks) == 1 else None
        if self._kept is None:
            found = self._map(lambda edges: (torch.unique_consecutive(edges[0]), edges[3].clone()))
            rows, keys = (torch.cat(parts) for parts in zip(*found, strict=True))
            self._chunks = torch.split(rows, at_once)
        else:
            keys = self._kept[3]
        if self._num_regions**2 <= len(labels):
            # A table of all pairs is faster than a sort.
            table = torch.bincount(keys)
            keys, ranks = nonzero_rows(table), (table > 0).cumsum(0) - 1
            self.counts, self._index = table[keys], partial(torch.index_select, ranks, 0)
        else:
            keys, self.counts = torch.unique(keys, return_counts=True)
            self._index = partial(torch.searchsorted, keys)
        self.pairs = torch.stack([keys // self._num_regions, keys % self._num_regions], dim=1)

    def _find(self, rows: Tensor) -> list[Tensor]:
        """Return end points and columns of the edges of points, and the keys of their pairs."""
        low, high, _ = self._columns.indices(self._neighbors.indices.shape[1])
        width = max(high - low, 1)
        if kernels.serve(self._labels, *self._neighbors):
            where = self._labels, *self._neighbors, rows, low, high, self._num_regions
            *edges, count = kernels.call("crossing_edges", *where)
            scratch.release()
            return [values.view(-1)[: int(count)] for values in edges]
        near = self._neighbors.select(rows)
        scratch.release()
        chosen = nonzero_rows(_crosses(self._labels, rows, near, self._columns))
        source = rows.index_select(0, chosen // width)
        targets = near.indices[:, self._columns].reshape(-1).index_select(0, chosen)
        ends = torch.stack([self._labels.index_select(0, end) for end in (source, targets)])
        keys = ends.amin(dim=0).long() * self._num_regions + ends.amax(dim=0)
        return [source, targets, chosen % width, keys]

    def _map(self, work: Callable[[list[Tensor]], Returned]) -> Iterator[Returned]:
        """Yield the results of ``work`` for all edges in order, one chunk of points at a time."""

        def find(rows: Tensor) -> Returned:
            return work(self._kept or self._find(rows))

        for batch in split_rows(len(self._chunks), _CHUNKS_AT_ONCE):
            yield from map_tasks(find, self._chunks[batch], self._labels.device)

    def map_contacts(self, work: Callable[[_Contacts], Returned]) -> Iterator[Returned]:
        """Yield the results of ``work`` for the edges of each chunk of points, in order."""
        return self._map(lambda edges: work(_Contacts(self._index(edges[3]), *edges[:3])))


def _crosses(labels: Tensor, rows: Rows, near: Neighbors, columns: slice) -> Tensor:
    """Return a mask of the neighbors of points in another region."""
    valid = None if near.valid is None else near.valid[:, columns]
    near = Neighbors(near.indices[:, columns], valid)
    other = near.gather(labels)
    crosses = (other != labels[rows, None]) & (other >= 0)
    return crosses if valid is None else crosses & valid


def _select(contacts: _Contacts, chosen: Tensor) -> _Contacts:
    """Return the selected edges."""
    rows = nonzero_rows(chosen)
    return _Contacts(*(values.index_select(0, rows) for values in contacts))


def _edge_vectors(points: Tensor, contacts: _Contacts) -> Tensor:
    """Return the edges as vectors ``(n, 3)`` in float64."""
    start, end = (points.index_select(0, rows) for rows in (contacts.source, contacts.target))
    return end.double() - start.double()


def _length_on_line(points: Tensor, edges: _RegionEdges, along: Tensor, spacing: Tensor) -> Tensor:
    """Return the length of each pair's line covered by edge midpoints, shape ``(E,)``."""
    origin = points[:1].double()

    def find_cells(contacts: _Contacts) -> tuple[Tensor, ...]:
        if kernels.serve(points, contacts.source):
            size = 2 ** (2 * len(contacts.pair)).bit_length()
            slots = contacts.pair.new_empty(size, dtype=torch.int32)
            lines = contacts.source, contacts.target, contacts.pair, along.double(), spacing
            *found, count = kernels.call("line_cells", points, *lines, _MAX_CELL, slots)
            return tuple(values[: int(count)].clone() for values in found)
        contacts = _select(contacts, spacing[contacts.pair].isfinite())
        ends = (contacts.source, contacts.target)
        start, end = (points.index_select(0, rows).double() - origin for rows in ends)
        position = ((start + end) / 2 * along[contacts.pair]).sum(dim=1) / spacing[contacts.pair]
        cell = position.nan_to_num(0, 0, 0).clamp(-_MAX_CELL, _MAX_CELL).floor().long()
        return unique_cells(contacts.pair, cell)

    pair, cell = unique_cells(*map(torch.cat, zip(*edges.map_contacts(find_cells), strict=True)))
    # An interval of n cells on average meets n + 1: count the steps from cell to cell.
    is_next = (pair[1:] == pair[:-1]) & (cell[1:] == cell[:-1] + 1)
    steps = torch.bincount(pair[1:][is_next], minlength=len(spacing))
    return steps * torch.where(spacing.isfinite(), spacing, 0.0)


def unique_cells(owner: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct cells of each owner, ascending."""
    # Cell ranks fit into one integer with the owner; indices of distant cells do not.
    cells, rank = torch.unique(cell, return_inverse=True)
    width = max(len(cells), 1)
    keys = torch.unique(owner * width + rank)
    return keys // width, cells[keys % width]


def _contact_radii(points: Tensor, neighbors: Neighbors, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance to the last contact neighbor of each point, and their number."""
    nearest = KnnAdjacency(neighbors).neighbors.select(rows)
    count = nearest.mask().sum(dim=1)
    last = nearest.indices.gather(1, (count - 1).clamp(min=0)[:, None]).squeeze(1)
    return (points[last].double() - points[rows].double()).norm(dim=1), count
