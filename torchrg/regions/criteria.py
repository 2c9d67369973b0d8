"""Which neighbours may join a region: one criterion a function.

Each tests the edges from some points, ``rows``, to their K neighbours, and returns which of
them pass, shape ``(n, K)``, bool. A new criterion is a setting, a function here, and the line of
:mod:`torchrg.regions.edges` that calls it.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import deg_to_sq_chord, sq_chords
from torchrg.neighbors import gather_patches
from torchrg.robust import median, qn
from torchrg.structures import Neighbors

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


def are_valid(cloud: GrowingCloud, rows: Rows) -> Tensor:
    """Tell which edges lead from one valid point to another one that is its neighbour."""
    indices, counted = cloud.neighbors
    own = torch.arange(len(cloud.valid), device=indices.device)[rows, None]
    passed = _of_neighbors(cloud, rows, cloud.valid) & cloud.valid[rows, None]
    passed &= indices[rows] != own
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
