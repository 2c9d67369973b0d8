"""Starts that no rotation changes: planes through a few points, and the patch's own axes."""

import torch
from torch import Tensor

from torchrg.robust.elemental import elemental_sets
from torchrg.robust.lanes import (
    eigenvectors,
    smallest_points,
    sorted_points,
    sum_points,
    sum_squares,
)
from torchrg.robust.scatter import covariance_entries

NUM_PLANES = 64
NUM_PLANE_STARTS = 4
_PLANES_AT_ONCE = 8


def plane_starts(columns: list[Tensor], size: int) -> Tensor:
    """Choose the sets nearest to the best of 64 planes through P points each.

    The best planes are those with the smallest ``size``-th distance (least median of squares).
    With a minority of outliers some of the planes pass through clean points only, wherever the
    outliers are; six scatter estimates may all be drawn to one cluster of them. There are only
    sums and one sort a plane, against 27 Qn for the published starts.

    Args:
        columns: P coordinates of shape ``(K, M)``, K >= P.
        size: h, the number of points of an initial set.

    Returns:
        1 for a point in the set, 0 for another, shape ``(K, 4, M)``; fewer starts where there are
        fewer planes.
    """
    num_points, num_lanes = columns[0].shape
    sets = elemental_sets(num_points, len(columns), NUM_PLANES, seed=0).to(columns[0].device)
    scores = []
    for first in range(0, len(sets), _PLANES_AT_ONCE):
        some = sets[first : first + _PLANES_AT_ONCE]
        nearest = sorted_points(_sq_residuals(columns, some[:, :, None]))[:, size - 1]
        scores.append(nearest.reshape(len(some), num_lanes))
    score = torch.cat(scores)
    starts = []
    for _ in range(min(NUM_PLANE_STARTS, len(sets))):
        best = score.argmin(dim=0)
        score.scatter_(0, best[None], torch.inf)
        residuals = _sq_residuals(columns, sets[best].t()[None])
        starts.append(smallest_points(residuals, size))
    return torch.stack(starts, dim=1)


def rotate_to_axes(columns: list[Tensor]) -> list[Tensor]:
    """Express the points of each lane in the eigenvectors of its covariance."""
    ones = torch.ones_like(columns[0])
    means = [sum_points(column) / len(column) for column in columns]
    vectors = eigenvectors(covariance_entries(columns, means, ones, len(ones)))
    centered = [column - mean for column, mean in zip(columns, means, strict=True)]
    rotated = []
    for j in range(len(columns)):
        column = centered[0] * vectors[:, 0, j]
        for i in range(1, len(columns)):
            column += centered[i] * vectors[:, i, j]
        rotated.append(column)
    return rotated


def _sq_residuals(columns: list[Tensor], sets: Tensor) -> Tensor:
    """Squared distances ``(K, S * M)`` to the hyperplanes through ``sets (S, P, M or 1)``."""
    num_points, num_lanes = columns[0].shape
    corners = [
        [column.gather(0, sets[:, k].expand(-1, num_lanes)) for column in columns]
        for k in range(len(columns))
    ]
    edges = [[a - b for a, b in zip(corner, corners[0], strict=True)] for corner in corners[1:]]
    normal = _across(edges, corners[0])
    offset = corners[0][0] * normal[0]
    for corner, part in zip(corners[0][1:], normal[1:], strict=True):
        offset = offset + corner * part
    residual = columns[0][:, None] * normal[0]
    for column, part in zip(columns[1:], normal[1:], strict=True):
        residual += column[:, None] * part
    # Points that span no hyperplane are infinitely far from it.
    residual -= torch.where(sum_squares(normal) > 0, offset, torch.inf)
    return (residual * residual).reshape(num_points, -1)


def _across(edges: list[list[Tensor]], like: list[Tensor]) -> list[Tensor]:
    """Unit vectors across P - 1 edges; zero where these do not span a hyperplane."""
    size = len(like)
    if size == 1:
        return [torch.ones_like(like[0])]
    if size == 3:
        (u0, u1, u2), (v0, v1, v2) = edges
        normal = [u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0]
    elif size == 2:
        normal = [-edges[0][1], edges[0][0]]
    else:
        matrix = torch.stack([torch.stack(edge, dim=-1) for edge in edges], dim=-2)
        minors = []
        for j in range(size):
            kept = [i for i in range(size) if i != j]
            minors.append(torch.linalg.det(matrix[..., kept]) * (-1) ** j)
        normal = minors
    length = sum_squares(normal).sqrt()
    length = torch.where(length > 0, length, 1.0)
    return [part / length for part in normal]
