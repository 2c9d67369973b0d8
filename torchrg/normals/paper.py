"""Robust plane fits, and the paper's two-stage estimator."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._checks import check_shapes
from torchrg._parallel import CHUNK_SIZE, map_chunks
from torchrg.config import NormalsConfig
from torchrg.errors import ConfigError
from torchrg.linalg.angles import at_most, deg_to_sq_chord, sq_chord_to_deg, sq_chords
from torchrg.normals.pca import (
    check_patches,
    fit_normals_pca,
    fit_points,
    fit_points_pca,
    replace_rows,
)
from torchrg.robust import RobustFit, fit_detmcd
from torchrg.robust.scale import QN_FACTOR, qn_exceeds
from torchrg.structures import Neighbors, NormalFit

_PLANE = 2
"""Dimension of a plane: a robust fit to collinear points does not define a normal."""


def fit_normals_robust(
    patches: Tensor,
    mask: Tensor | None = None,
    *,
    estimator: Callable[..., RobustFit] = fit_detmcd,
    resolution: Tensor | None = None,
    **settings: Any,  # noqa: ANN401 - passed to the estimator
) -> NormalFit:
    """Fit a plane to the inliers of each patch's robust location and scatter.

    The default is DetMCD [1], eq. (6) and Algorithm 1. Points whose squared robust distance is at
    most the chi-square quantile are inliers; normal, curvature and residual are those of PCA on
    them. (The paper prints the cutoff as 3.075; the root of the quantile 9.3484 in its eq. (6) is
    3.0575.)

    ``estimator`` is one of :mod:`torchrg.robust`, such as ``fit_detmm`` [2]; other keywords are its
    parameters, and a value out of range is a ``ConfigError``. For the remaining arguments and
    errors see :func:`torchrg.normals.fit_normals_pca`.

    Returns:
        The fit. If the trusted fraction of the points lies exactly on one plane, it is that plane,
        with curvature 0; without a unique plane ``valid`` is False.

    References:
        [1] M. Hubert, P. Rousseeuw, T. Verdonck. A deterministic algorithm for robust location and
        scatter. Journal of Computational and Graphical Statistics 21(3), 2012.
        [2] A. Khaloo, D. Lattanzi. Robust normal estimation and region growing segmentation of
        infrastructure 3D point cloud models. Advanced Engineering Informatics 34, 2017.

    Example:
        >>> floor = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] *= torch.arange(40) > 29
        >>> fit_normals_robust(floor).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_robust", patches, mask, resolution)
    robust = estimator(patches.detach(), mask, **{"min_dimension": _PLANE, **settings})
    return fit_normals_pca(patches, robust.support & robust.valid[..., None], resolution=resolution)


def find_sharp_points(
    normals: Tensor,
    neighbors: Neighbors,
    *,
    valid: Tensor | None = None,
    rule: Literal["qn", "percentile"] = "qn",
    angle_deg: float = 5.0,
    chunk_size: int = CHUNK_SIZE,
) -> Tensor:
    """Return a mask of sharp feature points ``(N,)`` from the angles between neighboring normals.

    Let ``a_j`` be the angle between the normals of a point and its j-th neighbor (the point itself
    included, with angle 0). A point is sharp if ``Qn(a) > angle_deg`` (``"qn"``, eq. 9), or if the
    25th percentile of ``a``, the ``ceil(K/4)``-th smallest, exceeds it (``"percentile"``, Algorithm
    1).

    Args:
        normals: Unit normals of any sign, shape ``(N, 3)``.
        neighbors: Neighbors of each point.
        valid: Points that have a normal, shape ``(N,)``; invalid points are ignored as neighbors
            and are sharp, so that a robust fit may find a normal. Default: all.
        rule: See above.
        angle_deg: Limit in degrees.
        chunk_size: Points processed at a time.

    Raises:
        ShapeError: If a shape or device is invalid.
        ConfigError: If ``rule`` is unknown.

    Example:
        >>> normals = torch.tensor([[0.0, 0, 1]] * 3 + [[0.6, 0, 0.8], [1.0, 0, 0]])
        >>> neighbors = Neighbors(torch.tensor([[0, 1, 2], [2, 3, 4]]))
        >>> find_sharp_points(normals, neighbors)
        tensor([False,  True])
    """
    if rule not in ("qn", "percentile"):
        raise ConfigError(f"find_sharp_points: expected rule to be qn or percentile, got {rule!r}.")
    check_shapes(
        "find_sharp_points",
        normals=(normals, "N 3"),
        neighbors=(neighbors.indices, "M K"),
        valid=(valid, "N"),
    )
    columns = normals.detach().T.contiguous()
    if valid is not None and bool(valid.all()):
        valid = None
    sharp = torch.empty(len(neighbors.indices), dtype=torch.bool, device=normals.device)

    def classify(block: slice) -> None:
        near = neighbors.select(block)
        counted = near.valid if valid is None else near.mask() & near.gather(valid)
        if kernels.serve(near.indices, columns, k=near.indices.shape[1]):
            (chords,) = kernels.call("neighbor_chords", columns, near.indices)
        else:
            near_columns = [near.gather(column) for column in columns]
            chords = sq_chords([component[:, :1] for component in near_columns], near_columns)
        exceeds = _qn_exceeds if rule == "qn" else _percentile_exceeds
        sharp[block] = exceeds(chords, counted, angle_deg)

    map_chunks(classify, len(sharp), chunk_size, normals.device)
    return sharp if valid is None else sharp | ~valid


def _qn_exceeds(chords: Tensor, counted: Tensor | None, angle_deg: float) -> Tensor:
    """Return whether Qn of the angles exceeds the limit.

    If the majority of the angles lies within one difference of zero, so do all their pairs, which
    suffices: counting decides for most points of a room, and only the remaining ones need angles.
    """
    near = at_most(chords, deg_to_sq_chord(angle_deg / QN_FACTOR))
    if counted is None:
        majority: Tensor | int = chords.shape[-1] // 2 + 1
    else:
        near *= counted
        majority = counted.sum(dim=-1) // 2 + 1
    exceeds = near.sum(dim=-1) < majority
    rows = exceeds.nonzero().squeeze(-1)
    mask = None if counted is None else counted[rows]
    exceeds[rows] = qn_exceeds(sq_chord_to_deg(chords[rows]), angle_deg, mask=mask)
    return exceeds


def _percentile_exceeds(chords: Tensor, counted: Tensor | None, angle_deg: float) -> Tensor:
    """Return whether fewer than a quarter of the angles are within the limit."""
    within = chords <= deg_to_sq_chord(angle_deg)
    if counted is None:
        return within.sum(dim=-1) * 4 < chords.shape[-1]
    return (within & counted).sum(dim=-1) * 4 < counted.sum(dim=-1)


def estimate_paper(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    """Estimate normals by Algorithm 1: PCA, sharp feature points, DetMCD at sharp points."""
    fit = fit_points_pca(points, neighbors, chunk_size=chunk_size)
    sharp = find_sharp_points(
        fit.normals,
        neighbors,
        valid=fit.valid,
        rule=config.sharp_rule,
        angle_deg=config.sharp_angle_deg,
        chunk_size=chunk_size,
    )
    rows = sharp.nonzero().squeeze(-1)
    robust = partial(
        fit_normals_robust,
        support_fraction=config.support_fraction,
        quantile=config.inlier_quantile,
        scaling=config.mcd_scaling,
        inliers=config.mcd_inliers,
    )
    refined = fit_points(points, neighbors, robust, rows=rows, chunk_size=chunk_size)
    return replace_rows(fit, rows, refined)._replace(sharp=sharp)
