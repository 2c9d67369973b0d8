"""Boundary polygons of planar regions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg._optional import require


def trace_polygon(positions: NDArray[np.float64], width: float) -> list[NDArray[np.float64]]:
    """Return the boundary polygons of points in a plane, as rings through some of the points.

    Points near an edge, found with square cells, are triangulated. Triangles over empty cells are
    dropped, the remaining ones united. Holes and dents narrower than ``width``, the cell width, are
    filled. Outer rings ``(V, 2)`` run counterclockwise, holes clockwise, without repeating the
    first point; collinear points have none.

    Raises:
        MissingDependencyError: If shapely is not installed.
    """
    from scipy.ndimage import binary_erosion
    from scipy.spatial import Delaunay, QhullError

    shapely = require("shapely", extra="outline", purpose="trace outlines")
    if width <= 0:
        return []
    cells = np.floor((positions - positions.min(axis=0)) / width).astype(np.int64) + 1
    occupied = np.zeros(cells.max(axis=0) + 2, dtype=bool)
    occupied[tuple(cells.T)] = True
    inside = binary_erosion(occupied, np.ones((3, 3), dtype=bool))
    corners = positions[~inside[tuple(cells.T)]]
    try:
        triangles = corners[Delaunay(corners).simplices]
    except (QhullError, ValueError):
        return []
    ends = np.roll(triangles, 1, axis=1)
    probes = np.concatenate([(triangles + ends) / 2, triangles.mean(axis=1, keepdims=True)], axis=1)
    sampled_cells = np.floor((probes - positions.min(axis=0)) / width).astype(np.int64) + 1
    covered = occupied[sampled_cells[..., 0], sampled_cells[..., 1]].all(axis=1)
    faces = shapely.polygons(triangles[covered])
    try:
        # Triangles sharing complete edges form a coverage, whose union is faster.
        shape = shapely.coverage_union_all(faces)
    except shapely.errors.GEOSException:
        # Four points on a circle, up to rounding, may have overlapping triangles.
        shape = shapely.union_all(faces)
    return _rings(shapely, shapely.simplify(shape, width / 6), width * width)


def _rings(shapely: Any, shape: Any, min_area: float) -> list[NDArray[np.float64]]:  # noqa: ANN401
    """Return the rings of one or more polygons, largest first, without specks."""
    parts = [polygon for polygon in shapely.get_parts(shape) if polygon.geom_type == "Polygon"]
    largest = max((polygon.area for polygon in parts), default=0.0)
    parts = [polygon for polygon in parts if polygon.area >= min(min_area, largest)]
    rings: list[NDArray[np.float64]] = []
    for polygon in sorted(parts, key=lambda polygon: -polygon.area):
        oriented = shapely.geometry.polygon.orient(polygon)
        holes = [hole for hole in oriented.interiors if shapely.Polygon(hole).area >= min_area]
        rings += [np.asarray(ring.coords)[:-1] for ring in (oriented.exterior, *holes)]
    return rings
