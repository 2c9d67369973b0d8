"""Plane table: fits, measurements and adjacency of regions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._parallel import map_tasks, nonzero_rows
from torchrg.config import Auto
from torchrg.errors import ShapeError
from torchrg.linalg.angles import unit_direction
from torchrg.linalg.moments import Segments, eigh3_lapack, to_column_major
from torchrg.neighbors.knn import check_neighbors
from torchrg.neighbors.order import distinct_rows, mark_distinct
from torchrg.regions.adjacency import find_adjacency
from torchrg.regions.classes import find_kinds
from torchrg.regions.extents import covered_areas, fit_rectangles
from torchrg.regions.fit import POINTS_AT_ONCE, RegionPlanes, fit_planes
from torchrg.regions.polygons import trace_polygon
from torchrg.structures import AnyCloud, Neighbors, PlaneAdjacency, Planes
from torchrg.structures.points import Labels, Points, Rows

_Polygons = tuple[tuple[Tensor, ...], ...]


def summarize_planes(
    points: AnyCloud,
    normals: Points,
    labels: Labels,
    *,
    neighbors: Neighbors | None = None,
    up: Sequence[float] | str | None = None,
    outline: bool = False,
    canonical: bool = False,
    facet_tolerance: float | Auto | None = None,
) -> Planes:
    """Fit a plane to each region and measure it.

    Duplicates in one region count once, except in ``count``. The table does not depend on the point
    order, except the adjacency, which depends on ``neighbors``.

    Args:
        points: Points, shape ``(N, 3)``; unlabeled points may have any value.
        normals: Unit normals of any sign, shape ``(N, 3)``. They distinguish curved from flat
            regions, and define the planes of degenerate ones (one or two points, or collinear).
        labels: Region of each point, shape ``(N,)``: 0 to M-1, each at least once, or negative.
        neighbors: Neighbors of each point. Default: no adjacency.
        up: Upward direction for the classification: three numbers, or an axis such as ``"z"`` or
            ``"-y"``. Default: no classes.
        outline: Whether to trace polygons; requires shapely (``torchrg[outline]``).
        canonical: Whether the points are finite and in canonical order with duplicates of a region
            adjacent; saves a sort.
        facet_tolerance: For faceted surfaces with spread normals, in the unit of the points:
            regions within an RMS distance of 1.5 times this value are planes. Default: the normals
            alone decide.

    Raises:
        ShapeError: If a shape or dtype is not as above, or a labeled point is not finite.
        ConfigError: If ``up`` is not a direction.
        MissingDependencyError: If polygons are requested and shapely is not installed.

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
    if neighbors is not None and not canonical:
        check_neighbors("summarize_planes", neighbors, points)
    rows = _distinct_rows(points, labels, canonical=canonical)
    segments, positions = Segments(labels[rows]), to_column_major(points[rows])
    fit = fit_planes(segments, positions, to_column_major(normals[rows]))
    fit = fit.flattened(facet_tolerance)
    planes = measure_planes(segments, positions, fit, outline=outline)
    planes = replace(planes, count=torch.bincount(labels.clamp(min=-1) + 1, minlength=1)[1:])
    if up is not None:
        direction = unit_direction("summarize_planes", up)
        planes = replace(planes, kind=find_kinds(planes, positions, labels[rows], direction))
    if neighbors is not None:
        meeting = find_adjacency(
            points, labels, neighbors, fit.normal, fit.thickness, curved=fit.curved
        )
        sizes = (size.to(points.dtype) for size in meeting[1:])
        planes = replace(planes, adjacency=PlaneAdjacency(meeting.pairs, *sizes))
    return planes


def _distinct_rows(points: Tensor, labels: Tensor, *, canonical: bool) -> Rows:
    """Return the rows of the distinct points of each region, in canonical order."""
    if canonical:
        is_first = mark_distinct(*points.unbind(dim=1), labels)
        return slice(None) if bool(is_first.all()) else nonzero_rows(is_first)
    members = nonzero_rows(labels >= 0)
    num_nonfinite = int(torch.count_nonzero(~points[members].isfinite().all(dim=1)))
    if num_nonfinite:
        raise ShapeError(
            f"summarize_planes: expected finite labeled points, got {num_nonfinite:,} non-finite. "
            "Label them -1."
        )
    return members[distinct_rows(points[members], labels[members])]


