"""Units of the axes of a cloud, checked against the data."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SAMPLE = 10_000
"""Approximate number of points from which spans are measured."""
_QUANTILES = (0.01, 0.99)
"""Quantiles that bound the span of a coordinate, robust to outliers."""
_MIN_POINTS = 100
"""Minimum number of points whose spans are judged; fewer have any shape."""
_MAX_HEIGHT = 50.0
"""Maximum ratio of the span of z to those of x and y in one unit: a mast of 0.2 m and 10 m. Degrees
are 100,000 times longer than meters."""
_MAX_WIDTH = 1000.0
"""Maximum ratio of the span of x or y to that of z in one unit, unless z is noise: polders of 10 km
with houses of 10 m."""
_MAX_NOISE_STEPS = 100.0
"""Maximum ratio of the span of z to its noise on a flat surface. Landscapes and rooms, in any unit,
span more of their noise."""
_NUM_PAIRS = 1000
"""Number of pairs of nearest points in x and y from which the noise of z is measured."""
_SAME_UNIT = 1e-3
"""Relative difference of two units that count as one, such as the two kinds of foot."""
_GEO_UNITS = {9001: 1.0, 9002: 0.3048, 9003: 0.3048006}
"""Meters by the code of a unit in GeoTIFF keys."""
_GEO_MODEL, _GEO_HORIZONTAL, _GEO_VERTICAL = 1024, 3076, 4099
"""GeoTIFF keys of the model (2: degrees), and of the units of x and y, and of z."""


def describe_units(points: NDArray[np.floating], header: Mapping[str, Any] | None = None) -> str:
    """Return a note if the axes of a cloud seem to have different units, else an empty string.

    Args:
        points: Coordinates with z up, shape ``(N, 3)``; points that are not finite are ignored.
        header: See ``Cloud.header``; the reference system in it decides.
    """
    if note := _describe_header(header or {}):
        return note
    finite = points[:: max(len(points) // _SAMPLE, 1)]
    finite = finite[np.isfinite(finite).all(axis=1)].astype(np.float64)
    if len(finite) < _MIN_POINTS:
        return ""
    low, high = np.quantile(finite, _QUANTILES, axis=0)
    width, height = float((high - low)[:2].max()), float((high - low)[2])
    is_flat = width > _MAX_WIDTH * height > 0 and height > _MAX_NOISE_STEPS * _noise(points)
    if 0 < _MAX_HEIGHT * width < height or is_flat:
        return (
            f"x and y span {width:.2g}, z spans {height:.2g}: one unit is unlikely; convert "
            "degrees or units first"
        )
    return ""


def _noise(points: NDArray[np.floating]) -> float:
    """Return the lowest tenth of the differences of z between nearest points in x and y."""
    from scipy.spatial import cKDTree

    finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    some = finite[:: max(len(finite) // _NUM_PAIRS, 1)]
    _, near = cKDTree(finite[:, :2]).query(some[:, :2], k=2)
    return float(np.quantile(np.abs(finite[near[:, 1], 2] - some[:, 2]), 0.1))


def _describe_header(header: Mapping[str, Any]) -> str:
    """Return a note if the reference system of a file has degrees, or two units of length."""
    texts, keys = [str(header.get("coordinate_metadata", ""))], dict[int, int]()
    for record in getattr(header.get("las"), "vlrs", ()):
        texts.append(str(getattr(record, "string", "")))
        keys |= {key.id: key.value_offset for key in getattr(record, "geo_keys", ())}
    flat, _, vertical = "".join(texts).partition("VERT")
    has_degrees = re.search(r"\b(GEOGCS|GEOGCRS|GEODCRS)\[", flat) is not None
    is_projected = re.search(r"\bPROJ(CS|CRS)\[|cartesian", flat, re.IGNORECASE) is not None
    if (has_degrees and not is_projected) or keys.get(_GEO_MODEL) == 2:
        return "x and y are degrees by its header; project the cloud first, as to UTM"
    pattern = r'\b(?:LENGTH)?UNIT\["[^"]*",\s*([\d.eE+-]+)'
    units = [float(found[-1]) for part in (flat, vertical) if (found := re.findall(pattern, part))]
    codes = [_GEO_UNITS.get(keys.get(key, 0)) for key in (_GEO_HORIZONTAL, _GEO_VERTICAL)]
    units = units if len(units) == 2 else [unit for unit in codes if unit is not None]
    if len(units) == 2 and abs(units[0] - units[1]) > _SAME_UNIT * units[0]:
        return f"x and y are in units of {units[0]:g} m, z of {units[1]:g} m; convert one of them"
    return ""
