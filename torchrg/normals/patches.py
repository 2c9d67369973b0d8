"""From fits of patches to estimators of clouds, a block at a time."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from torchrg._parallel import fair_chunks, map_chunks
from torchrg.config import NormalsConfig
from torchrg.linalg.moments import coordinate_resolution
from torchrg.neighbors import gather_patches
from torchrg.structures import Neighbors, NormalFit

FitPatches = Callable[..., NormalFit]
"""Patches ``(n, K, 3)``, mask ``(n, K)`` or None, keyword ``resolution`` ``(n,)`` -> fit."""


def fit_points(
    points: Tensor,
    neighbors: Neighbors,
    fit: FitPatches,
    *,
    rows: Tensor | None = None,
    chunk_size: int = 16384,
) -> NormalFit:
    """Fit the neighbourhoods of some points of a cloud, with bounded memory.

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        fit: Estimator of a block of patches.
        rows: Points to fit, shape ``(n,)``. Default: all.
        chunk_size: Patches in memory at a time; changes no result.

    Returns:
        Normals, curvature, validity and residual of those points.

    Example:
        >>> from torchrg.normals.pca import fit_normals_pca
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> neighbors = Neighbors(torch.tensor([[0, 1, 2], [1, 0, 2], [2, 0, 1]]))
        >>> fit_points(points, neighbors, fit_normals_pca).normals.abs()[0]
        tensor([0., 0., 1.])
    """

    def fit_chunk(chunk: slice) -> NormalFit:
        block = chunk if rows is None else rows[chunk]
        mask = None if neighbors.valid is None else neighbors.valid[block]
        patches = gather_patches(points, neighbors.indices[block])
        return fit(patches, mask, resolution=coordinate_resolution(points[block]))

    chunks = fair_chunks(len(points) if rows is None else len(rows), chunk_size)
    return join_fits(map_chunks(fit_chunk, chunks, points.device))


def join_fits(parts: Sequence[NormalFit]) -> NormalFit:
    """Return the fits of consecutive points as one, without ``sharp``.

    Example:
        >>> flat = NormalFit(torch.zeros(2, 3), *torch.zeros(3, 2))
        >>> join_fits([flat, flat]).curvature
        tensor([0., 0., 0., 0.])
    """
    columns = list(zip(*parts, strict=True))
    return NormalFit(*(torch.cat(column) for column in columns[:4]))


Estimator = Callable[[Tensor, Neighbors, NormalsConfig, int], NormalFit]
"""Points, their neighbours, settings, chunk size -> fit."""


def at_all_points(fit: FitPatches, **settings: str) -> Estimator:
    """Return the estimator that fits every neighbourhood alike.

    Args:
        fit: Fit of patches, as :func:`torchrg.normals.fit_normals_pca`.
        **settings: Its keywords, and the fields of :class:`torchrg.config.NormalsConfig` for them.

    Returns:
        The estimator.

    Example:
        >>> from torchrg.normals.pca import fit_normals_pca
        >>> estimate = at_all_points(fit_normals_pca)
        >>> neighbors = Neighbors(torch.tensor([[0, 1, 2], [1, 0, 2], [2, 0, 1]]))
        >>> estimate(torch.eye(3), neighbors, NormalsConfig(k=3), 16).valid.all()
        tensor(True)
    """

    def estimate(
        points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
    ) -> NormalFit:
        chosen = {keyword: getattr(config, field) for keyword, field in settings.items()}
        return fit_points(points, neighbors, partial(fit, **chosen), chunk_size=chunk_size)

    return estimate


def about_query(patches: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the first point of each patch that counts, and all points relative to it.

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``.
        mask: Which points count, shape ``(*, K)``, bool; the others may hold NaN. Default: all.

    Returns:
        Query points, shape ``(*, 3)``, and differences to them, shape ``(*, K, 3)``, zero for
        points that do not count.

    Example:
        >>> patches, mask = torch.tensor([[5.0, 5, 5], [1, 2, 3]]), torch.tensor([False, True])
        >>> about_query(patches, mask)[0]
        tensor([1., 2., 3.])
    """
    if mask is None:
        return patches[..., 0, :], patches - patches[..., :1, :]
    first = mask.to(torch.uint8).argmax(dim=-1)[..., None, None]
    query = patches.gather(-2, first.expand(*first.shape[:-1], 3))
    query = torch.where(mask.any(dim=-1)[..., None, None], query, 0.0)
    return query.squeeze(-2), torch.where(mask[..., None], patches - query, 0.0)


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
