"""Consensus normals: flat, curved or broken neighborhoods, distinguished by noise.

Modules in reading order: ``noise``, ``hypotheses`` (planes at broken points), ``surfaces`` (model
selection), ``smoothing``; ``constants`` documents every number.
"""

import torch
from torch import Tensor

from torchrg import scratch
from torchrg._parallel import ROWS_IN_CACHE, limit_rows
from torchrg.config import NormalsConfig
from torchrg.neighbors import measure_sampling, search_knn
from torchrg.normals.consensus import constants
from torchrg.normals.consensus.noise import estimate_noise, regional_noise
from torchrg.normals.consensus.smoothing import (
    choose_planes,
    describe_inliers,
    smooth_planes,
    standard_errors,
)
from torchrg.normals.consensus.surfaces import fit_surfaces
from torchrg.normals.pca import fit_points_pca
from torchrg.structures import Neighbors, NormalFit


@torch.no_grad()
def estimate_consensus(
    points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
) -> NormalFit:
    """Estimate normals that are accurate up to edges and smooth on curved surfaces.

    Every point gets the simplest surface that explains its neighbors, given their noise:

    1. *Noise.* PCA at every point, and the noise ``s`` from small neighborhoods; see
       :func:`torchrg.normals.consensus.noise.estimate_noise`. No sensor model is assumed.
    2. *Flat.* If the deviation from the plane is at most 1.05 s, the PCA normal is kept.
    3. *Curved.* Other points get a paraboloid. Its normal is kept if its deviation ``J`` is at most
       1.2 s, or at most 0.15 of the deviation of the plane; a symmetric edge has 0.27.
    4. *Broken.* At the remaining points, the plane with the most votes initializes the fit of two
       planes that meet, and of three. The point takes its plane of these if they explain the
       neighbors, and significantly better than the paraboloid. Otherwise, if the paraboloid is far
       off, it takes the voted plane. See :func:`torchrg.normals.consensus.surfaces.fit_surfaces`.
       These points are ``sharp``.
    5. *Smoothing.* Normals with a standard error of at least 0.17 degrees are smoothed bilaterally
       (:func:`torchrg.normals.consensus.smoothing.smooth_planes`). Points with a voted plane choose
       again among the planes of their neighbors
       (:func:`torchrg.normals.consensus.smoothing.choose_planes`). Both steps run twice.

    With ``config.adaptive_k`` the neighborhoods first grow with the noise: by the factor ``(u /
    0.15)^2``, where ``u`` is the median ratio of noise to radius, up to ``adaptive_k`` neighbors.
    Only this parameter and ``noise_scope`` are used.

    Returns:
        The fit, with ``sharp``. At sharp points, curvature and residual are from the neighbors
        within three times the noise of the plane. The curvature excludes noise, which the small
        width of a narrow face would amplify. At other points both are from PCA. ``valid`` is from
        PCA, as is everything with fewer than 12 neighbors.
    """
    width = max(neighbors.indices.shape[1], config.adaptive_k or 0)
    size = min(chunk_size, limit_rows(ROWS_IN_CACHE, width))
    fit = fit_points_pca(points, neighbors, chunk_size=chunk_size).map(scratch.store)
    if neighbors.indices.shape[1] < constants.MIN_NEIGHBORS:
        return fit._replace(sharp=torch.zeros_like(fit.valid))
    survey = estimate_noise(points, neighbors, fit, chunk_size=size)
    if config.adaptive_k is not None:
        is_known = survey.noise.isfinite() & (survey.radius > 0)
        fractions = torch.where(is_known, survey.noise / survey.radius, torch.nan)
        count = adapted_count(fractions, neighbors.indices.shape[1], config)
        if count > neighbors.indices.shape[1]:
            neighbors = search_knn(points, count)
            fit = fit_points_pca(points, neighbors, chunk_size=chunk_size).map(scratch.store)
            survey = estimate_noise(points, neighbors, fit, chunk_size=size)
    noise = survey.noise
    if config.noise_scope == "auto":
        config = config.with_sampling(measure_sampling(points, neighbors))
    if config.noise_scope == "regional":
        fraction = constants.REGIONAL_FRACTION
        noise = torch.minimum(noise, fraction * regional_noise(noise, neighbors))
        survey = survey._replace(noise=noise)

    planes, sharp, voted = fit_surfaces(points, neighbors, fit, survey, chunk_size=size)

    errors = standard_errors(points, neighbors, planes, survey, sharp, chunk_size=size)
    uncertain = (fit.valid & (errors > constants.MIN_ERROR)).nonzero().squeeze(-1)
    voted_rows = voted.nonzero().squeeze(-1)
    for _ in range(constants.NUM_PASSES):
        planes = smooth_planes(points, neighbors, planes, noise, errors, uncertain, chunk_size=size)
        planes = choose_planes(points, neighbors, planes, noise, voted_rows, chunk_size=size)
    curvature, residual_rms = describe_inliers(
        points, neighbors, planes, noise, fit, sharp, chunk_size=size
    )
    return NormalFit(planes.normals, curvature, fit.valid, residual_rms, sharp)


def adapted_count(fractions: Tensor, count: int, config: NormalsConfig) -> int:
    """Return the number of neighbors for which noise is a small fraction of the radius.

    ``fractions`` are the ratios of noise to radius of all points with ``count`` neighbors, NaN if
    unknown; ``config.adaptive_k`` is the maximum.
    """
    finite = fractions[~fractions.isnan()]
    if config.adaptive_k is None or len(finite) == 0:
        return count
    adapted = round(count * (float(finite.median()) / constants.ADAPTIVE_NOISE) ** 2)
    return min(max(count, adapted), config.adaptive_k, len(fractions))
