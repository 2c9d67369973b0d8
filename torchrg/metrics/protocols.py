"""Counts of right, split, merged, missed and invented planes, as two benchmarks count them."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.metrics.contingency import ContingencyTable

_MATCH_IOU, _PART_IOU = 0.75, 0.2
"""Least IoU of a match and of an overlap in part, as in the EVOPS benchmark. Above 0.5 matches are
one to one."""


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
    """The indices of the EVOPS benchmark, shares in [0, 1].

    Attributes:
        precision: Regions that match a face, of all regions.
        recall: Faces that match a region, of all faces.
        f1: Harmonic mean of precision and recall.
        mean_iou: Mean IoU of the matches.
        mean_dice: Mean Dice coefficient of the matches.
        over_segmented: Faces that overlap several regions in part, of all faces.
        under_segmented: Regions that overlap several faces in part, of all regions.
        missed: Faces without a counterpart, of all faces.
        noise: Regions without a counterpart, of all regions.
    """

    precision: float
    recall: float
    f1: float
    mean_iou: float
    mean_dice: float
    over_segmented: float
    under_segmented: float
    missed: float
    noise: float


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

    # Two classes can only meet in a correct pair, so each pair settles its own conflict.
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
    wholes: Tensor, inside: Tensor, shares: Tensor, overlaps: Tensor, sizes: Tensor, limit: float
) -> Tensor:
    """Return the mean of the two measures of each whole made of several parts, 0 for others."""
    count = torch.bincount(wholes[inside], minlength=len(sizes))
    points = sizes.new_zeros(len(sizes)).index_add_(0, wholes[inside], overlaps[inside])
    held = points.double() / sizes
    total = shares.new_zeros(len(sizes)).index_add_(0, wholes[inside], shares[inside])
    mean = total / count.clamp(min=1)
    return torch.where((count >= 2) & (held > limit), (mean + held) / 2, 0)


def score_evops(table: ContingencyTable) -> EvopsScore:
    """Score regions against faces by the EVOPS protocol [1].

    A region and a face *match* at an IoU of 0.75 and overlap *in part* at 0.2. A region that
    overlaps several faces in part is under-segmented, a face that overlaps several regions in part
    over-segmented. A region is noise, and a face missed, if it overlaps nothing in part, or exactly
    one partner that it does not match and that has no other partner.

    Convention:
        Both bounds are included ("at least"), as in the benchmark. A point of no face counts in
        its region's size, a point of no region in its face's.

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
        >>> score_evops(table).precision, score_evops(table).recall
        (0.5, 0.5)
    """
    full, part = table.iou >= _MATCH_IOU, table.iou >= _PART_IOU
    matched = table.iou[full]
    num_matched = len(matched)
    num_regions, num_faces = len(table.region_sizes), len(table.face_sizes)
    faces_of = torch.bincount(table.regions[part], minlength=num_regions)
    regions_of = torch.bincount(table.faces[part], minlength=num_faces)

    # A lone partner in part that is no match leaves both sides without a counterpart.
    lone = part & ~full & (faces_of[table.regions] == 1) & (regions_of[table.faces] == 1)
    noise = int((faces_of == 0).sum()) + int(lone.sum())
    missed = int((regions_of == 0).sum()) + int(lone.sum())
    return EvopsScore(
        precision=share(num_matched, num_regions),
        recall=share(num_matched, num_faces),
        f1=share(2 * num_matched, num_regions + num_faces),
        mean_iou=share(float(matched.sum()), num_matched),
        mean_dice=share(float((2 * matched / (1 + matched)).sum()), num_matched),
        over_segmented=share(int((regions_of > 1).sum()), num_faces),
        under_segmented=share(int((faces_of > 1).sum()), num_regions),
        missed=share(missed, num_faces),
        noise=share(noise, num_regions),
    )


def share(part: float, whole: float) -> float:
    """Return ``part / whole``, and 0 where the whole is 0."""
    return part / whole if whole else 0.0
