"""Evaluation of plane labels, superpoints, normals, and clusters on the Gaussian sphere.

``METRICS`` lists the unit of each metric and whether higher is better. Modules for torchmetrics are
in :mod:`torchrg.metrics.modules`, which needs the extra ``metrics``.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from torchrg.metrics.clusters import ClusterScore, score_clusters
from torchrg.metrics.contingency import ContingencyTable, contingency_table
from torchrg.metrics.labels import (
    LabelScore,
    adjusted_rand_index,
    match_regions,
    score_labels,
    segmentation_covering,
)
from torchrg.metrics.matching import differing_rows, match_points
from torchrg.metrics.normals import NormalScore, score_normals
from torchrg.metrics.partition import PartitionScore, score_partition

__all__ = [
    "METRICS",
    "ClusterScore",
    "ContingencyTable",
    "Index",
    "LabelScore",
    "NormalScore",
    "PartitionScore",
    "adjusted_rand_index",
    "contingency_table",
    "differing_rows",
    "match_points",
    "match_regions",
    "score_clusters",
    "score_labels",
    "score_normals",
    "score_partition",
    "segmentation_covering",
]
__dir__ = __all__.copy


class Index(NamedTuple):
    """Unit and direction of a metric.

    Attributes:
        unit: ``"%"``, ``"fraction"``, ``"deg"``, ``"deg^2"``, ``"rad"``, ``"count"``, or ``""``.
        higher_is_better: None if neither direction is better.
    """

    unit: str
    higher_is_better: bool | None


_MEANINGS = {
    Index("%", True): "precision recall f1",
    Index("fraction", True): "mean_best_iou precision_iou50 recall_iou50 precision_iou80 "
    "recall_iou80 fraction_labeled covering ari asa oracle_miou boundary_recall boundary_precision "
    "under_5_deg under_10_deg under_20_deg",
    Index("rad", False): "cp",
    Index("rad", True): "sp",
    Index("deg", False): "rms mean median",
    Index("deg^2", False): "msae",
    Index("", True): "dvi",
    Index("", False): "dbi",
    Index("", None): "boundary_distance dvi_exact",
    Index("count", False): "invalid",
    Index("count", None): "pairs regions faces points count points_per_superpoint clusters "
    "sampled_clusters",
}
_INDEX_OF = {name: index for index, names in _MEANINGS.items() for name in names.split()}
_FIELDS = {
    "labels": LabelScore._fields,
    "superpoints": PartitionScore._fields,
    "clusters": ClusterScore._fields,
    "normals": NormalScore._fields,
}
METRICS: Mapping[str, Mapping[str, Index]] = MappingProxyType(
    {
        part: MappingProxyType({name: _INDEX_OF[name] for name in fields})
        for part, fields in _FIELDS.items()
    }
)
"""Fields of the scores by part and name.

Example:
    >>> METRICS["labels"]["f1"]
    Index(unit='%', higher_is_better=True)
"""
