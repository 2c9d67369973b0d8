"""From fits of patches to estimators of clouds, a chunk at a time."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from torchrg._parallel import CHUNK_SIZE, map_chunks
from torchrg.config import NormalsConfig
from torchrg.linalg import coordinate_resolution
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
    chunk_size: int = CHUNK_SIZE,
    **of_points: Tensor,
) -> NormalFit:
    """Fit the neighbourhoods of some points of a cloud ``(N, 3)``, by default of all of them.

    At most ``chunk_size`` patches are in memory at a time, which changes no result. Other keywords
    are those of ``fit`` that have a value for each point, shape ``(N,)``. Returns the fit of the
    given rows, without ``sharp``.
    """

    def fit_chunk(chunk: slice) -> NormalFit:
        chosen = chunk if rows is None else rows[chunk]
        indices, mask = neighbors.at(chosen)
        patches = gather_patches(points, indices)
        own = {name: values[chosen] for name, values in of_points.items()}
        return fit(patches, mask, resolution=coordinate_resolution(points[chosen]), **own)

    num_rows = len(points) if rows is None else len(rows)
    parts = list(zip(*map_chunks(fit_chunk, num_rows, chunk_size, points.device), strict=True))
    return NormalFit(*(torch.cat(part) for part in parts[:4]))


Estimator = Callable[[Tensor, Neighbors, NormalsConfig, int], NormalFit]
"""Points, their neighbours, settings, chunk size -> fit."""


def at_all_points(fit: FitPatches, **settings: str) -> Estimator:
    """Return the estimator that fits every neighbourhood alike.

    The settings are keywords of the fit, and the fields of :class:`torchrg.config.NormalsConfig`
    for them.
    """

    def estimate(
        points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
    ) -> NormalFit:
        chosen = {keyword: getattr(config, field) for keyword, field in settings.items()}
        return fit_points(points, neighbors, partial(fit, **chosen), chunk_size=chunk_size)

    return estimate


def about_first(patches: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the first point of each patch that counts, and all points relative to it.

    Zero where no point counts, and for points that do not; these may hold NaN.
    """
    if mask is None:
        return patches[..., 0, :], patches - patches[..., :1, :]
    first = mask.to(torch.uint8).argmax(dim=-1)[..., None, None]
    place = patches.gather(-2, first.expand(*first.shape[:-1], 3))
    place = torch.where(mask.any(dim=-1)[..., None, None], place, 0.0)
    return place.squeeze(-2), torch.where(mask[..., None], patches - place, 0.0)


def replace_rows(fit: NormalFit, rows: Tensor, refined: NormalFit) -> NormalFit:
    """Return a fit in which some points have another one; ``sharp`` stays."""
    merged = [old.index_copy(0, rows, new) for old, new in zip(fit[:4], refined[:4], strict=True)]
    normals, curvature, valid, residual_rms = merged
    return NormalFit(normals, curvature, valid, residual_rms, fit.sharp)
