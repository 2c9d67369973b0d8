"""Consensus normals: flat, curved or broken, told apart by the noise of the cloud itself."""

import torch
from torch import Tensor

from torchrg.config import NormalsConfig
from torchrg.neighbors import gather_patches
from torchrg.normals.chunks import fit_points
from torchrg.normals.columns import Columns, fit_planes, residuals, split_columns
from torchrg.normals.noise import Survey, survey_noise
from torchrg.normals.paraboloid import fit_paraboloids
from torchrg.normals.pca import fit_normals_pca
from torchrg.normals.rounds import TangentPlanes, average_planes, choose_planes
from torchrg.normals.votes import vote_planes
from torchrg.normals.wedge import fit_wedges
from torchrg.robust.chunks import chunks_of
from torchrg.structures import Neighbors, NormalFit

_LEAST_NEIGHBORS = 12
_BLOCK = 4096
_UNEXPLAINED = 1.05
_CURVED_SHARE = 0.15
_BROKEN = 1.5
_EXPLAINED = 1.3
_GAIN = 8.0
_POOLED_GAIN = 8.0
_MAX_GAIN = 40.0
_POOL = 16
_INLIER_REACH = 3.0
_AGREEMENT = 9.0
_LEAST_ANGLE = 0.0087


@torch.no_grad()
def estimate_consensus(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    r"""Estimate normals that are right up to the edges and stay smooth on curved surfaces.

    Every point gets the simplest surface that explains its neighbours, given their noise:

    1. *Noise.* PCA at every point, and the noise ``s`` from small neighbourhoods; see
       :func:`torchrg.normals.noise.survey_noise`. Nothing is assumed of the sensor.
    2. *Flat or not.* Where the deviation from the plane is at most 1.05 s, PCA stands.
    3. *Curved.* The others get a paraboloid; where its deviation ``J`` is at most 1.05 s, or 0.15
       of the plane's (an edge never comes below 0.27), its normal stands.
    4. *Broken.* At what is left, the plane through the point with the most votes
       (:func:`torchrg.normals.votes.vote_planes`) starts the fit of two planes that meet
       (:func:`torchrg.normals.wedge.fit_wedges`), with deviation ``W`` and as many parameters as
       the paraboloid. The point takes its plane of the two if that explains the neighbours
       (``W <= 1.3 s``) and better than the paraboloid: the drop of chi-square,
       ``(K - 6) (J^2 - W^2) / s^2``, is above 8, at the point and on average over its 16 nearest.
       If two planes do not explain them (corners, thin plates) and the paraboloid is far off
       (``J > 1.5 s``), it takes the plane of the votes. These points are ``sharp``.
    5. *Rounds.* Twice, planes are averaged with those of the neighbours that agree, as far as noise
       makes it worth while, and points that follow votes choose again among the planes of their
       neighbours; see :func:`torchrg.normals.rounds.average_planes` and ``choose_planes``.

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        config: Not used beyond ``k``: the estimator sets its own scales.
        chunk_size: Points handled at a time.

    Returns:
        The fit, with ``sharp``. At sharp points curvature and residual are those of the neighbours
        within three times the noise of the plane. With fewer than 12 neighbours it is that of PCA.

    Example:
        >>> from torchrg.neighbors import search_knn
        >>> floor = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
        >>> cloud = torch.cat([floor + 0.5, floor[:, [0, 2, 1]]])
        >>> fit = estimate_consensus(cloud, search_knn(cloud, 30), NormalsConfig(k=30), 256)
        >>> bool((fit.normals[:400].abs() == torch.tensor([0.0, 0, 1])).all())
        True
    """
    fit = fit_points(points, neighbors, _fit_pca, chunk_size=chunk_size)
    if neighbors.indices.shape[1] < _LEAST_NEIGHBORS:
        return fit._replace(sharp=torch.zeros_like(fit.valid))
    block = min(chunk_size, _BLOCK)
    survey = survey_noise(points, neighbors, fit, chunk_size=block)
    planes, sharp, voted = _fit_pieces(points, neighbors, fit, survey, block)
    angles = _AGREEMENT * survey.noise / (survey.radius * neighbors.indices.shape[1] ** 0.5)
    noisy = (fit.valid & (angles > _AGREEMENT / 3 * _LEAST_ANGLE)).nonzero().squeeze(-1)
    voters = voted.nonzero().squeeze(-1)
    for _ in range(2):
        planes = average_planes(
            points, neighbors, planes, survey.noise, angles, noisy, chunk_size=block
        )
        planes = choose_planes(points, neighbors, planes, survey.noise, voters, chunk_size=block)
    curvature, residual_rms = fit.curvature.clone(), fit.residual_rms.clone()
    for rows in _blocks(sharp, block):
        values = _inlier_spread(points, neighbors, planes, survey.noise, rows)
        smallest, total = values[:, 0].clamp(min=0), values.clamp(min=0).sum(dim=1)
        curvature[rows] = smallest / torch.where(total > 0, total, 1.0)
        residual_rms[rows] = smallest.sqrt()
    return NormalFit(planes.normals, curvature, fit.valid, residual_rms, sharp)


def _fit_pca(patches: Tensor, mask: Tensor | None, resolution: Tensor) -> NormalFit:
    return fit_normals_pca(patches, mask, resolution=resolution)


def _fit_pieces(
    points: Tensor, neighbors: Neighbors, fit: NormalFit, survey: Survey, block: int
) -> tuple[TangentPlanes, Tensor, Tensor]:
    """Return a plane for each point, which are sharp, and which of these follow votes alone."""
    noise, plane_deviation = survey.noise, survey.deviations
    normals, offsets = fit.normals.clone(), survey.offsets.clone()
    bent_deviation = plane_deviation.clone()
    unexplained = fit.valid & (plane_deviation > _UNEXPLAINED * noise)
    for rows in _blocks(unexplained, block):
        columns, counted = _gather(points, neighbors, rows)
        bent = fit_paraboloids(columns, fit.normals[rows], counted)
        normals[rows], offsets[rows], bent_deviation[rows] = bent
    open_ = unexplained & (bent_deviation > _UNEXPLAINED * noise)
    open_ &= bent_deviation > _CURVED_SHARE * plane_deviation
    gain, explained = torch.zeros_like(noise), torch.zeros_like(open_)
    pieces = [tensor.clone() for tensor in (normals, offsets, normals, offsets)]
    for rows in _blocks(open_, block):
        columns, counted = _gather(points, neighbors, rows)
        scale = noise[rows]
        votes = vote_planes(columns, scale, fit.normals[rows], counted)
        wedge = fit_wedges(columns, *votes, scale, counted)
        for piece, values in zip(pieces, (*votes, wedge.normals, wedge.offsets), strict=True):
            piece[rows] = values
        explained[rows] = wedge.deviations <= _EXPLAINED * scale
        bent_by_noise, by_noise = bent_deviation[rows] / scale, wedge.deviations / scale
        drop = (bent_by_noise * bent_by_noise - by_noise * by_noise) * (counted.sum(dim=1) - 6)
        gain[rows] = drop.clamp(-_MAX_GAIN, _MAX_GAIN)
    pooled = _mean_of_nearest(gain, neighbors, block)
    wedged = open_ & explained & (gain > _GAIN) & (pooled > _POOLED_GAIN)
    voted = open_ & ~wedged & (bent_deviation > _BROKEN * noise)
    for chosen, normal, offset in ((voted, *pieces[:2]), (wedged, *pieces[2:])):
        normals = torch.where(chosen[:, None], normal, normals)
        offsets = torch.where(chosen, offset, offsets)
    return TangentPlanes(normals, offsets), voted | wedged, voted


def _blocks(chosen: Tensor, block: int) -> list[Tensor]:
    """Return the rows of the chosen points in blocks."""
    rows = chosen.nonzero().squeeze(-1)
    return [rows[part] for part in chunks_of(len(rows), block)]


def _gather(points: Tensor, neighbors: Neighbors, rows: Tensor) -> tuple[Columns, Tensor]:
    """Return columns of the neighbours and which count, as 0 or 1."""
    columns = split_columns(gather_patches(points, neighbors.indices[rows]))
    if neighbors.valid is None:
        return columns, torch.ones_like(columns[0])
    return columns, neighbors.valid[rows].to(points.dtype)


def _mean_of_nearest(values: Tensor, neighbors: Neighbors, block: int) -> Tensor:
    """Return the mean of values over the nearest neighbours."""
    means = torch.empty_like(values)
    for part in chunks_of(len(values), block):
        indices = neighbors.indices[part, :_POOL]
        near = values.index_select(0, indices.reshape(-1)).view(indices.shape)
        means[part] = near.mean(dim=1)
    return means


def _inlier_spread(
    points: Tensor, neighbors: Neighbors, planes: TangentPlanes, noise: Tensor, rows: Tensor
) -> Tensor:
    """Return the eigenvalues of the covariance of the neighbours near the planes of some points."""
    columns, counted = _gather(points, neighbors, rows)
    rests = residuals(columns, planes.normals[rows], planes.offsets[rows])
    near = rests.abs() <= (_INLIER_REACH * noise[rows])[:, None]
    return fit_planes(columns, near * counted)[2]
