"""Statistics over the points of each region, the same for any number of threads."""

import torch
from torch import Tensor


class Segments:
    """The points of each region side by side, in the order of their rows.

    Sums run over one region after the other, never by atomic additions, so they do not depend on
    threads or device scheduling.

    Args:
        labels: Region of each point, shape ``(N,)``: 0 to M-1, each at least once, or negative.

    Example:
        >>> segments = Segments(torch.tensor([1, 0, -1, 1]))
        >>> segments.counts.tolist(), segments.rows.tolist()
        ([1, 2], [1, 0, 3])
        >>> segments.mean(segments.take(torch.tensor([1.0, 2.0, 9.0, 3.0]))).tolist()
        [2.0, 2.0]
    """

    def __init__(self, labels: Tensor) -> None:
        ascending, rows = labels.sort(stable=True)
        num_unlabeled = int(torch.searchsorted(ascending, 0))
        self.rows = rows[num_unlabeled:]
        self.labels = ascending[num_unlabeled:].long()
        self.counts = torch.bincount(self.labels)

    def take(self, values: Tensor) -> Tensor:
        """Return the values of the points that have a region, region by region."""
        return values.index_select(0, self.rows)

    def first(self, values: Tensor) -> Tensor:
        """Return the value of the first point of each region."""
        return values[self.rows[self.counts.cumsum(0) - self.counts]]

    def spread(self, values: Tensor) -> Tensor:
        """Return for each point, in the order of :meth:`take`, the value of its region."""
        return values.index_select(0, self.labels)

    def take_columns(self, vectors: Tensor) -> list[Tensor]:
        """Return the three columns of :meth:`take` of vectors ``(N, 3)``, in float64."""
        return [self.take(column).double() for column in vectors.unbind(dim=1)]

    def spread_columns(self, vectors: Tensor) -> list[Tensor]:
        """Return the three columns of :meth:`spread` of vectors ``(M, 3)``."""
        return [self.spread(column) for column in vectors.unbind(dim=1)]

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of each region's values, given in the order of :meth:`take`."""
        return self._reduce(values, "sum")

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of each region's values."""
        return self.sum(values) / self.counts

    def bounds(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return the smallest and the largest value of each region."""
        return self._reduce(values, "min"), self._reduce(values, "max")

    def first_of_each(self, chosen: Tensor) -> Tensor:
        """Return the place of the first chosen value of each region that has one."""
        places = chosen.nonzero().squeeze(1)
        owner = self.labels[places]
        is_first = torch.ones_like(owner, dtype=torch.bool)
        is_first[1:] = owner[1:] != owner[:-1]
        return places[is_first]

    def median(self, values: Tensor) -> Tensor:
        """Return the median of each region's values, the lower one of an even number."""
        parts = torch.split(values, self.counts.tolist())
        return torch.stack([part.median() for part in parts]) if parts else values

    def _reduce(self, values: Tensor, how: str) -> Tensor:
        if len(self.counts) == 0:
            return values[:0]
        return torch.segment_reduce(values.contiguous(), how, lengths=self.counts)
