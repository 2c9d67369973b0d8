"""Normal estimators by name."""

from functools import partial

from torch import Tensor

from torchrg._parallel import limit_rows
from torchrg.config import NormalsConfig
from torchrg.linalg.precision import to_single
from torchrg.normals.consensus import estimate_consensus
from torchrg.normals.irls import estimate_irls
from torchrg.normals.jet import fit_normals_jet
from torchrg.normals.paper import estimate_paper, fit_normals_robust
from torchrg.normals.pca import Estimator, at_all_points, fit_points_pca
from torchrg.robust import fit_detmcd, fit_detmm, fit_fastmcd, fit_mve
from torchrg.structures import Neighbors, NormalFit

_MCD = {"support_fraction": "support_fraction", "quantile": "inlier_quantile"}
_DETMCD = _MCD | {"scaling": "mcd_scaling", "inliers": "mcd_inliers"}

ESTIMATORS: dict[str, Estimator] = {
    "pca": lambda points, neighbors, _, chunk_size: fit_points_pca(
        points, neighbors, chunk_size=chunk_size
    ),
    "jet": at_all_points(fit_normals_jet),
    "irls": estimate_irls,
    "fastmcd": at_all_points(partial(fit_normals_robust, estimator=fit_fastmcd), **_MCD),
    "mve": at_all_points(partial(fit_normals_robust, estimator=fit_mve), **_MCD),
    "detmcd": at_all_points(partial(fit_normals_robust, estimator=fit_detmcd), **_DETMCD),
    "detmm": at_all_points(
        partial(fit_normals_robust, estimator=fit_detmm), quantile="inlier_quantile"
    ),
    "paper": estimate_paper,
    "consensus": estimate_consensus,
}
"""Estimators by name: points, neighbors, configuration, chunk size -> fit."""
WITHOUT_GRADIENT = {"consensus"}
"""Estimators without gradients, because they select and smooth planes in several steps."""


def run_estimator(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    """Fit the neighborhoods of finite points ``(N, 3)``; ``chunk_size`` is for typical ones.

    Float64 points are fitted in float32 if it is fine enough; the fit has the dtype of the points.
    """
    width = max(neighbors.indices.shape[1], config.adaptive_k or 0)
    single, chunk_size = to_single(points), limit_rows(chunk_size, width)
    fit = ESTIMATORS[config.method](single, neighbors, config, chunk_size)
    if single.dtype == points.dtype:
        return fit
    normals, curvature, rms = (values.to(points) for values in (*fit[:2], fit.residual_rms))
    return fit._replace(normals=normals, curvature=curvature, residual_rms=rms)
