"""The scores as :class:`torchmetrics.Metric`: one ``update`` a scan, ``compute`` over a data set.

Needs the extra ``metrics``. All classes of one family keep the same state, so a
``torchmetrics.MetricCollection`` of them scores each scan once; give those of one collection the
same settings, since it tells the states apart by their first values only.
"""

from torchrg.metrics.modules.base import MeanOverScans
from torchrg.metrics.modules.clusters import (
    ClusterScores,
    Compactness,
    Separation,
    SphereDaviesBouldin,
    SphereDunn,
)
from torchrg.metrics.modules.labels import (
    LabelScores,
    MeanBestIoU,
    MissedFaces,
    NoiseRegions,
    OverSegmented,
    PlaneARI,
    PlaneF1,
    PlaneNMI,
    PlanePrecision,
    PlaneRecall,
    PrecisionIoU50,
    PrecisionIoU80,
    RecallIoU50,
    RecallIoU80,
    SegmentationCovering,
    ShareLabeled,
    UnderSegmented,
)
from torchrg.metrics.modules.normals import (
    NormalMeanError,
    NormalMedianError,
    NormalMSAE,
    NormalRMS,
    NormalScores,
    NormalUnder5,
    NormalUnder10,
    NormalUnder20,
)

__all__ = [
    "ClusterScores",
    "Compactness",
    "LabelScores",
    "MeanBestIoU",
    "MeanOverScans",
    "MissedFaces",
    "NoiseRegions",
    "NormalMSAE",
    "NormalMeanError",
    "NormalMedianError",
    "NormalRMS",
    "NormalScores",
    "NormalUnder5",
    "NormalUnder10",
    "NormalUnder20",
    "OverSegmented",
    "PlaneARI",
    "PlaneF1",
    "PlaneNMI",
    "PlanePrecision",
    "PlaneRecall",
    "PrecisionIoU50",
    "PrecisionIoU80",
    "RecallIoU50",
    "RecallIoU80",
    "SegmentationCovering",
    "Separation",
    "ShareLabeled",
    "SphereDaviesBouldin",
    "SphereDunn",
    "UnderSegmented",
]
