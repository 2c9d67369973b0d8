"""Covariances of many small sets of points, and when a direction of one counts as flat."""

import torch
from torch import Tensor

from torchrg._checks import check_floating, check_shapes


def rank_tolerance(num_values: int, dtype: torch.dtype) -> float:
    """Return the singular value, relative to the largest, at which a direction counts as flat.

    Args:
        num_values: Number of points (or rows) that went into the matrix.
        dtype: Working precision.

    Returns:
        ``max(num_values, 3) * eps``.

    Example:
        >>> rank_tolerance(50, torch.float64) < 1e-13
        True
    """
    return max(num_values, 3) * torch.finfo(dtype).eps


def covariance(patches: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Return mean and covariance (denominator: the number of points) of each patch, eq. (1).

    Two passes about the first point of each patch: accurate far from the origin.

    Args:
        patches: Points, shape ``(*, K, P)``.
        mask: Which points count, shape ``(*, K)``, bool; the others may hold anything. Default:
            all.

    Returns:
        The mean ``(*, P)`` and the covariance ``(*, P, P)``. A patch without points has zeros.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> mean, matrix = covariance(torch.tensor([[0.0, 0, 1], [2, 0, 1], [0, 4, 1], [2, 4, 1]]))
        >>> mean, matrix.diagonal()
        (tensor([1., 2., 1.]), tensor([1., 4., 0.]))
    """
    check_shapes("covariance", patches=(patches, "* K P"), mask=(mask, "* K"))
    check_floating("covariance", patches=patches)
    columns = patches.unbind(dim=-1)
    if mask is None:
        first = [column[..., :1] for column in columns]
        shifted = [column - start for column, start in zip(columns, first, strict=True)]
        count: Tensor | int = patches.shape[-2]
    else:
        # Any counted point serves as the local origin: the one with the largest mask value.
        anchor = mask.to(torch.uint8).argmax(dim=-1, keepdim=True)
        first = [column.gather(-1, anchor) for column in columns]
        shifted = [
            torch.where(mask, column - start, 0.0)
            for column, start in zip(columns, first, strict=True)
        ]
        count = mask.sum(dim=-1, keepdim=True).clamp(min=1)
    means = [column.sum(dim=-1, keepdim=True) / count for column in shifted]
    centered = [column - mean for column, mean in zip(shifted, means, strict=True)]
    if mask is not None:
        centered = [torch.where(mask, column, 0.0) for column in centered]
    total = count if isinstance(count, int) else count.squeeze(-1)
    size = len(columns)
    entries = {
        (i, j): (centered[i] * centered[j]).sum(dim=-1) / total
        for i in range(size)
        for j in range(i + 1)
    }
    rows = [
        torch.stack([entries[max(i, j), min(i, j)] for j in range(size)], dim=-1)
        for i in range(size)
    ]
    center = torch.cat([start + mean for start, mean in zip(first, means, strict=True)], dim=-1)
    if mask is not None:
        center = torch.where(mask.any(dim=-1, keepdim=True), center, 0.0)
    return center, torch.stack(rows, dim=-2)
