"""Scores as :class:`torchmetrics.Metric`: one ``update`` a scan, ``compute`` over a data set."""

import math
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchrg._optional import require
from torchrg.metrics.catalog import METRICS
from torchrg.metrics.clusters import ClusterScore, score_clusters
from torchrg.metrics.labels import LabelScore, score_labels
from torchrg.metrics.normals import NormalScore, score_normals

if TYPE_CHECKING:
    from torchmetrics import Metric
else:
    Metric = require("torchmetrics", extra="metrics", purpose="use torchrg.metrics.modules").Metric


class MeanOverScans(Metric):
    """Mean of each index over the scans that it is defined for; base of the classes below.

    The states are sums, so they reduce across workers and processes by addition. ``compute``
    returns the index that the class is named for, or a dict of all of them.
    """

    full_state_update = False
    is_differentiable = False
    higher_is_better: bool | None = None
    names: ClassVar[tuple[str, ...]]
    index: ClassVar[str | None] = None
    total: Tensor
    scans: Tensor

    def __init__(self, **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__(**kwargs)
        zeros = torch.zeros(len(self.names), dtype=torch.float64)
        self.add_state("total", zeros, dist_reduce_fx="sum")
        self.add_state("scans", zeros.long(), dist_reduce_fx="sum")

    def _add(self, score: NamedTuple) -> None:
        """Add the indices of one scan, leaving out those that are undefined (nan or None)."""
        values = [math.nan if value is None else float(value) for value in score]
        known = torch.tensor(values, dtype=torch.float64, device=self.total.device)
        self.total += known.nan_to_num(nan=0.0, posinf=math.inf, neginf=-math.inf)
        self.scans += ~known.isnan()

    def compute(self) -> Tensor | dict[str, Tensor]:
        """Return the mean over the scans, nan where no scan defines it; scalar float64 tensors."""
        means = self.total / self.scans
        if self.index is not None:
            return means[self.names.index(self.index)]
        return dict(zip(self.names, means.unbind(), strict=True))


def direction(part: str, index: str) -> bool | None:
    """Return whether more is better, from the catalog.

    Example:
        >>> direction("clusters", "dbi")
        False
    """
    return METRICS[part][index].higher_is_better


class ClusterScores(MeanOverScans):
    """All indices of :func:`torchrg.metrics.score_clusters`, each averaged over the scans.

    Scans with fewer than two clusters count for ``cp`` only.

    Args:
        min_size: Clusters of fewer points count as unlabelled.
        distinct_directions: Whether clusters of about one direction are merged first.
        sample_size: Clusters up to this size are scored over all pairs of points.
        **kwargs: Those of :class:`torchmetrics.Metric`.

    Example:
        >>> import torch
        >>> scores = ClusterScores()
        >>> scores.update(torch.eye(3), torch.tensor([0, 1, 2]))
        >>> round(float(scores.compute()["sp"]), 4)
        1.5708
    """

    names = ClusterScore._fields

    def __init__(
        self,
        *,
        min_size: int = 1,
        distinct_directions: bool = False,
        sample_size: int = 20_000,
        **kwargs: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**kwargs)
        self.min_size = min_size
        self.distinct_directions = distinct_directions
        self.sample_size = sample_size

    def update(self, normals: Tensor, labels: Tensor) -> None:
        """Score one scan: normals ``(N, 3)`` and the cluster of each, ``(N,)``."""
        score = score_clusters(
            normals,
            labels,
            min_size=self.min_size,
            distinct_directions=self.distinct_directions,
            sample_size=self.sample_size,
        )
        self._add(score)


class Compactness(ClusterScores):
    """``cp`` of :class:`torchrg.metrics.ClusterScore`, radians."""

    index = "cp"
    higher_is_better = direction("clusters", "cp")


class Separation(ClusterScores):
    """``sp`` of :class:`torchrg.metrics.ClusterScore`, radians."""

    index = "sp"
    higher_is_better = direction("clusters", "sp")


class SphereDaviesBouldin(ClusterScores):
    """``dbi`` of :class:`torchrg.metrics.ClusterScore`."""

    index = "dbi"
    higher_is_better = direction("clusters", "dbi")


class SphereDunn(ClusterScores):
    """``dvi`` of :class:`torchrg.metrics.ClusterScore`."""

    index = "dvi"
    higher_is_better = direction("clusters", "dvi")


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


class NormalScores(MeanOverScans):
    """All indices of :func:`torchrg.metrics.score_normals`, each averaged over the scans.

    Scans without points, or without a split into sharp and regular points, do not count for the
    indices that need them.

    Args:
        **kwargs: Those of :class:`torchmetrics.Metric`.

    Example:
        >>> import torch
        >>> scores = NormalScores()
        >>> scores.update(torch.tensor([[0.0, 1, 1]]), torch.tensor([[0.0, 0, 1]]))
        >>> scores.update(torch.tensor([[0.0, 0, -1]]), torch.tensor([[0.0, 0, 1]]))
        >>> round(float(scores.compute()["mean"]), 4)
        22.5
    """

    names = NormalScore._fields

    def update(
        self,
        normals: Tensor,
        truth: Tensor,
        sharp: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> None:
        """Score one scan: estimated and true normals ``(N, 3)``; sharp points, valid ``(N,)``."""
        self._add(score_normals(normals, truth, sharp, valid=valid))


class NormalMSAE(NormalScores):
    """``msae`` of :class:`torchrg.metrics.NormalScore`, degrees^2."""

    index = "msae"
    higher_is_better = direction("normals", "msae")


class NormalRMS(NormalScores):
    """``rms`` of :class:`torchrg.metrics.NormalScore`, degrees."""

    index = "rms"
    higher_is_better = direction("normals", "rms")


class NormalMeanError(NormalScores):
    """``mean`` of :class:`torchrg.metrics.NormalScore`, degrees."""

    index = "mean"
    higher_is_better = direction("normals", "mean")


class NormalMedianError(NormalScores):
    """``median`` of :class:`torchrg.metrics.NormalScore`, degrees."""

    index = "median"
    higher_is_better = direction("normals", "median")


class NormalUnder5(NormalScores):
    """``under_5_deg`` of :class:`torchrg.metrics.NormalScore`."""

    index = "under_5_deg"
    higher_is_better = direction("normals", "under_5_deg")


class NormalUnder10(NormalScores):
    """``under_10_deg`` of :class:`torchrg.metrics.NormalScore`."""

    index = "under_10_deg"
    higher_is_better = direction("normals", "under_10_deg")


class NormalUnder20(NormalScores):
    """``under_20_deg`` of :class:`torchrg.metrics.NormalScore`."""

    index = "under_20_deg"
    higher_is_better = direction("normals", "under_20_deg")
