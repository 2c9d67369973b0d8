"""Consensus normals: flat, curved or broken, told apart by the noise of the cloud itself."""

import torch
from torch import Tensor

from torchrg._parallel import ROWS_IN_CACHE, map_chosen
from torchrg.config import NormalsConfig
from torchrg.linalg.moments import Columns, fit_planes, residuals, split_columns
from torchrg.neighbors import gather_patches, search_knn
from torchrg.normals.consensus.noise import Survey, survey_noise
from torchrg.normals.consensus.smoothing import TangentPlanes, average_planes, choose_planes
from torchrg.normals.consensus.surfaces import fit_pieces
from torchrg.normals.patches import fit_points
from torchrg.normals.pca import fit_normals_pca
from torchrg.structures import Neighbors, NormalFit

_LEAST_NEIGHBORS = 12
_NUM_ROUNDS = 2
_INLIER_REACH = 3.0
_LEAST_ERROR = 0.003
_MOST_ERROR = 0.1
_QUIET = 0.15


@torch.no_grad()
def estimate_consensus(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    r"""Estimate normals that are right up to the edges and stay smooth on curved surfaces.

    Every point gets the simplest surface that explains its neighbours, given their noise:

    1. *Noise.* PCA at every point, and the noise ``s`` from small neighbourhoods; see
       :func:`torchrg.normals.consensus.noise.survey_noise`. Nothing is assumed of the sensor.
    2. *Flat.* Where the deviation from the plane is at most 1.05 s, PCA stands.
    3. *Curved.* The others get a paraboloid. Where its deviation ``J`` is at most 1.2 s, or 0.15
       of the plane's (that of a symmetric edge is 0.27), its normal stands.
    4. *Broken.* At what is left, the plane through the point with the most votes starts the fit of
       two planes that meet, and of three. The point takes its plane of these if they explain the
       neighbours, and significantly better than the paraboloid does. Where they do not, and the
       paraboloid is far off, it takes the plane of the votes. See
       :func:`torchrg.normals.consensus.surfaces.fit_pieces`. These points are ``sharp``.
    5. *Rounds.* Twice, planes are averaged with those of the neighbours that agree
       (:func:`torchrg.normals.consensus.smoothing.average_planes`) where the standard error of
       the normals is worth it (0.17 degrees and more), and the points that follow votes choose
       again among the planes of their neighbours
       (:func:`torchrg.normals.consensus.smoothing.choose_planes`).

    With ``config.adaptive_k``, neighbourhoods grow with the noise first: with ``u`` the median of
    noise by radius, by the factor ``(u / 0.15)^2``, up to that many neighbours.

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        config: ``adaptive_k`` is used; the estimator finds all other scales itself.
        chunk_size: Points handled at a time.

    Returns:
        The fit, with ``sharp``. At sharp points curvature and residual are those of the neighbours
        within three times the noise of the plane, the curvature less what the noise explains (in a
        narrow face the little width would make a large curvature of it); elsewhere they are those
        of PCA. ``valid`` is that of PCA; with fewer than 12 neighbours so is all else.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
        >>> cloud = torch.cat([floor + 0.5, floor[:, [0, 2, 1]]])
        >>> fit = estimate_consensus(cloud, search_knn(cloud, 30), NormalsConfig(k=30), 256)
        >>> bool((fit.normals[:400].abs() == torch.tensor([0.0, 0, 1])).all())
        True
    """
    block = min(chunk_size, ROWS_IN_CACHE)
    fit = fit_points(points, neighbors, _fit_pca, chunk_size=chunk_size)
    if neighbors.indices.shape[1] < _LEAST_NEIGHBORS:
        return fit._replace(sharp=torch.zeros_like(fit.valid))
    survey = survey_noise(points, neighbors, fit, chunk_size=block)
    if config.adaptive_k is not None:
        count = _wanted_neighbors(survey, neighbors, config.adaptive_k)
        if count > neighbors.indices.shape[1]:
            neighbors = search_knn(points, count)
            fit = fit_points(points, neighbors, _fit_pca, chunk_size=chunk_size)
            survey = survey_noise(points, neighbors, fit, chunk_size=block)
    planes, sharp, voted = fit_pieces(points, neighbors, fit, survey, chunk_size=block)
    errors = _standard_errors(points, neighbors, planes, survey, sharp, block)
    noisy = (fit.valid & (errors > _LEAST_ERROR)).nonzero().squeeze(-1)
    voters = voted.nonzero().squeeze(-1)
    for _ in range(_NUM_ROUNDS):
        planes = average_planes(
            points, neighbors, planes, survey.noise, errors, noisy, chunk_size=block
        )
        planes = choose_planes(points, neighbors, planes, survey.noise, voters, chunk_size=block)
    curvature, residual_rms = fit.curvature.clone(), fit.residual_rms.clone()

    def describe(rows: Tensor) -> None:
        _, values = _inliers(points, neighbors, planes, survey.noise, rows)
        smallest, total = values[:, 0].clamp(min=0), values.clamp(min=0).sum(dim=1)
        bent = (smallest - survey.noise[rows].square()).clamp_(min=0)
        curvature[rows] = bent / torch.where(total > 0, total, 1.0)
        residual_rms[rows] = smallest.sqrt()

    map_chosen(describe, sharp, block)
    return NormalFit(planes.normals, curvature, fit.valid, residual_rms, sharp)


def _fit_pca(patches: Tensor, mask: Tensor | None, resolution: Tensor) -> NormalFit:
    return fit_normals_pca(patches, mask, resolution=resolution)


def _wanted_neighbors(survey: Survey, neighbors: Neighbors, most: int) -> int:
    """Return the number of neighbours with which noise is a small share of the radius."""
    num_points, count = neighbors.indices.shape
    known = survey.noise.isfinite() & (survey.radius > 0)
    if not bool(known.any()):
        return count
    share = float((survey.noise[known] / survey.radius[known]).median())
    return min(max(count, round(count * (share / _QUIET) ** 2)), most, num_points)


def _standard_errors(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    survey: Survey,
    sharp: Tensor,
    block: int,
) -> Tensor:
    """Return the standard error of the normals in radians, shape ``(N,)``.

    Of a plane through ``n`` points that is the noise by ``(n l_1)^(1/2)``, with the middle
    eigenvalue ``l_1`` of their covariance: a quarter of the squared radius where they fill a disc.
    """
    radius = torch.where(survey.radius > 0, survey.radius, 1.0)
    counted = neighbors.valid
    num_points: Tensor | int = neighbors.indices.shape[1]
    if counted is not None:
        num_points = counted.sum(dim=1).clamp_(min=1)
    errors: Tensor = 2 * survey.noise / (radius * num_points**0.5)

    def work(rows: Tensor) -> None:
        count, values = _inliers(points, neighbors, planes, survey.noise, rows)
        width = (count * values[:, 1].clamp(min=0)).sqrt_()
        error = survey.noise[rows] / torch.where(width > 0, width, survey.noise[rows])
        errors[rows] = torch.maximum(errors[rows], error.clamp_(max=_MOST_ERROR))

    map_chosen(work, sharp, block)
    return errors


def _inliers(
    points: Tensor, neighbors: Neighbors, planes: TangentPlanes, noise: Tensor, rows: Tensor
) -> tuple[Tensor, Tensor]:
    """Return number and covariance eigenvalues of the neighbours near the planes of some points."""
    columns: Columns = split_columns(gather_patches(points, neighbors.indices[rows]))
    near = (
        residuals(columns, planes.normals[rows], planes.offsets[rows]).abs()
        <= (_INLIER_REACH * noise[rows])[:, None]
    )
    if neighbors.valid is not None:
        near &= neighbors.valid[rows]
    weights = near.to(points.dtype)
    return weights.sum(dim=1), fit_planes(columns, weights)[2]
