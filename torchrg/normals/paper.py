"""The paper's two stages: PCA everywhere, a robust fit where the normals disagree."""

from functools import partial
from typing import Literal

import torch
from torch import Tensor

from torchrg._parallel import CHUNK_SIZE, map_chunks
from torchrg.config import NormalsConfig
from torchrg.errors import ConfigError
from torchrg.linalg import at_most, deg_to_sq_chord, sq_chord_to_deg, sq_chords
from torchrg.normals.patches import fit_points, replace_rows
from torchrg.normals.pca import fit_points_pca
from torchrg.normals.robust import fit_normals_robust
from torchrg.robust.scale import QN_FACTOR, qn_exceeds
from torchrg.structures import Neighbors, NormalFit


def find_sharp_points(
    normals: Tensor,
    neighbors: Neighbors,
    *,
    valid: Tensor | None = None,
    rule: Literal["qn", "percentile"] = "qn",
    angle_deg: float = 5.0,
    chunk_size: int = CHUNK_SIZE,
) -> Tensor:
    r"""Tell sharp feature points from regular ones by the angles to their neighbours' normals.

    With ``a_j`` the angle between the normals of a point and of its j-th neighbour (the point
    itself included, with angle 0), a point is sharp if ``Qn(a) > angle_deg`` (``"qn"``, eq. 9), or
    if the 25th percentile of ``a``, the ``ceil(K/4)``-th smallest, exceeds it (``"percentile"``,
    Algorithm 1).

    Args:
        normals: Unit normals of any sign, shape ``(N, 3)``.
        neighbors: Neighbours of each point.
        valid: Points that have a normal, shape ``(N,)``; the others do not count as neighbours and
            are sharp themselves, so that a robust fit may find them one. Default: all.
        rule: See above.
        angle_deg: Limit in degrees.
        chunk_size: Points handled at a time.

    Returns:
        Shape ``(N,)``, bool.

    Raises:
        ConfigError: If ``rule`` is unknown.

    Example:
        >>> normals = torch.tensor([[0.0, 0, 1]] * 3 + [[0.6, 0, 0.8], [1.0, 0, 0]])
        >>> neighbors = Neighbors(torch.tensor([[0, 1, 2], [2, 3, 4]]))
        >>> find_sharp_points(normals, neighbors)
        tensor([False,  True])
    """
    if rule not in ("qn", "percentile"):
        raise ConfigError(f"find_sharp_points: expected rule to be qn or percentile, got {rule!r}.")
    columns = normals.detach().T.contiguous()
    if valid is not None and bool(valid.all()):
        valid = None
    sharp = torch.empty(len(neighbors.indices), dtype=torch.bool, device=normals.device)

    def classify(block: slice) -> None:
        near = neighbors.at(block)
        counted = near.valid if valid is None else near.counted() & near.of(valid)
        around = [near.of(column) for column in columns]
        chords = sq_chords([component[:, :1] for component in around], around)
        exceeds = _qn_exceeds if rule == "qn" else _percentile_exceeds
        sharp[block] = exceeds(chords, counted, angle_deg)

    map_chunks(classify, len(sharp), chunk_size, normals.device)
    return sharp if valid is None else sharp | ~valid


def _qn_exceeds(chords: Tensor, counted: Tensor | None, angle_deg: float) -> Tensor:
    """Return whether Qn of the angles exceeds the limit.

    If the majority of the angles lies within one difference of zero, all their pairs do, and they
    are enough: counting decides for most points of a room, and only the rest needs angles.
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
    """Estimate normals by Algorithm 1: PCA, sharp feature points, DetMCD at those."""
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
