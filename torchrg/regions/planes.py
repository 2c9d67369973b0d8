"""The plane table: one plane fitted to each region."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.regions.areas import covered_areas
from torchrg.regions.extents import fit_rectangles
from torchrg.regions.fitting import FittedPlanes, fit_planes, shared_moments, sum_of_products
from torchrg.regions.segments import Segments
from torchrg.structures import Planes

_CURVED_SPREAD_DEG = 8.0
"""A smooth bend by three to four times this angle has this spread."""


def summarize_planes(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    labels: Tensor | NDArray[np.integer],
) -> Planes:
    """Fit a plane to each region and measure it.

    Args:
        points: Points, shape ``(N, 3)``; those without a label may hold anything.
        normals: Unit normals of any sign, shape ``(N, 3)``. They tell curved regions from flat
            ones, and decide where points do not: in regions of one or two points, or along a line.
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
    fit = fit_planes(segments, points, normals)
    first, second = _plane_axes(fit)
    places, centers = segments.take_columns(points), segments.spread_columns(fit.center)
    centered = [place - center for place, center in zip(places, centers, strict=True)]
    u, v = (sum_of_products(centered, segments.spread_columns(axis)) for axis in (first, second))
    boxes = fit_rectangles(segments, u, v)
    mean = torch.stack([segments.mean(column) for column in centered], dim=1)
    axes = boxes.directions @ torch.stack([first, second], dim=1)

    def own(values: Tensor) -> Tensor:
        return values.to(points.dtype)

    return Planes(
        normal=own(fit.normal),
        offset=own((fit.center * fit.normal).sum(dim=1)),
        centroid=own(fit.center + mean),
        area=own(covered_areas(segments, u, v, boxes)),
        count=segments.counts,
        rms=own(segments.mean(fit.residuals * fit.residuals).sqrt()),
        extent=own(boxes.sides),
        axes=own(axes),
        center=own(fit.center + (boxes.center[:, None] @ axes).squeeze(1)),
        curved=are_curved(segments, normals),
    )


def are_curved(segments: Segments, normals: Tensor) -> Tensor:
    """Tell regions whose normals turn from flat ones.

    Args:
        segments: The regions.
        normals: Unit normals, shape ``(N, 3)``.

    Returns:
        Shape ``(M,)``, bool.

    Example:
        >>> are_curved(Segments(torch.tensor([0, 0, 1])), torch.eye(3))
        tensor([ True, False])
    """
    return normal_spread_deg(segments, normals) > _CURVED_SPREAD_DEG


def normal_spread_deg(segments: Segments, normals: Tensor) -> Tensor:
    """Return the root mean square angle of normals to the direction they share, signs aside.

    Args:
        segments: The regions.
        normals: Unit normals, shape ``(N, 3)``.

    Returns:
        Degrees, shape ``(M,)``: of an arc of 30 degrees 8.7, of a full column 45.

    Example:
        >>> normal_spread_deg(Segments(torch.zeros(2, dtype=torch.int64)), torch.eye(3)[:2])
        tensor([45.0000], dtype=torch.float64)
    """
    shared = shared_moments(segments, normals)[0][:, 2]
    return (1 - shared).clamp(min=0, max=1).sqrt().asin().rad2deg()


def _plane_axes(fit: FittedPlanes) -> tuple[Tensor, Tensor]:
    """Return two unit directions that span each plane, the first along the region."""
    component = (fit.along * fit.normal).sum(dim=1, keepdim=True)
    first = fit.along - component * fit.normal
    first = first / first.norm(dim=1, keepdim=True)
    return first, torch.linalg.cross(fit.normal, first)
