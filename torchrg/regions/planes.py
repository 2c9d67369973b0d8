"""The plane table: one plane fitted to each region."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.linalg import eigh3
from torchrg.regions.segments import Segments
from torchrg.structures import Planes

_FLAT_RATIO = 4.0
"""A region whose second variance is less than this times its least has no plane of its own."""


def summarize_planes(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    labels: Tensor | NDArray[np.integer],
) -> Planes:
    """Fit a plane to the points of each region by total least squares.

    Args:
        points: Points, shape ``(N, 3)``; those without a label may hold anything.
        normals: Unit normals of any sign, shape ``(N, 3)``. They only decide where the points do
            not: in regions of one or two points, or along a line.
        labels: Region of each point, shape ``(N,)``: 0 to M-1, each at least once, or negative.

    Returns:
        The table, M rows.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> points = torch.tensor([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 2]])
        >>> normals, labels = torch.eye(3)[[2] * 4], torch.zeros(4, dtype=torch.int64)
        >>> planes = summarize_planes(points, normals, labels)
        >>> planes.normal.tolist(), planes.offset.tolist(), planes.count.tolist()
        ([[0.0, 0.0, 1.0]], [2.0], [4])
    """
    points = as_tensor("summarize_planes", "points", points).detach()
    normals = as_tensor("summarize_planes", "normals", normals).detach()
    labels = as_tensor("summarize_planes", "labels", labels)
    check_shapes(
        "summarize_planes", points=(points, "N 3"), normals=(normals, "N 3"), labels=(labels, "N")
    )
    check_floating("summarize_planes", points=points, normals=normals)
    segments = Segments(labels)
    origin = segments.first(points).double()
    local = segments.take(points).double() - segments.spread(origin)
    mean = segments.mean(local)
    centered = local - segments.spread(mean)
    variances, axes = eigh3(segments.mean(_outer(centered)))
    directions = segments.take(normals).double()
    usual = eigh3(segments.mean(_outer(directions)))[1][:, :, 2]
    normal = _with_sign(_plane_normals(variances, axes, usual))
    residuals = (centered * segments.spread(normal)).sum(dim=1)
    centroid = origin + mean
    box = _box_area(segments, centered, normal, axes[:, :, 2])
    return Planes(
        normal=normal.to(points.dtype),
        offset=(centroid * normal).sum(dim=1).to(points.dtype),
        centroid=centroid.to(points.dtype),
        area=box.to(points.dtype),
        count=segments.counts,
        rms=segments.mean(residuals * residuals).sqrt().to(points.dtype),
    )


def _outer(vectors: Tensor) -> Tensor:
    """Return the outer product of each vector with itself, shape ``(n, 3, 3)``."""
    return vectors[:, :, None] * vectors[:, None, :]


def _plane_normals(variances: Tensor, axes: Tensor, usual: Tensor) -> Tensor:
    """Return the normals of planes, from the points' own normals where the points give none."""
    low, middle, high = variances.unbind(dim=1)
    along = axes[:, :, 2]
    is_line = high > _FLAT_RATIO * middle
    across = usual - torch.where(is_line[:, None], (usual * along).sum(1, True) * along, 0.0)
    length = across.norm(dim=1, keepdim=True)
    across = torch.where(length > 0, across / length, axes[:, :, 0])
    return torch.where((middle > _FLAT_RATIO * low)[:, None], axes[:, :, 0], across)


def _with_sign(normals: Tensor) -> Tensor:
    """Return normals whose component of largest magnitude is positive."""
    largest = normals.gather(1, normals.abs().argmax(dim=1, keepdim=True))
    return torch.where(largest < 0, -normals, normals)


def _box_area(segments: Segments, centered: Tensor, normal: Tensor, along: Tensor) -> Tensor:
    """Return the area of the rectangle along the principal axes that holds each region."""
    across = torch.linalg.cross(normal, along)
    first = segments.extent((centered * segments.spread(along)).sum(dim=1))
    second = segments.extent((centered * segments.spread(across)).sum(dim=1))
    return first * second
