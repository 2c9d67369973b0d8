"""What surface explains each neighbourhood: a plane, a paraboloid, or planes that meet."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import map_chosen, map_chunks
from torchrg.linalg.moments import Columns, split_columns
from torchrg.neighbors import gather_patches
from torchrg.normals.consensus.hypotheses import (
    Pieces,
    Wedge,
    fit_corners,
    fit_wedges,
    split_by_votes,
    split_off,
    vote_planes,
)
from torchrg.normals.consensus.noise import Survey
from torchrg.normals.consensus.smoothing import TangentPlanes
from torchrg.normals.jet import fit_paraboloids
from torchrg.structures import Neighbors, NormalFit

_UNEXPLAINED = 1.05
_BENT = 1.2
_CURVED_SHARE = 0.15
_EXPLAINED = 1.3
_WELL_EXPLAINED = 1.15
_CORNER_SHARE = 0.9
_FAR_OFF = 2.0
_LEAST_GAIN = 8.0
_LEAST_POOLED_GAIN = 20.0
_MOST_GAIN = 40.0
_NUM_POOLED = 16
_NUM_PARAMETERS = 6


class PieceFit(NamedTuple):
    """Planes of all points, and how they were found.

    Attributes:
        planes: A plane at each point.
        sharp: Points whose neighbourhood is broken, shape ``(N,)``, bool.
        voted: Sharp points that follow votes alone, shape ``(N,)``, bool.
    """

    planes: TangentPlanes
    sharp: Tensor
    voted: Tensor


def fit_pieces(
    points: Tensor,
    neighbors: Neighbors,
    fit: NormalFit,
    survey: Survey,
    *,
    chunk_size: int = 2048,
) -> PieceFit:
    r"""Give each point the plane, the paraboloid or the piece of broken planes that explains most.

    With ``s`` the noise, points whose plane deviates by at most 1.05 s keep it. The others get a
    paraboloid, of deviation ``J``; it stands where ``J`` is at most 1.2 s (of 200 points that have
    an edge, one is missed; of those that have none, half are spared), or at most 0.15 of the
    plane's deviation. Otherwise two planes that meet are fitted, and where these deviate by more
    than 1.15 s, three, which replace the two if their deviation is below 0.9 of theirs. The point
    takes its plane of these, of deviation ``W``, where ``W <= 1.3 s`` and the gain over the
    paraboloid, a difference of chi-square with as many parameters in both models,

    .. math:: (K - 6) (J^2 - W^2) / \max(s, W)^2,

    is above 8, and above 20 on average over the point's 16 nearest (0 where nothing is broken):
    noise makes single points look broken, an edge all of them. Points left over with ``J > 2 s``
    take the plane of the votes.

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        fit: Planes of PCA.
        survey: Deviations from these, and the noise.
        chunk_size: Points handled at a time.

    Returns:
        Planes, and which points are sharp.
    """
    noise = survey.noise
    normals, offsets = fit.normals.clone(), survey.offsets.clone()
    bent = survey.deviations.clone()
    unexplained = fit.valid & (survey.deviations > _UNEXPLAINED * noise)

    def bend(rows: Tensor) -> None:
        columns, counted = _gather(points, neighbors, rows)
        normals[rows], offsets[rows], bent[rows] = fit_paraboloids(
            columns, fit.normals[rows], counted
        )

    map_chosen(bend, unexplained, chunk_size)
    broken = unexplained & (bent > _BENT * noise)
    broken &= bent > _CURVED_SHARE * survey.deviations
    gain, explained = torch.zeros_like(noise), torch.zeros_like(broken)
    votes, pieces = (TangentPlanes(normals.clone(), offsets.clone()) for _ in range(2))

    def split(rows: Tensor) -> None:
        columns = _gather_counted(points, neighbors, rows)
        counted, scale = torch.ones_like(columns[0]), noise[rows]
        voted = vote_planes(columns, scale, fit.normals[rows], counted)
        found = _fit_broken(columns, *voted, scale, counted)
        votes.normals[rows], votes.offsets[rows] = voted
        pieces.normals[rows], pieces.offsets[rows] = found.normals, found.offsets
        explained[rows] = found.deviations <= _EXPLAINED * scale
        known = found.deviations.isfinite()
        rest = torch.where(known, found.deviations, scale)
        unit = torch.maximum(scale, rest)
        drop = ((bent[rows] / unit).square() - (rest / unit).square()) * (
            counted.sum(dim=1) - _NUM_PARAMETERS
        )
        gain[rows] = torch.where(known, drop, -_MOST_GAIN).clamp_(-_MOST_GAIN, _MOST_GAIN)

    asked = broken & (_may_meet(broken, neighbors, chunk_size) | (bent > _FAR_OFF * noise))
    for same in _by_count(asked, neighbors):
        map_chosen(split, same, chunk_size)
    pooled = _mean_of_nearest(gain, neighbors, chunk_size)
    meeting = broken & explained & (gain > _LEAST_GAIN) & (pooled > _LEAST_POOLED_GAIN)
    voting = broken & ~meeting & (bent > _FAR_OFF * noise)
    for chosen, planes in ((voting, votes), (meeting, pieces)):
        normals = torch.where(chosen[:, None], planes.normals, normals)
        offsets = torch.where(chosen, planes.offsets, offsets)
    return PieceFit(TangentPlanes(normals, offsets), voting | meeting, voting)


def _fit_broken(
    columns: Columns, normals: Tensor, offsets: Tensor, noise: Tensor, counted: Tensor
) -> Pieces:
    """Return two planes that meet, or three where two do not explain the neighbours."""
    pieces, *parts = fit_wedges(columns, normals, offsets, noise, counted)
    rows = (pieces.deviations > _WELL_EXPLAINED * noise).nonzero().squeeze(-1)
    some = (columns[0][rows], columns[1][rows], columns[2][rows])
    start = Pieces(*(part[rows] for part in pieces))
    scale, count = noise[rows], counted[rows]
    guesses = (
        split_off(Wedge(start, *(part[rows] for part in parts)), scale, count),
        split_by_votes(some, normals[rows], offsets[rows], scale, count),
    )
    best = start._replace(deviations=_CORNER_SHARE * start.deviations)
    for groups in guesses:
        best = _better(best, fit_corners(some, groups, count))
    improved = best.deviations < _CORNER_SHARE * start.deviations
    rows = rows[improved]
    merged = [old.index_copy(0, rows, new[improved]) for old, new in zip(pieces, best, strict=True)]
    return Pieces(*merged)


def _better(one: Pieces, other: Pieces) -> Pieces:
    """Return, for each point, the fit that deviates less."""
    less = other.deviations < one.deviations
    return Pieces(
        *(
            torch.where(less.view(-1, *[1] * (a.dim() - 1)), b, a)
            for a, b in zip(one, other, strict=True)
        )
    )


def _gather(points: Tensor, neighbors: Neighbors, rows: Tensor) -> tuple[Columns, Tensor]:
    """Return columns of the neighbours and which count, as 0 or 1."""
    columns = split_columns(gather_patches(points, neighbors.indices[rows]))
    if neighbors.valid is None:
        return columns, torch.ones_like(columns[0])
    return columns, neighbors.valid[rows].to(points.dtype)


def _by_count(chosen: Tensor, neighbors: Neighbors) -> list[Tensor]:
    """Return the chosen points in sets whose points have equally many neighbours that count."""
    if neighbors.valid is None:
        return [chosen]
    count = neighbors.valid.sum(dim=1)
    return [chosen & (count == number) for number in torch.unique(count[chosen]).tolist()]


def _gather_counted(points: Tensor, neighbors: Neighbors, rows: Tensor) -> Columns:
    """Return columns of the neighbours that count, equally many for all of these points."""
    patches = gather_patches(points, neighbors.indices[rows])
    if neighbors.valid is not None:
        counted = neighbors.valid[rows]
        order = (~counted).to(torch.uint8).argsort(dim=1, stable=True)
        order = order[:, : int(counted[0].sum())]
        patches = patches.gather(1, order[:, :, None].expand(-1, -1, 3))
    return split_columns(patches)


def _may_meet(broken: Tensor, neighbors: Neighbors, chunk_size: int) -> Tensor:
    """Return the points whose gain can make that of some point large enough on average.

    Noise makes single points look broken: most of them are spared the fits.
    """
    most = _mean_of_nearest(broken.float() * _MOST_GAIN, neighbors, chunk_size)
    open_points = broken & (most > _LEAST_POOLED_GAIN)
    pooled = neighbors.indices[open_points, :_NUM_POOLED].reshape(-1)
    return torch.zeros_like(broken).index_fill_(0, pooled.long(), True)


def _mean_of_nearest(values: Tensor, neighbors: Neighbors, chunk_size: int) -> Tensor:
    """Return the mean of values over the nearest neighbours."""
    means = torch.empty_like(values)

    def work(part: slice) -> None:
        indices = neighbors.indices[part, :_NUM_POOLED]
        near = values.index_select(0, indices.reshape(-1)).view(indices.shape)
        if neighbors.valid is None:
            means[part] = near.mean(dim=1)
            return
        counted = neighbors.valid[part, :_NUM_POOLED]
        means[part] = (near * counted).sum(dim=1) / counted.sum(dim=1).clamp_(min=1)

    map_chunks(work, len(values), chunk_size, values.device)
    return means
