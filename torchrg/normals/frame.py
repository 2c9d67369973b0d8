"""The principal frame of a neighbourhood, with gradients that are finite everywhere."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import eigh3, rank_tolerance


class PrincipalFrame(NamedTuple):
    """Eigenvalues and eigenvectors of covariances; gradients flow through the first two.

    Attributes:
        normals: Unit eigenvectors of the smallest eigenvalue, shape ``(*, 3)``.
        smallest: Smallest eigenvalues, not below zero, shape ``(*)``.
        values: All eigenvalues in ascending order, shape ``(*, 3)``, without gradient.
        vectors: Unit eigenvectors as columns, shape ``(*, 3, 3)``, without gradient.
    """

    normals: Tensor
    smallest: Tensor
    values: Tensor
    vectors: Tensor


def principal_frame(matrices: Tensor) -> PrincipalFrame:
    r"""Decompose symmetric 3x3 matrices, with first-order gradients of normal and smallest value.

    With the decomposition held constant, one step of perturbation theory changes nothing in value
    and everything in gradient: ``dn = sum_j v_j (v_j . dA n) / (l0 - l_j)``. Where two eigenvalues
    are equal, the turn between their vectors is left out.

    Args:
        matrices: Symmetric matrices, shape ``(*, 3, 3)``.

    Returns:
        The frame.

    Example:
        >>> matrix = torch.diag(torch.tensor([3.0, 1.0, 2.0])).requires_grad_()
        >>> principal_frame(matrix).smallest.backward()
        >>> matrix.grad.diagonal()
        tensor([0., 1., 0.])
    """
    with torch.no_grad():
        values, vectors = eigh3(matrices)
    normals, smallest = vectors[..., 0], values[..., 0].clamp(min=0)
    if matrices.requires_grad:
        normals, smallest = _perturbed(matrices, values, vectors)
    return PrincipalFrame(normals, smallest, values, vectors)


def _perturbed(matrices: Tensor, values: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first eigenvector and eigenvalue with their first-order gradients."""
    smallest, normal = values[..., :1], vectors[..., :1]
    gap = smallest - values[..., 1:]
    distinct = gap.abs() > rank_tolerance(3, values.dtype) * values[..., 2:]
    turn = (vectors[..., 1:].mT @ (matrices @ normal)).squeeze(-1)
    turn = turn - turn.detach()
    step = torch.where(distinct, turn / torch.where(distinct, gap, 1.0), 0.0)
    moved = normal.squeeze(-1) + (vectors[..., 1:] @ step[..., None]).squeeze(-1)
    value = (normal.mT @ matrices @ normal).squeeze(-1)
    value = smallest + value - value.detach()
    return moved, value.squeeze(-1).clamp(min=0)


def root(squares: Tensor) -> Tensor:
    """Return square roots whose gradient at zero is zero.

    Example:
        >>> zero = torch.zeros(1, requires_grad=True)
        >>> root(zero).sum().backward()
        >>> zero.grad
        tensor([0.])
    """
    positive = squares > 0
    return torch.where(positive, squares, 1.0).sqrt() * positive
