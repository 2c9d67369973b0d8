"""Exact fits: planes, lines and points that contain a majority of a patch."""

import random
from functools import lru_cache
from itertools import combinations
from math import comb

import torch
from torch import Tensor

from torchrg import kernels
from torchrg.linalg.moments import eigh3_lapack
from torchrg.robust.lanes import (
    covariance_entries,
    is_in_kernels,
    sum_products,
    sum_squares,
    take_lanes,
)
from torchrg.robust.scale import sum_points

_NUM_SIMPLICES = 128
"""Number of tested simplices of P + 1 points. If 27 of 50 points lie on a plane, all simplices miss
it once in 25,000."""
_MAX_CANDIDATES = 16
"""Maximum number of candidate flats per patch. On exact planes nearly every simplex gives one."""
_MIN_EDGE = 0.01
"""Minimum length of an edge that spans another dimension, as a fraction of the patch extent."""


def find_flats(columns: list[Tensor], tolerance: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Find the flat of lowest dimension that contains at least ``size`` points of each lane.

    Each simplex of a fixed list spans a flat of every dimension. If the next vertex of a simplex
    lies on the flat of the previous ones, which never happens in general position, the flat is a
    candidate: its points are counted, and it is fitted to them again. Columns ``(K, M)`` are
    relative to the center of each lane; ``tolerance`` ``(M,)`` is the maximum distance to the flat.

    Returns its dimension ``(M,)`` (0 for a point, 1 for a line, ..., P - 1 for a hyperplane, P for
    none), and the mask of its points ``(K, M)``, all False for none.
    """
    num_coordinates, num_points = len(columns), len(columns[0])
    simplices = _simplices(num_points, min(num_coordinates, num_points - 1))
    if num_points <= num_coordinates or not is_in_kernels(columns):
        return _find_flats(columns, tolerance, size, simplices)
    dimension = torch.full_like(tolerance, num_coordinates, dtype=torch.int64)
    members = torch.zeros_like(columns[0], dtype=torch.bool)
    (candidates,) = kernels.call(
        "may_have_flats", *columns, torch.tensor(simplices, device="cpu"), tolerance
    )
    lanes = torch.nonzero(candidates).squeeze(1)
    if len(lanes):
        found = _find_flats(take_lanes(columns, lanes), tolerance[lanes], size, simplices)
        dimension[lanes], members[:, lanes] = found
    return dimension, members


def _find_flats(
    columns: list[Tensor], tolerance: Tensor, size: int, simplices: list[list[int]]
) -> tuple[Tensor, Tensor]:
    """Implement :func:`find_flats` with the vertices of the given simplices."""
    num_coordinates, (num_points, num_lanes) = len(columns), columns[0].shape
    dimension = torch.full((num_lanes,), num_coordinates, device=tolerance.device)
    members = torch.zeros((num_points, num_lanes), dtype=torch.bool, device=tolerance.device)
    vertices = [torch.tensor(vertex, device=tolerance.device) for vertex in simplices]
    origins = [column.index_select(0, vertices[0]) for column in columns]
    extent = torch.stack([column.abs().amax(dim=0) for column in columns]).amax(dim=0)
    axes: list[list[Tensor]] = []
    steep = torch.ones_like(origins[0], dtype=torch.bool)
    reach = (2 * tolerance).expand_as(origins[0])
    for vertex in vertices[1:]:
        corners = [column.index_select(0, vertex) for column in columns]
        edge = [corner.sub_(origin) for corner, origin in zip(corners, origins, strict=True)]
        across = _reject(edge, axes)
        height = sum_squares(across).sqrt()
        candidates = steep & (height <= reach) & (dimension == num_coordinates)
        lanes, near = _find_majorities(columns, origins, axes, candidates, reach, size)
        if len(lanes):
            on_flat = refine_flat(take_lanes(columns, lanes), near, tolerance[lanes], len(axes))
            is_full = on_flat.sum(dim=0) >= size
            dimension[lanes[is_full]] = len(axes)
            members[:, lanes[is_full]] = on_flat[:, is_full]
        steep = steep & (height > _MIN_EDGE * extent)
        # A short edge is inaccurate: the error from rounding its ends grows with the distance.
        reach = torch.maximum(reach, 2 * tolerance * (1 + 2 * extent / height))
        axes.append([component / height for component in across])
    if num_points <= num_coordinates:
        spanned = dimension == num_coordinates
        dimension[spanned] = num_points - 1
        members[:, spanned] = True
    return dimension, members


def _find_majorities(
    columns: list[Tensor],
    origins: list[Tensor],
    axes: list[list[Tensor]],
    candidates: Tensor,
    reach: Tensor,
    size: int,
) -> tuple[Tensor, Tensor]:
    """Return the lanes ``(F,)`` with enough points on a candidate, and these points ``(K, F)``."""
    open_lanes = torch.nonzero(candidates.any(dim=0)).squeeze(1)
    first = candidates[:, open_lanes]
    simplex, index = torch.nonzero(first & (first.cumsum(dim=0) <= _MAX_CANDIDATES), as_tuple=True)
    lane = open_lanes[index]
    offsets = [
        points - origin[simplex, lane]
        for points, origin in zip(take_lanes(columns, lane), origins, strict=True)
    ]
    across = _reject(offsets, [[component[simplex, lane] for component in axis] for axis in axes])
    near = sum_squares(across) <= reach[simplex, lane] ** 2
    # Prefer the most accurate candidate; an inaccurate one may include points off the flat.
    accuracy = torch.where(near.sum(dim=0) >= size, reach[simplex, lane], torch.inf)
    best = reach.new_full((len(open_lanes),), torch.inf)
    best.scatter_reduce_(0, index, accuracy, "amin")
    order = torch.arange(len(index), device=index.device)
    order = order.masked_fill((accuracy > best[index]) | accuracy.isinf(), len(index))
    winner = torch.full_like(open_lanes, len(index)).scatter_reduce_(0, index, order, "amin")
    winner = winner[winner < len(index)]
    return lane[winner], near[:, winner]


def refine_flat(columns: list[Tensor], chosen: Tensor, tolerance: Tensor, dimension: int) -> Tensor:
    """Fit a flat to the chosen points of each lane, and mark its points ``(K, M)``."""
    columns = [column.double() for column in columns]
    weights = chosen.double()
    count = sum_points(weights)
    means = [sum_points(weights * column) / count for column in columns]
    _, vectors = eigh3_lapack(covariance_entries(columns, means, weights, count))
    centered = [column - mean for column, mean in zip(columns, means, strict=True)]
    normals = vectors[..., : len(columns) - dimension].unbind(dim=2)
    across = sum_squares([sum_products(centered, normal.unbind(dim=1)) for normal in normals])
    return across <= tolerance.double() ** 2


def _reject(vectors: list[Tensor], directions: list[list[Tensor]]) -> list[Tensor]:
    """Component of vectors orthogonal to the given orthonormal directions."""
    for direction in directions:
        along = sum_products(vectors, direction)
        vectors = [
            component - along * axis for component, axis in zip(vectors, direction, strict=True)
        ]
    return vectors


@lru_cache(maxsize=256)
def _simplices(num_points: int, num_edges: int) -> list[list[int]]:
    """Vertices of the tested simplices: ``num_edges + 1`` lists of point indices."""
    corners = num_edges + 1
    if comb(num_points, corners) <= _NUM_SIMPLICES:
        # All cyclic orders: if the first vertices coincide, they span nothing.
        chosen = [
            (*vertices[turn:], *vertices[:turn])
            for turn in range(corners)
            for vertices in combinations(range(num_points), corners)
        ]
    else:
        draw = random.Random(num_points)  # noqa: S311 - a fixed list, not a secret
        chosen = [tuple(draw.sample(range(num_points), corners)) for _ in range(_NUM_SIMPLICES)]
    return [list(vertex) for vertex in zip(*chosen, strict=True)]
