"""Indices of plane labels as three published comparisons take them."""

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
"""Least IoU of a match in the EVOPS benchmark. Above 0.5 a match is one to one."""


class SegCompCounts(NamedTuple):
    """How the regions and faces are classified by the SegComp protocol.

    Attributes:
        correct: Pairs of a region and a face that are each other.
        over_segmented: Faces that two or more regions make up together.
        under_segmented: Regions that two or more faces make up together.
        missed: Faces in none of these.
        noise: Regions in none of these.
    """

    correct: int
    over_segmented: int
    under_segmented: int
    missed: int
    noise: int


class EvopsScore(NamedTuple):
    """Indices of the EVOPS benchmark, shares in [0, 1].

    Attributes:
        precision: Regions that match a face, of all regions.
        recall: Faces that match a region, of all faces.
        mean_iou: Mean IoU of the matches.
    """

    precision: float
    recall: float
    mean_iou: float


class VoxelScore(NamedTuple):
    """Voxels of planes that are found, shares in [0, 1].

    Attributes:
        precision: Voxels of regions in which a region meets its face, of all voxels of regions.
        recall: The same of all voxels of faces.
        f1: Harmonic mean of precision and recall.
    """

    precision: float
    recall: float
    f1: float


def score_voxels(
    points: Tensor | NDArray[np.floating],
    labels: Tensor | NDArray[Any],
    truth: Tensor | NDArray[Any],
    *,
    voxel_size: float,
    threshold: float = 0.5,
) -> VoxelScore:
    """Score regions by the voxels that they share with their faces [1], as compared in [2].

    The face of a region is the one that holds most of its points, if these are at least
    ``threshold`` of them; several regions may have one face, so split faces cost nothing. A voxel
    is right where a region and its face both have points in it.

    Convention:
        The grid begins at the least coordinates. Points of no face count in their region's size,
        and their voxels as voxels of the region. Of two faces that hold as many points the one of
        the lower label is taken. Points that are not finite are left out.

    Args:
        points: Points, shape ``(N, 3)``.
        labels: Predicted label of each point, shape ``(N,)``, integers, -1 for none.
        truth: True label of each point, shape ``(N,)``, integers, -1 for none.
        voxel_size: Side of a voxel, in the unit of the points; [2] has 5 cm to 13 cm.
        threshold: Least share of a region that its face holds.

    Returns:
        Shares; 0 where there is nothing to take a share of.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If ``voxel_size`` is not positive.

    References:
        [1] A. Araujo, M. Oliveira. A robust statistics approach for plane detection in unorganized
        point clouds. Pattern Recognition 100, 2020, section 4.
        [2] Comparison of real-time plane detection algorithms (2D-3D-S, 2023),
        github.com/rocketman123456/Comparison-of-Real-Time-Plane-Detection-Algorithms.

    Example:
        >>> line = torch.arange(6.0)[:, None] * torch.tensor([1.0, 0, 0])
        >>> labels, truth = torch.tensor([0, 0, 0, 0, 1, -1]), torch.tensor([0, 0, 0, 1, 1, 1])
        >>> score_voxels(line, labels, truth, voxel_size=1.0)
        VoxelScore(precision=0.8, recall=0.6666666666666666, f1=0.7272727272727273)
    """
    places = as_tensor("score_voxels", "points", points)
    labels, truth = check_labels("score_voxels", labels=labels, truth=truth)
    check_shapes("score_voxels", points=(places, "N 3"), labels=(labels, "N"), truth=(truth, "N"))
    voxels = sample_voxels(places, voxel_size).inverse
    seen = voxels >= 0
    voxels, labels, truth = voxels[seen], labels[seen], truth[seen]
    table = count_overlaps("score_voxels", labels, truth, 1, None)
    face_of = _face_of_region(table, threshold)
    # Points of no region find the entry behind the last.
    row = torch.searchsorted(table.region_labels, labels)
    row[labels == UNLABELED] = len(face_of) - 1
    face = torch.searchsorted(table.face_labels, truth)
    width = len(table.face_labels) + 1
    found, true = face_of[row] >= 0, truth != UNLABELED
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
    """Return the face that holds most of each region, -1 for less than a share; a last -1."""
    num_regions = len(table.region_sizes)
    most = table.overlaps.new_zeros(num_regions)
    most = most.scatter_reduce(0, table.regions, table.overlaps, "amax")
    first = most.new_full((num_regions,), len(table.face_sizes))
    is_most = table.overlaps == most[table.regions]
    first = first.scatter_reduce(0, table.regions[is_most], table.faces[is_most], "amin")
    chosen = torch.where(most >= threshold * table.region_sizes, first, UNLABELED)
    return torch.cat([chosen, chosen.new_tensor([UNLABELED])])


def count_segcomp(table: ContingencyTable, *, threshold: float = 0.8) -> SegCompCounts:
    """Classify regions and faces by the SegComp protocol [1], as SynPEB applies it [2].

    A region and a face are a *correct* pair if they share more than ``threshold`` of the points of
    each. A face is *over-segmented* if two or more regions lie in it, each with more than that
    share of its own points, and together hold more than that share of the face. A region is
    *under-segmented* by the mirrored rule. What takes part in several of these goes to the one
    with the highest mean of its two measures (correct: both shares; otherwise the mean share of
    the parts, and the share of the whole that they hold); at equal means correct goes first, then
    over-segmented.

    Convention:
        Shares must exceed the threshold, as in [2]; [1] writes "at least". A point of no face
        counts in its region's size, a point of no region in its face's.

    Args:
        table: Overlaps of regions and faces.
        threshold: The share, in [0.5, 1); SynPEB's results are for 0.8.

    Returns:
        The counts; all 0 where there is neither region nor face.

    Raises:
        ConfigError: If the threshold is outside [0.5, 1): below, the classes are not unique.

    References:
        [1] A. Hoover et al. An experimental comparison of range image segmentation algorithms.
        TPAMI 18(7), 1996, section 2.4.
        [2] A. Schaefer et al. A maximum likelihood approach to extract finite planes from 3-D
        laser scans. ICRA, 2019.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> labels, truth = torch.tensor([0, 0, 1, 1, 2, 2]), torch.tensor([5, 5, 5, 5, 6, 6])
        >>> table = contingency_table(labels, truth)
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
    """Return the mean of the two measures of each whole made of several parts, 0 for others."""
    count = torch.bincount(wholes[inside], minlength=len(sizes))
    points = sizes.new_zeros(len(sizes)).index_add_(0, wholes[inside], overlaps[inside])
    held = points.double() / sizes
    total = fractions.new_zeros(len(sizes)).index_add_(0, wholes[inside], fractions[inside])
    mean = total / count.clamp(min=1)
    return torch.where((count >= 2) & (held > limit), (mean + held) / 2, 0)


def score_evops(table: ContingencyTable) -> EvopsScore:
    """Score regions against faces that they match, at an IoU of at least 0.75, as EVOPS does [1].

    A point of no face counts in its region's size, a point of no region in its face's.

    Args:
        table: Overlaps of regions and faces.

    Returns:
        Shares; 0 where there is nothing to take a share of.

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
