"""Module forms of the batched functions; they hold settings and nothing else."""

from dataclasses import KW_ONLY, asdict, dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from torchrg.errors import ConfigError
from torchrg.linalg import covariance, eigh3
from torchrg.robust import RobustFit, fit_detmcd, fit_detmm, fit_fastmcd, qn
from torchrg.robust.mm import Target
from torchrg.robust.starts import Starts
from torchrg.robust.weights import Inliers, Scaling


@dataclass(eq=False, repr=False)
class _Function(nn.Module):
    """A function whose settings are attributes, the fields of the class, and shown."""

    def __post_init__(self) -> None:
        super().__init__()

    def extra_repr(self) -> str:
        """Return the settings as text."""
        return ", ".join(f"{name}={value!r}" for name, value in asdict(self).items())


class Covariance(_Function):
    """Mean and covariance of patches; see :func:`torchrg.linalg.covariance`.

    Example:
        >>> Covariance()(torch.tensor([[0.0, 0], [2, 0], [0, 4], [2, 4]]))[1].diagonal()
        tensor([1., 4.])
    """

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return mean and covariance."""
        return covariance(patches, mask)


@dataclass(eq=False, repr=False)
class Eigh(_Function):
    """Eigenvalues, ascending, and eigenvectors of symmetric matrices.

    Example:
        >>> Eigh()(torch.diag(torch.tensor([3.0, 1.0, 2.0])))[0]
        tensor([1., 2., 3.])
    """

    method: Literal["jacobi", "linalg"] = "jacobi"
    """:func:`torchrg.linalg.eigh3`, fast for many 3x3 matrices, or :func:`torch.linalg.eigh`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in ("jacobi", "linalg"):
            raise ConfigError(f"Eigh: expected method to be jacobi or linalg, got {self.method!r}.")

    def forward(self, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Return eigenvalues and eigenvectors."""
        if self.method == "jacobi":
            return eigh3(matrices)
        values, vectors = torch.linalg.eigh(matrices)
        return values, vectors


@dataclass(eq=False, repr=False)
class Qn(_Function):
    """Robust scale of rows; the fields are settings of :func:`torchrg.robust.qn`.

    Example:
        >>> Qn()(torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0]))
        tensor(2.2219)
    """

    dim: int = -1
    _: KW_ONLY
    finite_sample: bool = False

    def forward(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the scale."""
        return qn(values, mask=mask, **asdict(self))


@dataclass(eq=False, repr=False)
class DetMCD(_Function):
    """Deterministic MCD of patches; the fields are settings of :func:`torchrg.robust.fit_detmcd`.

    Example:
        >>> DetMCD()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    support_fraction: float = 0.5
    _: KW_ONLY
    quantile: float = 0.975
    starts: Starts = "paper"
    small_sample: bool = False
    scaling: Scaling = "consistency"
    inliers: Inliers = "raw"

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> RobustFit:
        """Return the fits."""
        return fit_detmcd(patches, mask, **asdict(self))


@dataclass(eq=False, repr=False)
class FastMCD(_Function):
    """MCD of patches with random starts; with the settings of :func:`torchrg.robust.fit_fastmcd`.

    Example:
        >>> FastMCD()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    support_fraction: float = 0.5
    _: KW_ONLY
    quantile: float = 0.975
    num_starts: int = 500
    small_sample: bool = False

    def forward(
        self,
        patches: Tensor,
        mask: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> RobustFit:
        """Return the fits; the generator draws the starts."""
        return fit_fastmcd(patches, mask, generator=generator, **asdict(self))


@dataclass(eq=False, repr=False)
class DetMM(_Function):
    """Deterministic MM-estimator of patches, with settings of :func:`torchrg.robust.fit_detmm`.

    Example:
        >>> DetMM()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    _: KW_ONLY
    quantile: float = 0.975
    starts: Starts = "robustbase"
    tuned_for: Target = "shape"

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> RobustFit:
        """Return the fits."""
        return fit_detmm(patches, mask, **asdict(self))
