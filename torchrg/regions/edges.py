"""Edge criteria of region growing.

A criterion tests the edges from points ``rows`` to their K neighbors and returns a mask of passing
edges, shape ``(n, K)``, bool. A new one needs a config field, a function here, and a call in
:func:`accept_edges`.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import ROWS_AT_ONCE, map_chunks, nonzero_rows
from torchrg.config import GrowingConfig
from torchrg.linalg.angles import deg_to_sq_chord, sq_chords
from torchrg.linalg.moments import Columns, project, sq_lengths, to_column_major
from torchrg.linalg.precision import rounded_sqrt
from torchrg.neighbors.knn import gather_columns
from torchrg.regions.shared_neighbors import connected_neighbors, min_shared_neighbors
from torchrg.robust.scale import QN_FACTOR, median, qn
from torchrg.structures import Neighbors
from torchrg.structures.points import Rows


class GrowingInput(NamedTuple):
    """Input of region growing in canonical order, with contiguous columns for fast indexing.

    Attributes:
        points: Shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``.
        curvature: Shape ``(N,)``.
        neighbors: Neighbors of each point.
        valid: Points that may belong to a region, shape ``(N,)``, bool.
        reach: Maximum distance of a coplanar neighbor to the point's plane, shape ``(N,)``,
            infinite if unknown, or None.
        colors: Shape ``(N, C)``, floating point, or None.
        max_color_distance: Maximum color difference between neighbors of a region.
        signed_normals: Whether opposite normals differ by 180 degrees instead of 0.
        angle_fraction: Fraction of ``max_angle_deg`` that limits the angle between normals.
        radii: Distance of each point to its last neighbor, shape ``(N,)``, or None if unknown.
    """

    points: Tensor
    normals: Tensor
    curvature: Tensor
    neighbors: Neighbors
    valid: Tensor
    reach: Tensor | None = None
    colors: Tensor | None = None
    max_color_distance: float = math.inf
    signed_normals: bool = False
    angle_fraction: float = 1.0
    radii: Tensor | None = None

    def select(self, rows: Tensor, neighbors: Neighbors) -> "GrowingInput":
        """Return the points ``rows`` ``(n,)`` as a cloud with the given neighbors."""
        return self._replace(
            points=to_column_major(self.points[rows]),
            normals=to_column_major(self.normals[rows]),
            curvature=self.curvature[rows],
            neighbors=neighbors,
            valid=self.valid[rows],
            reach=None if self.reach is None else self.reach[rows],
            colors=None if self.colors is None else to_column_major(self.colors[rows]),
            radii=None,
        )


def has_late_promotion(config: GrowingConfig) -> bool:
    """Return whether any edge of its region, not only the claiming one, can promote a point."""
    return config.connectivity is not None and config.connectivity_scope == "seed"


def mark_edges(
    cloud: GrowingInput, config: GrowingConfig, limit: Tensor, *, chunk_size: int
) -> tuple[Tensor, Tensor | None]:
    """Return the neighbors that join and the edges that make seeds, packed into bits.

    The bits are in 64-bit words, ``(N, words)``, int64. If the seed test depends on the claimed
    point alone, the second value is None. ``limit`` is the curvature limit.
    """
    is_global = config.seed_rule == "curvature" and config.curvature_scope == "cloud"
    order_independent = is_global and not has_late_promotion(config)
    num_points, k = cloud.neighbors.indices.shape
    test = None
    if config.connectivity is not None:
        min_shared = min_shared_neighbors(config.connectivity, k)
        test = partial(connected_neighbors, cloud.neighbors, min_shared, [])
    joins = np.zeros((num_points, 8 * -(-k // 64)), dtype=np.uint8)
    seeds = joins if order_independent else np.zeros_like(joins)

    def mark(rows: slice) -> None:
        connect = None if test is None else partial(test, rows)
        accepted, connected = accept_edges(cloud, config, rows, connect)
        _write_bits(joins[rows], accepted)
        if not order_independent:
            _write_bits(seeds[rows], _become_seeds(cloud, config, rows, limit, connected))

    map_chunks(mark, num_points, chunk_size, cloud.points.device)
    bits, seed_bits = (torch.from_numpy(marks.view(np.int64)) for marks in (joins, seeds))
    return bits, None if order_independent else seed_bits


def _write_bits(target: NDArray[np.uint8], flags: Tensor) -> None:
    """Write flags ``(n, K)`` to the bits of bytes, lowest bit first."""
    packed = np.packbits(flags.cpu().numpy(), axis=1, bitorder="little")
    target[:, : packed.shape[1]] = packed


def _become_seeds(
    cloud: GrowingInput, config: GrowingConfig, rows: slice, limit: Tensor, connected: Tensor | None
) -> Tensor:
    """Return a mask of the edges that make the neighbor a seed, shape ``(n, K)``."""
    target = cloud.neighbors.gather(cloud.curvature, rows)
    if config.curvature_scope == "neighborhood":
        counted = cloud.neighbors.mask(rows) & cloud.neighbors.gather(cloud.valid, rows)
        ascending = target.where(counted, torch.inf).sort(dim=1).values
        last = (counted.sum(dim=1, keepdim=True) - 1).double()
        index = (config.curvature_quantile * last).long().clamp_min(0)
        limit = ascending.gather(1, index)
    if config.seed_rule == "increment":
        becomes_seed = (target - cloud.curvature[rows, None]).abs() <= limit
    else:
        becomes_seed = target <= limit
    if connected is not None and config.connectivity_scope == "seed":
        becomes_seed &= connected
    return becomes_seed


def accept_edges(
    cloud: GrowingInput,
    config: GrowingConfig,
    rows: Rows,
    connect: Callable[[Tensor], Tensor] | None,
) -> tuple[Tensor, Tensor | None]:
    """Evaluate the enabled edge criteria for the given points, cheapest first.

    Returns a mask of neighbors that join the point's region, shape ``(n, K)``, bool, and a mask of
    connected neighbors, valid only where the first holds. The second is None without ``connect``,
    which tests the connectivity of the edges in a mask.
    """
    near, signed = cloud.neighbors.select(rows), cloud.signed_normals
    max_angle_deg = cloud.angle_fraction * config.max_angle_deg
    # Negative limits are disabled.
    angle = deg_to_sq_chord(max_angle_deg) if max_angle_deg < 90 or signed else -1.0
    distance = -1.0 if config.max_distance is None else config.max_distance**2
    columns = cloud.points.T, cloud.normals.T
    if kernels.serve(*near, *columns, cloud.valid, cloud.reach, k=near.indices.shape[1]):
        where = *columns, cloud.valid, cloud.reach, *near
        (joins,) = kernels.call("pass_edges", *where, angle, distance, signed)
    else:
        # An edge joins two different valid points.
        valid = near.gather(cloud.valid)
        joins = valid & valid[:, :1] & (near.indices != near.indices[:, :1]) & near.mask()
        if angle >= 0:
            joins &= within_angle(near, columns[1], angle, signed=signed)
        if distance >= 0:
            joins &= within_distance(near, columns[0], distance)
        if cloud.reach is not None:
            joins &= within_reach(near, *columns, cloud.reach)
    if cloud.colors is not None:
        joins &= within_distance(near, cloud.colors.T, cloud.max_color_distance**2)
    connected: Tensor | None = None
    if config.coplanarity:
        if connect is not None and config.coplanarity_scope == "connected":
            connected = connect(cloud.neighbors.mask(rows))
        # The reach replaces eq. (11) where it is known.
        tested = slice(None) if cloud.reach is None else nonzero_rows(cloud.reach[rows].isinf())
        compared = None if connected is None else connected[tested]
        joins[tested] = are_coplanar(
            cloud, near.select(tested), joins[tested], compared, config.coplanarity_floor
        )
    if connect is not None:
        if connected is None:
            connected = connect(joins)
        if config.connectivity_scope == "region":
            joins &= connected
    return joins, connected


def within_angle(near: Neighbors, normals: Tensor, max_sq_chord: float, *, signed: bool) -> Tensor:
    """Return a mask of neighbors whose normals ``(3, N)`` are within the angle limit, eq. (8)."""
    theirs = [near.gather(column) for column in normals.unbind()]
    return sq_chords([column[:, :1] for column in theirs], theirs, signed=signed) <= max_sq_chord


def within_distance(near: Neighbors, values: Tensor, max_sq_distance: float) -> Tensor:
    """Return a mask of neighbors whose positions or colors ``(C, N)`` are within a distance."""
    total = values.new_zeros(())
    for column in map(near.gather, values.unbind()):
        difference = column - column[:, :1]
        total = difference.mul_(difference).add_(total)
    return total <= max_sq_distance


def within_reach(near: Neighbors, points: Tensor, normals: Tensor, reach: Tensor) -> Tensor:
    """Return a mask of edges whose ends lie within ``reach`` ``(N,)`` of each other's planes."""
    ours = theirs = points.new_zeros(())
    for column in zip(points.unbind(), normals.unbind(), strict=True):
        position, slope = map(near.gather, column)
        offset = position - position[:, :1]
        ours = (offset * slope[:, :1]).add_(ours)
        theirs = offset.mul_(slope).add_(theirs)
    limit = near.gather(reach)
    return (ours.abs_() <= limit[:, :1]) & (theirs.abs_() <= limit)


