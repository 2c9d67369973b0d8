"""Planes by robust location and scatter: DetMCD, FastMCD, MVE, DetMM."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from torchrg.normals.pca import check_patches, fit_normals_pca
from torchrg.robust import RobustFit, fit_detmcd
from torchrg.structures import NormalFit


def fit_normals_robust(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    estimator: Callable[..., RobustFit] = fit_detmcd,
    resolution: Tensor | None = None,
    **settings: Any,  # noqa: ANN401 - of the estimator, which knows them
) -> NormalFit:
    """Fit a plane to the inliers of each patch's robust location and scatter.

    By default those of DetMCD [1], eq. (6) and Algorithm 1. Points whose squared robust distance is
    at most the chi-square quantile are inliers; the normal, curvature and residual are those of PCA
    on them. (The paper prints the cut as 3.075; that is the root, 3.0575, of the quantile 9.3484
    that its eq. (6) asks for.)

    The estimator is :func:`torchrg.robust.fit_detmcd`, :func:`torchrg.robust.fit_fastmcd` [2],
    :func:`torchrg.robust.fit_mve` [3] or :func:`torchrg.robust.fit_detmm` [4]; other keywords are
    its settings. The other arguments and errors are those of
    :func:`torchrg.normals.fit_normals_pca`; a setting out of range is a ``ConfigError``.

    Returns:
        The fit. Where the trusted share of the points lies exactly on one plane it is that plane,
        with curvature 0; where no unique plane exists ``valid`` is False.

    References:
        [1] M. Hubert, P. Rousseeuw, T. Verdonck. A deterministic algorithm for robust location and
        scatter. Journal of Computational and Graphical Statistics 21(3), 2012.
        [2] P. Rousseeuw, K. Van Driessen. A fast algorithm for the minimum covariance determinant
        estimator. Technometrics 41(3), 1999.
        [3] P. Rousseeuw. Multivariate estimation with high breakdown point. Mathematical
        Statistics and Applications B, 1985.
        [4] A. Khaloo, D. Lattanzi. Robust normal estimation and region growing segmentation of
        infrastructure 3D point cloud models. Advanced Engineering Informatics 34, 2017.

    Example:
        >>> import torch
        >>> floor = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] *= torch.arange(40) > 29
        >>> fit_normals_robust(floor).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_robust", patches, mask, resolution)
    robust = estimator(patches.detach(), mask, **settings)
    return fit_normals_pca(patches, robust.support & robust.valid[..., None], resolution=resolution)
