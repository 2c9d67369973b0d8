"""Polygons of few corners for drawings and tables."""

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TOLERANCES = (3.0, 1.5, 0.75)
"""Maximum distances of the boundary points from a straight side, in point spacings, first choice
first: points of random scans leave a ragged margin of about two spacings."""
_NOISE = 3.0
"""Minimum tolerance, in RMS distances of the plane."""
_MAX_AREA_CHANGE = 0.01
"""Maximum change of the area of a polygon, as a fraction: half by its largest ring, half by all
others."""
_MIN_SINE = 0.2
"""Minimum sine of the angle (12 degrees) at which two sides are extended to a corner."""
_Ring = NDArray[np.float64]


def straighten_rings(rings: Sequence[_Ring], spacing: float, rms: float) -> list[_Ring]:
    """Return the rings of a polygon with straight sides and few corners.

    Sides are lines of least squares through the ring's points, and meet in the corners. A ring
    whose area would change too much keeps its points; without shapely all do.

    Args:
        rings: Rings in the plane, shapes ``(V, 2)``.
        spacing: Distance of the plane's points to their neighbors.
        rms: RMS distance of the points to the plane, in the same unit.
    """
    if find_spec("shapely") is None:
        return list(rings)
    shapely = import_module("shapely")
    areas = [shapely.Polygon(ring).area for ring in rings]
    largest, straight = max(areas, default=0.0), []
    for ring, area in zip(rings, areas, strict=True):
        budget = _MAX_AREA_CHANGE / 2 * largest / (1 if area == largest else len(rings))
        for factor in _TOLERANCES:
            dense = np.asarray(shapely.segmentize(shapely.LinearRing(ring), spacing).coords)[:-1]
            fitted = _fit_sides(shapely, dense, max(factor * spacing, _NOISE * rms))
            if len(fitted) >= 3:
                polygon = shapely.Polygon(fitted)
                if polygon.is_valid and abs(polygon.area - area) <= budget:
                    ring = fitted
                    break
        straight.append(ring)
    return straight


def _fit_sides(shapely: Any, ring: _Ring, tolerance: float) -> _Ring:  # noqa: ANN401
    """Return the corners between the lines of least squares through the sides of a ring."""
    # The point that is farthest from the middle is a corner.
    first = np.square(ring - ring.mean(axis=0)).sum(axis=1).argmax()
    closed = np.roll(ring, -first, axis=0)[[*range(len(ring)), 0]]
    corners = np.asarray(shapely.simplify(shapely.LineString(closed), tolerance).coords)[:-1]
    starts = [int((closed[:-1] == corner).all(axis=1).argmax()) for corner in corners]
    sides = [closed[a : b + 1] for a, b in zip(starts, [*starts[1:], len(ring)], strict=True)]
    along = np.stack([np.linalg.svd(side - side.mean(axis=0))[2][0] for side in sides])
    normals = along @ [[0.0, 1.0], [-1.0, 0.0]]
    heights = np.array([side.mean(axis=0) @ n for side, n in zip(sides, normals, strict=True)])
    pairs = np.stack([np.roll(normals, 1, axis=0), normals], axis=1)
    sines = np.abs(np.linalg.det(pairs))
    pairs[sines < _MIN_SINE] = np.eye(2)
    meeting = np.linalg.solve(pairs, np.stack([np.roll(heights, 1), heights], 1)[..., None])[..., 0]
    is_near = np.linalg.norm(meeting - corners, axis=1) <= 2 * tolerance
    return np.where((is_near & (sines >= _MIN_SINE))[:, None], meeting, corners)
