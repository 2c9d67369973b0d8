"""Correspondence of the points of two clouds, by row or by distance."""

import numpy as np
from numpy.typing import NDArray

from torchrg._checks import to_cloud
from torchrg.neighbors.knn import search_nearest
from torchrg.structures import AnyCloud


def differing_rows(ours: AnyCloud, theirs: AnyCloud) -> NDArray[np.int64]:
    """Return the rows with different points in two clouds of equal length, ascending.

    Coordinates are compared in the narrower type of both clouds, so a float32 copy equals its
    float64 original. Non-finite points are equal to each other. Points moved by other rounding
    differ; use :func:`match_points` for them.

    Example:
        >>> exact = np.array([[0.1, 2.0, 3.0], [0.5, 0.25, 0.125]])
        >>> differing_rows(exact.astype(np.float32), exact).tolist()
        []
        >>> differing_rows(exact[::-1], exact).tolist()
        [0, 1]
    """
    ours, theirs = clouds = [to_cloud("differing_rows", cloud) for cloud in (ours, theirs)]
    dtype = min((cloud.coordinates.dtype for cloud in clouds), key=lambda dtype: dtype.itemsize)
    with np.errstate(over="ignore"):
        first, second = (cloud.coordinates.astype(dtype, copy=False) for cloud in clouds)
    same = (first == second).all(axis=1) & ours.finite & theirs.finite
    return np.flatnonzero(~same & (ours.finite | theirs.finite))


def match_points(ours: AnyCloud, theirs: AnyCloud, max_distance: float) -> NDArray[np.int64]:
    """Return the nearest point of ours for each of theirs, as rows of ours, shape ``(M,)``.

    The entry is -1 for points not finite, or farther than ``max_distance``, in units of the clouds.

    Example:
        >>> room = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
        >>> match_points(room[[2, 0]], room, 0.001).tolist()
        [1, -1, 0]
    """
    ours, theirs = (to_cloud("match_points", cloud) for cloud in (ours, theirs))
    ours_kept, theirs_kept = np.flatnonzero(ours.finite), np.flatnonzero(theirs.finite)
    rows = np.full(len(theirs), -1)
    if len(ours_kept):
        finite = ours.coordinates[ours_kept], theirs.coordinates[theirs_kept]
        nearest = search_nearest(*finite, max_distance)
        rows[theirs_kept] = np.where(nearest >= 0, ours_kept[nearest], -1)
    return rows
