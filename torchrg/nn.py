"""Modules for the batched functions, with settings checked at construction.

Modules take and return tensors, and can be chained in :class:`torch.nn.Sequential`:

>>> rng = torch.Generator().manual_seed(0)
>>> patches = torch.randn(8, 30, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.01])
>>> normals = nn.Sequential(Covariance(), Eigh(), Normal())(patches)
>>> bool((normals[:, 2].abs() > 0.99).all())
True
>>> robust = nn.Sequential(DetMCD(starts="planes", min_dimension=2), Eigh(), Normal())
>>> model = nn.Sequential(robust, nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 2))
>>> model(patches).shape
torch.Size([8, 2])

Patches ``(*, K, 3)`` go to :class:`Covariance` or a robust fit, then to :class:`Eigh` and
:class:`Normal`; :class:`PatchNormals` combines these steps for any estimator. A robust fit
describes the majority, even on a line; normals need planes: pass ``min_dimension=2``.
"""

from collections.abc import Callable
from dataclasses import KW_ONLY, asdict, dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from torchrg._checks import check_choices, check_kinds
from torchrg.errors import ConfigError, ShapeError
from torchrg.linalg import covariance, eigh3
from torchrg.normals import fit_normals_irls, fit_normals_jet, fit_normals_pca, fit_normals_robust
from torchrg.robust import RobustFit, fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve, qn
from torchrg.robust.mm import Target
from torchrg.robust.starts import MCDStarts, Starts
from torchrg.robust.weights import Inliers, Scaling
from torchrg.structures.points import NormalFit, short_repr

__all__ = [
    "MVE",
    "Covariance",
    "DetMCD",
    "DetMM",
    "DetS",
    "Eigen",
    "Eigh",
    "FastMCD",
    "Normal",
    "PatchNormals",
    "Qn",
]
__dir__ = __all__.copy

Result = TypeVar("Result")


@dataclass(eq=False, repr=False)
class _Function(nn.Module, Generic[Result]):
    """A function with its settings as fields."""

    if TYPE_CHECKING:  # A call of nn.Module returns Any.

        def __call__(self, *tensors: object, **options: object) -> Result: ...

    def __new__(cls, *values: object, **settings: object) -> Any:  # noqa: ANN401
        """Initialize the module; refuse other keywords, and tensors in place of settings."""
        names = [field.name for field in fields(cls)]
        for unknown in settings.keys() - names:
            from torchrg._synonyms import describe_keyword

            raise TypeError(f"{cls.__name__}() {describe_keyword(unknown, names)}")
        if any(isinstance(value, Tensor) for value in (*values, *settings.values())):
            name = cls.__name__
            raise ConfigError(f"{name}: expected settings, got a tensor; use {name}()(tensor).")
        module = super().__new__(cls)
        nn.Module.__init__(module)
        return module

    def __post_init__(self) -> None:
        # A call without patches validates the settings.
        self(torch.empty(0, 4, 3))

    def extra_repr(self) -> str:
        """Return the settings as text."""
        return ", ".join(f"{name}={value!r}" for name, value in asdict(self).items())


