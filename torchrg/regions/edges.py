"""The edges that regions grow along: from points to the neighbours that all criteria accept.

A criterion is a function that tests the edges from some points, ``rows``, to their K neighbours,
and returns which of them pass, shape ``(n, K)``, bool. A new one is a setting, a function here, and
the line of :func:`accept_edges` that calls it.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import allowed_threads, chunks_of, map_tasks, places_of
from torchrg.config import GrowingConfig
from torchrg.linalg import deg_to_sq_chord, sq_chords
from torchrg.neighbors import gather_patches
from torchrg.regions.shared_neighbors import SharedNeighbors, min_shared_neighbors
from torchrg.robust import median, qn
from torchrg.structures import Neighbors

EDGE_STEPS = 2
"""Steps from neighbour to neighbour, from a point, to all points that decide its edges. A part of a
cloud with those around it has the same edges: the criteria read the neighbours of both ends."""

_CHUNKS_A_THREAD = 4
"""Chunks tested before any is stored: threads wait for each other only so often."""


Rows = slice | Tensor
"""A block of points, or the rows of some."""


class GrowingCloud(NamedTuple):
    """What growth reads: a cloud in canonical order with everything known about its points.

    Coordinates and normals are fast to gather when each column is contiguous.

    Attributes:
        points: Shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``.
        curvature: Shape ``(N,)``.
        neighbors: Neighbours of each point.
        valid: Points that may belong to a region, shape ``(N,)``, bool.
        colors: Shape ``(N, C)``, floating point, or None.
        reach: Distance from its plane within which a neighbour lies on it, shape ``(N,)``, infinite
            where that is not known, or None.
    """

    points: Tensor
    normals: Tensor
    curvature: Tensor
    neighbors: Neighbors
    valid: Tensor
    colors: Tensor | None = None
    reach: Tensor | None = None


class EdgeLists(NamedTuple):
    """Edges of a directed graph in compressed rows.

    The edges of point i are ``starts[i]`` to ``starts[i + 1]``. Of the targets, or codes of
    targets, ``starts[N]`` are used: what is behind them is room for more.
    """

    starts: NDArray[np.signedinteger]
    targets: NDArray[np.int32]


def find_coded_edges(
    cloud: GrowingCloud, config: GrowingConfig, limit: Tensor, *, chunk_size: int
) -> tuple[EdgeLists, NDArray[np.bool_] | None]:
    """Return all edges with targets as ``2 * row + (whether the target becomes a seed)``.

    With late promotion these are only the edges that do make a seed. Then there is a second result:
    which neighbours a point merely claims, shape ``(N, K)``; these are most edges, and lists of
    them would take more time and memory. ``limit`` is that of the curvature, a scalar. Chunks of
    every size give the same edges.
    """
    shared = _shared_neighbors(cloud, config)
    indices = cloud.neighbors.indices
    claims = np.empty(indices.shape, dtype=bool) if config.promotes_late else None

    def find(rows: slice) -> _Edges:
        joins, connected = accept_edges(cloud, config, rows, _connect(shared, rows))
        becomes_seed = _become_seeds(cloud, config, rows, limit, connected)
        if claims is not None:
            claims[rows] = (joins & ~becomes_seed).cpu().numpy()
            joins &= becomes_seed
        return _pick((indices[rows].to(torch.int32) * 2).add_(becomes_seed), joins)

    return _pack(find, cloud, spare=0, chunk_size=chunk_size), claims


def find_edges(
    cloud: GrowingCloud, config: GrowingConfig, limit: Tensor, *, spare: int, chunk_size: int
) -> tuple[EdgeLists, EdgeLists]:
    """Return the edges between points of at most the curvature limit, which spread; all others'.

    The first have room for some spare edges, the second are coded as :func:`find_coded_edges` does.
    Chunks of every size give the same edges.
    """
    shared = _shared_neighbors(cloud, config)
    spreads = cloud.curvature <= limit
    others: dict[int, _Edges] = {}

    def find(rows: slice) -> _Edges:
        joins, _ = accept_edges(cloud, config, rows, _connect(shared, rows))
        targets = cloud.neighbors.indices[rows]
        others[rows.start] = _pick(targets.to(torch.int32) * 2, joins & ~spreads[rows, None])
        return _pick(targets, joins & spreads[rows, None])

    edges = _pack(find, cloud, spare=spare, chunk_size=chunk_size)
    rest = [_Edges(np.empty(0, np.int32), np.zeros(1, np.int64))]
    rest += (others[start] for start in sorted(others))
    targets, counts = zip(*rest, strict=True)
    return edges, EdgeLists(np.concatenate(counts).cumsum(), np.concatenate(targets))


def _become_seeds(
    cloud: GrowingCloud,
    config: GrowingConfig,
    rows: slice,
    limit: Tensor,
    connected: Tensor | None,
) -> Tensor:
    """Tell which neighbours of some points become seeds by the edge from the point, ``(n, K)``."""
    indices = cloud.neighbors.indices[rows]
    target = cloud.curvature.index_select(0, indices.reshape(-1)).view(indices.shape)
    if config.seed_rule == "increment":
        becomes_seed = (target - cloud.curvature[rows, None]).abs() <= limit
    else:
        becomes_seed = target <= limit
    if connected is not None and config.connectivity_scope == "seed":
        becomes_seed &= connected
    return becomes_seed


def accept_edges(
    cloud: GrowingCloud,
    config: GrowingConfig,
    rows: Rows,
    connect: Callable[[Tensor], Tensor] | None,
) -> tuple[Tensor, Tensor | None]:
    """Tell which neighbours of some points pass all criteria that are on, cheap ones first.

    Returns whether the neighbour joins the region of the point, shape ``(n, K)``, bool; and whether
    the two are connected, only settled where it joins, None without ``connect``, which tells it of
    the edges that it is asked for.
    """
    joins = are_valid(cloud, rows)
    joins &= within_angle(cloud, rows, config.max_angle_deg, signed=config.signed_normals)
    if config.max_distance is not None:
        joins &= within_distance(cloud, rows, cloud.points, config.max_distance)
    if config.max_color_distance is not None and cloud.colors is not None:
        joins &= within_distance(cloud, rows, cloud.colors, config.max_color_distance)
    if cloud.reach is not None:
        joins &= on_planes(cloud, rows, cloud.reach)
    connected: Tensor | None = None
    if config.coplanarity:
        if connect is not None and config.coplanarity_scope == "connected":
            counted = cloud.neighbors.valid
            everyone = torch.ones_like(joins) if counted is None else counted[rows]
            connected = connect(everyone)
        asked = joins if cloud.reach is None else joins & cloud.reach[rows, None].isinf()
        joins &= ~asked | are_coplanar(cloud, rows, asked, connected, config.coplanarity_floor)
    if connect is not None:
        if connected is None:
            connected = connect(joins)
        if config.connectivity_scope == "region":
            joins &= connected
    return joins, connected


def _connect(shared: SharedNeighbors | None, rows: slice) -> Callable[[Tensor], Tensor] | None:
    """Return the test of connectivity of a block of points."""
    return None if shared is None else partial(shared.connected, rows)


def _shared_neighbors(cloud: GrowingCloud, config: GrowingConfig) -> SharedNeighbors | None:
    """Return the test of connectivity, eq. (10), None where it is off."""
    if config.connectivity is None:
        return None
    k = cloud.neighbors.indices.shape[1]
    return SharedNeighbors(cloud.neighbors, min_shared_neighbors(config.connectivity, k))


class _Edges(NamedTuple):
    """Accepted edges of some points, in the order of points and columns; how many each has."""

    targets: NDArray[np.int32]
    counts: NDArray[np.signedinteger]


def _pick(targets: Tensor, accepted: Tensor) -> _Edges:
    """Return the accepted ones of targets ``(n, K)``."""
    chosen = targets.reshape(-1).index_select(0, places_of(accepted)).to(torch.int32)
    return _Edges(chosen.cpu().numpy(), np.count_nonzero(accepted.cpu().numpy(), axis=1))


def _pack(
    find: Callable[[slice], _Edges], cloud: GrowingCloud, *, spare: int, chunk_size: int
) -> EdgeLists:
    """Collect the edges of successive chunks, found by as many threads as torch uses."""
    num_points, k = cloud.neighbors.indices.shape
    # As long as it can get: memory that is not used is not touched.
    targets = np.empty(num_points * k + spare, dtype=np.int32)
    starts: NDArray[np.signedinteger]
    starts = np.zeros(num_points + 1, dtype=np.int32 if len(targets) < 2**31 else np.int64)
    chunks = chunks_of(num_points, chunk_size)
    at_once = _CHUNKS_A_THREAD * allowed_threads()
    used = 0
    for first in range(0, len(chunks), at_once):
        group = chunks[first : first + at_once]
        for rows, edges in zip(group, map_tasks(find, group, cloud.points.device), strict=True):
            targets[used : used + len(edges.targets)] = edges.targets
            starts[rows.start + 1 : rows.stop + 1] = used + np.cumsum(edges.counts)
            used += len(edges.targets)
    return EdgeLists(starts, targets)


def are_valid(cloud: GrowingCloud, rows: Rows) -> Tensor:
    """Tell which edges lead from one valid point to another one that is its neighbour."""
    indices, counted = cloud.neighbors
    own = rows
    if isinstance(own, slice):
        own = torch.arange(own.start, own.stop, device=indices.device)
    passed = _of_neighbors(cloud, rows, cloud.valid) & cloud.valid[rows, None]
    passed &= indices[rows] != own[:, None]
    return passed if counted is None else passed & counted[rows]


def within_angle(cloud: GrowingCloud, rows: Rows, max_angle_deg: float, *, signed: bool) -> Tensor:
    """Tell which neighbours' normals are within an angle of the point's, eq. (8)."""
    if max_angle_deg >= 90 and not signed:
        return torch.ones_like(cloud.neighbors.indices[rows], dtype=torch.bool)
    columns = cloud.normals.unbind(dim=1)
    own = [column[rows, None] for column in columns]
    theirs = [_of_neighbors(cloud, rows, column) for column in columns]
    return sq_chords(own, theirs, signed=signed) <= deg_to_sq_chord(max_angle_deg)


def within_distance(cloud: GrowingCloud, rows: Rows, values: Tensor, limit: float) -> Tensor:
    """Tell which neighbours' values ``(N, C)``, places or colours, are within a distance."""
    total = values.new_zeros(())
    for column in values.unbind(dim=1):
        difference = _of_neighbors(cloud, rows, column) - column[rows, None]
        total = difference.mul_(difference).add_(total)
    return total <= limit**2


