"""How far two labellings of the same points agree, from their table of overlaps."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.metrics.contingency import ContingencyTable
from torchrg.metrics.matching import best_iou


class Partitions(NamedTuple):
    """Sizes of the cells, rows and columns of two partitions of all points.

    Attributes:
        cells: Points that a part of the one and a part of the other share, int64.
        rows: Points of each part of the prediction, int64.
        columns: Points of each part of the truth, int64.
        num_points: Number of points.
    """

    cells: Tensor
    rows: Tensor
    columns: Tensor
    num_points: int


def adjusted_rand_index(table: ContingencyTable) -> float:
    r"""Return the Rand index corrected for chance [1].

    Convention:
        The unlabelled points of a side are one more part of it: the value is that of
        scikit-learn's ``adjusted_rand_score`` for the same labels, -1 included.

    Args:
        table: Overlaps of regions and faces.

    Returns:
        At most 1 (equal partitions), about 0 for independent ones, negative for worse. 1 for two
        partitions without any pair of points to judge, one point or no point included.

    References:
        [1] L. Hubert, P. Arabie. Comparing partitions. Journal of Classification, 1985, eq. 5.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([5, 5, -1, 2]), torch.tensor([0, 0, 1, 3]))
        >>> adjusted_rand_index(table)
        1.0
    """
    parts = _with_unlabeled(table)
    # Python's integers: products of two counts of pairs exceed 64 bits beyond 50,000 points.
    together, predicted, true = (
        int((sizes * (sizes - 1) // 2).sum()) for sizes in (parts.cells, parts.rows, parts.columns)
    )
    pairs = parts.num_points * (parts.num_points - 1) // 2
    scale = pairs * (predicted + true) - 2 * predicted * true
    return 2 * (pairs * together - predicted * true) / scale if scale else 1.0


def normalized_mutual_information(table: ContingencyTable) -> float:
    r"""Return ``2 I(C, G) / (H(C) + H(G))``, the information that two labellings share [1].

    Convention:
        The unlabelled points of a side are one more part of it: the value is that of
        scikit-learn's ``normalized_mutual_info_score`` (arithmetic mean of the entropies).

    Args:
        table: Overlaps of regions and faces.

    Returns:
        In [0, 1]; 1 where both sides have one part only, or no point at all.

    References:
        [1] N. Vinh, J. Epps, J. Bailey. Information theoretic measures for clusterings comparison.
        JMLR, 2010, table 2 (NMI_sum).

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([0, 1, 0, 1]), torch.tensor([0, 0, 1, 1]))
        >>> normalized_mutual_information(table)
        0.0
    """
    parts = _with_unlabeled(table)
    n = max(parts.num_points, 1)
    cells, rows, columns = (
        -float(torch.special.xlogy(sizes / n, sizes / n).sum())
        for sizes in (part.double() for part in (parts.cells, parts.rows, parts.columns))
    )
    if len(parts.rows) <= 1 and len(parts.columns) <= 1:
        return 1.0
    shared = rows + columns - cells
    return min(max(2 * shared / (rows + columns), 0.0), 1.0)


def segmentation_covering(table: ContingencyTable) -> float:
    r"""Return the covering of the faces by the regions [1].

    ``sum_j |G_j| max_i IoU(C_i, G_j) / sum_j |G_j|``: the mean best IoU weighted by size.

    Convention:
        Unlabelled points are no region and no face: truth without a face has no weight.

    Args:
        table: Overlaps of regions and faces.

    Returns:
        In [0, 1]; 0 where there is no face.

    References:
        [1] P. Arbelaez et al. Contour detection and hierarchical image segmentation. TPAMI, 2011,
        eq. 8.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([0, 0, 1, -1]), torch.tensor([3, 3, 4, 4]))
        >>> segmentation_covering(table)
        0.75
    """
    best = best_iou(table.faces, table.iou, len(table.face_sizes))
    return float((best * table.face_sizes).sum() / table.face_sizes.sum().clamp(min=1))


def _with_unlabeled(table: ContingencyTable) -> Partitions:
    """Return the partitions in which the unlabelled points of each side are one more part."""
    in_faces = table.overlaps.new_zeros(len(table.region_sizes))
    in_faces.index_add_(0, table.regions, table.overlaps)
    in_regions = table.overlaps.new_zeros(len(table.face_sizes))
    in_regions.index_add_(0, table.faces, table.overlaps)
    bare_regions = table.region_sizes - in_faces
    bare_faces = table.face_sizes - in_regions
    no_region = table.num_points - table.region_sizes.sum()
    no_face = table.num_points - table.face_sizes.sum()
    neither = no_region - bare_faces.sum()
    cells = torch.cat([table.overlaps, bare_regions, bare_faces, neither[None]])
    rows = torch.cat([table.region_sizes, no_region[None]])
    columns = torch.cat([table.face_sizes, no_face[None]])
    return Partitions(cells[cells > 0], rows[rows > 0], columns[columns > 0], table.num_points)
