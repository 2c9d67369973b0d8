"""What all scores have in common as metrics: sums over scans, and their mean."""

import math
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchrg._optional import require
from torchrg.metrics.catalog import METRICS

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