def on_planes(cloud: GrowingCloud, rows: Rows, reach: Tensor) -> Tensor:
    """Tell which neighbours are within reach ``(N,)`` of the point's plane, and it of theirs."""
    own = theirs = cloud.points.new_zeros(())
    columns = zip(cloud.points.unbind(dim=1), cloud.normals.unbind(dim=1), strict=True)
    for place, normal in columns:
        away = _of_neighbors(cloud, rows, place) - place[rows, None]
        own = (away * normal[rows, None]).add_(own)
        theirs = away.mul_(_of_neighbors(cloud, rows, normal)).add_(theirs)
    on_own = own.abs_() <= reach[rows, None]
    return on_own & (theirs.abs_() <= _of_neighbors(cloud, rows, reach))


def are_coplanar(
    cloud: GrowingCloud,
    rows: Rows,
    asked: Tensor,
    compared: Tensor | None,
    floor_fraction: float,
) -> Tensor:
    """Tell which neighbours are on the point's plane by eq. (11), False where not asked.

    The limit is taken over the neighbours ``compared``, shape ``(n, K)``, default all; its floor is
    a fraction of the distance to the farthest neighbour.
    """
    needed = (asked.sum(dim=1) > 0).nonzero().squeeze(-1)
    indices, mask = cloud.neighbors
    patches = gather_patches(cloud.points, indices[rows][needed])
    counted = None if mask is None else mask[rows][needed]
    residuals = plane_residuals(patches, cloud.normals[rows][needed])
    floor = floor_fraction * patch_radii(patches, counted)
    limits = coplanarity_limits(residuals, floor, counted if compared is None else compared[needed])
    result = torch.zeros_like(asked)
    result[needed] = residuals <= limits[:, None]
    return result