class Covariance(_Function[Tensor]):
    """Covariance of patches; see :func:`torchrg.linalg.covariance`, which also returns the mean.

    Example:
        >>> Covariance()(torch.tensor([[0.0, 0], [2, 0], [0, 4], [2, 4]])).diagonal()
        tensor([1., 4.])
    """

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return covariances ``(*, P, P)`` of patches ``(*, K, P)``."""
        return covariance(patches, mask)[1]


@short_repr
class Eigen(NamedTuple):
    """Eigenvalues, ascending ``(*, P)``, and unit eigenvectors as columns ``(*, P, P)``."""

    values: Tensor
    vectors: Tensor


@dataclass(eq=False, repr=False)
class Eigh(_Function[Eigen]):
    """Ascending eigenvalues and eigenvectors of symmetric matrices or robust fits.

    Example:
        >>> Eigh()(torch.diag(torch.tensor([3.0, 1.0, 2.0]))).values
        tensor([1., 2., 3.])
    """

    method: Literal["jacobi", "linalg"] = "jacobi"
    """:func:`torchrg.linalg.eigh3`, fast for many 3x3 matrices, or :func:`torch.linalg.eigh`."""

    def __post_init__(self) -> None:
        check_choices("Eigh", method=(self.method, Literal["jacobi", "linalg"]))
        nn.Module.__init__(self)

    def forward(self, matrices: Tensor | RobustFit) -> Eigen:
        """Return eigenvalues and eigenvectors of matrices ``(*, P, P)``; P = 3 for ``jacobi``."""
        tensor = matrices.covariance if isinstance(matrices, RobustFit) else matrices
        if self.method == "jacobi" and tensor.shape[-2:] != (3, 3):
            raise ShapeError(
                f'Eigh: expected shape (*, 3, 3), got {tuple(tensor.shape)}; use Eigh("linalg").'
            )
        return Eigen(*(eigh3(tensor) if self.method == "jacobi" else torch.linalg.eigh(tensor)))


class Normal(_Function[Tensor]):
    """Unit normal of the plane of each patch: the eigenvector of the smallest eigenvalue.

    Example:
        >>> Normal()(Eigh()(torch.diag(torch.tensor([3.0, 1.0, 2.0])))).abs()
        tensor([0., 1., 0.])
    """

    def __post_init__(self) -> None:
        nn.Module.__init__(self)

    def forward(self, eigen: Eigen) -> Tensor:
        """Return normals ``(*, P)``, of arbitrary sign."""
        check_kinds("Normal", "use Normal()(Eigh()(covariances or fits))", eigen=(eigen, Eigen))
        return eigen.vectors[..., 0]


@dataclass(eq=False, repr=False)
class Qn(_Function[Tensor]):
    """Robust scale of rows; the fields are settings of :func:`torchrg.robust.qn`.

    The constant is 2.2219, that of the publication. With ``finite_sample`` it is 2.21914 times a
    factor of the number of values, as in R's ``Qn(x)``.

    Example:
        >>> Qn()(torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0]))
        tensor(2.2219)
    """

    dim: int = -1
    _: KW_ONLY
    finite_sample: bool = False

    def __post_init__(self) -> None:
        if type(self.dim) is not int:
            raise ConfigError(f"Qn: expected dim to be an integer, got {self.dim!r}.")

    def forward(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the scale."""
        return qn(values, mask=mask, **asdict(self))


class _Fit(_Function[RobustFit]):
    """A robust fit."""

    function: ClassVar[Callable[..., RobustFit]]

    def forward(
        self, patches: Tensor, mask: Tensor | None = None, **options: torch.Generator | None
    ) -> RobustFit:
        """Return the fits of patches; ``generator`` draws the starts of FastMCD and MVE."""
        return self.function(patches, mask, **options, **asdict(self))


@dataclass(eq=False, repr=False)
class DetMCD(_Fit):
    """Deterministic MCD of patches; the fields are settings of :func:`torchrg.robust.fit_detmcd`.

    Example:
        >>> DetMCD()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    support_fraction: float = 0.5
    _: KW_ONLY
    quantile: float = 0.975
    starts: MCDStarts = "paper"
    small_sample: bool = False
    scaling: Scaling = "consistency"
    inliers: Inliers = "raw"
    min_dimension: int = 0
    chunk_size: int = 4096

    function = staticmethod(fit_detmcd)


@dataclass(eq=False, repr=False)
class FastMCD(_Fit):
    """MCD of patches with random starts, with the settings of :func:`torchrg.robust.fit_fastmcd`.

    Example:
        >>> FastMCD()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    support_fraction: float = 0.5
    _: KW_ONLY
    quantile: float = 0.975
    num_starts: int = 500
    small_sample: bool = False
    min_dimension: int = 0
    chunk_size: int = 16

    function = staticmethod(fit_fastmcd)


