"""Compactness and separation of clusters of normals, without ground truth."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ConfigError
from torchrg.metrics.contingency import check_labels, number_labels
from torchrg.metrics.sphere import (
    chord_table,
    chord_to_angle,
    chords_between,
    chunk_rows,
    find_centers,
    measure_spreads,
    merge_directions,
    unit_vectors,
)
from torchrg.neighbors import canonical_order
from torchrg.structures.points import UNLABELED, short_repr

_COINCIDENT = 1e-12
"""Angle in radians below which centers or directions of two clusters differ only by rounding."""
_MAX_CELLS = 4096
"""Maximum number of grid cells in the search for the closest pair; beyond it, trees are faster."""
_FINEST_LEVEL = 50
"""Number of subdivisions after which cells are as small as the rounding of coordinates."""
_QUERIES = 65536
"""Number of directions per tree query. Each result shortens the next query."""


@short_repr
class ClusterScore(NamedTuple):
    """Internal indices on the Gaussian sphere; see :func:`score_clusters`.

    Attributes:
        cp: Compactness (eq. 12), radians, lower is better.
        sp: Separation (eq. 13), radians, higher is better.
        dbi: Davies-Bouldin index (eq. 14), lower is better.
        dvi: Dunn validity index (eq. 15), higher is better.
        clusters: Number of clusters, after merging if requested.
        points: Number of labeled points with a normal.
        invalid: Number of labeled points without a normal, which are ignored.
        sampled_clusters: Number of clusters whose term of ``dbi`` comes from a subsample.
        dvi_exact: Whether ``dvi`` is exact, without subsamples.
    """

    cp: float
    sp: float
    dbi: float
    dvi: float
    clusters: int
    points: int
    invalid: int
    sampled_clusters: int
    dvi_exact: bool


def score_clusters(
    normals: Tensor | NDArray[Any],
    labels: Tensor | NDArray[Any],
    *,
    min_size: int = 1,
    distinct_directions: bool = False,
    max_angle_deg: float = 5.0,
    sample_size: int = 20_000,
    seed: int = 0,
) -> ClusterScore:
    r"""Evaluate clusters of normals on the Gaussian sphere: CP, SP, DBI and DVI [1].

    The distance of two normals is ``arccos |n_i . n_j|`` (eq. 17). The center of a cluster is its
    normalized mean normal (eq. 16) after aligning the signs along the principal axis. For M
    clusters with centers ``c_i`` and mean pairwise distances ``w_i``:

    * CP: mean over the clusters of the mean distance to the center;
    * SP: mean distance over all pairs of centers;
    * DBI: mean over the clusters of ``max_j (w_i + w_j) / d(c_i, c_j)``;
    * DVI: minimum distance between two clusters, divided by the maximum diameter of a cluster.

    Convention:
        Two parallel walls have the same center on the sphere. In real rooms DBI therefore tends to
        infinity and DVI to 0. (The formulas bound DVI by (pi/2) / CP; the 10.0 printed in the
        paper exceeds this bound.) ``distinct_directions`` evaluates the *directions* instead.
        Points labeled ``UNLABELED`` (-1), or with a zero or non-finite normal, are ignored.

    Args:
        normals: Normals of any sign and length, shape ``(N, 3)``, floating point.
        labels: Cluster of each point, shape ``(N,)``, integers.
        min_size: Minimum number of points per cluster; smaller clusters count as unlabeled.
        distinct_directions: Whether to merge clusters with similar directions first.
        max_angle_deg: Maximum angle between the centers of merged clusters, in degrees, transitive.
        sample_size: Maximum cluster size for exact evaluation. Larger clusters are subsampled to
            this size for ``w_i``, and for the diameter in DVI if it has more candidate end points
            (few on planes). Everything else is exact.
        seed: Seed of the subsample, which does not depend on the order of the points.

    Returns:
        The indices. Without clusters all are nan; for one cluster all except CP. A cluster of one
        point has spread 0. If centers coincide, ``dbi`` is infinite. If all diameters are 0,
        ``dvi`` is infinite, or 0 if two clusters share a direction.

    Raises:
        ShapeError: If a shape, dtype or device is invalid.
        ConfigError: If a setting is out of range.

    References:
        [1] Indoor Point Cloud Segmentation Using a Modified Region Growing Algorithm and Accurate
        Normal Estimation, section III.A.

    Example:
        >>> normals = torch.tensor([[0.0, 0, 1], [0, 0.6, 0.8], [1, 0, 0], [-1, 0, 0]])
        >>> score = score_clusters(normals, torch.tensor([0, 0, 1, 1]))
        >>> round(score.cp, 4), round(score.sp, 4), round(score.dbi, 4), round(score.dvi, 4)
        (0.1609, 1.5708, 0.4097, 2.441)
    """
    normals = as_tensor("score_clusters", "normals", normals)
    (labels,) = check_labels("score_clusters", labels=labels)
    check_shapes("score_clusters", normals=(normals, "N 3"), labels=(labels, "N"))
    check_floating("score_clusters", normals=normals)
    for name, value, minimum in (("min_size", min_size, 1), ("sample_size", sample_size, 2)):
        if value < minimum:
            raise ConfigError(f"score_clusters: expected {name} >= {minimum}, got {value!r}.")
    if not 0 <= max_angle_deg <= 90:
        raise ConfigError(
            f"score_clusters: expected max_angle_deg in [0, 90], got {max_angle_deg!r}."
        )
    _, rows, sizes = torch.unique(labels, return_inverse=True, return_counts=True)
    labeled = (labels != UNLABELED) & (sizes >= min_size)[rows]
    directions, exists = unit_vectors(normals[labeled])
    directions, (_, clusters) = directions[exists], number_labels(labels[labeled][exists])
    centers, turned = find_centers(directions, clusters)
    if distinct_directions:
        clusters = merge_directions(centers, max_angle_deg=max_angle_deg)[clusters]
        centers, turned = find_centers(directions, clusters)
    members = turned[clusters.argsort(stable=True)]
    parts = torch.split(members, torch.bincount(clusters).tolist()) if len(clusters) else ()
    means, diameters, num_sampled, exact = measure_spreads(
        parts, centers, sample_size=sample_size, seed=seed
    )
    angles = chord_to_angle(chords_between(turned, centers[clusters]))
    sp, dbi = _separation(centers, means)
    return ClusterScore(
        cp=float((torch.bincount(clusters, angles) / torch.bincount(clusters)).mean()),
        sp=sp,
        dbi=dbi,
        dvi=_dunn(closest_between(directions, clusters), diameters),
        clusters=len(centers),
        points=len(clusters),
        invalid=int((~exists).sum()),
        sampled_clusters=num_sampled,
        dvi_exact=exact,
    )


def _separation(centers: Tensor, spreads: Tensor) -> tuple[float, float]:
    """Return SP (eq. 13) and DBI (eq. 14); nan for fewer than two clusters."""
    count = len(centers)
    if count < 2:
        return math.nan, math.nan
    total, worst, rows = 0.0, 0.0, chunk_rows(count)
    for start in range(0, count, rows):
        block = slice(start, start + rows)
        distances = chord_to_angle(chord_table(centers[block], centers))
        total += float(distances.sum())
        distances[distances <= _COINCIDENT] = 0
        ratios = (spreads[block, None] + spreads) / distances
        ratios[distances == 0] = math.inf
        ratios.diagonal(start).fill_(-math.inf)
        worst += float(ratios.amax(dim=1).sum())
    return total / (count * (count - 1)), worst / count


def _dunn(closest: float, diameters: Tensor) -> float:
    """Return DVI (eq. 15) from the minimum distance between clusters and their diameters."""
    if len(diameters) < 2:
        return math.nan
    if closest <= _COINCIDENT:
        return 0.0
    largest = float(diameters.max())
    return closest / largest if largest > _COINCIDENT else math.inf


def closest_between(directions: Tensor, clusters: Tensor) -> float:
    """Return the minimum angle between directions of different clusters, for eq. (15).

    The search is exact for clouds of any size. First, a grid on the sphere is refined step by step,
    and cells farther from all other clusters than the best pair so far are dropped. This suffices
    for separated clusters. Kd-trees search the remaining points of overlapping clusters: cluster
    indices differ in at least one binary digit, so the directions are split by each digit, and the
    closest pair across each split is found.

    Unit vectors have shape ``(N, 3)``, float64; infinite for fewer than two clusters.
    """
    if len(clusters) == 0 or clusters.min() == clusters.max():
        return torch.inf
    # Adding 0 turns -0 into 0, so that equal rows are bit-identical.
    points = torch.where(directions[:, 2:] < 0, -directions, directions) + 0.0
    order = canonical_order(points)
    points, clusters = points[order], clusters[order]
    repeated = (points[1:] == points[:-1]).all(dim=1)
    if (repeated & (clusters[1:] != clusters[:-1])).any():
        return 0.0
    new = torch.cat([torch.ones_like(repeated[:1]), ~repeated])
    chord = _closest_chord(points[new], clusters[new])
    return float(chord_to_angle(torch.tensor(chord, dtype=torch.float64, device="cpu")))


def _closest_chord(points: Tensor, clusters: Tensor) -> float:
    """Return the shortest chord between two clusters of distinct points of the upper hemisphere."""
    best, cells = 2.0, clusters
    for level in range(_FINEST_LEVEL):
        cells, firsts = _refine(cells, points, level)
        if len(firsts) > _MAX_CELLS:
            return _closest_by_digits(points, clusters, best)
        chords = _closest_others(points[firsts], clusters[firsts])
        best = min(best, float(chords.min()))
        if len(firsts) == len(points):
            break
        # Both ends of a chord are within a cell diagonal of the first point of their cell.
        near = (chords <= best + 2 * 3**0.5 * 0.5**level)[cells]
        points, clusters, cells = points[near], clusters[near], cells[near]
    return best


def _refine(cells: Tensor, points: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Halve the cells; return the cell of each point, and one point of each cell."""
    keys = cells
    for column in points.unbind(dim=1):
        keys = keys * 2 + ((column + 1) * 2**level).long() % 2
    order = keys.argsort(stable=True)
    new = torch.ones_like(keys, dtype=torch.bool)
    new[1:] = keys[order][1:] != keys[order][:-1]
    return torch.empty_like(keys).index_copy_(0, order, new.cumsum(0) - 1), order[new]


