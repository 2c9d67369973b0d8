"""Which point of one file is which of another: that of the same row, or the nearest one.

Files of the same points differ by rounding: to float32, to the grid of LAS, to the digits of a
text. Numbers agree within half a step of the coarser file and half a step of the finer one, so that
no two places that the coarser file tells apart are taken for one.
"""

from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg._parallel import ROWS_AT_ONCE, chunks_of
from torchrg.neighbors import search_nearest
from torchrg.structures import Cloud

_MOST_DIGITS = 12
"""A number with more decimals than this, or with more digits in all, is as exact as its type."""
_NOISE = 4
"""Steps of the number's type by which arithmetic, such as ``integer * scale + offset``, may move
it."""
_EXTREME: dict[str, Any] = {"over": "ignore", "under": "ignore", "invalid": "ignore"}
"""Settings under which coordinates of 1e-300, which have no digits to speak of, agree only if they
are equal."""
_SAMPLE = 10_000
"""Points that tell where the middle of a cloud is."""
_FAR = 4.0
"""Median distances from the middle at which the corner of a room lies, or beyond."""


class Rounding(NamedTuple):
    """How coarsely a file gives its coordinates.

    Attributes:
        dtype: Their type.
        scales: Steps of the three axes of a LAS file, otherwise 0, shape ``(3,)``.
        decimals: Those of the number that has most; None where numbers are not cut short.
        digits: As ``decimals``, but all significant digits.
        middle: Where the cloud is, shape ``(3,)``.
        reach: How far from there any origin near the cloud is.
    """

    dtype: np.dtype[np.floating]
    scales: NDArray[np.float64]
    decimals: int | None
    digits: int | None
    middle: NDArray[np.float64]
    reach: float

    @classmethod
    def of(cls, cloud: Cloud) -> "Rounding":
        """Return the rounding of a cloud, as its numbers and its header show it.

        Example:
            >>> rounding = Rounding.of(Cloud(np.array([[0.25, 1.5, 100.0], [0.125, 3.0, 7.0]])))
            >>> rounding.decimals, rounding.digits
            (3, 3)
        """
        las = cloud.header.get("las")
        scales = np.zeros(3) if las is None else np.asarray(las.scales, np.float64)
        decimals: int | None = 0
        digits: int | None = 1
        for rows in chunks_of(len(cloud), ROWS_AT_ONCE):
            numbers = cloud.coordinates[rows][cloud.finite[rows]]
            numbers = numbers[numbers != 0]
            decimals = _least_places(numbers, decimals, 0.0)
            digits = _least_places(numbers, digits, _exponents(numbers) + 1)
        finite = np.flatnonzero(cloud.finite)
        sample = cloud.coordinates[finite[:: len(finite) // _SAMPLE + 1]].astype(np.float64)
        middle, reach = np.zeros(3), 0.0
        if len(sample):
            middle = np.median(sample, axis=0)
            reach = _FAR * float(np.median(np.abs(sample - middle).max(axis=1)))
        return cls(cloud.coordinates.dtype, scales, decimals, digits, middle, reach)

    def half_steps(
        self, points: NDArray[np.float64], least: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return by how much rounding may have moved finite points, shape ``(n, 3)``.

        ``least`` are absolute values from which steps grow: those of the points, or of what they
        were before, whichever is less.
        """
        # torchrg and others compute with float32 about some origin.
        local = (np.abs(points - self.middle) + self.reach).astype(np.float32)
        steps: list[Any] = [np.spacing(local), np.spacing(least.astype(self.dtype)), self.scales]
        if self.decimals is not None:
            steps.append(10.0**-self.decimals)
        if self.digits is not None:
            steps.append(np.where(least > 0, 10.0 ** (_exponents(least) + 1 - self.digits), 0.0))
        largest: NDArray[np.float64] = reduce(np.maximum, steps)
        return largest / 2


def _exponents(numbers: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the powers of ten that numbers begin with; 0 for 0."""
    sizes, exponents = np.abs(numbers, dtype=np.float64), np.zeros(numbers.shape)
    np.log10(sizes, where=sizes > 0, out=exponents)
    return np.floor(exponents, out=exponents)


def _least_places(
    numbers: NDArray[np.floating], least: int | None, before: NDArray[np.float64] | float
) -> int | None:
    """Return how many digits, of which so many come ``before`` the point, give all numbers back.

    At least ``least``; None if more than :data:`_MOST_DIGITS`, or if that is None already.
    """
    if least is None:
        return None
    exact, noise = numbers.astype(np.float64), _NOISE * np.spacing(np.abs(numbers))
    with np.errstate(**_EXTREME):
        for places in range(least, _MOST_DIGITS + 1):
            unit = 10.0 ** (places - before)
            if (np.abs(np.rint(exact * unit) / unit - exact) <= noise).all():
                return places
    return None


def differing_rows(ours: Cloud, theirs: Cloud) -> NDArray[np.int64]:
    """Return the rows that hold another point in the other cloud, beyond what rounding explains.

    Points that are not finite agree with each other.

    Args:
        ours: A cloud of N points.
        theirs: A cloud of as many.

    Returns:
        Rows, ascending, shape ``(n,)``.

    Example:
        >>> exact = np.array([[0.123456, 2.0, 3.0], [0.5, 0.25, 0.125]])
        >>> written = Cloud(exact.round(3))
        >>> differing_rows(written, Cloud(exact)).tolist()
        []
        >>> differing_rows(written, Cloud(exact[::-1])).tolist()
        [0, 1]
    """
    return np.flatnonzero(~_agree(ours, theirs, np.arange(len(ours))))


def match_points(
    ours: Cloud, theirs: Cloud, max_distance: float | None = None
) -> NDArray[np.int64]:
    """Return the nearest point of ours for each of theirs.

    Args:
        ours: A cloud of N points.
        theirs: A cloud of M points, in the same coordinates.
        max_distance: Points farther than this are no match. Default: only what is the same point
            but for rounding is one, so that order and number may differ and nothing else.

    Returns:
        Rows of ours, shape ``(M,)``; -1 for no match, as for points that are not finite.

    Example:
        >>> room = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
        >>> match_points(Cloud(room[[2, 0]]), Cloud(room)).tolist()
        [1, -1, 0]
    """
    limit = np.inf if max_distance is None else max_distance
    ours_kept, theirs_kept = np.flatnonzero(ours.finite), np.flatnonzero(theirs.finite)
    found = search_nearest(ours.coordinates[ours_kept], theirs.coordinates[theirs_kept], limit)
    rows = np.full(len(theirs), -1)
    rows[theirs_kept] = np.where(found >= 0, ours_kept[found], -1) if len(ours_kept) else -1
    return rows if max_distance is not None else np.where(_agree(ours, theirs, rows), rows, -1)


def _agree(ours: Cloud, theirs: Cloud, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for each of their points whether it is that of a row of ours but for rounding."""
    agree = np.zeros(len(theirs), dtype=bool)
    roundings = Rounding.of(ours), Rounding.of(theirs)
    for chunk in chunks_of(len(theirs), ROWS_AT_ONCE):
        clouds = ((ours, rows[chunk]), (theirs, chunk))
        finite, other_finite = (cloud.finite[part] for cloud, part in clouds)
        both = finite & other_finite
        agree[chunk] = ~finite & ~other_finite
        points = [cloud.coordinates[part][both].astype(np.float64) for cloud, part in clouds]
        with np.errstate(**_EXTREME):
            least = np.minimum(*map(np.abs, points))
            halves = [r.half_steps(p, least) for r, p in zip(roundings, points, strict=True)]
            coarse, fine = np.maximum(*halves), np.minimum(*halves)
            bound = coarse + np.where(fine < coarse, fine, 0.0) + _NOISE * np.spacing(least)
            apart = np.abs(np.subtract(*points))
        agree[chunk][both] = ((apart <= bound) | (apart == 0)).all(axis=1)
    return agree
