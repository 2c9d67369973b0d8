"""Evaluation of superpoints against ground-truth objects."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes, is_positive
from torchrg.errors import ConfigError, shown
from torchrg.metrics.contingency import (
    check_labels,
    contingency_table,
    fraction,
    is_first,
    is_not_ignored,
)
from torchrg.neighbors import search_knn
from torchrg.neighbors.order import distinct_rows
from torchrg.structures import AnyCloud
from torchrg.structures.points import UNLABELED, short_repr

_NUM_NEIGHBORS = 8
"""Number of neighbors of a surface point; a boundary separates it from at least one of them."""


@short_repr
class PartitionScore(NamedTuple):
    """Quality of superpoints; see :func:`score_partition`.

    Attributes:
        asa: Achievable segmentation accuracy: fraction of points that are correct if every
            superpoint takes its most frequent object.
        oracle_miou: Mean IoU over the objects of that labeling.
        boundary_recall: Fraction of ground-truth boundary points with a superpoint boundary point
            within ``boundary_distance``. None without coordinates, as the next two.
        boundary_precision: The same fraction with the roles exchanged.
        boundary_distance: Maximum distance of matching boundaries, in units of the cloud.
        count: Number of superpoints, including those without an evaluated point.
        points_per_superpoint: Mean number of points of a superpoint, over all points.
        points: Number of evaluated points.
    """

    asa: float
    oracle_miou: float
    boundary_recall: float | None
    boundary_precision: float | None
    boundary_distance: float | None
    count: int  # type: ignore[assignment]
    points_per_superpoint: float
    points: int


def score_partition(
    superpoints: Tensor | NDArray[Any],
    ground_truth: Tensor | NDArray[Any],
    points: AnyCloud | None = None,
    *,
    boundary_distance: float | None = None,
    ignore: int | None = None,
) -> PartitionScore:
    """Evaluate a partition by the accuracy of a perfect classifier of its superpoints.

    Achievable segmentation accuracy and boundary recall are metrics of superpixels [1, 2]; the
    labeling by the most frequent object is the oracle of superpoint graphs [3]. More superpoints
    are never worse, so compare partitions with the same count.

    Convention:
        Points with the ground-truth label :data:`torchrg.UNLABELED` (-1) or ``ignore`` are not
        evaluated. Points with superpoint -1 belong to none, and are wrong. Ties between frequent
        objects go to the lowest label. Boundary points have a point with another label among their
        8 nearest evaluated points. Duplicate points with the same labels count once for boundaries.

    Args:
        superpoints: Superpoint of each point, shape ``(N,)``, integers.
        ground_truth: Ground-truth object of each point, shape ``(N,)``, integers.
        points: Points, shape ``(N, 3)``, for the boundary metrics, which ignore non-finite points.
            Default: boundary metrics are None.
        boundary_distance: Maximum distance of matching boundaries, in units of the cloud. Default:
            the median distance to the 8th nearest neighbor.
        ignore: Another ground-truth label that is not evaluated.

    Returns:
        The metrics. Fractions of nothing are 0.

    Raises:
        ShapeError: If labels are no integers, points not floating point, or lengths differ.
        ConfigError: If ``boundary_distance`` is not positive.

    References:
        [1] M.-Y. Liu et al. Entropy rate superpixel segmentation. CVPR, 2011.
        [2] A. Levinshtein et al. TurboPixels: fast superpixels using geometric flows. TPAMI, 2009.
        [3] L. Landrieu, M. Simonovsky. Large-scale point cloud semantic segmentation with
        superpoint graphs. CVPR, 2018.

    Example:
        >>> score = score_partition(torch.tensor([0, 0, 0, 1, 1]), torch.tensor([5, 5, 6, 6, 6]))
        >>> score.asa, round(score.oracle_miou, 3), score.count, score.points_per_superpoint
        (0.8, 0.667, 2, 2.5)
    """
    superpoints, ground_truth = check_labels(
        "score_partition", superpoints=superpoints, ground_truth=ground_truth
    )
    if boundary_distance is not None and not is_positive(boundary_distance):
        raise ConfigError(
            f"score_partition: expected boundary_distance > 0, got {shown(boundary_distance)}."
        )
    if points is not None:
        points = as_tensor("score_partition", "points", points)
        check_shapes("score_partition", points=(points, "N 3"), ground_truth=(ground_truth, "N"))
        check_floating("score_partition", points=points)
    scored = (ground_truth != UNLABELED) & is_not_ignored(ground_truth, ignore)
    has_one = superpoints != UNLABELED
    count = len(torch.unique(superpoints[has_one]))
    num_right, miou = _score_oracle(superpoints[scored], ground_truth[scored])
    recall = precision = None
    if points is not None:
        used = scored & points.isfinite().all(dim=1)
        recall, precision, boundary_distance = _score_boundaries(
            superpoints[used], ground_truth[used], points[used].detach(), boundary_distance
        )
    num_scored = int(scored.sum())
    return PartitionScore(
        asa=fraction(num_right, num_scored),
        oracle_miou=miou,
        boundary_recall=recall,
        boundary_precision=precision,
        boundary_distance=boundary_distance if points is not None else None,
        count=count,
        points_per_superpoint=fraction(int(has_one.sum()), count),
        points=num_scored,
    )


def _score_oracle(superpoints: Tensor, ground_truth: Tensor) -> tuple[int, float]:
    """Return the number of points with the most frequent object, and the mean IoU."""
    table = contingency_table(superpoints, ground_truth)
    # Ties go to the lowest label.
    largest = is_first(table.regions, -table.overlaps, table.faces)
    majority, num_right = table.faces[largest], table.overlaps[largest]
    right = torch.zeros_like(table.face_sizes).index_add(0, majority, num_right)
    sizes = torch.zeros_like(right).index_add(0, majority, table.region_sizes)
    iou = right.double() / (sizes + table.face_sizes - right)
    return int(right.sum()), fraction(float(iou.sum()), len(iou))


def _score_boundaries(
    superpoints: Tensor, ground_truth: Tensor, points: Tensor, distance: float | None
) -> tuple[float, float, float]:
    """Return recall and precision of superpoint boundaries, and the distance used."""
    from scipy.spatial import cKDTree

    # Duplicate points with the same labels count once.
    rows = distinct_rows(points, superpoints, ground_truth)
    superpoints, ground_truth, points = superpoints[rows], ground_truth[rows], points[rows]
    if len(points) < 2:
        return 0.0, 0.0, distance or 0.0
    k = min(_NUM_NEIGHBORS + 1, len(points))
    indices = search_knn(points, k, canonical=True).indices[:, 1:].long()
    if distance is None:
        reach = (points[indices[:, -1]].double() - points.double()).norm(dim=1)
        distance = float(reach.median())
    ours, theirs = (
        points[(labels[indices] != labels[:, None]).any(dim=1)].double().cpu().numpy()
        for labels in (superpoints, ground_truth)
    )
    if len(ours) == 0 or len(theirs) == 0:
        return 0.0, 0.0, distance
    fractions = []
    for of, near in ((theirs, ours), (ours, theirs)):
        # The search bound is exclusive.
        limit = np.nextafter(distance, np.inf)
        distances = cKDTree(near).query(of, distance_upper_bound=limit)[0]
        fractions.append(float(np.isfinite(distances).mean()))
    return fractions[0], fractions[1], distance
