"""The plane table: one plane fitted to each region."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ConfigError
from torchrg.regions.adjacency import find_adjacency
from torchrg.regions.areas import covered_areas
from torchrg.regions.extents import fit_rectangles
from torchrg.regions.fitting import FittedPlanes, fit_planes, shared_moments, sum_of_products
from torchrg.regions.kinds import classify_planes
from torchrg.regions.outline import trace_outline
from torchrg.regions.segments import Segments
from torchrg.structures import Neighbors, PlaneAdjacency, Planes

_CURVED_SPREAD_DEG = 8.0
"""A smooth bend by three to four times this angle has this spread."""


def summarize_planes(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    labels: Tensor | NDArray[np.integer],
    *,
    neighbors: Neighbors | None = None,
    up: Sequence[float] | None = None,
    outline: bool = False,
) -> Planes:
    """Fit a plane to each region and measure it.

    Args:
        points: Points, shape ``(N, 3)``; those without a label may hold anything.
        normals: Unit normals of any sign, shape ``(N, 3)``. They tell curved regions from flat
            ones, and decide where points do not: in regions of one or two points, or along a line.
        labels: Region of each point, shape ``(N,)``: 0 to M-1, each at least once, or negative.
        neighbors: Neighbours of each point, to tell which planes meet.
        up: The upward direction, to tell floors, ceilings and walls.
        outline: Whether to trace outlines; needs shapely (``torchrg[outline]``).

    Returns:
        The table, M rows.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If ``up`` is not a direction.
        MissingDependencyError: If outlines are asked for and shapely is not installed.

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

    area, width = covered_areas(segments, u, v, boxes)

    def own(values: Tensor) -> Tensor:
        return values.to(points.dtype)

    planes = Planes(
        normal=own(fit.normal),
        offset=own((fit.center * fit.normal).sum(dim=1)),
        centroid=own(fit.center + mean),
        area=own(area),
        count=segments.counts,
        rms=own(segments.mean(fit.residuals * fit.residuals).sqrt()),
        extent=own(boxes.sides),
        axes=own(axes),
        center=own(fit.center + (boxes.center[:, None] @ axes).squeeze(1)),
        curved=are_curved(segments, normals),
    )
    if up is not None:
        planes = planes._replace(kind=classify_planes(planes, _direction(up, points)))
    if outline:
        frame = (fit.center, first, second)
        planes = planes._replace(outline=_outlines(segments, u, v, width, frame, points.dtype))
    if neighbors is not None:
        found = find_adjacency(
            points, labels, neighbors, fit.normal, fit.thickness, curved=planes.curved
        )
        lengths, angles = own(found.boundary_length), own(found.dihedral_deg)
        planes = planes._replace(adjacency=PlaneAdjacency(found.pairs, lengths, angles))
    return planes


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


def _direction(up: Sequence[float], points: Tensor) -> Tensor:
    """Return a direction beside the points, or say what is wrong with it."""
    direction = torch.tensor(list(up), dtype=points.dtype, device=points.device)
    if direction.shape != (3,) or not bool(direction.isfinite().all() and direction.any()):
        raise ConfigError(
            f"summarize_planes: expected up to be three numbers, not all zero, got {up!r}."
        )
    return direction


def _outlines(
    segments: Segments,
    u: Tensor,
    v: Tensor,
    width: Tensor,
    frame: tuple[Tensor, Tensor, Tensor],
    dtype: torch.dtype,
) -> tuple[tuple[Tensor, ...], ...]:
    """Trace the outline of each region, and lift it into space."""
    outlines = []
    counts = segments.counts.tolist()
    parts = torch.split(torch.stack([u, v], dim=1), counts)
    for part, size, center, first, second in zip(parts, width.tolist(), *frame, strict=True):
        rings = (
            torch.from_numpy(ring).to(u.device) for ring in trace_outline(part.cpu().numpy(), size)
        )
        lifted = (center + ring[:, :1] * first + ring[:, 1:] * second for ring in rings)
        outlines.append(tuple(ring.to(dtype) for ring in lifted))
    return tuple(outlines)


def _plane_axes(fit: FittedPlanes) -> tuple[Tensor, Tensor]:
    """Return two unit directions that span each plane, the first along the region."""
    first = _without(fit.along, fit.normal)
    # The points of one place have no direction of their own: any in the plane will do.
    least = fit.normal.abs().argmin(dim=1)
    other = _without(torch.eye(3, dtype=first.dtype, device=first.device)[least], fit.normal)
    first = torch.where(first.norm(dim=1, keepdim=True) > 0.5, first, other)
    first = first / first.norm(dim=1, keepdim=True)
    return first, torch.linalg.cross(fit.normal, first)


def _without(vectors: Tensor, normals: Tensor) -> Tensor:
    """Return vectors less their component along the normals."""
    return vectors - (vectors * normals).sum(dim=1, keepdim=True) * normals
