"""Which planes meet, along which length, and at which angle."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, places_of
from torchrg.linalg import unsigned_angle_deg
from torchrg.structures import Neighbors, PlaneAdjacency

_NUM_CONTACTS = 8
"""So many neighbours surround a point of a surface; more reach across gaps."""

_LEAST_CONTACTS = 3
"""Regions that touch in fewer edges do not meet: one may be an outlier's."""

_PARALLEL_DEG = 15.0
"""At a smaller angle the line in which two planes cross may be far from where they meet."""

_REACH = 4.0
_MAX_STEEPNESS = 0.25
"""An edge that leads farther across the planes than this many times their thickness, and than a
quarter of the way to the 8th neighbour, leads to a parallel surface."""


def find_adjacency(
    points: Tensor,
    labels: Tensor,
    neighbors: Neighbors,
    normal: Tensor,
    thickness: Tensor,
    *,
    curved: Tensor,
) -> PlaneAdjacency:
    r"""Find pairs of regions that meet, and measure where they do.

    Flat regions at an angle meet along the line in which their planes cross: the neighbours of one
    in the other, however narrow the strip without labels between them, are projected onto it. Their
    extent there, gaps left out, is the length. Of parallel or curved regions only the 8 nearest
    neighbours count, and the length is that of a curve that so many edges cross: with density
    :math:`\rho` and n edges from each point a curve of length L meets edges with
    :math:`\sum 1 / |e| = 2 n \rho L / \pi` (Cauchy and Crofton) [1].

    The planes have unit normals ``(M, 3)`` and a standard deviation of their points
    (``thickness``, ``(M,)``); ``curved`` tells which regions are not flat. The pairs are in
    float64; regions that touch in less than three edges do not meet.

    References:
        [1] L. Santalo. Integral Geometry and Geometric Probability. Addison-Wesley, 1976.
    """
    pairs, contacts = _find_contacts(labels, neighbors.indices, neighbors.valid)
    first, second = normal[pairs[:, 0]], normal[pairs[:, 1]]
    angle = unsigned_angle_deg(first, second)
    crossing = (angle > _PARALLEL_DEG) & ~curved[pairs].any(dim=1)
    is_crossing = crossing[contacts.pair]
    on_lines = _select(contacts, is_crossing)
    on_curves = _select(contacts, ~is_crossing & (contacts.column <= _NUM_CONTACTS))
    edge = points[on_curves.target].double() - points[on_curves.source].double()
    across = torch.stack([(edge * side[on_curves.pair]).sum(dim=1) for side in (first, second)])
    spacing, num_nearest = _contact_radii(points, neighbors, on_curves.source)
    reach = (_REACH * thickness[pairs].amax(dim=1))[on_curves.pair]
    flat = across.abs().amax(dim=0) <= torch.maximum(reach, _MAX_STEEPNESS * spacing)
    on_curves = _select(on_curves, flat)
    size = edge.norm(dim=1)
    share = math.pi**2 * spacing * spacing / (2 * num_nearest * num_nearest * size)
    share = torch.where(size > 0, share, 0.0)
    num_contacts = torch.bincount(torch.cat([on_lines.pair, on_curves.pair]), minlength=len(pairs))
    along = torch.linalg.cross(first, second)
    length = torch.where(
        crossing,
        _length_on_line(points, on_lines, along / along.norm(dim=1, keepdim=True), len(pairs)),
        _sum_of(on_curves.pair, share[flat], len(pairs)),
    )
    kept = num_contacts >= _LEAST_CONTACTS
    return PlaneAdjacency(pairs[kept], length[kept], angle[kept])


def contact_neighbors(neighbors: Neighbors) -> tuple[Tensor, Tensor]:
    """Return the (at most) 8 nearest neighbours of each point ``(N, n)``, and which count."""
    nearest = neighbors.indices[:, 1 : _NUM_CONTACTS + 1]
    if neighbors.valid is None:
        everyone = torch.ones((), dtype=torch.bool, device=nearest.device)
        return nearest, everyone.expand(nearest.shape)
    return nearest, neighbors.valid[:, 1 : _NUM_CONTACTS + 1]


