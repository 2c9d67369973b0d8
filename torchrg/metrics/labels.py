"""External indices: predicted plane labels against ground truth."""

from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.metrics.contingency import ContingencyTable, count_overlaps, fraction, is_first
from torchrg.structures.points import short_repr


@short_repr
class LabelScore(NamedTuple):
    """External indices of a segmentation; see :func:`score_labels`.

    ``METRICS["labels"]`` lists the units: percent as in the paper, counts, or fractions in [0, 1].

    Attributes:
        precision: Mean over the pairs of ``100 |C & G| / |C|`` (section III.B), percent.
        recall: Mean over the pairs of ``100 |C & G| / |G|`` (section III.B), percent.
        f1: Harmonic mean of precision and recall (section III.B), percent.
        pairs: Number of regions and faces that are each other's largest overlap.
        regions: Number of predicted regions with an evaluated point.
        faces: Number of ground-truth planes (faces) with an evaluated point.
        points: Number of evaluated points: all except those with the ignored label.
        mean_best_iou: Mean over all faces of the largest IoU with a region.
        precision_iou50: Fraction of regions with a face at IoU > 0.5.
        recall_iou50: Fraction of faces with a region at IoU > 0.5.
        precision_iou80: The same at IoU > 0.8; so is ``recall_iou80``.
        fraction_labeled: Fraction of evaluated points in a region.
        covering: See :func:`segmentation_covering`.
        ari: See :func:`adjusted_rand_index`.
    """

    precision: float
    recall: float
    f1: float
    pairs: int
    regions: int
    faces: int
    points: int
    mean_best_iou: float
    precision_iou50: float
    recall_iou50: float
    precision_iou80: float
    recall_iou80: float
    fraction_labeled: float
    covering: float
    ari: float


def score_labels(
    labels: Tensor | NDArray[Any],
    ground_truth: Tensor | NDArray[Any],
    *,
    min_size: int = 1,
    ignore: int | None = None,
) -> LabelScore:
    """Evaluate predicted plane labels against ground truth.

    Precision, recall and F1 are the paper's [1]: means over the one-to-one pairs of
    :func:`match_regions`. They ignore regions and faces without a partner, so the counts and the
    indices over all faces complement them.

    Arguments, errors and the handling of unlabeled points are as in
    :func:`torchrg.metrics.contingency_table`: a point without a face lowers the precision of its
    region, a point without a region the recall of its face. The paper shows regions from 50 points.

    Returns:
        The indices. Means and fractions over nothing are 0; the counts show this.

    References:
        [1] Indoor Point Cloud Segmentation Using a Modified Region Growing Algorithm and Accurate
        Normal Estimation, section III.B.

    Example:
        >>> score = score_labels(torch.tensor([8, 8, 8, 3, -1]), torch.tensor([0, 0, 1, 1, 1]))
        >>> score.pairs, round(score.precision, 1), round(score.recall, 1), round(score.f1, 1)
        (2, 83.3, 66.7, 74.1)
        >>> score.recall_iou50, score.fraction_labeled
        (0.5, 0.8)
    """
    table = count_overlaps("score_labels", labels, ground_truth, min_size, ignore)
    num_regions, num_faces = len(table.region_sizes), len(table.face_sizes)
    pairs = match_regions(table)
    shared = 100 * table.overlaps[pairs].double()
    precision, recall = (
        fraction(float((shared / sizes).sum()), len(pairs))
        for sizes in (
            table.region_sizes[table.regions[pairs]],
            table.face_sizes[table.faces[pairs]],
        )
    )
    matched50, matched80 = (int((table.iou > bound).sum()) for bound in (0.5, 0.8))
    return LabelScore(
        precision=precision,
        recall=recall,
        f1=fraction(2 * precision * recall, precision + recall),
        pairs=len(pairs),
        regions=num_regions,
        faces=num_faces,
        points=table.num_points,
        mean_best_iou=fraction(float(_best_iou(table).sum()), num_faces),
        precision_iou50=fraction(matched50, num_regions),
        recall_iou50=fraction(matched50, num_faces),
        precision_iou80=fraction(matched80, num_regions),
        recall_iou80=fraction(matched80, num_faces),
        fraction_labeled=fraction(int(table.region_sizes.sum()), table.num_points),
        covering=segmentation_covering(table),
        ari=adjusted_rand_index(table),
    )


