"""Module forms of the batched functions; they hold settings and nothing else."""

from typing import Literal

import torch
from torch import Tensor, nn

from torchrg.errors import ConfigError
from torchrg.linalg import covariance, eigh3
from torchrg.robust import qn


class Covariance(nn.Module):
    """Mean and covariance of patches; see :func:`torchrg.linalg.covariance`.

    Example:
        >>> Covariance()(torch.tensor([[0.0, 0], [2, 0], [0, 4], [2, 4]]))[1].diagonal()
        tensor([1., 4.])
    """

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return mean and covariance."""
        return covariance(patches, mask)


class Eigh(nn.Module):
    """Eigenvalues, ascending, and eigenvectors of symmetric matrices.

    Args:
        method: ``"jacobi"`` for :func:`torchrg.linalg.eigh3`, fast for many 3x3 matrices, or
            ``"linalg"`` for :func:`torch.linalg.eigh`.

    Example:
        >>> Eigh()(torch.diag(torch.tensor([3.0, 1.0, 2.0])))[0]
        tensor([1., 2., 3.])
    """

    def __init__(self, method: Literal["jacobi", "linalg"] = "jacobi") -> None:
        super().__init__()
        if method not in ("jacobi", "linalg"):
            raise ConfigError(f"Eigh: expected method to be jacobi or linalg, got {method!r}.")
        self.method = method

    def forward(self, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Return eigenvalues and eigenvectors."""
        if self.method == "jacobi":
            return eigh3(matrices)
        values, vectors = torch.linalg.eigh(matrices)
        return values, vectors

    def extra_repr(self) -> str:
        """Return the settings."""
        return f"method={self.method!r}"


class Qn(nn.Module):
    """Robust scale of rows; see :func:`torchrg.robust.qn`.

    Args:
        dim: Axis to reduce.
        finite_sample: Whether to correct for the number of values.

    Example:
        >>> Qn()(torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0]))
        tensor(2.2219)
    """

    def __init__(self, dim: int = -1, *, finite_sample: bool = False) -> None:
        super().__init__()
        self.dim = dim
        self.finite_sample = finite_sample

    def forward(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the scale."""
        return qn(values, dim=self.dim, finite_sample=self.finite_sample, mask=mask)

    def extra_repr(self) -> str:
        """Return the settings."""
        return f"dim={self.dim}, finite_sample={self.finite_sample}"
