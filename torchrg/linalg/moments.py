"""Means and covariances of patches, weighted neighborhoods and regions.

Points lie along the last axis in patches, along the first in the lanes of
:mod:`torchrg.robust.lanes`, and region by region in :class:`Segments`. Each layout has its own
summation order, so that a sum does not depend on its position in a tensor. All covariances are
:func:`second_moments` about a mean, except in robust fits, which need determinants of thin ones.
"""

import bisect
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._checks import check_floating, check_shapes
from torchrg._parallel import allowed_threads
from torchrg.linalg.eigen import smallest_eigenvector3

_MIN_POINTS = 2**14
"""Minimum number of points per thread."""


def covariance(patches: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return mean and covariance (denominator: the number of points) of each patch, eq. (1).

    Two passes about the first point of each patch, accurate far from the origin. ``mask`` ``(*,
    K)`` selects points of patches ``(*, K, P)``; masked-out points may be arbitrary.

    Returns:
        The mean ``(*, P)`` and the covariance ``(*, P, P)``; zeros for patches without points.

    Raises:
        ShapeError: If a shape or dtype is invalid.

    Example:
        >>> mean, matrix = covariance(torch.tensor([[0.0, 0, 1], [2, 0, 1], [0, 4, 1], [2, 4, 1]]))
        >>> mean, matrix.diagonal()
        (tensor([1., 2., 1.]), tensor([1., 4., 0.]))
    """
    check_shapes("covariance", patches=(patches, "* K P"), mask=(mask, "* K"))
    check_floating("covariance", patches=patches)
    return covariance_of_columns(patches.unbind(dim=-1), mask)


def covariance_of_columns(
    columns: Sequence[Tensor], mask: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Variant of :func:`covariance` for points given as coordinate columns ``(*, K)``."""
    first = [column[..., :1] for column in columns]
    count: Tensor | int = columns[0].shape[-1]
    if mask is not None:
        # Any selected point can be the local origin: take the first one.
        anchor = mask.to(torch.uint8).argmax(dim=-1, keepdim=True)
        first = [column.gather(-1, anchor) for column in columns]
        count = mask.sum(dim=-1, keepdim=True).clamp(min=1)

    def moved(values: Sequence[Tensor], origin: Sequence[Tensor]) -> list[Tensor]:
        differences = [column - start for column, start in zip(values, origin, strict=True)]
        return differences if mask is None else [torch.where(mask, d, 0.0) for d in differences]

    shifted = moved(columns, first)
    means = [column.sum(dim=-1, keepdim=True) / count for column in shifted]
    total = count.squeeze(-1) if isinstance(count, Tensor) else count
    matrix = second_moments(moved(shifted, means), total=total)
    center = torch.cat([start + mean for start, mean in zip(first, means, strict=True)], dim=-1)
    if mask is not None:
        center = torch.where(mask.any(dim=-1, keepdim=True), center, 0.0)
    return center, matrix


def second_moments(
    columns: Sequence[Tensor],
    weights: Tensor | None = None,
    add: Callable[[Tensor], Tensor] = lambda column: column.sum(dim=-1),
    total: Tensor | float = 1.0,
) -> Tensor:
    """Return the second moments of weighted points about zero, shape ``(*, P, P)``.

    For a covariance, pass P columns relative to their mean. Weights have the same shape (default:
    1). ``add`` sums a column, by default along the last axis, to shape ``(*)``. Sums are divided by
    ``total``, for a covariance the sum of the weights.
    """
    return _symmetric([add(column) / total for column in _products(columns, weights)], len(columns))


def _products(columns: Sequence[Tensor], weights: Tensor | None) -> list[Tensor]:
    """Return the weighted products of all pairs of columns, the upper triangle by rows."""
    weighted = columns if weights is None else [weights * column for column in columns]
    return [weighted[i] * other for i in range(len(columns)) for other in columns[i:]]


def _symmetric(triangle: Sequence[Tensor], size: int) -> Tensor:
    """Return symmetric matrices ``(*, P, P)`` from their upper triangle by rows."""
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    entries = dict(zip(pairs, triangle, strict=True))
    rows = [
        torch.stack([entries[min(i, j), max(i, j)] for j in range(size)], dim=-1)
        for i in range(size)
    ]
    return torch.stack(rows, dim=-2)


def to_column_major(vectors: Tensor) -> Tensor:
    """Return vectors ``(N, C)`` in column-major layout, which regions read without a copy."""
    return scratch.store(vectors.T.contiguous().T)


class Segments:
    """Points grouped by region, in the order of their rows.

    Sums run sequentially per region, without atomic additions, so they do not depend on threads or
    device scheduling. ``labels`` ``(N,)`` are 0 to M-1, none missing, or negative. At most
    ``max_points`` points per region are taken, evenly spaced along their rows (default: all).
    Regions have ``sizes`` ``(M,)`` points, of which ``counts`` are taken.
    """

    def __init__(self, labels: Tensor, *, max_points: int | None = None) -> None:
        if labels.device.type == "cpu" and kernels.serve():
            num_regions = max(int(labels.max()) + 1, 0) if len(labels) else 0
            labels = labels.long()
            self.counts, self.sizes, _ = tables = labels.new_zeros(3, num_regions).unbind()
            rows = kernels.call("segment_rows", labels, max_points or len(labels) + 1, *tables)[0]
            self.rows = rows[: int(self.counts.sum())]
            return
        labels = labels.clamp(min=-1)
        num_unlabeled, *_ = counts = torch.bincount(labels + 1, minlength=1)
        self.rows = labels.argsort(stable=True)[num_unlabeled:]
        self.counts = self.sizes = counts[1:]
        if max_points is not None:
            steps = ((self.counts + (max_points - 1)) // max_points).clamp(min=1)
            region = torch.repeat_interleave(self.counts, output_size=len(self.rows))
            index = torch.arange(len(region), device=labels.device)
            index -= (self.counts.cumsum(0) - self.counts)[region]
            self.rows = self.rows[index % steps[region] == 0]
            self.counts = (self.counts + steps - 1) // steps

    @cached_property
    def labels(self) -> Tensor:
        """The region of each point, in the order of :meth:`gather`."""
        return torch.repeat_interleave(self.counts, output_size=len(self.rows))

    def chunks(self, max_points: int) -> "list[Segments]":
        """Split into parts of complete regions, renumbered from 0, of at most ``max_points``.

        The parts have about equal size for the threads.
        """
        size = max(len(self.rows) // allowed_threads() + 1, _MIN_POINTS)
        max_points, ends = min(size, max_points), self.counts.cumsum(0).tolist()
        parts: list[Segments] = []
        region = row = 0
        while region < len(ends) or not parts:
            last = max(bisect.bisect_right(ends, row + max_points), min(region + 1, len(ends)))
            segments = Segments.__new__(Segments)
            end = ends[last - 1] if last else 0
            segments.rows = self.rows[row:end]
            segments.counts, segments.sizes = self.counts[region:last], self.sizes[region:last]
            parts.append(segments)
            region, row = last, end
        return parts

    def gather(self, values: Tensor) -> Tensor:
        """Gather the values of the points, region by region."""
        return values.index_select(0, self.rows)

    def first(self, values: Tensor) -> Tensor:
        """Return the value of the first point of each region."""
        return values[self.rows[self.counts.cumsum(0) - self.counts]]

    def broadcast(self, values: Tensor) -> Tensor:
        """Broadcast a value per region to its points, in the order of :meth:`gather`."""
        return values.index_select(0, self.labels)

    def gather_columns(self, vectors: Tensor) -> list[Tensor]:
        """Apply :meth:`gather` to the columns of vectors ``(N, 3)``, in float64."""
        return [self.gather(column).double() for column in vectors.unbind(dim=1)]

    def coordinates(self, vectors: Tensor, centers: Tensor, axes: Tensor) -> list[Tensor]:
        """Return coordinates relative to region centers ``(M, 3)`` along region axes.

        ``vectors`` are ``(N, 3)``, ``axes`` ``(M, A, 3)``; returns A columns ``(n,)``, float64.
        """
        if self.are_served(centers):
            columns, tables = self.gather_columns(vectors), (self.counts, centers, axes)
            return list(kernels.call("segment_coordinates", *columns, *tables)[0])
        about, found = self.gather_centered(vectors, centers), []
        for axis in axes.unbind(dim=1):
            total = torch.zeros_like(about[0])
            # Separate products and sums: their rounding must not depend on block boundaries.
            for column, component in zip(about, axis.unbind(dim=1), strict=True):
                total += column * self.broadcast(component)
            found.append(total)
        return found

    def gather_centered(self, vectors: Tensor, centers: Tensor) -> list[Tensor]:
        """Apply :meth:`gather` to vectors ``(N, 3)``, relative to region centers ``(M, 3)``."""
        pairs = zip(vectors.unbind(dim=1), centers.unbind(dim=1), strict=True)
        return [self.gather(column).double() - self.broadcast(center) for column, center in pairs]

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of the values of each region, given in the order of :meth:`gather`."""
        return reduce_runs(values, self.counts, "sum")

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of the values of each region."""
        return self.sum(values) / self.counts

    def moments(
        self, columns: Sequence[Tensor], weights: Tensor, *, centered: bool = True
    ) -> tuple[Tensor, Tensor]:
        """Return the weighted mean ``(M, 3)`` and covariance ``(M, 3, 3)`` of each region.

        The columns are those of :meth:`gather_columns`; if not ``centered``, the mean is zero.
        """
        if self.are_served(weights):
            numbers = self.counts, centered
            mean, covariance = kernels.call("segment_moments", *columns, weights, *numbers)
            return mean, covariance
        total = self.sum(weights)
        means = [self.sum(column * weights) / total * centered for column in columns]
        about = [c - self.broadcast(mean) for c, mean in zip(columns, means, strict=True)]
        return torch.stack(means, dim=1), second_moments(about, weights, self.sum, total)

    def reweigh(
        self,
        columns: Sequence[Tensor],
        means: Tensor,
        axes: Tensor,
        min_scale: Tensor,
        factors: tuple[float, float],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return Tukey's bisquare weights of the residuals along an axis of each region.

        The scale is the first factor times the median absolute residual, at least ``min_scale``
        ``(M,)``. The weight is zero from the second factor times the scale. Returns weights
        ``(n,)``, median absolute residuals ``(M,)`` and mean squares ``(M,)``.
        """
        if self.are_served(means):
            tables = self.counts, means, axes, min_scale
            weights, medians, squares = kernels.call(
                "reweigh_segments", *columns, *tables, *factors
            )
            return weights, medians, squares
        residuals = torch.zeros_like(columns[0])
        # Separate products and sums: their rounding must not depend on memory block boundaries.
        for column, mean, component in zip(columns, means.T, axes.T, strict=True):
            residuals += (column - self.broadcast(mean)) * self.broadcast(component)
        medians = self.median(residuals.abs())
        cut = factors[1] * torch.maximum(factors[0] * medians, min_scale)
        # A region with all points at the origin has cut 0, and residuals 0 too.
        ratio = residuals / self.broadcast(torch.where(cut > 0, cut, 1.0))
        weights = (1 - ratio * ratio).clamp(min=0).square()
        return weights, medians, self.mean(residuals * residuals)

    def are_served(self, values: Tensor) -> bool:
        """Return whether kernels support float64 values of these regions."""
        is_plain = values.is_cpu and values.dtype == torch.float64
        return is_plain and kernels.serve() and bool(self.counts.all())

    def median(self, values: Tensor) -> Tensor:
        """Return the lower median of the values of each region."""
        return self.quantile(values, 0.5)

    def quantile(self, values: Tensor, fraction: float) -> Tensor:
        """Return the lower quantile of the values of each region, without interpolation."""
        ranks = (fraction * (self.counts - 1).double()).long()
        if values.device.type == "cpu" and kernels.serve():
            found = kernels.call("kth_values", values.double(), self.counts, ranks)[0]
            return found.to(values.dtype)
        order = values.argsort()
        order = order[self.labels[order].argsort(stable=True)]
        ends = self.counts.cumsum(0)
        # A region without points has the appended NaN.
        index = torch.where(self.counts > 0, ends - self.counts + ranks, len(values))
        return torch.cat([values[order], values.new_tensor([torch.nan])])[index]


def reduce_runs(values: Tensor, counts: Tensor, how: str) -> Tensor:
    """Return the "sum", "min" or "max" ``(M,)`` of runs with ``counts`` values each.

    Integers must be below 2^53: float64 represents them on devices other than the CPU.
    """
    if values.device.type != "cpu" or not bool(counts.all()):
        # segment_reduce needs a value, and floats. Its checks, off if unsafe, wait for a device.
        numbers = values if values.is_floating_point() else values.double()
        if len(values) == 0:
            empty = {"sum": 0.0, "min": torch.inf, "max": -torch.inf}[how]
            return numbers.new_full(counts.shape, empty).to(values.dtype)
        numbers = torch.segment_reduce(numbers.contiguous(), how, lengths=counts, unsafe=True)
        return numbers.to(values.dtype)
    # Five times faster than in torch; pairwise sums are also more accurate.
    reduction = {"sum": np.add, "min": np.minimum, "max": np.maximum}[how]
    starts = counts.cumsum(0) - counts
    return torch.from_numpy(reduction.reduceat(values.numpy(), starts.numpy()))


def kth_smallest(values: Tensor, k: int) -> Tensor:
    """Return the value with index k in sorted order of ``(n,)``, NaN last; NaN if empty."""
    if len(values) == 0:
        return values.new_tensor(torch.nan)
    if values.device.type == "cpu" and kernels.serve():
        # Up to thirty times faster than in torch.
        run = torch.tensor([[len(values)], [k]], device="cpu")
        return kernels.call("kth_values", values.double(), *run)[0].to(values.dtype).squeeze(0)
    return values.kthvalue(k + 1).values


_NUM_LANES = 8
"""Number of parallel accumulators in kernels, ``LANES`` in ``plain.h``."""
Columns = tuple[Tensor, Tensor, Tensor]
"""Coordinates x, y and z of neighborhoods, each ``(n, K)`` and contiguous. The lanes of
:mod:`torchrg.robust.lanes` are transposed, since robust fits sort every neighborhood."""


def unbind_columns(patches: Tensor) -> Columns:
    """Split patches ``(n, K, 3)`` into contiguous columns ``(n, K)``."""
    x, y, z = patches.unbind(dim=-1)
    return x.contiguous(), y.contiguous(), z.contiguous()


def sum_neighbors(values: Tensor) -> Tensor:
    """Return sums ``(*)`` over the neighbors ``(*, K)`` in the summation order of the kernels.

    Every eighth value is added to one of eight accumulators, as in a vector register; these are
    added pairwise. Rounding that decides between equally good planes is therefore the same with and
    without the library.
    """
    first, *others = torch.split(_pad_lanes(values), _NUM_LANES, dim=-1)
    first = first.clone()
    for lanes in others:
        first += lanes
    while first.shape[-1] > 1:
        half = first.shape[-1] // 2
        first = first[..., :half] + first[..., half:]
    return first.squeeze(-1)


def _pad_lanes(values: Tensor) -> Tensor:
    """Append zeros to values ``(*, K)`` until they fill the lanes."""
    missing = -values.shape[-1] % _NUM_LANES if values.shape[-1] else _NUM_LANES
    return torch.nn.functional.pad(values, (0, missing)) if missing else values


def sq_lengths(columns: Columns) -> Tensor:
    """Return the squared distance of each neighbor, shape ``(n, K)``."""
    x, y, z = columns
    return x * x + y * y + z * z


def residuals(columns: Columns, normals: Tensor, offsets: Tensor) -> Tensor:
    """Return signed distances of the neighbors to planes ``normal . q = offset``, ``(n, K)``."""
    return project(columns, normals).sub_(offsets[:, None])


def project(columns: Columns, axes: Tensor) -> Tensor:
    """Return coordinates of the neighbors along axes ``(*, n, 3)``, shape ``(*, n, K)``."""
    x, y, z = columns
    a, b, c = (component[..., None] for component in axes.unbind(dim=-1))
    # Separate products and sums: fused multiply-adds may round differently at the end of a block.
    return (x * a).add_(y * b).add_(z * c)


def fit_weighted_planes(columns: Columns, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a plane to each neighborhood by least squares with nonnegative weights ``(n, K)``.

    Returns unit normals ``(n, 3)``, offsets ``(n,)`` of the planes ``normal . q = offset``, and the
    ascending eigenvalues ``(n, 3)`` of the weighted covariance.
    """
    means, covariance = weighted_moments(columns, weights)
    values, normals = smallest_eigenvector3(covariance)
    return normals, dot(normals, means), values


def fit_planes_to_each(columns: Columns, groups: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
    """Fit a plane to the neighbors for each set of weights; see :func:`fit_weighted_planes`."""
    normals, offsets, _ = fit_weighted_planes(columns, torch.stack(list(groups)))
    return list(zip(normals.unbind(), offsets.unbind(), strict=True))


def fit_parallel_planes(
    columns: Columns, groups: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit parallel planes to the neighbors, one per set of weights, by least squares.

    Returns unit normals ``(n, 3)``, offsets of the G planes ``(G, n)``, and the mean squared
    residual over all sets ``(n,)``.
    """
    totals = torch.stack([weights.sum(dim=1) for weights in groups])
    means, covariances = weighted_moments(columns, torch.stack(list(groups)))
    fractions = totals / totals.sum(dim=0).clamp(min=1)
    pooled = (fractions[:, :, None, None] * covariances).sum(dim=0)
    values, normals = smallest_eigenvector3(pooled)
    return normals, dot(normals, means), values[:, 0].clamp(min=0)


def weighted_moments(columns: Sequence[Tensor], weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted mean ``(*, 3)`` and covariance ``(*, 3, 3)`` of each neighborhood.

    Columns have shape ``(n, K)``, weights the same or, for several fits, ``(*, n, K)``.
    """
    columns, weights = [_pad_lanes(column) for column in columns], _pad_lanes(weights)
    total = sum_neighbors(weights)
    inverse = 1 / torch.where(total > 0, total, 1.0)
    # One sum of all products: a device takes longer to start a sum than to run it.
    sums = sum_neighbors(torch.stack([weights * column for column in columns]))
    means = [moment * inverse for moment in sums.unbind()]
    centered = [column - mean[..., None] for column, mean in zip(columns, means, strict=True)]
    products = torch.stack(_products(centered, weights * inverse[..., None]))
    matrix = _symmetric(sum_neighbors(products).unbind(), len(columns))
    return torch.stack(means, dim=-1), matrix


def dot(vectors: Tensor, others: Tensor) -> Tensor:
    """Return dot products ``(*)`` of vectors ``(*, 3)``, summed in coordinate order."""
    x, y, z = (vectors * others).unbind(dim=-1)
    return x + y + z


def eigh3_lapack(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Variant of :func:`eigh3` by LAPACK, faster for fewer than a thousand matrices.

    Non-finite matrices give NaN.
    """
    undefined = ~matrices.isfinite().flatten(-2).all(dim=-1)
    if are_undefined := bool(undefined.any()):
        matrices = matrices.masked_fill(undefined[..., None, None], 0.0)
    values, vectors = torch.linalg.eigh(matrices, UPLO="U")
    if are_undefined:
        values[undefined], vectors[undefined] = torch.nan, torch.nan
    return values, vectors