def match_regions(table: ContingencyTable) -> Tensor:
    """Pair regions and faces that are each other's largest overlap.

    This is the paper's pairing, see :func:`score_labels`. Ties in overlap go to the larger
    intersection over union, that is the smaller partner, then to the lower label. The paper also
    mentions "the maximum or second maximum overlap", without defining the use of the second.
    Returns the rows of the table's overlaps that are pairs, ascending, shape ``(P,)``, int64.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([4, 4, 4, 5, 5]), torch.tensor([0, 0, 1, 1, 1]))
        >>> pairs = match_regions(table)
        >>> table.region_labels[table.regions[pairs]].tolist()
        [4, 5]
        >>> table.face_labels[table.faces[pairs]].tolist()
        [0, 1]
    """
    regions, faces, fewest = table.regions, table.faces, -table.overlaps
    of_region = is_first(regions, fewest, table.face_sizes[faces], faces)
    of_face = is_first(faces, fewest, table.region_sizes[regions], regions)
    return (of_region & of_face).nonzero().squeeze(1)


def adjusted_rand_index(table: ContingencyTable) -> float:
    """Return the Rand index corrected for chance [1].

    Unlabeled points count as one part, so the value equals scikit-learn's ``adjusted_rand_score``
    for the same labels, including -1. At most 1 (equal partitions), about 0 for independent
    partitions, negative for worse; 1 without pairs of points.

    References:
        [1] L. Hubert, P. Arabie. Comparing partitions. Journal of Classification, 1985, eq. 5.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([5, 5, -1, 2]), torch.tensor([0, 0, 1, 3]))
        >>> adjusted_rand_index(table)
        1.0
    """
    # Python integers: products of two pair counts exceed 64 bits beyond 50,000 points.
    together, predicted, true = (
        int((sizes * (sizes - 1) // 2).sum()) for sizes in _sizes_with_unlabeled(table)
    )
    pairs = table.num_points * (table.num_points - 1) // 2
    scale = pairs * (predicted + true) - 2 * predicted * true
    return 2 * (pairs * together - predicted * true) / scale if scale else 1.0


def segmentation_covering(table: ContingencyTable) -> float:
    r"""Return the covering of the faces by the regions [1], in [0, 1]; 0 without faces.

    ``sum_j |G_j| max_i IoU(C_i, G_j) / sum_j |G_j|``: the mean best IoU weighted by size.

    References:
        [1] P. Arbelaez et al. Contour detection and hierarchical image segmentation. TPAMI, 2011,
        eq. 8.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([0, 0, 1, -1]), torch.tensor([3, 3, 4, 4]))
        >>> segmentation_covering(table)
        0.75
    """
    return float((_best_iou(table) * table.face_sizes).sum() / table.face_sizes.sum().clamp(min=1))


def _best_iou(table: ContingencyTable) -> Tensor:
    """Return the largest IoU of each face with a region, 0 without overlap, ``(F,)``."""
    best = table.iou.new_zeros(len(table.face_sizes))
    return best.scatter_reduce(0, table.faces, table.iou, "amax")


def _sizes_with_unlabeled(table: ContingencyTable) -> tuple[Tensor, Tensor, Tensor]:
    """Return the sizes of overlaps, regions and faces, with unlabeled points as another part."""
    in_faces = torch.zeros_like(table.region_sizes).index_add(0, table.regions, table.overlaps)
    in_regions = torch.zeros_like(table.face_sizes).index_add(0, table.faces, table.overlaps)
    bare_regions, bare_faces = table.region_sizes - in_faces, table.face_sizes - in_regions
    no_region = table.num_points - table.region_sizes.sum()
    no_face = table.num_points - table.face_sizes.sum()
    neither = no_region - bare_faces.sum()
    overlaps = torch.cat([table.overlaps, bare_regions, bare_faces, neither[None]])
    regions = torch.cat([table.region_sizes, no_region[None]])
    faces = torch.cat([table.face_sizes, no_face[None]])
    return overlaps[overlaps > 0], regions[regions > 0], faces[faces > 0]
