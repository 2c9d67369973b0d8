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


_LABELS = {
    Index("%", True): "precision recall f1",
    Index("count", None): "pairs regions faces points",
    Index(
        "fraction", True
    ): "mean_best_iou precision_iou50 recall_iou50 precision_iou80 recall_iou80 "
    "fraction_labeled covering ari",
}
_SUPERPOINTS = {
    Index("fraction", True): "asa oracle_miou boundary_recall boundary_precision",
    Index("", None): "boundary_distance",
    Index("count", None): "count points_per_superpoint points",
}
_CLUSTERS = {
    Index("rad", False): "cp",
    Index("rad", True): "sp",
    Index("", False): "dbi",
    Index("", True): "dvi",
    Index("count", None): "clusters points sampled_clusters",
    Index("count", False): "invalid",
    Index("", None): "dvi_exact",
}
_NORMALS = {
    Index("deg^2", False): "msae",
    Index("deg", False): "rms mean median",
    Index("fraction", True): "under_5_deg under_10_deg under_20_deg",
    Index("count", None): "points",
    Index("count", False): "invalid",
}


def _by_name(fields: tuple[str, ...], meanings: dict[Index, str]) -> Mapping[str, Index]:
    """Return the unit and direction of each field."""
    index_of = {name: index for index, names in meanings.items() for name in names.split()}
    return MappingProxyType({name: index_of[name] for name in fields})


METRICS: Mapping[str, Mapping[str, Index]] = MappingProxyType(
    {
        "labels": _by_name(LabelScore._fields, _LABELS),
        "superpoints": _by_name(PartitionScore._fields, _SUPERPOINTS),
        "clusters": _by_name(ClusterScore._fields, _CLUSTERS),
        "normals": _by_name(NormalScore._fields, _NORMALS),
    }
)
"""Fields of the scores by part and name.

Example:
    >>> METRICS["labels"]["f1"]
    Index(unit='%', higher_is_better=True)
"""
