"""Sums over the points of each region, the same for any number of threads."""

import torch
from torch import Tensor


class Segments:
    """The points of each region side by side, in the order of their rows.

    Args:
        labels: Region of each point, shape ``(N,)``: 0 to M-1, or negative for none.

    Example:
        >>> segments = Segments(torch.tensor([1, 0, -1, 1]))
        >>> segments.counts.tolist(), segments.rows.tolist()
        ([1, 2], [1, 0, 3])
        >>> segments.mean(segments.take(torch.tensor([1.0, 2.0, 9.0, 3.0]))).tolist()
        [2.0, 2.0]
    """

    def __init__(self, labels: Tensor) -> None:
        self.rows = labels.argsort(stable=True)
        self.rows = self.rows[int((labels < 0).sum()) :]
        self.labels = labels[self.rows].long()
        self.counts = torch.bincount(self.labels)

    def take(self, values: Tensor) -> Tensor:
        """Return the values of the points that have a region, region by region."""
        return values[self.rows]

    def first(self, values: Tensor) -> Tensor:
        """Return the value of the first point of each region."""
        return values[self.rows[self.counts.cumsum(0) - self.counts]]

    def spread(self, values: Tensor) -> Tensor:
        """Return for each point, in the order of :meth:`take`, the value of its region."""
        return values[self.labels]

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of each region's values, in the order of :meth:`take`."""
        return torch.segment_reduce(values.contiguous(), "sum", lengths=self.counts)

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of each region's values."""
        counts = self.counts.view(-1, *[1] * (values.dim() - 1))
        return self.sum(values) / counts

    def extent(self, values: Tensor) -> Tensor:
        """Return the difference of largest and smallest value of each region."""
        high = torch.segment_reduce(values, "max", lengths=self.counts)
        return high - torch.segment_reduce(values, "min", lengths=self.counts)
