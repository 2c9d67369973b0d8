"""The paper's two stages: PCA everywhere, a robust fit where the normals disagree."""

from functools import partial

from torch import Tensor

from torchrg.config import NormalsConfig
from torchrg.normals.chunks import fit_points
from torchrg.normals.detmcd import fit_normals_detmcd
from torchrg.normals.pca import fit_normals_pca
from torchrg.normals.sharp import find_sharp_points
from torchrg.structures import Neighbors, NormalFit


def estimate_paper(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    """Estimate normals by Algorithm 1: PCA, sharp feature points, DetMCD at those.

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        config: Sharp rule and limit, support fraction and inlier quantile of the MCD.
        chunk_size: Points handled at a time.

    Returns:
        The fit, with ``sharp``.

    Example:
        >>> import torch
        >>> points = torch.cat([torch.eye(3), torch.zeros(1, 3)])
        >>> neighbors = Neighbors(torch.tensor([[0, 1, 3], [1, 0, 3], [2, 0, 3], [3, 0, 1]]))
        >>> estimate_paper(points, neighbors, NormalsConfig(k=3), 16).valid.all()
        tensor(True)
    """
    fit = fit_points(points, neighbors, _fit_pca, chunk_size=chunk_size)
    sharp = find_sharp_points(
        fit.normals,
        neighbors,
        valid=fit.valid,
        rule=config.sharp_rule,
        angle_deg=config.sharp_angle_deg,
        chunk_size=chunk_size,
    )
    rows = sharp.nonzero().squeeze(-1)
    robust = partial(_fit_detmcd, config=config)
    refined = fit_points(points, neighbors, robust, rows=rows, chunk_size=chunk_size)
    return replace_rows(fit, rows, refined)._replace(sharp=sharp)


def replace_rows(fit: NormalFit, rows: Tensor, refined: NormalFit) -> NormalFit:
    """Return a fit in which some points have another one.

    Example:
        >>> import torch
        >>> flat = NormalFit(torch.zeros(3, 3), *torch.zeros(3, 3))
        >>> one = NormalFit(torch.ones(1, 3), *torch.ones(3, 1))
        >>> replace_rows(flat, torch.tensor([1]), one).curvature
        tensor([0., 1., 0.])
    """
    merged = [old.index_copy(0, rows, new) for old, new in zip(fit[:4], refined[:4], strict=True)]
    normals, curvature, valid, residual_rms = merged
    return NormalFit(normals, curvature, valid, residual_rms, fit.sharp)


def _fit_pca(patches: Tensor, mask: Tensor | None, resolution: Tensor) -> NormalFit:
    return fit_normals_pca(patches, mask, resolution=resolution)


def _fit_detmcd(
    patches: Tensor, mask: Tensor | None, resolution: Tensor, *, config: NormalsConfig
) -> NormalFit:
    return fit_normals_detmcd(
        patches,
        mask,
        support_fraction=config.support_fraction,
        quantile=config.inlier_quantile,
        resolution=resolution,
    )
