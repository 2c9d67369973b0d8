"""External indices as metrics."""

from typing import Any

from torch import Tensor

from torchrg.metrics.external import LabelScore, score_labels
from torchrg.metrics.modules.base import MeanOverScans, direction


class LabelScores(MeanOverScans):
    """All indices of :func:`torchrg.metrics.score_labels`, each averaged over the scans.

    Args:
        min_size: Regions of fewer points count as unlabelled.
        ignore: Points with this true label are left out. Default: none is.
        **kwargs: Those of :class:`torchmetrics.Metric`.

    Example:
        >>> import torch
        >>> scores = LabelScores()
        >>> scores.update(torch.tensor([0, 0, 1, 1]), torch.tensor([3, 3, 4, 4]))
        >>> scores.update(torch.tensor([0, 0, 0, 0]), torch.tensor([3, 3, 4, 4]))
        >>> float(scores.compute()["precision"])
        75.0
    """

    names = LabelScore._fields

    def __init__(self, *, min_size: int = 1, ignore: int | None = None, **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__(**kwargs)
        self.min_size = min_size
        self.ignore = ignore

    def update(self, labels: Tensor, truth: Tensor) -> None:
        """Score one scan: predicted and true label of each point, both ``(N,)``."""
        self._add(score_labels(labels, truth, min_size=self.min_size, ignore=self.ignore))


class PlanePrecision(LabelScores):
    """``precision`` of :class:`torchrg.metrics.LabelScore`, percent."""

    index = "precision"
    higher_is_better = direction("labels", "precision")


class PlaneRecall(LabelScores):
    """``recall`` of :class:`torchrg.metrics.LabelScore`, percent."""

    index = "recall"
    higher_is_better = direction("labels", "recall")


class PlaneF1(LabelScores):
    """``f1`` of :class:`torchrg.metrics.LabelScore`, percent."""

    index = "f1"
    higher_is_better = direction("labels", "f1")


class MeanBestIoU(LabelScores):
    """``mean_best_iou`` of :class:`torchrg.metrics.LabelScore`."""

    index = "mean_best_iou"
    higher_is_better = direction("labels", "mean_best_iou")


class PrecisionIoU50(LabelScores):
    """``precision_iou50`` of :class:`torchrg.metrics.LabelScore`."""

    index = "precision_iou50"
    higher_is_better = direction("labels", "precision_iou50")


class RecallIoU50(LabelScores):
    """``recall_iou50`` of :class:`torchrg.metrics.LabelScore`."""

    index = "recall_iou50"
    higher_is_better = direction("labels", "recall_iou50")


class PrecisionIoU80(LabelScores):
    """``precision_iou80`` of :class:`torchrg.metrics.LabelScore`."""

    index = "precision_iou80"
    higher_is_better = direction("labels", "precision_iou80")


class RecallIoU80(LabelScores):
    """``recall_iou80`` of :class:`torchrg.metrics.LabelScore`."""

    index = "recall_iou80"
    higher_is_better = direction("labels", "recall_iou80")


class OverSegmented(LabelScores):
    """``over_segmented`` of :class:`torchrg.metrics.LabelScore`."""

    index = "over_segmented"
    higher_is_better = direction("labels", "over_segmented")


class UnderSegmented(LabelScores):
    """``under_segmented`` of :class:`torchrg.metrics.LabelScore`."""

    index = "under_segmented"
    higher_is_better = direction("labels", "under_segmented")


class MissedFaces(LabelScores):
    """``missed`` of :class:`torchrg.metrics.LabelScore`."""

    index = "missed"
    higher_is_better = direction("labels", "missed")


class NoiseRegions(LabelScores):
    """``noise`` of :class:`torchrg.metrics.LabelScore`."""

    index = "noise"
    higher_is_better = direction("labels", "noise")


class ShareLabeled(LabelScores):
    """``share_labeled`` of :class:`torchrg.metrics.LabelScore`."""

    index = "share_labeled"
    higher_is_better = direction("labels", "share_labeled")


class SegmentationCovering(LabelScores):
    """``covering`` of :class:`torchrg.metrics.LabelScore`."""

    index = "covering"
    higher_is_better = direction("labels", "covering")


class PlaneARI(LabelScores):
    """``ari`` of :class:`torchrg.metrics.LabelScore`."""

    index = "ari"
    higher_is_better = direction("labels", "ari")


class PlaneNMI(LabelScores):
    """``nmi`` of :class:`torchrg.metrics.LabelScore`."""

    index = "nmi"
    higher_is_better = direction("labels", "nmi")
