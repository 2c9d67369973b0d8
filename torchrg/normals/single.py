"""Estimators of one kind of fit at every point."""

from collections.abc import Callable

from torch import Tensor

from torchrg._chunks import fair_chunks, map_chunks
from torchrg.config import NormalsConfig
from torchrg.neighbors import gather_patches
from torchrg.normals.chunks import coordinate_resolution, fit_points, join_fits
from torchrg.normals.irls import fit_normals_irls
from torchrg.normals.noise import survey_noise
from torchrg.normals.pca import fit_normals_pca
from torchrg.structures import Neighbors, NormalFit

Estimator = Callable[[Tensor, Neighbors, NormalsConfig, int], NormalFit]
"""Points, their neighbours, settings, chunk size -> fit."""


def at_all_points(fit: Callable[..., NormalFit], **settings: str) -> Estimator:
    """Return the estimator that fits every neighbourhood alike.

    Args:
        fit: Fit of patches, as :func:`torchrg.normals.fit_normals_pca`.
        **settings: Its keywords, and the fields of :class:`torchrg.config.NormalsConfig` for them.

    Returns:
        The estimator.

    Example:
        >>> import torch
        >>> estimate = at_all_points(fit_normals_pca)
        >>> neighbors = Neighbors(torch.tensor([[0, 1, 2], [1, 0, 2], [2, 0, 1]]))
        >>> estimate(torch.eye(3), neighbors, NormalsConfig(k=3), 16).valid.all()
        tensor(True)
    """

    def estimate(
        points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
    ) -> NormalFit:
        chosen = {keyword: getattr(config, field) for keyword, field in settings.items()}

        def fit_block(patches: Tensor, mask: Tensor | None, resolution: Tensor) -> NormalFit:
            return fit(patches, mask, resolution=resolution, **chosen)

        return fit_points(points, neighbors, fit_block, chunk_size=chunk_size)

    return estimate


def estimate_irls(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    """Estimate normals by iteratively weighted PCA, with the noise found about each point.

    See :func:`torchrg.normals.fit_normals_irls`. Its authors ask the user for the noise; here it
    is estimated from the planes of PCA about each point.

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        config: Settings, none of which matters here.
        chunk_size: Points handled at a time.

    Returns:
        The fit.

    Example:
        >>> import torch
        >>> neighbors = Neighbors(torch.tensor([[0, 1, 2], [1, 0, 2], [2, 0, 1]]))
        >>> estimate_irls(torch.eye(3), neighbors, NormalsConfig(k=3), 16).valid.all()
        tensor(True)
    """
    known = points.detach()
    planes = at_all_points(fit_normals_pca)(known, neighbors, config, chunk_size)
    noise = survey_noise(known, neighbors, planes, chunk_size=chunk_size).noise

    def fit_chunk(chunk: slice) -> NormalFit:
        return fit_normals_irls(
            gather_patches(points, neighbors.indices[chunk]),
            None if neighbors.valid is None else neighbors.valid[chunk],
            noise=noise[chunk],
            resolution=coordinate_resolution(points[chunk]),
        )

    chunks = fair_chunks(len(points), chunk_size)
    return join_fits(map_chunks(fit_chunk, chunks, points.device))
