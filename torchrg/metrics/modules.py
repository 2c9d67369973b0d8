"""Evaluation as a :class:`torchmetrics.Metric`."""

import inspect
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchrg._optional import require
from torchrg.errors import ConfigError
from torchrg.metrics import (
    METRICS,
    ClusterScore,
    LabelScore,
    NormalScore,
    PartitionScore,
    score_clusters,
    score_labels,
    score_normals,
    score_partition,
)

if TYPE_CHECKING:
    from torchmetrics import Metric
else:
    Metric = require("torchmetrics", extra="metrics", purpose="use torchrg.metrics.modules").Metric

__all__ = ["PlaneMetric"]
__dir__ = __all__.copy

_SCORES: dict[str, Callable[..., LabelScore | PartitionScore | ClusterScore | NormalScore]] = {
    "labels": score_labels,
    "superpoints": score_partition,
    "clusters": score_clusters,
    "normals": score_normals,
}
"""Evaluation function of each part of ``METRICS``."""


class PlaneMetric(Metric):
    """Mean of a metric over the scans for which it is defined, or of all metrics of a part.

    The states are sums of all metrics of the part, so they reduce across workers and processes by
    addition. Metrics of one part in a ``MetricCollection`` evaluate each scan once.

    Args:
        index: A part of :data:`torchrg.metrics.METRICS`, for a dict, or a metric, such as ``"f1"``.
        **settings: Settings of the evaluation, such as ``min_size=50``, and of ``Metric``.

    Attributes:
        part: The part of ``METRICS``.
        index: The metric; None for all, in which case ``unit`` and ``higher_is_better`` are None.

    Raises:
        ConfigError: If the metric does not exist, or its name is ambiguous.

    Example:
        >>> f1 = PlaneMetric("f1", min_size=2)
        >>> f1.update(torch.tensor([0, 0, 1, 1]), torch.tensor([3, 3, 4, 4]))
        >>> f1.update(torch.tensor([0, 0, 0, 0]), torch.tensor([3, 3, 4, 4]))
        >>> round(float(f1.compute()), 2), f1.unit, f1.higher_is_better
        (83.33, '%', True)
        >>> normals = PlaneMetric("normals")
        >>> normals.update(torch.tensor([[0.0, 1, 1]]), torch.tensor([[0.0, 0, 1]]))
        >>> round(float(normals.compute()["mean"]), 4)
        45.0
    """

    full_state_update = False
    is_differentiable = False
    total: Tensor
    scans: Tensor

    def __init__(self, index: str, **settings: Any) -> None:  # noqa: ANN401
        part, name = _find_index(index)
        parameters = inspect.signature(_SCORES[part]).parameters
        super().__init__(**{key: settings.pop(key) for key in settings.keys() - parameters.keys()})
        self.part, self.index, self.settings = part, name, settings
        zeros = torch.zeros(len(METRICS[self.part]), dtype=torch.float64)
        self.add_state("total", zeros, dist_reduce_fx="sum")
        self.add_state("scans", zeros.long(), dist_reduce_fx="sum")

    @property
    def unit(self) -> str | None:
        """Unit of the metric, from ``METRICS``."""
        return None if self.index is None else METRICS[self.part][self.index].unit

    @property
    def higher_is_better(self) -> bool | None:  # type: ignore[override]
        """Whether higher is better, from ``METRICS``."""
        return None if self.index is None else METRICS[self.part][self.index].higher_is_better

    def update(self, *tensors: Tensor, **named: Tensor) -> None:
        """Add a scan; the tensors are the arguments of the evaluation function.

        Labels: predicted and ground-truth label of each point, both ``(N,)``. Superpoints: the
        same, and points ``(N, 3)`` for boundary metrics. Clusters: normals ``(N, 3)`` and clusters
        ``(N,)``. Normals: estimated and ground-truth normals ``(N, 3)``, and ``valid=`` ``(N,)``.
        """
        score = _SCORES[self.part](*tensors, **named, **self.settings)._asdict()
        values = (math.nan if score[name] is None else score[name] for name in METRICS[self.part])
        indices = torch.tensor([*map(float, values)], dtype=torch.float64, device=self.total.device)
        # Metrics undefined for the scan are nan, and ignored.
        self.total += indices.nan_to_num(nan=0.0, posinf=math.inf, neginf=-math.inf)
        self.scans += ~indices.isnan()

    def compute(self) -> Tensor | dict[str, Tensor]:
        """Return the mean over the scans as scalar float64 tensors, nan if defined for no scan."""
        means = dict(zip(METRICS[self.part], (self.total / self.scans).unbind(), strict=True))
        return means if self.index is None else means[self.index]


def _find_index(name: str) -> tuple[str, str | None]:
    """Return the part and name of a metric, or a part and None for all its metrics."""
    if name in METRICS:
        return name, None
    parts = [part for part, indices in METRICS.items() if name in indices]
    if len(parts) == 1:
        return parts[0], name
    if parts:
        raise ConfigError(
            f"PlaneMetric: expected an unambiguous index, got {name!r} of {' and '.join(parts)}; "
            f"use PlaneMetric({parts[0]!r}) and its {name!r}."
        )
    listed = ", ".join([*METRICS, *dict.fromkeys(n for part in METRICS.values() for n in part)])
    raise ConfigError(f"PlaneMetric: expected index to be one of {listed}, got {name!r}.")