@dataclass(eq=False, repr=False)
class MVE(_Fit):
    """Minimum volume ellipsoid of patches, with the settings of :func:`torchrg.robust.fit_mve`.

    It is for points of 3 coordinates; use :class:`DetMCD` for more.

    Example:
        >>> MVE()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    support_fraction: float = 0.5
    _: KW_ONLY
    quantile: float = 0.975
    num_starts: int = 500
    exhaustive: bool = False
    min_dimension: int = 0
    chunk_size: int = 64

    function = staticmethod(fit_mve)


@dataclass(eq=False, repr=False)
class DetS(_Fit):
    """Deterministic S-estimator of patches, with settings of :func:`torchrg.robust.fit_dets`.

    Gradients are those of the last step, with fixed weights of the points.

    Example:
        >>> DetS()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    _: KW_ONLY
    quantile: float = 0.975
    starts: Starts = "robustbase"
    min_dimension: int = 0
    chunk_size: int = 2048

    function = staticmethod(fit_dets)


@dataclass(eq=False, repr=False)
class DetMM(_Fit):
    """Deterministic MM-estimator of patches, with settings of :func:`torchrg.robust.fit_detmm`.

    Gradients are those of the last step, with fixed weights of the points.

    Example:
        >>> DetMM()(torch.eye(3)[[0, 1, 2, 0, 1, 2]]).exact_fit
        tensor(True)
    """

    _: KW_ONLY
    quantile: float = 0.975
    starts: Starts = "robustbase"
    tuned_for: Target = "shape"
    min_dimension: int = 0
    chunk_size: int = 2048

    function = staticmethod(fit_detmm)


Method = Literal["pca", "jet", "irls", "detmcd", "fastmcd", "mve", "dets", "detmm"]

_FITS: dict[str, Callable[..., NormalFit]] = {
    "pca": fit_normals_pca,
    "jet": fit_normals_jet,
    "irls": fit_normals_irls,
    "detmcd": partial(fit_normals_robust, estimator=fit_detmcd),
    "fastmcd": partial(fit_normals_robust, estimator=fit_fastmcd),
    "mve": partial(fit_normals_robust, estimator=fit_mve),
    "dets": partial(fit_normals_robust, estimator=fit_dets),
    "detmm": partial(fit_normals_robust, estimator=fit_detmm),
}


class PatchNormals(nn.Module):
    """Unit normals of patches, by any estimator.

    ``settings`` are keyword arguments of the method, such as ``support_fraction=0.75``; ``irls``
    needs ``noise``, a number in units of the points.

    Raises:
        ConfigError: If the method, a setting or a value is invalid.

    Example:
        >>> corner = torch.eye(3)[[0, 1, 2, 0, 1, 2]]
        >>> PatchNormals("detmcd", support_fraction=0.75)(corner).abs()
        tensor([0.5774, 0.5774, 0.5774])
    """

    def __init__(self, method: Method = "pca", **settings: Any) -> None:  # noqa: ANN401
        super().__init__()
        check_choices("PatchNormals", method=(method, Method))
        self.method, self.settings = method, settings
        if method == "irls" and not settings.get("noise", 0) > 0:
            raise ConfigError(
                "PatchNormals: expected noise > 0 for irls, in units of points, got none; pass it."
            )
        try:
            self.fit(torch.empty(0, 4, 3))
        except TypeError as error:
            reason = str(error).partition("() ")[2]
            raise ConfigError(f"PatchNormals: {method} {reason}.") from None

    def fit(self, patches: Tensor, mask: Tensor | None = None) -> NormalFit:
        """Return normals with curvature and residuals of patches ``(*, K, 3)``."""
        settings = dict(self.settings)
        if self.method == "irls":
            settings["noise"] = torch.full_like(patches[..., 0, 0], settings["noise"])
        return _FITS[self.method](patches, mask, **settings)

    def forward(self, patches: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return unit normals ``(*, 3)`` of arbitrary sign, zero where there is no plane."""
        return self.fit(patches, mask).normals

    def extra_repr(self) -> str:
        """Return the settings as text."""
        options = {"method": self.method, **self.settings}
        return ", ".join(f"{name}={value!r}" for name, value in options.items())