def count_contacts(labels: Tensor, neighbors: Neighbors) -> tuple[Tensor, Tensor]:
    """Return the pairs of regions that touch, and the number of contacts of each pair.

    Of labels ``(N,)``, negative for none: pairs ``(E, 2)``, the smaller label first, ascending, and
    counts ``(E,)``.
    """
    pairs, contacts = _find_contacts(labels, *contact_neighbors(neighbors))
    return pairs, torch.bincount(contacts.pair, minlength=len(pairs))


class _Contacts(NamedTuple):
    """Edges between regions: numbers of their pairs, ends of the edges, columns in the lists."""

    pair: Tensor
    source: Tensor
    target: Tensor
    column: Tensor


def _find_contacts(
    labels: Tensor, targets: Tensor, counted: Tensor | None
) -> tuple[Tensor, _Contacts]:
    """Return the pairs of regions with an edge between them, ascending, and these edges."""
    num_regions = int(labels.max()) + 1 if len(labels) else 0
    narrow = labels.to(torch.int32)
    found = []
    for start in range(0, max(len(labels), 1), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        target, own = targets[rows].reshape(-1), narrow[rows]
        other = narrow.index_select(0, target).view(targets[rows].shape)
        touches = (other != own[:, None]) & (other >= 0) & (own >= 0)[:, None]
        if counted is not None:
            touches &= counted[rows]
        places = places_of(touches)
        source, column = places // touches.shape[1], places % touches.shape[1]
        first, second = own[source].long(), other.reshape(-1)[places].long()
        key = torch.minimum(first, second) * num_regions + torch.maximum(first, second)
        found.append((key, source + start, target[places].long(), column))
    keys, sources, targets, columns = (torch.cat(parts) for parts in zip(*found, strict=True))
    numbers, pair = torch.unique(keys, return_inverse=True)
    width = max(num_regions, 1)
    pairs = torch.stack([numbers // width, numbers % width], dim=1)
    return pairs, _Contacts(pair, sources, targets, columns)


def _select(contacts: _Contacts, chosen: Tensor) -> _Contacts:
    """Return the chosen ones of the edges."""
    rows = chosen.nonzero().squeeze(1)
    return _Contacts(*(values.index_select(0, rows) for values in contacts))


def _length_on_line(points: Tensor, contacts: _Contacts, along: Tensor, num_pairs: int) -> Tensor:
    """Return how much of a line the middles of each pair's edges cover, shape ``(E,)``."""
    origin = points[:1].double()
    start, end = (points[rows].double() - origin for rows in (contacts.source, contacts.target))
    size = _sum_of(contacts.pair, (end - start).norm(dim=1), num_pairs)
    size = size / torch.bincount(contacts.pair, minlength=num_pairs)
    place = ((start + end) / 2 * along[contacts.pair]).sum(dim=1) / size[contacts.pair]
    cell = torch.where(place.isfinite(), place, 0.0).floor().long()
    low = int(cell.min()) if len(cell) else 0
    width = int(cell.max()) - low + 2 if len(cell) else 1
    keys = torch.unique(contacts.pair * width + (cell - low))
    owner = keys // width
    is_next = torch.zeros(len(keys), dtype=torch.float64, device=points.device)
    is_next[1:] = (keys[1:] == keys[:-1] + 1).double()
    # An interval of n cells on average meets n + 1: count the steps from cell to cell.
    steps = _sum_of(owner, is_next, num_pairs)
    return steps * torch.where(size.isfinite(), size, 0.0)


def _contact_radii(points: Tensor, neighbors: Neighbors, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance to the last of the contact neighbours of points, and their number."""
    mask = neighbors.valid
    nearest, counted = contact_neighbors(
        Neighbors(neighbors.indices[rows], None if mask is None else mask[rows])
    )
    number = counted.sum(dim=1)
    last = nearest.gather(1, (number - 1).clamp(min=0)[:, None]).squeeze(1)
    return (points[last].double() - points[rows].double()).norm(dim=1), number


def _sum_of(owner: Tensor, values: Tensor, num_owners: int) -> Tensor:
    """Return the sum of the values of each owner, one after the other."""
    order = owner.argsort(stable=True)
    counts = torch.bincount(owner, minlength=num_owners)
    if num_owners == 0:
        return values[:0]
    return torch.segment_reduce(values[order].contiguous(), "sum", lengths=counts)
