"""Module forms of the batched functions; they hold settings and nothing else."""

from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchrg.errors import ConfigError
from torchrg.linalg import covariance, eigh3
from torchrg.robust import RobustFit, fit_detmcd, fit_detmm, fit_fastmcd, qn
from torchrg.robust.mm import Target
from torchrg.robust.starts import Starts


class _Function(nn.Module):
    """A function whose settings are attributes, and shown."""

    def __init__(self, **settings: object) -> None:
        super().__init__()
        self._names = tuple(settings)
        for name, value in settings.items():
            setattr(self, name, value)

    def settings(self) -> dict[str, Any]:
        """Return the settings by name."""
        return {name: getattr(self, name) for name in self._names}

    def extra_repr(self) -> str:
        """Return the settings as text."""
        return ", ".join(f"{name}={value!r}" for name, value in self.settings().items())


class Covariance(_Function):
    """Mean and covariance of patches; see :func:`torchrg.linalg.covariance`.

    Example:
        >>> Covariance()(torch.tensor([[0.0, 0], [2, 0], [0, 4], [2, 4]]))[1].diagonal()
        tensor([1., 4.])
    """

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return mean and covariance."""
        return covariance(patches, mask)


class Eigh(_Function):
    """Eigenvalues, ascending, and eigenvectors of symmetric matrices.

    Args:
        method: ``"jacobi"`` for :func:`torchrg.linalg.eigh3`, fast for many 3x3 matrices, or
            ``"linalg"`` for :func:`torch.linalg.eigh`.

    Example:
        >>> Eigh()(torch.diag(torch.tensor([3.0, 1.0, 2.0])))[0]
        tensor([1., 2., 3.])
    """

    def __init__(self, method: Literal["jacobi", "linalg"] = "jacobi") -> None:
        if method not in ("jacobi", "linalg"):
            raise ConfigError(f"Eigh: expected method to be jacobi or linalg, got {method!r}.")
        super().__init__(method=method)

    def forward(self, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Return eigenvalues and eigenvectors."""
        if self.method == "jacobi":
            return eigh3(matrices)
        values, vectors = torch.linalg.eigh(matrices)
        return values, vectors


class Qn(_Function):
    """Robust scale of rows; see :func:`torchrg.robust.qn`.

    Args:
        dim: Axis to reduce.
        finite_sample: Whether to correct for the number of values.

    Example:
        >>> Qn()(torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0]))
        tensor(2.2219)
    """

    def __init__(self, dim: int = -1, *, finite_sample: bool = False) -> None:
        super().__init__(dim=dim, finite_sample=finite_sample)

    def forward(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the scale."""
        return qn(values, mask=mask, **self.settings())


class DetMCD(_Function):
    """Deterministic MCD of patches; see :func:`torchrg.robust.fit_detmcd`.

    Args:
        support_fraction: Share of the points that may be trusted.
        quantile: Quantile of the chi-square distribution at which inliers end.
        starts: Which deterministic starts.
        small_sample: Whether to correct for the number of points.

    Example:
        >>> DetMCD()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    def __init__(
        self,
        support_fraction: float = 0.5,
        *,
        quantile: float = 0.975,
        starts: Starts = "paper",
        small_sample: bool = False,
    ) -> None:
        super().__init__(
            support_fraction=support_fraction,
            quantile=quantile,
            starts=starts,
            small_sample=small_sample,
        )

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> RobustFit:
        """Return the fits."""
        return fit_detmcd(patches, mask, **self.settings())


class FastMCD(_Function):
    """MCD of patches with random starts; see :func:`torchrg.robust.fit_fastmcd`.

    Args:
        support_fraction: Share of the points that may be trusted.
        quantile: Quantile of the chi-square distribution at which inliers end.
        num_starts: Number of random starts.
        small_sample: Whether to correct for the number of points.

    Example:
        >>> FastMCD()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    def __init__(
        self,
        support_fraction: float = 0.5,
        *,
        quantile: float = 0.975,
        num_starts: int = 500,
        small_sample: bool = False,
    ) -> None:
        super().__init__(
            support_fraction=support_fraction,
            quantile=quantile,
            num_starts=num_starts,
            small_sample=small_sample,
        )

    def forward(
        self,
        patches: Tensor,
        mask: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> RobustFit:
        """Return the fits; the generator draws the starts."""
        return fit_fastmcd(patches, mask, generator=generator, **self.settings())


class DetMM(_Function):
    """Deterministic MM-estimator of patches; see :func:`torchrg.robust.fit_detmm`.

    Args:
        quantile: Quantile of the chi-square distribution at which inliers end.
        starts: Which deterministic starts.
        tuned_for: What the efficiency is that of, ``"shape"`` or ``"location"``.

    Example:
        >>> DetMM()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    def __init__(
        self,
        *,
        quantile: float = 0.975,
        starts: Starts = "robustbase",
        tuned_for: Target = "shape",
    ) -> None:
        super().__init__(quantile=quantile, starts=starts, tuned_for=tuned_for)

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> RobustFit:
        """Return the fits."""
        return fit_detmm(patches, mask, **self.settings())
