"""Run an estimator of patches over the points of a cloud, a block at a time."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrg._chunks import fair_chunks, map_chunks
from torchrg.neighbors import gather_patches
from torchrg.structures import Neighbors, NormalFit

FitPatches = Callable[[Tensor, Tensor | None, Tensor], NormalFit]
"""Patches ``(n, K, 3)``, mask ``(n, K)`` or None, resolution ``(n,)`` -> fit."""


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
        >>> fit = lambda patches, mask, size: fit_normals_pca(patches, mask, resolution=size)
        >>> fit_points(points, neighbors, fit).normals.abs()[0]
        tensor([0., 0., 1.])
    """

    def fit_chunk(chunk: slice) -> NormalFit:
        block = chunk if rows is None else rows[chunk]
        mask = None if neighbors.valid is None else neighbors.valid[block]
        patches = gather_patches(points, neighbors.indices[block])
        return fit(patches, mask, coordinate_resolution(points[block]))

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


def coordinate_resolution(points: Tensor) -> Tensor:
    """Return the rounding of coordinate differences at each point, shape ``(N,)``.

    Example:
        >>> coordinate_resolution(torch.tensor([[0.0, -2.0, 1.0]])) < 1e-6
        tensor([True])
    """
    return points.abs().amax(dim=-1) * (4 * torch.finfo(points.dtype).eps)
