"""Surface selection per neighborhood: a plane, a paraboloid, or meeting planes."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import ROWS_AT_ONCE, map_chunks, map_selected, nonzero_rows
from torchrg.linalg.moments import Columns, unbind_columns
from torchrg.neighbors.knn import gather_columns, gather_patches
from torchrg.normals.consensus import constants
from torchrg.normals.consensus.hypotheses import (
    MeetingPlanes,
    candidate_ranks,
    fit_meeting_planes,
    vote_planes,
)
from torchrg.normals.consensus.noise import NoiseEstimate
from torchrg.normals.jet import FLAT_PIVOT, fit_paraboloids
from torchrg.structures import Neighbors, NormalFit

_PARABOLOID_PARAMETERS = 6


class TangentPlanes(NamedTuple):
    """A plane at each point: unit normals ``(N, 3)``, zero if none, and offsets along them."""

    normals: Tensor
    offsets: Tensor


def fit_surfaces(
    points: Tensor, neighbors: Neighbors, fit: NormalFit, survey: NoiseEstimate, *, chunk_size: int
) -> tuple[TangentPlanes, Tensor, Tensor]:
    r"""Select the plane, paraboloid or meeting planes that explain each neighborhood best.

    With ``s`` the noise, points whose plane deviates by at most 1.05 s keep it. Other points get a
    paraboloid of deviation ``J``, accepted if ``J`` is at most 1.2 s, or at most 0.15 of the
    plane's deviation. Otherwise two meeting planes are fitted, and three if these deviate by more
    than 1.15 s. Three planes replace two if their deviation is below 0.9 times. The point takes its
    plane of these, of deviation ``W``, if ``W <= 1.3 s`` and the gain over the paraboloid, a
    difference of chi-square with equal numbers of parameters,

    .. math:: (K - 6) (J^2 - W^2) / \max(s, W)^2,

    is above 8, and above 20 on average over the point's 16 nearest, where neighborhoods that are
    not broken count as 0. Noise makes single points look broken; an edge does so to all of them.
    Remaining points with ``J > 2 s`` take the voted plane. ``fit`` and ``survey`` are from PCA of
    all neighbors. Returns the tangent planes of all points, a mask of sharp points (with broken
    neighborhoods), and a mask of points with the voted plane.
    """
    noise, points = survey.noise, points.contiguous()
    normals, offsets = fit.normals.clone(), survey.offsets.clone()
    deviations = survey.deviations.clone()

    def fit_curved(rows: Tensor) -> None:
        cloud = points, *neighbors, fit.normals
        if kernels.serve(*cloud, k=neighbors.indices.shape[1]):
            fitted = kernels.call("fit_paraboloids", *cloud, rows, FLAT_PIVOT)
        else:
            near, counted = neighbors.indices[rows], neighbors.mask(rows).to(points.dtype)
            fitted = fit_paraboloids(gather_columns(points, near), fit.normals[rows], counted)
        normals[rows], offsets[rows], deviations[rows] = fitted

    not_flat = fit.valid & (survey.deviations > constants.FLAT_LIMIT * noise)
    map_selected(fit_curved, not_flat, chunk_size)
    broken = not_flat & (deviations > constants.CURVED_LIMIT * noise)
    broken &= deviations > constants.CURVED_FRACTION * survey.deviations
    far_off = deviations > constants.FAR_OFF * noise
    gain, explained = torch.zeros_like(noise), torch.zeros_like(broken)
    by_votes, meeting = (
        TangentPlanes(*(scratch.store(values.clone()) for values in (normals, offsets)))
        for _ in range(2)
    )

    def split(rows: Tensor) -> None:
        near, scale = neighbors.select(rows), noise[rows]
        voted, planes = broken_planes(points, near, scale, fit.normals[rows])
        by_votes.normals[rows], by_votes.offsets[rows] = voted
        meeting.normals[rows], meeting.offsets[rows] = planes.normals, planes.offsets
        explained[rows] = planes.deviations <= constants.MEETING_LIMIT * scale
        has_planes = planes.deviations.isfinite()
        residual = torch.where(has_planes, planes.deviations, scale)
        unit = torch.maximum(scale, residual)
        drop = (deviations[rows] / unit).square() - (residual / unit).square()
        drop *= _count_each(near) - _PARABOLOID_PARAMETERS
        upper = constants.MAX_GAIN
        gain[rows] = torch.where(has_planes, drop, -upper).clamp_(-upper, upper)

    candidates = broken & (_may_meet(broken, neighbors, chunk_size) | far_off)
    groups = [candidates] if bool(candidates.any()) else []
    if neighbors.valid is not None:
        counts = neighbors.valid.sum(dim=1)
        groups = [candidates & (counts == count) for count in torch.unique(counts[candidates])]
    for group in groups:
        map_selected(split, group, chunk_size)
    pooled = _mean_of_nearest(gain, neighbors, chunk_size)
    meets = broken & explained & (gain > constants.MIN_GAIN) & (pooled > constants.MIN_POOLED_GAIN)
    voted = broken & ~meets & far_off
    for chosen, planes in ((voted, by_votes), (meets, meeting)):
        normals = torch.where(chosen[:, None], planes.normals, normals)
        offsets = torch.where(chosen, planes.offsets, offsets)
    return TangentPlanes(normals, offsets), voted | meets, voted


def broken_planes(
    points: Tensor, near: Neighbors, noise: Tensor, normals: Tensor
) -> tuple[TangentPlanes, MeetingPlanes]:
    """Return the voted planes and the meeting planes of points with equal neighbor counts.

    ``near`` are the neighbors of the points, with noise ``(n,)`` and PCA normals ``(n, 3)``; see
    :func:`torchrg.normals.consensus.hypotheses.vote_planes` and
    :func:`torchrg.normals.consensus.hypotheses.fit_meeting_planes`.
    """
    if kernels.serve(points, *near, noise, normals, k=near.indices.shape[1]) and len(noise):
        vote = constants.VOTE_REACH, constants.VOTE_FALLOFF
        fit = constants.FIT_REACH, constants.FIT_FALLOFF
        meeting = constants.MEETING_GAP, constants.CORNER_LIMIT, constants.CORNER_FRACTION
        counts = constants.NUM_REFITS, constants.NUM_ALTERNATIONS, constants.MIN_PLANE_POINTS
        parameters = torch.tensor([*vote, *fit, *meeting, *counts], dtype=torch.float32)
        tables = candidate_ranks(_count_each(near)), parameters
        fits = kernels.call("broken_planes", points, *near, noise, normals, *tables)
        return TangentPlanes(*fits[:2]), MeetingPlanes(*fits[2:])
    columns = _gather_counted(points, near)
    voted = vote_planes(columns, noise, normals, torch.ones_like(columns[0]))
    return TangentPlanes(*voted), fit_meeting_planes(columns, *voted, noise)


def _count_each(near: Neighbors) -> int:
    """Return the number of neighbors of each of some points with equal neighbor counts."""
    return near.indices.shape[1] if near.valid is None else int(near.valid[0].sum())


def _gather_counted(points: Tensor, near: Neighbors) -> Columns:
    """Return columns of the counted neighbors, of points with equal neighbor counts."""
    patches = gather_patches(points, near.indices)
    if near.valid is not None:
        order = (~near.valid).to(torch.uint8).argsort(dim=1, stable=True)
        order = order[:, : _count_each(near)]
        patches = patches.gather(1, order[:, :, None].expand(-1, -1, 3))
    return unbind_columns(patches)


def _may_meet(broken: Tensor, neighbors: Neighbors, chunk_size: int) -> Tensor:
    """Return points whose gain can make an average large enough; spares most of the fits."""
    upper = _mean_of_nearest(broken.float() * constants.MAX_GAIN, neighbors, chunk_size)
    candidates = broken & (upper > constants.MIN_POOLED_GAIN)
    may_meet = torch.zeros_like(broken)
    for rows in torch.split(nonzero_rows(candidates), ROWS_AT_ONCE):
        pooled = neighbors.indices[rows, : constants.NUM_POOLED].reshape(-1)
        may_meet.index_fill_(0, pooled.long(), True)
    return may_meet


def _mean_of_nearest(values: Tensor, neighbors: Neighbors, chunk_size: int) -> Tensor:
    """Return the mean of values over the nearest neighbors."""
    means = torch.empty_like(values)

    def work(chunk: slice) -> None:
        near = Neighbors(neighbors.indices[chunk, : constants.NUM_POOLED]).gather(values)
        if neighbors.valid is None:
            means[chunk] = near.mean(dim=1)
            return
        counted = neighbors.valid[chunk, : constants.NUM_POOLED]
        means[chunk] = (near * counted).sum(dim=1) / counted.sum(dim=1).clamp_(min=1)

    map_chunks(work, len(values), chunk_size, values.device)
    return means
