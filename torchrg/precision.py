"""Whether coordinates have steps that are coarse for the spacing of their points.

float32 has 24 bits: a northing of five million metres is a multiple of half a metre there, and so
are the planes of a room. Nothing that comes later brings back what was lost.
"""

import math
import warnings

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import PrecisionWarning

_COARSE, _COARSE_GRID = 0.1, 0.5
"""Steps of the coordinates, in spacings of the points, from which on there is a note: those of
float32, which nobody has chosen, and those of a grid that a file was written with."""
_SURELY_FINE = 1e-3
"""Step, in spacings of an even surface, up to which nothing is searched: half of the points would
have to lie a hundred times as close for it to be too coarse."""
_QUARTILES = (0.25, 0.75)
"""Quantiles of each coordinate about the middle half of a cloud: single points far off play no
part."""
_SAMPLE = 20_000
"""About as many points tell the spacing."""
_CELL = 32
"""Side of the cells of the sample, in spacings of an even surface: seven of eight points are not at
the border of their cell, where the nearest point may be outside."""
_PRIMES = np.array([73_856_093, 19_349_663, 83_492_791])
"""Factors of the hash of a cell: M. Teschner et al. Optimized spatial hashing for collision
detection of deformable objects. VMV, 2003."""
_MIXING = 0x9E3779B97F4A7C15
"""Odd factor next to 2^64 over the golden ratio, which spreads such a hash over all 64 bits."""

_ABOVE_DECORATORS = 5
"""Frames from here to the caller of a function that has two decorators."""


def note_on_steps(
    points: NDArray[np.floating],
    *,
    scale: float = 0.0,
    cure: str = "write float64, or subtract an offset before saving",
) -> str:
    """Return a line for people where the steps of coordinates are coarse for the spacing.

    It is empty where they are not, and where that cannot be told: of fewer than three points, and
    where half of them are in one place. It does not depend on the order of the points.

    Args:
        points: Coordinates as they came, shape ``(N, 3)``, float32 or float64; what is not finite
            does not count, nor do the steps of float64.
        scale: What the coordinates are multiples of in their file. Default: of nothing.
        cure: What to do where it is the type that is too coarse, and not the scale.

    Example:
        >>> points = np.random.default_rng(0).random((1000, 3), dtype=np.float32)
        >>> note_on_steps(points)
        ''
        >>> note_on_steps(points + np.float32(5_400_000))  # doctest: +ELLIPSIS
        'coordinates have steps of 0.5 for a spacing of about 0.03; write float64, or subtract ...'
    """
    is_single = points.dtype == np.float32
    if not is_single and scale == 0:
        return ""
    finite = np.logical_and.reduce(np.isfinite(points.T))
    finite_points = points if finite.all() else points[finite]
    if len(finite_points) < 3:
        return ""
    with np.errstate(over="ignore", invalid="ignore"):
        ranks = [int(fraction * (len(finite_points) - 1)) for fraction in _QUARTILES]
        # One rank and one column at a time: a third of the time of np.quantile.
        low, high = np.array(
            [[np.partition(column, k)[k] for column in finite_points.T] for k in ranks],
            dtype=np.float64,
        )
        width, reach = float((high - low).max()), np.float32(np.abs([low, high]).max())
        single = float(np.spacing(reach)) if is_single else 0.0
    step = max(single, scale)
    even = width / math.sqrt(len(finite_points))
    if not 0 < width < math.inf or step <= _SURELY_FINE * even:
        return ""
    spacing = _spacing(finite_points, _CELL * even) if step < even else even
    is_grid = scale > _COARSE_GRID * spacing
    if not is_grid and single <= _COARSE * spacing:
        return ""
    step, cure = (scale, "write it with a finer scale") if is_grid else (single, cure)
    return f"coordinates have steps of {step:.2g} for a spacing of about {spacing:.1g}; {cure}"


def warn_of_steps(caller: str, points: Tensor) -> None:
    """Warn the user, above a public function and its decorators, of :func:`note_on_steps`."""
    coordinates = points.detach().cpu().numpy()
    note = note_on_steps(
        coordinates, cure="pass float64, or subtract an offset before it is float32"
    )
    if note:
        warnings.warn(f"{caller}: {note}.", PrecisionWarning, stacklevel=_ABOVE_DECORATORS)


def _spacing(points: NDArray[np.floating], side: float) -> float:
    """Return the median distance to the nearest other place, of the points in some of all cells.

    The place of a cell decides whether it is one of them, so that no order of the points does.
    """
    from scipy.spatial import cKDTree

    cells = np.floor(points.astype(np.float64) / side).clip(-(2.0**62), 2.0**62).astype(np.int64)
    hashes = np.bitwise_xor.reduce(cells * _PRIMES, axis=1).view(np.uint64) * np.uint64(_MIXING)
    fraction = min(_SAMPLE / len(points), 1.0)
    chosen = points[hashes <= fraction * np.iinfo(np.uint64).max]
    places = np.unique(chosen.astype(np.float64), axis=0)
    if len(places) < 2:
        return math.inf
    return float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))