def are_coplanar(
    cloud: GrowingInput,
    near: Neighbors,
    mask: Tensor,
    compared: Tensor | None,
    floor_fraction: float,
) -> Tensor:
    """Return a mask of the neighbors in ``mask`` ``(n, K)`` on the point's plane, eq. (11).

    The limit is computed over the neighbors ``compared``, shape ``(n, K)``, default all. Its floor
    is a fraction of the distance to the farthest neighbor.
    """
    columns = cloud.points.T, cloud.normals.T
    is_complete = compared is None and near.valid is None
    if is_complete and kernels.serve(near.indices, *columns, k=mask.shape[1]):
        factors = QN_FACTOR, floor_fraction
        found, open_rows = kernels.call("are_coplanar", *columns, near.indices, mask, *factors)
        result = found & mask
    else:
        result, open_rows = mask.clone(), mask.any(dim=1)
    tested = nonzero_rows(open_rows)
    if len(tested) == 0:
        return result
    indices, counted = near.select(tested)
    offsets = gather_columns(cloud.points, indices)
    # |(p_j - p_i) . n_i|, below eq. (10).
    residuals = project(offsets, cloud.normals[indices[:, 0].long()]).abs_()
    floor = floor_fraction * patch_radii(offsets, counted)
    used = counted if compared is None else compared[tested]
    # The limit is at least twice the floor.
    far = mask[tested] & ~(residuals <= 2 * floor[:, None])
    rows = nonzero_rows(far.any(dim=1))
    used = None if used is None else used[rows]
    limits = coplanarity_limits(residuals[rows], floor[rows], used)
    far[rows] &= ~(residuals[rows] <= limits[:, None])
    result[tested] = mask[tested] & ~far
    return result


