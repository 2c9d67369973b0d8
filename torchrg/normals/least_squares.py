"""Least squares of many small systems by orthogonalisation."""

from collections.abc import Sequence

import torch
from torch import Tensor


def least_squares(
    columns: Sequence[tuple[Tensor, Tensor | float]], target: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Fit a target by columns, and leave out columns that depend on the ones before.

    Modified Gram-Schmidt with the target as the last column: as accurate as Householder's QR, and
    made of sums of products only, so it runs batched on any device and gradients flow.

    Args:
        columns: Columns, shape ``(*, K)``, each with the share of its length, a number or shape
            ``(*, 1)``, that must be left after the columns before it are taken out.
        target: Shape ``(*, K)``.

    Returns:
        The coefficient of each column, shape ``(*, 1)``, 0 where it is left out, and the residual,
        shape ``(*, K)``.

    Example:
        >>> one, x = torch.ones(3), torch.tensor([0.0, 1.0, 2.0])
        >>> (a, b), _ = least_squares([(one, 1e-6), (x, 1e-6)], 2 * x + 1)
        >>> a.round(decimals=4), b.round(decimals=4)
        (tensor([1.]), tensor([2.]))
    """
    basis: list[Tensor] = []
    mixing: list[list[Tensor]] = []
    for column, share in columns:
        rest, mix = column, []
        for direction in basis:
            mix.append((direction * rest).sum(dim=-1, keepdim=True))
            rest = rest - mix[-1] * direction
        sq_rest = (rest * rest).sum(dim=-1, keepdim=True)
        kept = sq_rest > share * share * (column * column).sum(dim=-1, keepdim=True)
        length = torch.where(kept, sq_rest, 1.0).sqrt()
        basis.append(torch.where(kept, rest / length, 0.0))
        mixing.append([*mix, length])
    projections = []
    for direction in basis:
        projections.append((direction * target).sum(dim=-1, keepdim=True))
        target = target - projections[-1] * direction
    coefficients: list[Tensor] = []
    for row in reversed(range(len(basis))):
        known = sum(
            (mixing[row + 1 + i][row] * c for i, c in enumerate(coefficients)),
            start=torch.zeros_like(projections[row]),
        )
        coefficients.insert(0, (projections[row] - known) / mixing[row][row])
    return coefficients, target
