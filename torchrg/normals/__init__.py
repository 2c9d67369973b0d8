"""Normal and curvature estimation for point clouds.

:func:`estimate_normals` takes a cloud and the name of an estimator in :data:`ESTIMATORS`:

====================  =============================================  =============================
name                  estimator                                      purpose
====================  =============================================  =============================
``pca``               least squares                                  smooth surfaces, speed
``jet``               quadratic surface                              curved surfaces without edges
``irls``              iteratively reweighted plane                   edges with little noise
``fastmcd``, ``mve``  min. determinant or volume, random starts      comparison
``detmcd``            min. determinant, deterministic starts         many outliers at any point
``detmm``             MM-estimator                                   outliers, more efficiency
``paper``             ``pca``, then ``detmcd`` at sharp points       the published method
``consensus``         ``pca``, then planes that neighbors support    the default: edges, noise
====================  =============================================  =============================

Signs are arbitrary unless ``orient`` or :func:`orient_normals` chooses them. The ``fit_*``
functions take patches of shape ``(*, K, 3)``; the estimators are built on them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchrg._checks import as_cloud, as_tensor, eager_only
from torchrg._parallel import CHUNK_SIZE
from torchrg.config import AnyConfig, NormalsConfig, settings_of
from torchrg.errors import ConfigError
from torchrg.neighbors import distinct_points
from torchrg.neighbors.knn import check_neighbors, check_num_neighbors, search_distinct
from torchrg.normals.estimators import ESTIMATORS, WITHOUT_GRADIENT, run_estimator
from torchrg.normals.irls import fit_normals_irls
from torchrg.normals.jet import JetFit, fit_jet, fit_normals_jet
from torchrg.normals.orient import (
    Orientation,
    SearchDistinct,
    choose_side,
    find_directions,
    orient_normals,
    turn_faces,
)
from torchrg.normals.paper import find_sharp_points, fit_normals_robust
from torchrg.normals.pca import fit_normals_pca
from torchrg.structures import AnyCloud, Cloud, Neighbors, NormalFit
from torchrg.structures.points import Points
from torchrg.structures.precision import warn_about_coordinates

__all__ = [
    "ESTIMATORS",
    "JetFit",
    "Orientation",
    "estimate_normals",
    "find_sharp_points",
    "fit_jet",
    "fit_normals_irls",
    "fit_normals_jet",
    "fit_normals_pca",
    "fit_normals_robust",
    "orient_normals",
]
__dir__ = __all__.copy


@eager_only
def estimate_normals(
    points: AnyCloud,
    config: NormalsConfig | AnyConfig | None = None,
    *,
    orient: Orientation = "none",
    viewpoint: Points | Sequence[float] | None = None,
    front: Points | None = None,
    neighbors: Neighbors | SearchDistinct | None = None,
    max_distance: float | None = None,
    chunk_size: int = CHUNK_SIZE,
    on_stage: Callable[[str], None] = lambda stage: None,
    **changes: Any,  # noqa: ANN401
) -> NormalFit:
    """Estimate the normal and curvature of every point of a cloud.

    Convention:
        Float64 points without gradients are fitted relative to a local origin in float32, if its
        rounding steps are at most a thousandth of the spacing of the points.

        Gradients flow from normals, curvature and residual to the points. They are the gradients of
        the fit with all selections held fixed: neighbors, inliers, sharp points, and the noise in
        ``irls``. With the covariance ``C`` of the fitted points, its eigenvalues ``l`` and
        eigenvectors ``v``, ``dn = sum_j v_j (v_j . dC n) / (l_0 - l_j)``. ``jet`` adds the gradient
        of its least squares, ``irls`` that of each of its steps; ``consensus`` has none. Among
        duplicates, gradients flow to the first.

    Args:
        points: Points, shape ``(N, 3)``, a cloud or the path of a file. Points with NaN or Inf are
            skipped and not ``valid``.
        config: A normals configuration, a dictionary, a complete configuration, or a preset name.
            Default: that of :func:`torchrg.load_config`.
        orient: Normal orientation, as in :func:`orient_normals`, with the same neighbors. Default:
            signs are arbitrary.
        viewpoint: Scanner position, as in :func:`orient_normals`.
        front: Direction to the side from which each point was seen, as in :func:`orient_normals`.
        neighbors: Neighbors of finite points, the point itself first, or a function that searches
            them. Default: searched among distinct points; duplicates share a result.
        max_distance: See :func:`torchrg.search_knn`.
        chunk_size: Points processed at a time; bounds memory, does not change the result.
        on_stage: Callback that receives ``"normals"`` and ``"orientation"`` when these start.
        **changes: Individual parameters, as in ``method="pca", k=20``: see
            :class:`torchrg.config.NormalsConfig`.

    Returns:
        The fit in the order of the points.

    Raises:
        ConfigError: If ``method`` or ``orient`` is unknown, a parameter is out of range, or the
            points require gradients that the method does not support.
        ShapeError: If a shape or dtype is not as above.

    Warns:
        PrecisionWarning: See :func:`torchrg.segment_planes`.

    Example:
        >>> floor = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
        >>> floor[:, 2] = 1.5
        >>> estimate_normals(floor, method="pca", k=20).normals.abs()[0]
        tensor([0., 0., 1.])
    """
    points = as_cloud(points)
    is_cloud = isinstance(points, Cloud)  # It warns on access to its points.
    positions, directions = find_directions(
        "estimate_normals", points, orient, viewpoint=viewpoint, front=front
    )
    tensor = positions if is_cloud else as_tensor("estimate_normals", "points", points)
    if not is_cloud:
        warn_about_coordinates("estimate_normals", tensor)
    settings = settings_of("estimate_normals", NormalsConfig, config, changes)
    if settings.method in WITHOUT_GRADIENT and tensor.requires_grad and torch.is_grad_enabled():
        names = ", ".join(sorted(ESTIMATORS.keys() - WITHOUT_GRADIENT))
        raise ConfigError(
            f"estimate_normals: expected a method with gradients ({names}) for points that require "
            f"them, got {settings.method!r}; choose one, or pass points.detach()."
        )
    on_stage("normals")
    if neighbors is not None and not callable(neighbors):
        check_neighbors("estimate_normals", neighbors, tensor)
        sites, near, restore = tensor, neighbors, _unchanged
    else:
        distinct = distinct_points(tensor)
        numbers = {"k": settings.k, "adaptive_k": settings.adaptive_k}
        check_num_neighbors("estimate_normals", len(distinct.points), **numbers)
        search = neighbors or partial(search_distinct, max_distance=max_distance)
        sites, restore = distinct.points, distinct.restore
        near = search(sites, settings.k)
    fit = run_estimator(sites, near, settings, chunk_size)

    def turn(side: Orientation) -> Tensor:
        return restore(turn_faces(sites, fit.normals, side, near))

    on_stage("orientation")
    found = fit.map(restore)
    return found._replace(normals=choose_side(positions, found.normals, orient, directions, turn))


def _unchanged(values: Tensor) -> Tensor:
    return values
