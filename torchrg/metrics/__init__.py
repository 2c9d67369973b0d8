"""Scores of plane labels, of clusters on the Gaussian sphere, and of normals.

``METRICS`` says of every index its unit and whether more is better. The forms for torchmetrics
are in :mod:`torchrg.metrics.modules`, which needs the extra ``metrics``.
"""

from torchrg.metrics.catalog import METRICS, Index
from torchrg.metrics.clusters import ClusterScore, score_clusters
from torchrg.metrics.contingency import ContingencyTable, contingency_table
from torchrg.metrics.labels import (
    LabelScore,
    adjusted_rand_index,
    match_regions,
    normalized_mutual_information,
    score_labels,
    segmentation_covering,
)
from torchrg.metrics.normals import NormalScore, score_normals
from torchrg.metrics.protocols import EvopsScore, SegCompCounts, count_segcomp, score_evops

__all__ = [
    "METRICS",
    "ClusterScore",
    "ContingencyTable",
    "EvopsScore",
    "Index",
    "LabelScore",
    "NormalScore",
    "SegCompCounts",
    "adjusted_rand_index",
    "contingency_table",
    "count_segcomp",
    "match_regions",
    "normalized_mutual_information",
    "score_clusters",
    "score_evops",
    "score_labels",
    "score_normals",
    "segmentation_covering",
]