def coplanarity_limits(residuals: Tensor, floor: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the maximum residual ``(n,)`` of a coplanar neighbor, eq. (11).

    :math:`\gamma_{th} = \mathrm{median}(\gamma) + 2 \max(Q_n(\gamma), \mathrm{floor})`. The paper
    has no floor. Without it, the limit of a neighborhood with mostly equal residuals (exact or
    quantized coordinates) is their median, which fragments the wall.
    """
    scale = torch.maximum(qn(residuals, mask=mask), floor)
    return median(residuals, mask=mask) + 2 * scale


def neighborhood_radii(points: Tensor, neighbors: Neighbors) -> Tensor:
    """Return the distance of each point to its last neighbor, shape ``(N,)``."""
    indices, counted = neighbors

    def measure(rows: slice) -> Tensor:
        last = indices[rows, -1]
        if counted is not None:
            column = counted[rows].sum(dim=1, keepdim=True).sub_(1).clamp_(min=0)
            last = indices[rows].gather(1, column).squeeze(1)
        x, y, z = (column.index_select(0, last) - column[rows] for column in points.T)
        return rounded_sqrt(sq_lengths((x, y, z)))

    return torch.cat(map_chunks(measure, len(points), ROWS_AT_ONCE, points.device))


def patch_radii(columns: Columns, mask: Tensor | None = None) -> Tensor:
    """Return the distance from each point to its farthest counted neighbor, shape ``(n,)``."""
    sq_distances = sq_lengths(columns)
    if mask is not None:
        sq_distances = torch.where(mask, sq_distances, 0.0)
    return rounded_sqrt(sq_distances.amax(dim=-1))
