"""The accepted edges of a block of points: all criteria, the cheap ones first."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._parallel import chunks_of, map_tasks, places_of
from torchrg.config import GrowingConfig
from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import gather_patches
from torchrg.regions.criteria import (
    coplanarity_limits,
    neighborhood_radii,
    patch_radii,
    plane_residuals,
    sq_chord_limit,
    sq_chords,
)
from torchrg.regions.shared_neighbors import SharedNeighbors
from torchrg.structures import Neighbors

_BLOCKS_A_THREAD = 4
"""Blocks found before any is stored: threads wait for each other only so often."""


class EdgeLists(NamedTuple):
    """Edges of a directed graph in compressed rows.

    Attributes:
        starts: The edges of point i are ``starts[i]`` to ``starts[i + 1]``, shape ``(N + 1,)``.
        targets: Targets (or codes of targets), shape ``(capacity,)``, of which ``starts[N]`` are
            used: what is behind them is room for more.
    """

    starts: NDArray[np.signedinteger]
    targets: NDArray[np.int32]


class EdgeBlock(NamedTuple):
    """The edges of a block of points.

    Attributes:
        targets: Targets (or codes) of accepted edges, in the order of points and columns, ``(E,)``.
        counts: Number of edges of each point, shape ``(n,)``.
    """

    targets: NDArray[np.int32]
    counts: NDArray[np.signedinteger]


def pack_edges(
    edges_of: Callable[[slice], EdgeBlock],
    num_points: int,
    *,
    capacity: int,
    chunk_size: int,
    device: torch.device,
) -> EdgeLists:
    """Collect the edges of successive blocks of points, several blocks at a time.

    Args:
        edges_of: Gives the edges of a block; called from as many threads as torch uses.
        num_points: Number of points.
        capacity: Length of the array of targets, at least the number of edges. Memory that is not
            used is not touched.
        chunk_size: Points of a block.
        device: Where the edges are found; blocks run side by side only on a CPU.

    Returns:
        The lists, the same for every chunk size.

    Example:
        >>> def to_next(rows):
        ...     targets = np.arange(rows.start, rows.stop, dtype=np.int32) + 1
        ...     return EdgeBlock(targets, np.ones(len(targets), dtype=np.int64))
        >>> lists = pack_edges(
        ...     to_next, 3, capacity=5, chunk_size=2, device=torch.device("cpu")
        ... )
        >>> lists.starts.tolist(), lists.targets[:3].tolist()
        ([0, 1, 2, 3], [1, 2, 3])
    """
    starts: NDArray[np.signedinteger]
    starts = np.zeros(num_points + 1, dtype=np.int32 if capacity < 2**31 else np.int64)
    targets = np.empty(capacity, dtype=np.int32)
    chunks = chunks_of(num_points, chunk_size)
    at_once = _BLOCKS_A_THREAD * max(torch.get_num_threads(), 1)
    used = 0
    for first in range(0, len(chunks), at_once):
        group = chunks[first : first + at_once]
        for rows, block in zip(group, map_tasks(edges_of, group, device), strict=True):
            targets[used : used + len(block.targets)] = block.targets
            starts[rows.start + 1 : rows.stop + 1] = used + np.cumsum(block.counts)
            used += len(block.targets)
    return EdgeLists(starts, targets)


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


def checked_cloud(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    curvature: Tensor | NDArray[np.floating],
    neighbors: Neighbors,
    valid: Tensor | None,
    colors: Tensor | NDArray[np.generic] | None,
) -> GrowingCloud:
    """Check what the user passed to ``grow_regions``, and settle which points are valid.

    Returns:
        The cloud, in the order it came in, without ``reach``.

    Raises:
        ShapeError: If a shape, dtype or device is not as :func:`torchrg.grow_regions` says.
    """
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
    finite = normals.isfinite().all(dim=1) & curvature.isfinite()
    valid = finite if valid is None else finite & valid
    colors = None if colors is None else _by_column(colors.to(points.dtype))
    return GrowingCloud(
        _by_column(points), _by_column(normals), curvature, neighbors, valid, colors
    )


def reordered(cloud: GrowingCloud, order: Tensor) -> GrowingCloud:
    """Return the cloud with its points, and the rows its neighbours name, in another order.

    Args:
        cloud: The cloud.
        order: Old row of each new one, shape ``(N,)``.
    """
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


def plane_reach_of(
    cloud: GrowingCloud, residual_rms: Tensor | NDArray[np.floating] | None, config: GrowingConfig
) -> Tensor:
    """Return how far from each point's plane a neighbour may be.

    Args:
        cloud: The cloud.
        residual_rms: Root mean square distance of the neighbours from the planes, shape ``(N,)``.
        config: Settings, with ``plane_reach``.

    Returns:
        Shape ``(N,)``: so many times the residual; infinite where the fit is exact, which is to say
        that nothing is known of the noise.

    Raises:
        ConfigError: If the residuals are missing.
        ShapeError: If their shape or dtype is not that of the points.
    """
    if residual_rms is None or config.plane_reach is None:
        raise ConfigError(
            "grow_regions: expected residual_rms, which plane_reach needs, got None; pass that of "
            "the normals or set plane_reach to None."
        )
    caller = "grow_regions"
    residual_rms = as_tensor(caller, "residual_rms", residual_rms).detach()
    check_shapes(caller, points=(cloud.points, "N 3"), residual_rms=(residual_rms, "N"))
    check_floating(caller, points=cloud.points, residual_rms=residual_rms)
    floor = config.coplanarity_floor * neighborhood_radii(cloud.points, cloud.neighbors)
    return torch.where(residual_rms > floor, config.plane_reach * residual_rms, torch.inf)


def _by_column(vectors: Tensor) -> Tensor:
    """Return vectors ``(N, C)`` laid out column by column."""
    return vectors.T.contiguous().T


class AcceptedEdges(NamedTuple):
    """Which neighbours of a block of points the criteria accept.

    Attributes:
        joins: Whether the neighbour joins the region of the point, shape ``(n, K)``, bool.
        connected: Whether the two are connected, shape ``(n, K)``, bool; only settled where
            ``joins``. None where connectivity is not tested.
    """

    joins: Tensor
    connected: Tensor | None


def accept_edges(
    cloud: GrowingCloud, config: GrowingConfig, rows: slice, shared: SharedNeighbors
) -> AcceptedEdges:
    """Tell which neighbours of a block of points may join the points' regions.

    Args:
        cloud: The cloud, in canonical order.
        config: Settings; each criterion that is on has to hold.
        rows: The block.
        shared: Counts of common neighbours of the cloud.

    Returns:
        The edges of the block. Those of or to points that are not valid, and those of points to
        themselves, are never accepted.
    """
    indices = cloud.neighbors.indices[rows]
    counted = None if cloud.neighbors.valid is None else cloud.neighbors.valid[rows]
    joins = _is_candidate(cloud, rows, indices)
    if counted is not None:
        joins &= counted
    joins &= _within_angle(cloud.normals, rows, indices, config)
    if config.max_distance is not None:
        sq_distances = _sq_differences(cloud.points, rows, indices)
        joins &= sq_distances <= config.max_distance**2
    if config.max_color_distance is not None and cloud.colors is not None:
        sq_distances = _sq_differences(cloud.colors, rows, indices)
        joins &= sq_distances <= config.max_color_distance**2
    if cloud.reach is not None:
        joins &= _on_planes(cloud, rows, indices, cloud.reach)
    connected: Tensor | None = None
    min_shared = min_shared_neighbors(config.connectivity, indices.shape[1])
    if config.coplanarity:
        if config.coplanarity_scope == "connected":
            everyone = torch.ones_like(joins) if counted is None else counted
            connected = shared.at_least(min_shared, rows, everyone)
        asked = joins if cloud.reach is None else joins & cloud.reach[rows, None].isinf()
        flat = _coplanar(cloud, rows, indices, asked, config.coplanarity_floor, connected)
        joins &= flat | ~asked
    if config.connectivity is None:
        return AcceptedEdges(joins, None)
    if connected is None:
        connected = shared.at_least(min_shared, rows, joins)
    if config.connectivity_scope == "region":
        joins &= connected
    return AcceptedEdges(joins, connected)


def min_shared_neighbors(connectivity: float | None, k: int) -> int:
    """Return the least number of common neighbours of connected points, eq. (10).

    Args:
        connectivity: Fraction of the k neighbours, or None.
        k: Number of neighbours, the point itself included.

    Returns:
        ``ceil(connectivity * k)``, of the decimal fraction that was written (0.07 * 100 is 7, not
        the 7.000000000000001 of binary arithmetic); 0 for None.

    Example:
        >>> min_shared_neighbors(0.75, 50), min_shared_neighbors(0.07, 100)
        (38, 7)
    """
    return 0 if connectivity is None else math.ceil(round(connectivity * k, 9))


class EdgeFinder:
    """Finds the edges of blocks of points, in the form that each way of growing reads.

    Args:
        cloud: The cloud, in canonical order.
        config: Settings.
        limit: Curvature limit, a scalar.
    """

    def __init__(self, cloud: GrowingCloud, config: GrowingConfig, limit: Tensor) -> None:
        self._cloud = cloud
        self._config = config
        self._limit = limit
        self._spreads = cloud.curvature <= limit
        self._shared = SharedNeighbors(cloud.neighbors)
        self._others: dict[int, tuple[NDArray[np.int32], NDArray[np.int32]]] = {}

    def spreading(self, rows: slice) -> EdgeBlock:
        """Return the edges of the block's points that spread, and remember those of the others."""
        joins = accept_edges(self._cloud, self._config, rows, self._shared).joins
        spreads = self._spreads[rows, None]
        targets = self._cloud.neighbors.indices[rows]
        others = joins & ~spreads
        found = _pick(targets, others)
        sources = np.arange(rows.start, rows.stop, dtype=np.int32)
        self._others[rows.start] = np.repeat(sources, found.counts), found.targets
        return _pick(targets, joins & spreads)

    def others(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return sources and targets of the edges of points that do not spread, in order."""
        parts = [self._others[start] for start in sorted(self._others)]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    def coded(self, rows: slice) -> EdgeBlock:
        """Return the block's edges with targets as ``2 * row + (whether it becomes a seed)``."""
        config, curvature = self._config, self._cloud.curvature
        edges = accept_edges(self._cloud, config, rows, self._shared)
        indices = self._cloud.neighbors.indices[rows]
        target = curvature.index_select(0, indices.reshape(-1)).view(indices.shape)
        if config.seed_rule == "increment":
            becomes_seed = (target - curvature[rows, None]).abs() <= self._limit
        else:
            becomes_seed = target <= self._limit
        if edges.connected is not None and config.connectivity_scope == "seed":
            becomes_seed &= edges.connected
        codes = (indices.to(torch.int32) * 2).add_(becomes_seed.to(torch.int32))
        return _pick(codes, edges.joins)


def _pick(targets: Tensor, accepted: Tensor) -> EdgeBlock:
    """Return the accepted ones of targets ``(n, K)``."""
    chosen = targets.reshape(-1).index_select(0, places_of(accepted)).to(torch.int32)
    return EdgeBlock(chosen.cpu().numpy(), np.count_nonzero(accepted.cpu().numpy(), axis=1))


def _is_candidate(cloud: GrowingCloud, rows: slice, indices: Tensor) -> Tensor:
    """Return which entries lead from a valid point to another valid point, shape ``(n, K)``."""
    target_valid = cloud.valid.index_select(0, indices.reshape(-1)).view(indices.shape)
    own = torch.arange(len(cloud.points), device=indices.device)[rows, None]
    return target_valid & cloud.valid[rows, None] & (indices != own)


def _within_angle(normals: Tensor, rows: slice, indices: Tensor, config: GrowingConfig) -> Tensor:
    """Return which neighbours' normals are within the angle limit, shape ``(n, K)``."""
    if config.max_angle_deg >= 90 and not config.signed_normals:
        return torch.ones_like(indices, dtype=torch.bool)
    flat = indices.reshape(-1)
    columns = normals.unbind(dim=1)
    own = [column[rows, None] for column in columns]
    theirs = [column.index_select(0, flat).view(indices.shape) for column in columns]
    chords = sq_chords(own, theirs, signed=config.signed_normals)
    return chords <= sq_chord_limit(config.max_angle_deg)


def _sq_differences(values: Tensor, rows: slice, indices: Tensor) -> Tensor:
    """Return squared distances between the values of points and of neighbours, ``(n, K)``."""
    flat = indices.reshape(-1)
    total = torch.zeros(indices.shape, dtype=values.dtype, device=values.device)
    for column in values.unbind(dim=1):
        difference = column.index_select(0, flat).view(indices.shape) - column[rows, None]
        total += difference.mul_(difference)
    return total


def _on_planes(cloud: GrowingCloud, rows: slice, indices: Tensor, reach: Tensor) -> Tensor:
    """Return which neighbours lie on the plane of the point, and it on theirs, ``(n, K)``."""
    flat = indices.reshape(-1)
    own = torch.zeros(indices.shape, dtype=cloud.points.dtype, device=indices.device)
    theirs = torch.zeros_like(own)
    for place, normal in zip(cloud.points.unbind(dim=1), cloud.normals.unbind(dim=1), strict=True):
        away = place.index_select(0, flat).view(indices.shape) - place[rows, None]
        own += away * normal[rows, None]
        theirs += away.mul_(normal.index_select(0, flat).view(indices.shape))
    on_own = own.abs_() <= reach[rows, None]
    return on_own & (theirs.abs_() <= reach.index_select(0, flat).view(indices.shape))


def _coplanar(
    cloud: GrowingCloud,
    rows: slice,
    indices: Tensor,
    asked: Tensor,
    floor_fraction: float,
    left: Tensor | None,
) -> Tensor:
    """Return which of the asked edges are coplanar by eq. (11), over the neighbours ``left``."""
    needed = (asked.sum(dim=1) > 0).nonzero().squeeze(-1)
    patches = gather_patches(cloud.points, indices[needed])
    counted = None if cloud.neighbors.valid is None else cloud.neighbors.valid[rows][needed]
    residuals = plane_residuals(patches, cloud.normals[rows][needed])
    floor = floor_fraction * patch_radii(patches, counted)
    limits = coplanarity_limits(residuals, floor, counted if left is None else left[needed])
    result = torch.zeros_like(asked)
    result[needed] = residuals <= limits[:, None]
    return result
