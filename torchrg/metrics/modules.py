"""Scores as a :class:`torchmetrics.Metric`: one ``update`` a scan, ``compute`` over a data set."""

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

_SCORES: dict[str, Callable[..., LabelScore | PartitionScore | ClusterScore | NormalScore]] = {
    "labels": score_labels,
    "superpoints": score_partition,
    "clusters": score_clusters,
    "normals": score_normals,
}
"""The function of each part of ``METRICS``."""


class PlaneMetric(Metric):
    """Mean of an index over the scans that it is defined for, or of all indices of a part.

    The states are sums of all indices of the part, so they reduce across workers and processes by
    addition, and the metrics of one part in a ``MetricCollection`` score each scan once.

    Args:
        index: A part of :data:`torchrg.metrics.METRICS`, for a dict of all its indices; or an index
            of one, as in ``"f1"``.
        **settings: Settings of the function of the part, as in ``min_size=50``, and those of
            :class:`torchmetrics.Metric`.

    Attributes:
        part: The part of ``METRICS`` that the index is of.
        index: The index; None for all, and so are the others then.

    Raises:
        ConfigError: If there is no such index, or several parts have one of that name.

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
        """Unit of the index, from the catalogue."""
        return None if self.index is None else METRICS[self.part][self.index].unit

    @property
    def higher_is_better(self) -> bool | None:  # type: ignore[override]
        """Whether more of the index is better, from the catalogue."""
        return None if self.index is None else METRICS[self.part][self.index].higher_is_better

    def update(self, *tensors: Tensor, **named: Tensor) -> None:
        """Add the score of one scan, given the tensors that the function of the part takes.

        Labels: predicted and true label of each point, both ``(N,)``. Superpoints: the same, then,
        for borders, points ``(N, 3)``. Clusters: normals ``(N, 3)`` and the cluster of each,
        ``(N,)``. Normals: estimated and true normals ``(N, 3)``, and ``valid=`` of ``(N,)``.
        """
        score = _SCORES[self.part](*tensors, **named, **self.settings)._asdict()
        values = (math.nan if score[name] is None else score[name] for name in METRICS[self.part])
        indices = torch.tensor([*map(float, values)], dtype=torch.float64, device=self.total.device)
        # An index that the scan does not define is nan, and left out.
        self.total += indices.nan_to_num(nan=0.0, posinf=math.inf, neginf=-math.inf)
        self.scans += ~indices.isnan()

    def compute(self) -> Tensor | dict[str, Tensor]:
        """Return the mean over the scans, nan where no scan defines it; scalar float64 tensors."""
        means = dict(zip(METRICS[self.part], (self.total / self.scans).unbind(), strict=True))
        return means if self.index is None else means[self.index]


def _find_index(name: str) -> tuple[str, str | None]:
    """Return the part of an index and its name, or a part and None for all of it."""
    if name in METRICS:
        return name, None
    parts = [part for part, indices in METRICS.items() if name in indices]
    if len(parts) == 1:
        return parts[0], name
    if parts:
        raise ConfigError(
            f"PlaneMetric: expected an index of one part, got {name!r} of {' and '.join(parts)}; "
            f"take PlaneMetric({parts[0]!r}) and its {name!r}."
        )
    listed = ", ".join([*METRICS, *dict.fromkeys(n for part in METRICS.values() for n in part)])
    raise ConfigError(f"PlaneMetric: expected index to be one of {listed}, got {name!r}.")
