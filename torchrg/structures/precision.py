"""Precision and units of coordinates: rounding steps, placeholders, and spans of the axes.

float32 has 24 bits: a northing of five million meters is a multiple of 0.5 m. Lost precision cannot
be recovered.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, map_tasks, split_rows
from torchrg.errors import PrecisionWarning, UnitWarning, warn

_COARSE, _COARSE_GRID = 0.1, 0.5
"""Rounding steps above which there is a note, in spacings: for float32, and for a file's scale."""
_MAX_FINE_STEP = 1e-3
"""Rounding step, in spacings of a uniform surface, up to which no search is needed: for it to be
too coarse, half of the points would have to be a hundred times closer."""
_QUARTILES = (0.25, 0.75)
"""Quantiles of each coordinate that bound the middle half of a cloud, robust to outliers."""
_SAMPLE = 20_000
"""Approximate number of points from which the spacing is measured."""
_CELL = 32
"""Side of the cells of the sample, in spacings of a uniform surface. Seven of eight points are away
from the boundary of their cell, outside of which the nearest point may be."""
_MIN_PLACEHOLDERS = 10
"""Points at 0 0 0 from which they count as pixels without depth. Fewer may be measured."""
_PRIMES = np.array([73_856_093, 19_349_663, 83_492_791])
"""Factors of the cell hash: M. Teschner et al. Optimized spatial hashing for collision detection of
deformable objects. VMV, 2003."""
_MIXING = 0x9E3779B97F4A7C15
"""Odd factor next to 2^64 over the golden ratio, which spreads the hash over all 64 bits."""
_SPAN_SAMPLE = 10_000
"""Approximate number of points from which spans are measured."""
_QUANTILES = (0.01, 0.99)
"""Quantiles that bound the span of a coordinate, robust to outliers."""
_MIN_POINTS = 100
"""Minimum number of points whose spans are judged; fewer have any shape."""
_MAX_HEIGHT = 50.0
"""Maximum ratio of the span of z to the spans of x and y in one unit: a mast is 0.2 m wide and 10 m
high. A degree is 100,000 times longer than a meter."""
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


def describe_steps(
    points: NDArray[np.floating],
    *,
    scale: float = 0.0,
    fix: str = "write float64, or subtract an offset before saving",
) -> str:
    """Return a note if the rounding step of coordinates is coarse for their spacing.

    The note is empty if the step is fine, or cannot be judged: with fewer than three points, or if
    half of them coincide. It does not depend on the order of the points.

    Args:
        points: Input coordinates, shape ``(N, 3)``, float32 or float64. Non-finite points and the
            rounding step of float64 are ignored.
        scale: Step of the coordinates in their file. Default: none.
        fix: Fix if the type, not the scale, is too coarse.
    """
    is_single = points.dtype == np.float32
    if not is_single and scale == 0:
        return ""
    is_finite = np.isfinite([points.min(initial=0), points.max(initial=0)]).all()
    finite = points if is_finite else points[np.isfinite(points).all(axis=1)]
    if len(finite) < 3:
        return ""
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = _middle_half(finite)
        width, reach = float((high - low).max()), np.float32(np.abs([low, high]).max())
        single = float(np.spacing(reach)) if is_single else 0.0
    step = max(single, scale)
    even = width / math.sqrt(len(finite))
    if not 0 < width < math.inf or step <= _MAX_FINE_STEP * even:
        return ""
    spacing = _spacing(finite, _CELL * even) if step < even else even
    is_grid = scale > _COARSE_GRID * spacing
    if not is_grid and single <= _COARSE * spacing:
        return ""
    step, fix = (scale, "write it with a finer scale") if is_grid else (single, fix)
    return f"coordinates have steps of {step:.2g} for a spacing of about {spacing:.1g}; {fix}"


def is_fine_step(step: float, points: NDArray[np.floating]) -> bool:
    """Return whether a rounding step is surely fine for finite points ``(N, 3)``."""
    low, high = _middle_half(points)
    return step <= _MAX_FINE_STEP * float((high - low).max()) / math.sqrt(len(points))


def _middle_half(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the lowest and highest coordinates of the middle half of points, shape ``(2, 3)``."""
    ranks = [int(fraction * (len(points) - 1)) for fraction in _QUARTILES]

    def work(axis: int) -> NDArray[np.floating]:
        # A column takes a third of the time of np.quantile.
        return np.partition(points[:, axis], ranks)[ranks]

    return np.array(map_tasks(work, range(3), torch.device("cpu")), dtype=np.float64).T


def describe_placeholders(points: NDArray[np.floating]) -> str:
    """Return a note if many points lie at 0 0 0, where cameras put pixels without depth."""
    at_zero = points[points[:, 0] == 0]
    count = len(at_zero) - int(np.count_nonzero(at_zero.any(axis=1)))
    if not _MIN_PLACEHOLDERS <= count < len(points):
        return ""
    return (
        f"{count:,} of {len(points):,} points lie at 0 0 0, as pixels without depth do; remove "
        "them, or set them to NaN"
    )


def warn_about_coordinates(caller: str, points: Tensor) -> None:
    """Warn about coarse steps, placeholders of missing points, and axes of different units."""
    coordinates = points.detach().cpu().numpy()
    fix = "pass float64, or subtract an offset before it is float32"
    steps, missing = describe_steps(coordinates, fix=fix), describe_placeholders(coordinates)
    for note in filter(None, (steps, missing)):
        warn(f"{caller}: {note}.", PrecisionWarning)
    if note := describe_units(coordinates):
        warn(f"{caller}: {note}.", UnitWarning)


def _spacing(points: NDArray[np.floating], side: float) -> float:
    """Return the median distance to the nearest distinct point, in a sample of cells.

    Cells are sampled by a hash of their position, so the order of the points does not matter.
    """
    from scipy.spatial import cKDTree

    max_hash = min(_SAMPLE / len(points), 1.0) * np.iinfo(np.uint64).max
    chosen = []
    for rows in split_rows(len(points), ROWS_AT_ONCE):
        part = points[rows].astype(np.float64)
        cells = np.floor(part / side).clip(-(2.0**62), 2.0**62).astype(np.int64)
        mixed = np.bitwise_xor.reduce(cells * _PRIMES, axis=1)
        chosen.append(part[mixed.view(np.uint64) * np.uint64(_MIXING) <= max_hash])
    positions = np.unique(np.concatenate(chosen), axis=0)
    if len(positions) < 2:
        return math.inf
    return float(np.median(cKDTree(positions).query(positions, k=2)[0][:, 1]))


def describe_units(points: NDArray[np.floating], header: Mapping[str, Any] | None = None) -> str:
    """Return a note if the axes of a cloud seem to have different units, else an empty string.

    Args:
        points: Coordinates with z up, shape ``(N, 3)``; points that are not finite are ignored.
        header: See ``Cloud.header``; the reference system in it decides.
    """
    if note := _describe_header(header or {}):
        return note
    finite = points[:: max(len(points) // _SPAN_SAMPLE, 1)]
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
