"""Internal indices as metrics."""

from typing import Any

from torch import Tensor

from torchrg.metrics.internal import ClusterScore, score_clusters
from torchrg.metrics.modules.base import MeanOverScans, direction


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