def measure_planes(
    segments: Segments, points: Tensor, fit: RegionPlanes, *, outline: bool = False
) -> Planes:
    """Measure regions on their fitted planes; see :func:`summarize_planes`."""
    frames, chunks = _plane_axes(fit), segments.chunks(POINTS_AT_ONCE)
    sizes = [len(chunk.counts) for chunk in chunks]
    parts = zip(chunks, *(torch.split(part, sizes) for part in (fit.center, frames)), strict=True)

    def measure(part: tuple[Segments, Tensor, Tensor]) -> tuple[list[Tensor], _Polygons]:
        return _measure(points, part[0], part[1:], outline=outline)

    measured, polygons = zip(*map_tasks(measure, list(parts), points.device), strict=True)
    mean, area, sides, directions, middle = map(torch.cat, zip(*measured, strict=True))
    axes = directions @ frames[:, :2]

    def to_input_dtype(values: Tensor) -> Tensor:
        return values.to(points.dtype)

    return Planes(
        normal=to_input_dtype(fit.normal),
        offset=to_input_dtype((fit.center * fit.normal).sum(dim=1)),
        centroid=to_input_dtype(fit.center + mean),
        area=to_input_dtype(area),
        count=fit.num_points,
        rms=to_input_dtype(fit.rms),
        extent=to_input_dtype(sides),
        axes=to_input_dtype(axes),
        center=to_input_dtype(fit.center + (middle[:, None] @ axes).squeeze(1)),
        curved=fit.curved,
        outline=sum(polygons, ()) if outline else None,
    )


def _measure(
    points: Tensor, segments: Segments, frame: tuple[Tensor, Tensor], *, outline: bool
) -> tuple[list[Tensor], _Polygons]:
    """Return mean, area, rectangle and polygons of regions, given their plane frames.

    A frame is the centers ``(M, 3)`` and the axes ``(M, 3, 3)``: two in the plane, then its normal.
    The mean is in space.
    """
    u, v, height = segments.coordinates(points, *frame)
    mean = torch.stack([segments.mean(column) for column in (u, v, height)], dim=1)
    mean = (mean[:, None] @ frame[1]).squeeze(1)
    del height
    boxes = fit_rectangles(segments, u, v)
    area, width = covered_areas(segments, u, v, boxes)
    rings = _trace_polygons(segments, u, v, width, frame, points.dtype) if outline else ()
    return [mean, area, *boxes], rings


def _plane_axes(fit: RegionPlanes) -> Tensor:
    """Return three unit axes of each plane ``(M, 3, 3)``: along the region, across, and normal."""
    first = _reject(eigh3_lapack(fit.covariance)[1][:, :, 2], fit.normal)
    # A region at a single position has no direction: any direction in the plane will do.
    min_axis = fit.normal.abs().argmin(dim=1)
    other = _reject(torch.eye(3, dtype=first.dtype, device=first.device)[min_axis], fit.normal)
    first = torch.where(first.norm(dim=1, keepdim=True) > 0.5, first, other)
    first = first / first.norm(dim=1, keepdim=True)
    return torch.stack([first, torch.linalg.cross(fit.normal, first), fit.normal], dim=1)


def _reject(vectors: Tensor, normals: Tensor) -> Tensor:
    """Return vectors without their component along the normals."""
    return vectors - (vectors * normals).sum(dim=1, keepdim=True) * normals


def _trace_polygons(
    segments: Segments,
    u: Tensor,
    v: Tensor,
    width: Tensor,
    frame: tuple[Tensor, Tensor],
    dtype: torch.dtype,
) -> _Polygons:
    """Trace the polygons of each region, and lift them into space."""
    polygons = []
    parts = torch.split(torch.stack([u, v], dim=1), segments.counts.tolist())
    for positions, size, center, axes in zip(parts, width.tolist(), *frame, strict=True):
        traced = trace_polygon(positions.cpu().numpy(), size)
        rings = (torch.from_numpy(ring).to(u.device) for ring in traced)
        lifted = (center + ring[:, :1] * axes[0] + ring[:, 1:] * axes[1] for ring in rings)
        polygons.append(tuple(ring.to(dtype) for ring in lifted))
    return tuple(polygons)
