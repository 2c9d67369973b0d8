"""Region adjacency: pairs of planes that meet, boundary lengths and angles."""

import math
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import (
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
    return PlaneAdjacency(pairs[meets], length[meets], angle[meets])


class KnnAdjacency:
    """Adjacency of a point cloud: up to 8 nearest neighbors per point."""

    def __init__(self, neighbors: Neighbors) -> None:
        columns, valid = slice(1, NUM_CONTACTS + 1), neighbors.valid
        valid = None if valid is None else valid[:, columns]
        self.neighbors = Neighbors(neighbors.indices[:, columns], valid)
        self._points = neighbors.indices[:, :1]

    def neighbor_rows(self, rows: Rows) -> Tensor:
        """Return the neighbors of the given points, shape ``(n, 8)``, padded with the point."""
        near, counted = self.neighbors.select(rows)
        return near if counted is None else torch.where(counted, near, self._points[rows])

    def frontier(self, candidates: Tensor, changed: Tensor) -> Tensor:
        """Return the candidates that have a changed neighbor."""
        num_points = len(self.neighbors.indices)
        is_changed = torch.zeros(num_points, dtype=torch.bool, device=candidates.device)
        is_changed[changed] = True
        return candidates[is_changed[self.neighbor_rows(candidates)].any(dim=1)]

    def contacts(self, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Apply :func:`find_region_pairs` to the nearest neighbors."""
        return find_region_pairs(labels, self.neighbors)


def find_region_pairs(labels: Tensor, neighbors: Neighbors) -> tuple[Tensor, Tensor]:
    """Return pairs of adjacent regions and the number of edges between them.

    For labels ``(N,)``, negative if unlabeled: pairs ``(E, 2)``, smaller label first, ascending,
    and counts ``(E,)``.
    """
    edges = _RegionEdges(labels, neighbors)
    return edges.pairs, edges.counts


class _Contacts(NamedTuple):
    """Edges between regions: pair index, end points, and column in the neighbor lists."""

    pair: Tensor
    source: Tensor
    target: Tensor
    column: Tensor


class _RegionEdges:
    """Edges between regions, recomputed on each pass: storing all could take more than the cloud.

    ``pairs`` ``(E, 2)`` are the adjacent regions, ascending, and ``counts`` ``(E,)`` their edges.
    """

    def __init__(self, labels: Tensor, neighbors: Neighbors) -> None:
        # int32 indexing is three times faster.
        self._labels, self._neighbors = labels.to(torch.int32), neighbors
        self._num_regions = int(labels.max()) + 1 if len(labels) else 0
        self._width = max(neighbors.indices.shape[1], 1)
        self._at_once = limit_rows(ROWS_IN_CACHE, self._width)
        meets = torch.empty_like(labels, dtype=torch.bool)

        def mark(chunk: slice) -> None:
            meets[chunk] = self._at_boundary(chunk)

        map_chunks(mark, len(labels), self._at_once, labels.device)
        self._rows = nonzero_rows(meets).to(torch.int32)
        # Keeping small tensors of every chunk would fragment the heap (glibc).
        counts: Counter[int] = Counter()
        for rows in torch.split(self._rows, self._at_once):
            values = torch.unique(self._boundary_edges(rows)[2], return_counts=True)
            counts.update(dict(zip(*(of_chunk.tolist() for of_chunk in values), strict=True)))
        self._keys = labels.new_tensor(sorted(counts), dtype=torch.int64)
        self.counts = labels.new_tensor([counts[key] for key in sorted(counts)], dtype=torch.int64)
        num_regions = max(self._num_regions, 1)
        self.pairs = torch.stack([self._keys // num_regions, self._keys % num_regions], dim=1)

    def _at_boundary(self, rows: slice) -> Tensor:
        """Return which points have a neighbor in another region, shape ``(n,)``."""
        label, near = self._labels[rows], self._neighbors.select(rows)
        if kernels.serve(label, *near):
            return kernels.call("at_boundary", self._labels, label, *near)[0]
        return self._crossing_neighbors(label, near)[0].any(dim=1)

    def _crossing_neighbors(self, label: Tensor, near: Neighbors) -> tuple[Tensor, Tensor]:
        """Return a mask of the neighbors in another region, and their labels."""
        other = near.gather(self._labels)
        crosses = (other != label[:, None]) & (other >= 0) & (label >= 0)[:, None]
        return crosses if near.valid is None else crosses & near.valid, other

    def _boundary_edges(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the flat list indices of boundary edges, the neighbor lists, and the pairs."""
        label, near = self._labels[rows], self._neighbors.select(rows)
        scratch.release()
        crosses, other = self._crossing_neighbors(label, near)
        flat_index = nonzero_rows(crosses)
        first = label.index_select(0, flat_index // self._width)
        second = other.reshape(-1).index_select(0, flat_index)
        lower, higher = torch.minimum(first, second), torch.maximum(first, second)
        return flat_index, near.indices, lower.long() * self._num_regions + higher

    def map_contacts(self, work: Callable[[_Contacts], Returned]) -> Iterator[Returned]:
        """Yield the results of ``work`` for all edges in order, one chunk of points at a time."""

        def find(rows: Tensor) -> Returned:
            flat_index, targets, keys = self._boundary_edges(rows)
            source, column = flat_index // self._width, flat_index % self._width
            targets = targets.reshape(-1).index_select(0, flat_index)
            pair = torch.searchsorted(self._keys, keys)
            return work(_Contacts(pair, rows.index_select(0, source), targets, column))

        chunks = torch.split(self._rows, self._at_once)
        for batch in split_rows(len(chunks), _CHUNKS_AT_ONCE):
            yield from map_tasks(find, chunks[batch], self._rows.device)


def _select(contacts: _Contacts, chosen: Tensor) -> _Contacts:
    """Return the selected edges."""
    rows = chosen.nonzero().squeeze(1)
    return _Contacts(*(values.index_select(0, rows) for values in contacts))


def _edge_vectors(points: Tensor, contacts: _Contacts) -> Tensor:
    """Return the edges as vectors ``(n, 3)`` in float64."""
    start, end = (points.index_select(0, rows) for rows in (contacts.source, contacts.target))
    return end.double() - start.double()


def _length_on_line(points: Tensor, edges: _RegionEdges, along: Tensor, spacing: Tensor) -> Tensor:
    """Return the length of each pair's line covered by edge midpoints, shape ``(E,)``."""
    origin = points[:1].double()
    cells = array("q"), array("q")

    def find_cells(contacts: _Contacts) -> tuple[Tensor, Tensor]:
        contacts = _select(contacts, spacing[contacts.pair].isfinite())
        ends = (contacts.source, contacts.target)
        start, end = (points.index_select(0, rows).double() - origin for rows in ends)
        position = ((start + end) / 2 * along[contacts.pair]).sum(dim=1) / spacing[contacts.pair]
        cell = position.nan_to_num(0, 0, 0).clamp(-_MAX_CELL, _MAX_CELL).floor().long()
        return unique_cells(contacts.pair, cell)

    for found in edges.map_contacts(find_cells):
        for indices, values in zip(cells, found, strict=True):
            indices.frombytes(values.cpu().numpy().tobytes())
    columns = (torch.from_numpy(np.array(indices)).to(points.device) for indices in cells)
    pair, cell = unique_cells(*columns)
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