def _of_neighbors(cloud: GrowingCloud, rows: Rows, values: Tensor) -> Tensor:
    """Return the values ``(N,)`` of the points' neighbours, shape ``(n, K)``."""
    indices = cloud.neighbors.indices[rows]
    return values.index_select(0, indices.reshape(-1)).view(indices.shape)


def plane_residuals(patches: Tensor, normals: Tensor) -> Tensor:
    """Return ``|(p_j - p_i) . n_i|``, shape ``(n, K)``, below eq. (10), of patches about p_i."""
    x, y, z = patches.unbind(dim=-1)
    a, b, c = normals[:, :, None].unbind(dim=1)
    result = x * a
    result += y * b
    result += z * c
    return result.abs_()


def coplanarity_limits(residuals: Tensor, floor: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the largest residual ``(n,)`` of a coplanar neighbour, eq. (11).

    :math:`\gamma_{th} = \mathrm{median}(\gamma) + 2 \max(Q_n(\gamma), \mathrm{floor})`. The paper
    has no floor. Without one, the limit of a neighbourhood where most residuals are equal (exact
    or quantised coordinates) is their median, and the wall shatters.
    """
    scale = torch.maximum(qn(residuals, mask=mask), floor)
    return median(residuals, mask=mask) + 2 * scale


def neighborhood_radii(points: Tensor, neighbors: Neighbors) -> Tensor:
    """Return the distance of each point to its last neighbour, shape ``(N,)``."""
    indices, counted = neighbors
    last = torch.full_like(indices[:, :1], indices.shape[1] - 1)
    if counted is not None:
        last = counted.sum(dim=1, keepdim=True, dtype=last.dtype).sub_(1).clamp_(min=0)
    ends = torch.cat([indices[:, :1], indices.gather(1, last.long())], dim=1)
    return patch_radii(gather_patches(points, ends))


def patch_radii(patches: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the distance from each point to its farthest neighbour that counts, shape ``(n,)``."""
    x, y, z = patches.unbind(dim=-1)
    sq_distances = x * x
    sq_distances += y * y
    sq_distances += z * z
    if mask is not None:
        sq_distances = torch.where(mask, sq_distances, 0.0)
    return sq_distances.amax(dim=-1).sqrt()
