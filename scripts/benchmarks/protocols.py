"""Plane metrics of three published comparisons."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_shapes
from torchrg.errors import ConfigError
from torchrg.metrics.contingency import ContingencyTable, check_labels, count_overlaps, fraction
from torchrg.neighbors import sample_voxels
from torchrg.structures import UNLABELED

_MATCH_IOU = 0.75
"""Minimum IoU of a match in the EVOPS benchmark. Above 0.5, matches are one to one."""


class SegCompCounts(NamedTuple):
    """Counts of regions and faces (ground-truth planes) by the SegComp protocol.

    Attributes:
        correct: Matching pairs of a region and a face.
        over_segmented: Faces split into two or more regions.
        under_segmented: Regions that cover two or more faces.
        missed: Remaining faces.
        noise: Remaining regions.
    """

    correct: int
    over_segmented: int
    under_segmented: int
    missed: int
    noise: int


class EvopsScore(NamedTuple):
    """Metrics of the EVOPS benchmark, in [0, 1].

    Attributes:
        precision: Fraction of regions that match a face.
        recall: Fraction of faces that match a region.
        mean_iou: Mean IoU of the matches.
    """

    precision: float
    recall: float
    mean_iou: float


class VoxelScore(NamedTuple):
    """Voxel metrics of planes, in [0, 1].

    Attributes:
        precision: Fraction of region voxels that contain points of a region and of its face.
        recall: The same number as a fraction of all face voxels.
        f1: Harmonic mean of precision and recall.
    """

    precision: float
    recall: float
    f1: float


def score_voxels(
    points: Tensor | NDArray[np.floating],
    labels: Tensor | NDArray[Any],
    ground_truth: Tensor | NDArray[Any],
    *,
    voxel_size: float,
    threshold: float = 0.5,
) -> VoxelScore:
    """Evaluate regions by the voxels that they share with their faces [1], as in [2].

    The face of a region is the face with most of its points, if it has at least the fraction
    ``threshold``. Several regions may have the same face, so split faces are not penalized. A voxel
    is correct if it contains points of a region and of its face.

    Convention:
        The grid starts at the minimum coordinates. Points without a face count for the size and the
        voxels of their region. Ties between faces go to the lower label. Points that are not finite
        are ignored.

    Args:
        points: Points, shape ``(N, 3)``.
        labels: Predicted label of each point, shape ``(N,)``, integers, -1 for none.
        ground_truth: Ground-truth label of each point, shape ``(N,)``, integers, -1 for none.
        voxel_size: Voxel size, in the unit of the points; [2] uses 5 to 13 cm.
        threshold: Minimum fraction of a region in its face. Default: 0.5.

    Returns:
        The metrics; 0 if a denominator is 0.

    Raises:
        ShapeError: If a shape or dtype is wrong.
        ConfigError: If ``voxel_size`` is not positive.

    References:
        [1] A. Araujo, M. Oliveira. A robust statistics approach for plane detection in unorganized
        point clouds. Pattern Recognition 100, 2020, section 4.
        [2] Comparison of real-time plane detection algorithms (2D-3D-S, 2023),
        github.com/rocketman123456/Comparison-of-Real-Time-Plane-Detection-Algorithms.

    Example:
        >>> line = torch.arange(6.0)[:, None] * torch.tensor([1.0, 0, 0])
        >>> labels = torch.tensor([0, 0, 0, 0, 1, -1])
        >>> ground_truth = torch.tensor([0, 0, 0, 1, 1, 1])
        >>> score_voxels(line, labels, ground_truth, voxel_size=1.0)
        VoxelScore(precision=0.8, recall=0.6666666666666666, f1=0.7272727272727273)
    """
    positions = as_tensor("score_voxels", "points", points)
    labels, ground_truth = check_labels("score_voxels", labels=labels, ground_truth=ground_truth)
    check_shapes(
        "score_voxels",
        points=(positions, "N 3"),
        labels=(labels, "N"),
        ground_truth=(ground_truth, "N"),
    )
    voxels = sample_voxels(positions, voxel_size).inverse
    seen = voxels >= 0
    voxels, labels, ground_truth = voxels[seen], labels[seen], ground_truth[seen]
    table = count_overlaps("score_voxels", labels, ground_truth, 1, None)
    face_of = _face_of_region(table, threshold)
    # Points without a region use the last entry.
    row = torch.searchsorted(table.region_labels, labels)
    row[labels == UNLABELED] = len(face_of) - 1
    face = torch.searchsorted(table.face_labels, ground_truth)
    width = len(table.face_labels) + 1
    found, true = face_of[row] >= 0, ground_truth != UNLABELED
    keys = voxels[found] * width + face_of[row][found]
    right = keys[torch.isin(keys, voxels[true] * width + face[true])] // width
    num_right = len(torch.unique(right))
    num_found, num_true = (
        len(torch.unique(voxels[chosen])) for chosen in (labels != UNLABELED, true)
    )
    return VoxelScore(
        precision=fraction(num_right, num_found),
        recall=fraction(num_right, num_true),
        f1=fraction(2 * num_right, num_found + num_true),
    )


def _face_of_region(table: ContingencyTable, threshold: float) -> Tensor:
    """Return the face with most points of each region, -1 below the threshold; append -1."""
    num_regions = len(table.region_sizes)
    largest = table.overlaps.new_zeros(num_regions)
    largest = largest.scatter_reduce(0, table.regions, table.overlaps, "amax")
    first = largest.new_full((num_regions,), len(table.face_sizes))
    is_largest = table.overlaps == largest[table.regions]
    first = first.scatter_reduce(0, table.regions[is_largest], table.faces[is_largest], "amin")
    chosen = torch.where(largest >= threshold * table.region_sizes, first, UNLABELED)
    return torch.cat([chosen, chosen.new_tensor([UNLABELED])])


def count_segcomp(table: ContingencyTable, *, threshold: float = 0.8) -> SegCompCounts:
    """Classify regions and faces by the SegComp protocol [1], as SynPEB applies it [2].

    A region and a face form a *correct* pair if their overlap exceeds the fraction ``threshold`` of
    both. A face is *over-segmented* if two or more regions each have more than that fraction of
    their points in it, and together cover more than that fraction of the face. A region is
    *under-segmented* by the symmetric rule. Conflicts are resolved by the highest mean of two
    measures: both fractions of a correct pair, else the mean fraction of the parts and the covered
    fraction of the whole. Ties prefer correct, then over-segmented.

    Convention:
        Fractions must exceed the threshold, as in [2]; [1] states "at least". Points without a face
        count for the size of their region, and points without a region for that of their face.

    Args:
        table: Overlaps of regions and faces.
        threshold: Minimum fraction, in [0.5, 1). Default: 0.8, as in SynPEB's results.

    Returns:
        The counts; all 0 without regions and faces.

    Raises:
        ConfigError: If the threshold is outside [0.5, 1): below, the classes are not unique.

    References:
        [1] A. Hoover et al. An experimental comparison of range image segmentation algorithms.
        TPAMI 18(7), 1996, section 2.4.
        [2] A. Schaefer et al. A maximum likelihood approach to extract finite planes from 3-D
        laser scans. ICRA, 2019.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> labels = torch.tensor([0, 0, 1, 1, 2, 2])
        >>> ground_truth = torch.tensor([5, 5, 5, 5, 6, 6])
        >>> table = contingency_table(labels, ground_truth)
        >>> count_segcomp(table)
        SegCompCounts(correct=1, over_segmented=1, under_segmented=0, missed=0, noise=0)
    """
    if not 0.5 <= threshold < 1:
        raise ConfigError(f"count_segcomp: expected threshold in [0.5, 1), got {threshold!r}.")
    regions, faces = table.regions, table.faces
    of_region = table.overlaps / table.region_sizes[regions].double()
    of_face = table.overlaps / table.face_sizes[faces].double()
    in_face, in_region = of_region > threshold, of_face > threshold
    both = in_face & in_region
    fit = torch.where(both, (of_region + of_face) / 2, 0)
    split = _wholes(faces, in_face, of_region, table.overlaps, table.face_sizes, threshold)
    merged = _wholes(regions, in_region, of_face, table.overlaps, table.region_sizes, threshold)

    # Two classes can only meet in a correct pair, so each pair decides its own conflict.
    over, under = split[faces], merged[regions]
    correct = both & (fit >= over) & (fit >= under)
    is_split, is_merged = split > 0, merged > 0
    is_split[faces[both & ((fit >= over) | (under > over))]] = False
    is_merged[regions[both & ((fit >= under) | (over >= under))]] = False

    used_in_face = correct | (in_face & is_split[faces])
    used_in_region = correct | (in_region & is_merged[regions])
    seen_faces, seen_regions = is_split.clone(), is_merged.clone()
    seen_faces[faces[used_in_region]] = True
    seen_regions[regions[used_in_face]] = True
    return SegCompCounts(
        correct=int(correct.sum()),
        over_segmented=int(is_split.sum()),
        under_segmented=int(is_merged.sum()),
        missed=int((~seen_faces).sum()),
        noise=int((~seen_regions).sum()),
    )


def _wholes(
    wholes: Tensor, inside: Tensor, fractions: Tensor, overlaps: Tensor, sizes: Tensor, limit: float
) -> Tensor:
    """Return the mean of both measures for each whole with several parts, else 0."""
    count = torch.bincount(wholes[inside], minlength=len(sizes))
    points = sizes.new_zeros(len(sizes)).index_add_(0, wholes[inside], overlaps[inside])
    held = points.double() / sizes
    total = fractions.new_zeros(len(sizes)).index_add_(0, wholes[inside], fractions[inside])
    mean = total / count.clamp(min=1)
    return torch.where((count >= 2) & (held > limit), (mean + held) / 2, 0)


def score_evops(table: ContingencyTable) -> EvopsScore:
    """Match regions to faces at an IoU of at least 0.75, as in EVOPS [1].

    Points without a face count for the size of their region, and points without a region for that
    of their face.

    Args:
        table: Overlaps of regions and faces.

    Returns:
        The metrics; 0 if a denominator is 0.

    References:
        [1] A. Kornilova et al. EVOPS benchmark: evaluation of plane segmentation from RGBD and
        LiDAR data. arXiv:2204.05799, 2022.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([1, 1, 3, 3]), torch.tensor([2, 2, -1, 3]))
        >>> score_evops(table)
        EvopsScore(precision=0.5, recall=0.5, mean_iou=1.0)
    """
    matched = table.iou[table.iou >= _MATCH_IOU]
    return EvopsScore(
        precision=fraction(len(matched), len(table.region_sizes)),
        recall=fraction(len(matched), len(table.face_sizes)),
        mean_iou=fraction(float(matched.sum()), len(matched)),
    )
