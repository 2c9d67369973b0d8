"""How close two clusters of directions come."""

import numpy as np
import torch
from torch import Tensor

from torchrg.metrics.sphere import chord_table, chord_to_angle
from torchrg.neighbors import canonical_order

_QUERIES = 65536
_MAX_CELLS = 4096
_FINEST_LEVEL = 50
"""Cells of this level are as small as the rounding of coordinates."""


def closest_between(directions: Tensor, clusters: Tensor, *, max_pairs: int = 2**17) -> float:
    r"""Return the smallest angle between directions of different clusters, as eq. (15) needs it.

    Exact for clouds of any size, by two searches. A grid on the sphere, made finer step by step,
    drops the cells that are farther from every other cluster than two points known to be close;
    it settles clusters that stand apart. What is left where many clusters overlap goes to
    kd-trees: the numbers of different clusters differ in one binary digit at least, so for each
    digit the directions are split by it and the closest pair across the split is found.

    Args:
        directions: Unit vectors, shape ``(N, 3)``, float64.
        clusters: Cluster of each, 0 or more, shape ``(N,)``.
        max_pairs: Chords in memory at a time; does not change the result.

    Returns:
        Radians, in [0, pi/2]; infinite where there are fewer than two clusters.

    Example:
        >>> axes = torch.eye(3, dtype=torch.float64)
        >>> round(closest_between(axes, torch.tensor([0, 1, 1])), 4)
        1.5708
    """
    if len(clusters) == 0 or clusters.min() == clusters.max():
        return torch.inf
    # Adding 0 turns -0 into 0, so that equal rows are equal bit by bit.
    points = torch.where(directions[:, 2:] < 0, -directions, directions) + 0.0
    order = canonical_order(points)
    points, clusters = points[order], clusters[order]
    repeated = (points[1:] == points[:-1]).all(dim=1)
    if (repeated & (clusters[1:] != clusters[:-1])).any():
        return 0.0
    new = torch.cat([torch.ones_like(repeated[:1]), ~repeated])
    chord = _closest_chord(points[new], clusters[new], max_pairs)
    return float(chord_to_angle(torch.tensor(chord, dtype=torch.float64)))


def _closest_chord(points: Tensor, clusters: Tensor, max_pairs: int) -> float:
    """Return the shortest chord between two clusters of distinct points of the upper half."""
    best, cells = 2.0, clusters
    for level in range(_FINEST_LEVEL):
        cells, firsts = _refine(cells, points, level)
        if len(firsts) > _MAX_CELLS:
            return _closest_by_digits(points, clusters, best)
        chords = _closest_others(points[firsts], clusters[firsts], max_pairs)
        best = min(best, float(chords.min()))
        if len(firsts) == len(points):
            break
        # Both ends of a chord are at most the cell's diagonal away from the first of their cell.
        near = (chords <= best + 2 * 3**0.5 * 0.5**level)[cells]
        points, clusters, cells = points[near], clusters[near], cells[near]
    return best


def _refine(cells: Tensor, points: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Return the cell of each point, of side 0.5^level, and the row of a point of each cell.

    The given cells are of twice that side, or clusters at level 0; each is divided into eight.
    """
    keys = cells
    for column in points.unbind(dim=1):
        keys = keys * 2 + ((column + 1) * 2**level).long() % 2
    order = keys.argsort(stable=True)
    new = torch.ones_like(keys, dtype=torch.bool)
    new[1:] = keys[order][1:] != keys[order][:-1]
    return torch.empty_like(keys).index_copy_(0, order, new.cumsum(0) - 1), order[new]


def _closest_others(points: Tensor, clusters: Tensor, max_pairs: int) -> Tensor:
    """Return the chord from each point to the closest one of another cluster, shape ``(C,)``."""
    rows = max(1, max_pairs // len(points))
    blocks = []
    for start in range(0, len(points), rows):
        block = slice(start, start + rows)
        chords = chord_table(points[block], points)
        chords[clusters[block, None] == clusters] = torch.inf
        blocks.append(chords.amin(dim=1))
    return torch.cat(blocks)


def _closest_by_digits(points: Tensor, clusters: Tensor, best: float) -> float:
    """Return the shortest chord across any split by a binary digit, at most ``best``."""
    from scipy.spatial import cKDTree

    coordinates, numbers = points.numpy(force=True), clusters.numpy(force=True)
    for digit in range(int(numbers.max()).bit_length()):
        side = (numbers >> digit & 1).astype(bool)
        if side.all() or not side.any():
            continue
        ones, others = coordinates[side], coordinates[~side]
        # Opposite directions are one; across the equator that needs the antipodes.
        tree = cKDTree(np.concatenate([others, -others[others[:, 2] <= best]]))
        for start in range(0, len(ones), _QUERIES):
            queries = ones[start : start + _QUERIES]
            distances, _ = tree.query(queries, distance_upper_bound=best)
            best = min(best, float(distances.min()))
    return best
