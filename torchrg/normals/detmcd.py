"""Planes by the deterministic minimum covariance determinant."""

from torch import Tensor

from torchrg.normals.pca import check_patches
from torchrg.normals.robust_fits import fit_inliers
from torchrg.robust import fit_detmcd
from torchrg.structures import NormalFit


def fit_normals_detmcd(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    support_fraction: float = 0.5,
    quantile: float = 0.975,
    resolution: Tensor | None = None,
) -> NormalFit:
    """Fit a plane to the inliers of each patch's DetMCD, eq. (6) and Algorithm 1.

    Points whose squared robust distance is at most the chi-square quantile are inliers; the normal,
    curvature and residual are those of PCA on them. (The paper prints the cut as 3.075; that is the
    root, 3.0575, of the quantile 9.3484 that its eq. (6) asks for.)

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``.
        mask: Which points count, shape ``(*, K)``, bool. Default: all.
        support_fraction: Share of the points that the MCD fits, in [0.5, 1].
        quantile: Quantile of the chi-square distribution at which distances are cut.
        resolution: Size below which a coordinate difference is rounding, shape ``(*)``.

    Returns:
        The fit. Where h or more points lie exactly on one plane it is that plane, with curvature 0;
        where no unique plane exists ``valid`` is False.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If a setting is out of range.

    References:
        [1] M. Hubert, P. Rousseeuw, T. Verdonck. A deterministic algorithm for robust location and
        scatter. Journal of Computational and Graphical Statistics 21(3), 2012.

    Example:
        >>> import torch
        >>> floor = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] *= (torch.arange(40) > 29)
        >>> fit_normals_detmcd(floor).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_detmcd", patches, mask, resolution)
    robust = fit_detmcd(
        patches.detach(), mask, support_fraction=support_fraction, quantile=quantile
    )
    return fit_inliers(patches, robust, resolution)
