"""Unit and direction of every index, in one place for reports and for torchmetrics."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Index(NamedTuple):
    """What a number means.

    Attributes:
        unit: ``"%"``, ``"deg"``, ``"deg^2"``, ``"rad"``, ``"count"``, or ``""`` for shares and
            ratios.
        higher_is_better: None where neither direction is better.
    """

    unit: str
    higher_is_better: bool | None


_LABELS = {
    "precision": Index("%", True),
    "recall": Index("%", True),
    "f1": Index("%", True),
    "pairs": Index("count", None),
    "regions": Index("count", None),
    "faces": Index("count", None),
    "points": Index("count", None),
    "mean_best_iou": Index("", True),
    "precision_iou50": Index("", True),
    "recall_iou50": Index("", True),
    "precision_iou80": Index("", True),
    "recall_iou80": Index("", True),
    "correct": Index("count", True),
    "over_segmented": Index("count", False),
    "under_segmented": Index("count", False),
    "missed": Index("count", False),
    "noise": Index("count", False),
    "evops_precision": Index("", True),
    "evops_recall": Index("", True),
    "evops_f1": Index("", True),
    "evops_mean_iou": Index("", True),
    "evops_mean_dice": Index("", True),
    "evops_over_segmented": Index("", False),
    "evops_under_segmented": Index("", False),
    "evops_missed": Index("", False),
    "evops_noise": Index("", False),
    "share_labeled": Index("", True),
    "covering": Index("", True),
    "ari": Index("", True),
    "nmi": Index("", True),
}
_CLUSTERS = {
    "cp": Index("rad", False),
    "sp": Index("rad", True),
    "dbi": Index("", False),
    "dvi": Index("", True),
    "clusters": Index("count", None),
    "points": Index("count", None),
    "invalid": Index("count", False),
    "sample_size": Index("count", None),
    "seed": Index("", None),
    "sampled_clusters": Index("count", None),
    "dvi_exact": Index("", None),
}
_ERRORS = {
    "msae": Index("deg^2", False),
    "rms": Index("deg", False),
    "mean": Index("deg", False),
    "median": Index("deg", False),
    "under_5_deg": Index("", True),
    "under_10_deg": Index("", True),
    "under_20_deg": Index("", True),
    "points": Index("count", None),
}
_NORMALS = {
    **_ERRORS,
    "invalid": Index("count", False),
    **{f"sharp_{name}": index for name, index in _ERRORS.items()},
    **{f"regular_{name}": index for name, index in _ERRORS.items()},
}

METRICS: Mapping[str, Mapping[str, Index]] = MappingProxyType(
    {
        "labels": MappingProxyType(_LABELS),
        "clusters": MappingProxyType(_CLUSTERS),
        "normals": MappingProxyType(_NORMALS),
    }
)
"""The fields of ``LabelScore``, ``ClusterScore`` and ``NormalScore``, by part and name.

Example:
    >>> METRICS["labels"]["f1"]
    Index(unit='%', higher_is_better=True)
"""