def _closest_others(points: Tensor, clusters: Tensor) -> Tensor:
    """Return the chord from each point to the closest point of another cluster, shape ``(C,)``."""
    rows = chunk_rows(len(points))
    closest = []
    for chunk, owners in zip(torch.split(points, rows), torch.split(clusters, rows), strict=True):
        chords = chord_table(chunk, points)
        chords[owners[:, None] == clusters] = torch.inf
        closest.append(chords.amin(dim=1))
    return torch.cat(closest)


def _closest_by_digits(points: Tensor, clusters: Tensor, best: float) -> float:
    """Return the shortest chord across a split by any binary digit, at most ``best``."""
    from scipy.spatial import cKDTree

    coordinates, numbers = points.numpy(force=True), clusters.numpy(force=True)
    for digit in range(int(numbers.max()).bit_length()):
        side = (numbers >> digit & 1).astype(bool)
        if side.all() or not side.any():
            continue
        ones, others = coordinates[side], coordinates[~side]
        # Opposite directions are equal; pairs across the equator need the antipodes.
        tree = cKDTree(np.concatenate([others, -others[others[:, 2] <= best]]))
        for start in range(0, len(ones), _QUERIES):
            queries = ones[start : start + _QUERIES]
            distances, _ = tree.query(queries, distance_upper_bound=best)
            best = min(best, float(distances.min()))
    return best
