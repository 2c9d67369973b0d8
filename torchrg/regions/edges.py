"""The graph that regions grow in: edges from points to the neighbours that all criteria accept."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._parallel import allowed_threads, chunks_of, map_tasks, places_of
from torchrg.config import GrowingConfig
from torchrg.errors import ConfigError, ShapeError
from torchrg.regions.criteria import (
    GrowingCloud,
    Rows,
    are_coplanar,
    are_valid,
    neighborhood_radii,
    on_planes,
    within_angle,
    within_distance,
)
from torchrg.regions.shared_neighbors import SharedNeighbors, min_shared_neighbors
from torchrg.structures import Neighbors

_CHUNKS_A_THREAD = 4
"""Chunks tested before any is stored: threads wait for each other only so often."""


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
    targets, counts = zip(*(others[start] for start in sorted(others)), strict=True)
    starts = np.concatenate([[0], *counts]).cumsum()
    return edges, EdgeLists(starts, np.concatenate(targets))


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


def checked_cloud(
    config: GrowingConfig,
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    curvature: Tensor | NDArray[np.floating],
    neighbors: Neighbors,
    valid: Tensor | None,
    colors: Tensor | NDArray[np.generic] | None,
    residual_rms: Tensor | NDArray[np.floating] | None,
) -> GrowingCloud:
    """Check what the user passed to :func:`torchrg.grow_regions`, in the order it came in."""
    caller = "grow_regions"
    points = as_tensor(caller, "points", points).detach()
    normals = as_tensor(caller, "normals", normals).detach()
    curvature = as_tensor(caller, "curvature", curvature).detach()
    valid = None if valid is None else as_tensor(caller, "valid", valid)
    colors = None if colors is None else as_tensor(caller, "colors", colors)
    check_shapes(
        caller,
        points=(points, "N 3"),
        normals=(normals, "N 3"),
        curvature=(curvature, "N"),
        neighbors=(neighbors.indices, "N K"),
        neighbors_valid=(neighbors.valid, "N K"),
        valid=(valid, "N"),
        colors=(colors, "N C"),
    )
    check_floating(caller, points=points, normals=normals, curvature=curvature)
    if valid is not None and valid.dtype != torch.bool:
        raise ShapeError(f"{caller}: expected valid of bool, got {valid.dtype}.")
    if neighbors.indices.device != points.device:
        raise ShapeError(
            f"{caller}: expected points and neighbors on one device, got {points.device} and "
            f"{neighbors.indices.device}."
        )
    if config.max_color_distance is not None and colors is None:
        raise ConfigError(
            f"{caller}: expected colors, which max_color_distance needs, got None; pass them or "
            "set max_color_distance to None."
        )
    reach = None
    if config.plane_reach is not None:
        if residual_rms is None:
            raise ConfigError(
                f"{caller}: expected residual_rms, which plane_reach needs, got None; pass that of "
                "the normals or set plane_reach to None."
            )
        residual_rms = as_tensor(caller, "residual_rms", residual_rms).detach()
        check_shapes(caller, points=(points, "N 3"), residual_rms=(residual_rms, "N"))
        check_floating(caller, points=points, residual_rms=residual_rms)
        # Where the fit is exact nothing is known of the noise.
        floor = config.coplanarity_floor * neighborhood_radii(points, neighbors)
        reach = torch.where(residual_rms > floor, config.plane_reach * residual_rms, torch.inf)
    finite = normals.isfinite().all(dim=1) & curvature.isfinite()
    valid = finite if valid is None else finite & valid
    colors = None if colors is None else _by_column(colors.to(points.dtype))
    return GrowingCloud(
        _by_column(points), _by_column(normals), curvature, neighbors, valid, colors, reach
    )


def reordered(cloud: GrowingCloud, order: Tensor) -> GrowingCloud:
    """Return the cloud, and the rows its neighbours name, in an order ``(N,)`` of old rows."""
    row_of = torch.empty(len(order), dtype=torch.int32, device=order.device)
    row_of[order] = torch.arange(len(order), dtype=torch.int32, device=order.device)
    indices = cloud.neighbors.indices[order]
    indices = row_of.index_select(0, indices.reshape(-1)).view(indices.shape)
    mask = cloud.neighbors.valid
    return GrowingCloud(
        _by_column(cloud.points[order]),
        _by_column(cloud.normals[order]),
        cloud.curvature[order],
        Neighbors(indices, None if mask is None else mask[order]),
        cloud.valid[order],
        None if cloud.colors is None else _by_column(cloud.colors[order]),
        None if cloud.reach is None else cloud.reach[order],
    )


def _by_column(vectors: Tensor) -> Tensor:
    """Return vectors ``(N, C)`` laid out column by column."""
    return vectors.T.contiguous().T
