"""Check of rigid motions, such as camera poses."""

import torch
from torch import Tensor

from torchrg._checks import is_concrete
from torchrg.errors import ShapeError

_MAX_ERROR = 1e-3
"""Maximum error of an entry of ``R @ R.T``. Poses in text files have at least four digits."""
_MAX_ROW_ERROR = 1e-6
"""Maximum error of the last row, which programs write exactly."""


def check_rigid(caller: str, name: str, motions: Tensor | None) -> None:
    """Raise ShapeError if a matrix of ``(*, 4, 4)`` is not a rigid motion; None is skipped.

    A rigid motion turns and shifts: ``R @ R.T`` is the identity, the determinant of ``R`` is
    positive, and the last row is 0 0 0 1.
    """
    if motions is not None and is_concrete(motions):
        for matrix in motions.detach().reshape(-1, 4, 4).double().cpu():
            if fault := _describe_fault(matrix):
                raise ShapeError(f"{caller}: expected {name} to be rigid, got {fault}.")


def _describe_fault(matrix: Tensor) -> str:
    """Return the reason why a matrix ``(4, 4)`` is not a rigid motion, otherwise ""."""
    turn, row = matrix[:3, :3], matrix[3]
    if not bool(matrix.isfinite().all()):
        return "values that are not finite"
    if not bool(turn.any()):
        return "a rotation of zeros"
    if float((row - row.new_tensor([0, 0, 0, 1])).abs().max()) > _MAX_ROW_ERROR:
        if not bool(matrix[:3, 3].any()) and abs(float(row[3]) - 1) <= _MAX_ROW_ERROR:
            return "a transposed matrix, with the translation in its last row; transpose it"
        return f"a last row of {' '.join(f'{value:g}' for value in row.tolist())}, not 0 0 0 1"
    products = turn @ turn.T
    scale = float(products.trace() / 3) ** 0.5
    unit = torch.eye(3, dtype=products.dtype)
    if float((products / scale**2 - unit).abs().max()) > _MAX_ERROR:
        return "sheared or unevenly scaled axes"
    if float(torch.linalg.det(turn)) < 0:
        return "a mirror; negate the axis that points the other way"
    if float((products - unit).abs().max()) > _MAX_ERROR:
        return f"a rotation scaled by {scale:.4g}; divide it by {scale:.4g}"
    return ""
