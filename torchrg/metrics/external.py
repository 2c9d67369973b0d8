"""External indices: predicted plane labels against true ones."""

from typing import Any, NamedTuple

from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.metrics.agreement import (
    adjusted_rand_index,
    normalized_mutual_information,
    segmentation_covering,
)
from torchrg.metrics.contingency import ContingencyTable, check_labels, contingency_table
from torchrg.metrics.matching import best_iou, match_regions
from torchrg.metrics.protocols import count_segcomp, score_evops, share


class LabelScore(NamedTuple):
    """External indices of a labelling; see :func:`score_labels`.

    ``precision``, ``recall`` and ``f1`` are percentages as in the paper; counts are integers;
    everything else is a share in [0, 1] (``ari`` can be negative). ``METRICS["labels"]`` holds
    unit and direction of each.

    Attributes:
        precision: Mean over the pairs of ``100 |C & G| / |C|`` (section III.B), percent.
        recall: Mean over the pairs of ``100 |C & G| / |G|`` (section III.B), percent.
        f1: Harmonic mean of precision and recall (section III.B), percent.
        pairs: Regions and faces that are each other's largest overlap.
        regions: Predicted regions with a scored point.
        faces: True faces with a scored point.
        points: Scored points: all but those of the ignored label.
        mean_best_iou: Mean over all faces of the largest IoU with a region.
        precision_iou50: Regions with a face at IoU > 0.5, of all regions.
        recall_iou50: Faces with a region at IoU > 0.5, of all faces.
        precision_iou80: The same at IoU > 0.8.
        recall_iou80: The same at IoU > 0.8.
        correct: Correctly found faces by SegComp at 80 %.
        over_segmented: Faces split into several regions by SegComp at 80 %.
        under_segmented: Regions that merge several faces by SegComp at 80 %.
        missed: Faces in none of these three by SegComp at 80 %.
        noise: Regions in none of these three by SegComp at 80 %.
        evops_precision: Regions that match a face by EVOPS (IoU >= 0.75), of all regions.
        evops_recall: Faces that match a region by EVOPS, of all faces.
        evops_f1: Harmonic mean of the two.
        evops_mean_iou: Mean IoU of EVOPS' matches.
        evops_mean_dice: Mean Dice coefficient of EVOPS' matches.
        evops_over_segmented: Faces with several regions at IoU >= 0.2, of all faces.
        evops_under_segmented: Regions with several faces at IoU >= 0.2, of all regions.
        evops_missed: Faces without a counterpart by EVOPS, of all faces.
        evops_noise: Regions without a counterpart by EVOPS, of all regions.
        share_labeled: Scored points that lie in a region.
        covering: Segmentation covering: mean best IoU weighted by the size of the face.
        ari: Adjusted Rand index.
        nmi: Normalised mutual information, arithmetic mean.
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
    correct: int
    over_segmented: int
    under_segmented: int
    missed: int
    noise: int
    evops_precision: float
    evops_recall: float
    evops_f1: float
    evops_mean_iou: float
    evops_mean_dice: float
    evops_over_segmented: float
    evops_under_segmented: float
    evops_missed: float
    evops_noise: float
    share_labeled: float
    covering: float
    ari: float
    nmi: float


def score_labels(
    labels: Tensor | NDArray[Any],
    truth: Tensor | NDArray[Any],
    *,
    min_size: int = 1,
    ignore: int | None = None,
) -> LabelScore:
    """Score predicted plane labels against true ones.

    Precision, recall and F1 are the paper's [1]: means over the one-to-one pairs that
    :func:`match_regions` finds. They say nothing about regions and faces without a partner, so
    the counts and the indices over all faces stand beside them.

    Convention:
        Labels are integers of any value and order; ``UNLABELED`` (-1) is "no region" in
        ``labels`` and "no face" in ``truth``. How such points count:

        * They belong to no region, or to no face, so none is matched, missed or noise.
        * A point of no face still counts in its region's size, and lowers its precision and IoU;
          a point of no region counts in its face's size, and lowers its recall and IoU.
        * For ``ari`` and ``nmi`` the unlabelled points of each side are one more part, as when
          the labels are given to scikit-learn. Pass ``ignore=-1`` to leave out the points of no
          face altogether.
        * ``covering`` and ``mean_best_iou`` are over faces only.

    Args:
        labels: Predicted label of each point, shape ``(N,)``, integers.
        truth: True label of each point, shape ``(N,)``, integers.
        min_size: Regions of fewer points count as unlabelled (the paper draws those of 50 and
            more). Faces of any size count.
        ignore: Points with this true label are left out of everything. Default: none is.

    Returns:
        The indices. A mean or share over nothing is 0 (no pair, no region, no face, no point);
        the counts tell it from a real 0. ``ari`` and ``nmi`` are 1 where neither side divides
        the points.

    Raises:
        ShapeError: If the labels are not integers, or differ in length or device.
        ConfigError: If ``min_size`` is below 1.

    References:
        [1] Indoor Point Cloud Segmentation Using a Modified Region Growing Algorithm and Accurate
        Normal Estimation, section III.B. The other indices name theirs: :func:`count_segcomp`,
        :func:`score_evops`, :func:`adjusted_rand_index`, :func:`normalized_mutual_information`,
        :func:`segmentation_covering`.

    Example:
        >>> import torch
        >>> score = score_labels(torch.tensor([8, 8, 8, 3, -1]), torch.tensor([0, 0, 1, 1, 1]))
        >>> score.pairs, round(score.precision, 1), round(score.recall, 1), round(score.f1, 1)
        (2, 83.3, 66.7, 74.1)
        >>> score.recall_iou50, score.share_labeled
        (0.5, 0.8)
    """
    labels, truth = check_labels("score_labels", labels=labels, truth=truth)
    if min_size < 1:
        raise ConfigError(f"score_labels: expected min_size >= 1, got {min_size!r}.")
    table = contingency_table(labels, truth, min_size=min_size, ignore=ignore)
    num_regions, num_faces = len(table.region_sizes), len(table.face_sizes)
    precision, recall, num_pairs = pair_precision_recall(table)
    matched50, matched80 = (int((table.iou > bound).sum()) for bound in (0.5, 0.8))
    best = best_iou(table.faces, table.iou, num_faces)
    segcomp, evops = count_segcomp(table), score_evops(table)
    return LabelScore(
        precision=precision,
        recall=recall,
        f1=share(2 * precision * recall, precision + recall),
        pairs=num_pairs,
        regions=num_regions,
        faces=num_faces,
        points=table.num_points,
        mean_best_iou=share(float(best.sum()), num_faces),
        precision_iou50=share(matched50, num_regions),
        recall_iou50=share(matched50, num_faces),
        precision_iou80=share(matched80, num_regions),
        recall_iou80=share(matched80, num_faces),
        **segcomp._asdict(),
        **{f"evops_{name}": value for name, value in evops._asdict().items()},
        share_labeled=share(int(table.region_sizes.sum()), table.num_points),
        covering=segmentation_covering(table),
        ari=adjusted_rand_index(table),
        nmi=normalized_mutual_information(table),
    )


def pair_precision_recall(table: ContingencyTable) -> tuple[float, float, int]:
    """Return the mean precision and recall of the pairs, in percent, and how many pairs there are.

    Section III.B of the paper: ``P = 100 TP / (TP + FP)``, ``R = 100 TP / (TP + FN)`` with TP the
    points that region and face share. 0 where there is no pair.

    Example:
        >>> import torch
        >>> table = contingency_table(torch.tensor([0, 0, 0, 0]), torch.tensor([5, 5, 5, -1]))
        >>> pair_precision_recall(table)
        (75.0, 100.0, 1)
    """
    pairs = match_regions(table)
    shared = 100 * table.overlaps[pairs].double()
    precision = shared / table.region_sizes[table.regions[pairs]]
    recall = shared / table.face_sizes[table.faces[pairs]]
    count = len(pairs)
    return share(float(precision.sum()), count), share(float(recall.sum()), count), count
