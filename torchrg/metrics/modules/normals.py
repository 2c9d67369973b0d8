"""Errors of normals as metrics."""

from torch import Tensor

from torchrg.metrics.modules.base import MeanOverScans, direction
from torchrg.metrics.normals import NormalScore, score_normals


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
