"""Planes by robust location and scatter: DetMCD, FastMCD, MVE, DetMM."""

import torch
from torch import Tensor

from torchrg.normals.pca import check_patches, fit_normals_pca
from torchrg.robust import RobustFit, fit_detmcd, fit_detmm, fit_fastmcd, fit_mve
from torchrg.structures import NormalFit


def fit_normals_detmcd(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    support_fraction: float = 0.5,
    quantile: float = 0.975,
    resolution: Tensor | None = None,
) -> NormalFit:
    """Fit a plane to the inliers of each patch's DetMCD [1], eq. (6) and Algorithm 1.

    Points whose squared robust distance is at most the chi-square quantile are inliers; the normal,
    curvature and residual are those of PCA on them. (The paper prints the cut as 3.075; that is the
    root, 3.0575, of the quantile 9.3484 that its eq. (6) asks for.)

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``.
        mask: Which points count, shape ``(*, K)``, bool. Default: all.
        support_fraction: Share of the points that the robust fit trusts, in [0.5, 1].
        quantile: Quantile of the chi-square distribution at which squared distances are cut.
        resolution: Size below which a coordinate difference is rounding, shape ``(*)``, in the unit
            of the cloud. Default: rounding of the patch's own coordinates.

    Returns:
        The fit. Where the trusted share of the points lies exactly on one plane it is that plane,
        with curvature 0; where no unique plane exists ``valid`` is False.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If a setting is out of range.

    References:
        [1] M. Hubert, P. Rousseeuw, T. Verdonck. A deterministic algorithm for robust location and
        scatter. Journal of Computational and Graphical Statistics 21(3), 2012.

    Example:
        >>> floor = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] *= torch.arange(40) > 29
        >>> fit_normals_detmcd(floor).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_detmcd", patches, mask, resolution)
    robust = fit_detmcd(
        patches.detach(), mask, support_fraction=support_fraction, quantile=quantile
    )
    return _fit_inliers(patches, robust, resolution)


def fit_normals_fastmcd(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    support_fraction: float = 0.5,
    quantile: float = 0.975,
    num_starts: int = 500,
    generator: torch.Generator | None = None,
    resolution: Tensor | None = None,
) -> NormalFit:
    """Fit a plane to the inliers of each patch's MCD with random starts [1].

    As :func:`fit_normals_detmcd`, with :func:`torchrg.robust.fit_fastmcd`: ``num_starts`` sets of
    four points are drawn by the ``generator``, always the same sets where there is none.

    References:
        [1] P. Rousseeuw, K. Van Driessen. A fast algorithm for the minimum covariance determinant
        estimator. Technometrics 41(3), 1999.

    Example:
        >>> floor = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] *= torch.arange(40) > 29
        >>> fit_normals_fastmcd(floor, num_starts=50).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_fastmcd", patches, mask, resolution)
    robust = fit_fastmcd(
        patches.detach(),
        mask,
        support_fraction=support_fraction,
        quantile=quantile,
        num_starts=num_starts,
        generator=generator,
    )
    return _fit_inliers(patches, robust, resolution)


def fit_normals_mve(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    support_fraction: float = 0.5,
    quantile: float = 0.975,
    num_starts: int = 500,
    generator: torch.Generator | None = None,
    resolution: Tensor | None = None,
) -> NormalFit:
    """Fit a plane to the inliers of each patch's minimum volume ellipsoid [1].

    As :func:`fit_normals_fastmcd`, with :func:`torchrg.robust.fit_mve`, whose ellipsoid covers the
    ``support_fraction`` of the points.

    References:
        [1] P. Rousseeuw. Multivariate estimation with high breakdown point. Mathematical
        Statistics and Applications B, 1985.

    Example:
        >>> floor = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] *= torch.arange(40) > 29
        >>> fit_normals_mve(floor, num_starts=50).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_mve", patches, mask, resolution)
    robust = fit_mve(
        patches.detach(),
        mask,
        support_fraction=support_fraction,
        quantile=quantile,
        num_starts=num_starts,
        generator=generator,
    )
    return _fit_inliers(patches, robust, resolution)


def fit_normals_detmm(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    quantile: float = 0.975,
    resolution: Tensor | None = None,
) -> NormalFit:
    """Fit a plane to the inliers of each patch's deterministic MM-estimate [1].

    As :func:`fit_normals_detmcd`, with :func:`torchrg.robust.fit_detmm`, which trusts half of the
    points.

    References:
        [1] A. Khaloo, D. Lattanzi. Robust normal estimation and region growing segmentation of
        infrastructure 3D point cloud models. Advanced Engineering Informatics 34, 2017.

    Example:
        >>> floor = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] *= torch.arange(40) > 29
        >>> fit_normals_detmm(floor).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_detmm", patches, mask, resolution)
    robust = fit_detmm(patches.detach(), mask, quantile=quantile)
    return _fit_inliers(patches, robust, resolution)


def _fit_inliers(patches: Tensor, robust: RobustFit, resolution: Tensor | None) -> NormalFit:
    """Return the planes of PCA on the points that robust fits keep; none where they are invalid."""
    return fit_normals_pca(patches, robust.support & robust.valid[..., None], resolution=resolution)
